//! Puts names and units into a template.

use std::collections::BTreeSet;

use anyhow::{anyhow, bail};
use parallax_runtime::import::foreign::conversion;
use parallax_runtime::recording::log::{Log, Role, Signal};

use super::template::{ANGLES, LENGTHS, Template};

/// A signal's name and unit.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Named {
    name: String,
    unit: String,
}

impl Named {
    fn new(name: &str, unit: &str) -> Self {
        Self { name: name.into(), unit: unit.into() }
    }
}

impl From<&Signal> for Named {
    fn from(signal: &Signal) -> Self {
        Self::new(&signal.name, &signal.unit)
    }
}

/// What goes into the places of a template.
struct Slots {
    command: Named,
    position: Named,
    speed: Option<Named>,
}

/// The template's text for the signals of a log, or for made-up ones.
pub(super) fn fill(template: Template, name: &str, log: Option<&Log>) -> anyhow::Result<String> {
    let (inside, rate) = match template {
        Template::Axis | Template::Quadrotor => ("m", "m/s"),
        _ => ("rad", "rad/s"),
    };
    let slots = match log {
        Some(log) => of_log(template, log)?,
        None => made_up(template),
    };
    let joints = match log {
        Some(log) if template == Template::Arm => pairs(log),
        _ => [("shoulder", "goal_shoulder"), ("elbow", "goal_elbow")]
            .map(|(joint, goal)| (joint.to_owned(), Named::new(goal, "rad"), Named::new(joint, "rad")))
            .to_vec(),
    };
    if template == Template::Arm && joints.is_empty() {
        bail!(
            "the log has no command and measurement of one joint: their names must share a word, and their units be the same"
        );
    }
    let initial = match (factor(inside, &slots.position.unit), slots.speed.is_some()) {
        (1.0, _) => format!("q = {{ derivative = \"v\", initial = {} }}", quoted(&slots.position.name)),
        _ => "q = { derivative = \"v\" }".to_owned(),
    };
    let speed = slots.speed.clone().unwrap_or_else(|| Named::new("speed", rate));
    let places = [
        ("@name@", escaped(name)),
        ("@initial@", initial),
        ("@command@", quoted(&slots.command.name)),
        ("@command_unit@", escaped(or_one(&slots.command.unit))),
        ("@command_unit_quoted@", quoted(&slots.command.unit)),
        ("@position@", quoted(&slots.position.name)),
        ("@position_unit@", quoted(&slots.position.unit)),
        ("@position_unit_plain@", escaped(or_one(&slots.position.unit))),
        ("@position_value@", value("q", factor(inside, &slots.position.unit))),
        ("@speed@", quoted(&speed.name)),
        ("@speed_unit@", quoted(&speed.unit)),
        ("@speed_value@", value("v", factor(rate, &speed.unit))),
    ];
    let mut text = String::new();
    for line in template.text().lines() {
        if let Some(each) = line.strip_prefix("@each:").and_then(|rest| rest.strip_suffix('@')) {
            for (joint, goal, reading) in &joints {
                let own = [
                    ("@joint@", joint.clone()),
                    ("@goal@", quoted(&goal.name)),
                    ("@reading@", quoted(&reading.name)),
                    ("@unit@", quoted(&reading.unit)),
                ];
                text += &own.iter().fold(each.to_owned(), |line, (place, value)| line.replace(place, value));
                text.push('\n');
            }
            continue;
        }
        let line_of = places.iter().fold(line.to_owned(), |line, (place, value)| line.replace(place, value));
        // A speed that no sensor reads stays as an example.
        if line.contains("@speed@") && slots.speed.is_none() {
            text += "# ";
        }
        text += &line_of;
        text.push('\n');
    }
    if let Some(log) = log {
        text += &beside(log, &text);
    }
    Ok(text)
}

/// The signals of the log that the text does not name, for whoever goes on with it.
fn beside(log: &Log, text: &str) -> String {
    let unused: Vec<&Signal> =
        log.signals.iter().filter(|signal| !text.contains(&quoted(&signal.name))).collect();
    if unused.is_empty() {
        return String::new();
    }
    let mut beside = String::from("\n# The log has these signals, too:\n");
    for Signal { name, role, unit, .. } in unused {
        let unit = if unit.is_empty() { String::new() } else { format!(", {unit}") };
        beside += &format!("# {} ({role}{unit})\n", quoted(name));
    }
    beside
}

