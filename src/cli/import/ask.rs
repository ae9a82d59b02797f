//! Asks a person on a terminal what no file can say.

use std::io::{BufRead, Write};
use std::path::PathBuf;

use parallax_runtime::import::foreign::{Choice, Clock, Found, Plan, Series, conversion};
use parallax_runtime::recording::log::Role;

use super::show::suggested;
use crate::cli::failure::{Failure, Sort};
use crate::cli::output;

/// Who answers.
pub(super) trait Person {
    /// The answer to a question, without blanks around it; `None` when there will be none.
    fn answer(&mut self, question: &str) -> std::io::Result<Option<String>>;
}

/// The person at the terminal.
pub(super) struct Terminal;

impl Person for Terminal {
    fn answer(&mut self, question: &str) -> std::io::Result<Option<String>> {
        let mut out = std::io::stdout();
        write!(out, "{question} ")?;
        out.flush()?;
        let mut line = String::new();
        let read = std::io::stdin().lock().read_line(&mut line)?;
        Ok((read > 0).then(|| line.trim().to_owned()))
    }
}

/// Asks until all is said; `None` when the person goes away.
pub(super) fn plan(
    found: &[Found],
    mut plan: Plan,
    person: &mut dyn Person,
    out: &mut Option<PathBuf>,
) -> Result<Option<Plan>, Failure> {
    output::line("\nAn empty answer takes what stands in brackets; `none` takes none.");
    let unknown = |plan: &Plan| {
        let clocks = || found.iter().flat_map(|found| &found.groups).flat_map(|group| &group.clocks);
        clocks().find(|clock| plan.rate.is_none() && clock.is_numeric() && clock.unit.is_none()).cloned()
    };
    if let Some(clock) = unknown(&plan).filter(|_| plan.time_unit.is_none()) {
        let Some(unit) = time_unit(&clock, person)? else { return Ok(None) };
        plan.time_unit = Some(unit);
    }
    for (role, question) in [
        (Role::Command, "Which signals was the machine told to follow (commands)?"),
        (Role::Measurement, "Which did sensors read (measurements)?"),
        (Role::Context, "Which are circumstances, such as a battery's voltage (context)?"),
        (Role::Reference, "Which was a controller aiming at (references)?"),
    ] {
        let open = |name: &String| !plan.choices.iter().any(|choice| choice.series == *name);
        let offered: Vec<String> = suggested(found, role).into_iter().filter(open).collect();
        let Some(names) = names(found, &plan, question, &offered, person)? else { return Ok(None) };
        plan.choices.extend(names.into_iter().map(|series| Choice {
            name: series.clone(),
            series,
            role,
            unit: None,
            scale: 1.0,
        }));
    }
    for index in 0..plan.choices.len() {
        let series = parallax_runtime::import::foreign::series(found, &plan.choices[index].series).input()?;
        let Some(unit) = unit(series, person)? else { return Ok(None) };
        plan.choices[index].unit = unit;
    }
    if out.is_none() {
        let place = super::chosen::place(&found.iter().map(|found| found.path.clone()).collect::<Vec<_>>());
        let Some(answer) = person.answer(&format!("Into which folder? [{}]", place.display())).input()?
        else {
            return Ok(None);
        };
        *out = Some(if answer.is_empty() { place } else { answer.into() });
    }
    Ok(Some(plan))
}

fn time_unit(
    clock: &Clock,
    person: &mut dyn Person,
) -> Result<Option<parallax_runtime::import::foreign::TimeUnit>, Failure> {
    loop {
        let question = format!(
            "The time `{}` goes in steps of {}: s, ms, us or ns?",
            clock.name,
            output::number(clock.step())
        );
        let Some(answer) = person.answer(&question).input()? else { return Ok(None) };
        match answer.parse() {
            Ok(unit) => return Ok(Some(unit)),
            Err(error) => output::line(format!("  {error}")),
        }
    }
}

fn names(
    found: &[Found],
    plan: &Plan,
    question: &str,
    offered: &[String],
    person: &mut dyn Person,
) -> Result<Option<Vec<String>>, Failure> {
    let default = if offered.is_empty() { "none".to_owned() } else { offered.join(", ") };
    loop {
        let Some(answer) = person.answer(&format!("{question} [{default}]")).input()? else {
            return Ok(None);
        };
        if answer.is_empty() {
            return Ok(Some(offered.to_vec()));
        }
        if answer == "none" {
            return Ok(Some(Vec::new()));
        }
        let named = answer.split([',', ' ']).map(str::trim).filter(|name| !name.is_empty()).map(|name| {
            let series =
                parallax_runtime::import::foreign::series(found, name).map_err(|error| error.to_string())?;
            if plan.choices.iter().any(|choice| choice.series == series.name) {
                return Err(format!("`{name}` has a role already"));
            }
            Ok(series.name.clone())
        });
        match named.collect::<Result<Vec<_>, _>>() {
            Ok(names) => return Ok(Some(names)),
            Err(error) => output::line(format!("  {error}")),
        }
    }
}

/// The unit that a series is to have; `Some(None)` for the one that it has.
fn unit(series: &Series, person: &mut dyn Person) -> Result<Option<Option<String>>, Failure> {
    // What a model is written in, of the units that people log in.
    let usual = ["rad", "rad/s", "rad/s^2", "m", "m/s", "m/s^2", "V", "A", "N m", "N"];
    let better = usual.into_iter().find(|to| *to != series.unit && conversion(&series.unit, to).is_some());
    let question = match (series.unit.as_str(), better) {
        ("", _) => format!("Unit of {}? [none]", series.name),
        (unit, Some(better)) if !usual.contains(&unit) => {
            format!("{} is in {unit}. Convert it to {better}, or to what? [{better}]", series.name)
        }
        _ => return Ok(Some(None)),
    };
    loop {
        let Some(answer) = person.answer(&question).input()? else { return Ok(None) };
        let wanted = match answer.as_str() {
            "" if series.unit.is_empty() => return Ok(Some(None)),
            "" => better.unwrap_or_default().to_owned(),
            "none" => return Ok(Some(None)),
            unit => unit.to_owned(),
        };
        if series.unit.is_empty() || series.unit == wanted || conversion(&series.unit, &wanted).is_some() {
            return Ok(Some(Some(wanted)));
        }
        output::line(format!("  {} is not converted to {wanted}", series.unit));
    }
}