fn made_up(template: Template) -> Slots {
    let (command, position) = match template {
        Template::Joint => (Named::new("voltage", "V"), Named::new("angle", "rad")),
        Template::Axis => (Named::new("force", "N"), Named::new("position", "m")),
        Template::Quadrotor => (Named::new("thrust", ""), Named::new("height", "m")),
        _ => (Named::new("command", "V"), Named::new("reading", "V")),
    };
    Slots { command, position, speed: None }
}

fn of_log(template: Template, log: &Log) -> anyhow::Result<Slots> {
    let of = |role: Role| log.signals.iter().filter(move |signal| signal.role == role);
    // What resembles the template's own, or else the first.
    let (positions, speeds): (&[&str], &[&str]) = match template {
        Template::Joint => (&ANGLES, &["rad/s", "deg/s", "rpm", "turn/s"]),
        Template::Axis | Template::Quadrotor => (&LENGTHS, &["m/s", "mm/s", "cm/s"]),
        _ => (&[], &[]),
    };
    let with = |units: &[&str]| of(Role::Measurement).find(|signal| units.contains(&signal.unit.as_str()));
    let speed = with(speeds);
    let other = || of(Role::Measurement).find(|signal| Some(*signal) != speed);
    let position = with(positions).or_else(other).ok_or_else(|| {
        anyhow!(
            "the log has no measurement that a system could be compared with; `parallax info` shows its roles"
        )
    })?;
    let command = of(Role::Command).chain(of(Role::Context)).next().ok_or_else(|| {
        anyhow!("the log has no command that could drive a system; `parallax info` shows its roles")
    })?;
    Ok(Slots { command: command.into(), position: position.into(), speed: speed.map(Named::from) })
}

/// Commands and measurements of one joint: of one unit, with a word in common that no other pair has. A name for
/// expressions, the goal and the reading of each.
pub(super) fn pairs(log: &Log) -> Vec<(String, Named, Named)> {
    let of = |role: Role| log.signals.iter().filter(move |signal| signal.role == role);
    let goals: Vec<&Signal> = of(Role::Command).collect();
    let mut taken = BTreeSet::new();
    let mut pairs: Vec<(String, Named, Named)> = Vec::new();
    for reading in of(Role::Measurement) {
        let own = words(&reading.name);
        let shared = |goal: &&&Signal| {
            let count = words(&goal.name).intersection(&own).count();
            if goal.unit == reading.unit { count } else { 0 }
        };
        let Some(goal) = goals.iter().max_by_key(|goal| shared(goal)).filter(|goal| shared(goal) > 0) else {
            continue;
        };
        // Speeds and torques share words with goals as well; the first of a goal is its own.
        if pairs.iter().any(|(_, other, _)| other.name == goal.name) {
            continue;
        }
        let common = words(&goal.name).intersection(&own).cloned().collect::<Vec<_>>().join("_");
        let mut joint = identifier(&common);
        while !taken.insert(joint.clone()) {
            joint.push('_');
        }
        pairs.push((joint, Named::from(*goal), Named::from(reading)));
    }
    pairs
}

fn words(name: &str) -> BTreeSet<String> {
    let words = name.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_lowercase).collect()
}

/// A name that expressions can use.
fn identifier(text: &str) -> String {
    let name: String = text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if name.starts_with(|c: char| c.is_ascii_alphabetic()) { name } else { format!("joint_{name}") }
}

/// How many `to` one `from` is; 1 where that is not known.
fn factor(from: &str, to: &str) -> f64 {
    conversion(from, to).map_or(1.0, |conversion| conversion.factor)
}

fn value(state: &str, factor: f64) -> String {
    if factor == 1.0 { format!("\"{state}\"") } else { format!("\"{state}*{factor}\"") }
}

fn or_one(unit: &str) -> &str {
    if unit.is_empty() { "1" } else { unit }
}

fn quoted(text: &str) -> String {
    // On one line, whatever the name holds.
    format!("\"{}\"", escaped(text))
}

fn escaped(text: &str) -> String {
    let mut escaped = String::new();
    for c in text.chars() {
        match c {
            '"' | '\\' => escaped.extend(['\\', c]),
            c if c.is_control() => escaped += &format!("\\u{:04X}", c as u32),
            c => escaped.push(c),
        }
    }
    escaped
}
