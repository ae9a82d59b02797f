//! Effects that a file adds to the library: an equation with parameters, at a place.
//!
//! ```
//! use parallax_model::system::System;
//!
//! let text = r#"
//! format = 1
//! name = "axis"
//! [inputs]
//! u = { signal = "force" }
//! [state]
//! q = { derivative = "v" }
//! v = { derivative = "u/2" }
//! [outputs]
//! position = { value = "q", unit = "m" }
//! [joints]
//! axis = { position = "q", velocity = "v", inertia = "2" }
//!
//! [effects.magnet]                # an effect of one's own, tried beside those of the library
//! place = "joint:axis"            # or input:NAME, output:NAME
//! adds = "-pull*sin(20*q)"        # to the force of the joint, to the command, to the reading
//! parameters = { pull = { value = 0.0, low = -5.0, high = 5.0, unit = "N" } }
//! "#;
//! let system = System::parse(text, "system.toml")?;
//! assert_eq!(system.own[0].effect.name(), "magnet");
//! assert_eq!(system.parameters[system.own[0].parameters[0].index].name, "pull");
//! # Ok::<(), parallax_model::system::SystemError>(())
//! ```
//!
//! The equation is added to the system at once; at the parameters' values, where it must vanish, it changes nothing. A
//! diagnosis lets them go between `low` and `high`.

use super::System;
use super::error::SystemError;
use super::expression::Expression;
use super::lexer::{is_name_part, is_name_start};
use super::parts::{Entry, Parameter};
use super::table::{Field, Table};
use crate::effect::{Effect, Own, Place, PlaceKind};

/// An effect that the file adds to the library.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnEffect {
    /// The effect, by its name in the file.
    pub effect: Effect,
    /// Where it acts.
    pub place: Place,
    /// Its parameters.
    pub parameters: Vec<OwnParameter>,
    /// What it adds.
    adds: String,
    /// Line of the entry in `system.toml`.
    pub line: usize,
}

/// A parameter of an effect that the file adds.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnParameter {
    /// Index among [`System::parameters`]; its value there is the one at which the effect vanishes.
    pub index: usize,
    /// Smallest value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
}

/// Reads `[effects.NAME]`; its parameters are put to those of the system.
pub(super) fn read<'a>(
    name: &str,
    table: &Table<'a>,
    system: &mut System,
    mut take: impl FnMut(&str, &Field<'a>) -> Result<(), SystemError>,
) -> Result<OwnEffect, SystemError> {
    table.only(&["place", "adds", "parameters"])?;
    let stated = table.needed("place", "say where it acts, such as `place = \"joint:axis\"`")?;
    let place: Place = stated.string()?.parse().map_err(|error| stated.bad(&format!("{error}")))?;
    let known: Vec<&str> = match place.kind {
        PlaceKind::Input => system.inputs.iter().map(|i| i.name.as_str()).collect(),
        PlaceKind::Output => system.outputs.iter().map(|o| o.name.as_str()).collect(),
        PlaceKind::Joint => system.joints.iter().map(|j| j.name.as_str()).collect(),
        _ => return Err(stated.bad("an effect of one's own acts at a joint, an input or an output")),
    };
    if !known.contains(&place.key.as_str()) {
        return Err(stated.bad(&format!("the system has no such place (it has: {})", known.join(", "))));
    }
    if Effect::from_name(name).is_some() {
        return Err(stated.bad(&format!("the library has an effect `{name}` already; choose another name")));
    }
    let adds = table.needed("adds", "say what it adds to the force, the command or the reading")?;
    let text = adds.expression()?.text().to_owned();
    let mut parameters = Vec::new();
    let fields = table.needed("parameters", "name at least one, with `value`, `low` and `high`")?;
    for field in fields.table()?.fields() {
        take(field.key, &field)?;
        let own = field.table()?;
        own.only(&["value", "low", "high", "unit"])?;
        let number = |key, remedy: &str| own.needed(key, remedy)?.number();
        let value = number("value", "write the value at which the effect vanishes")?;
        let (low, high) =
            (number("low", "write its smallest value")?, number("high", "write its largest value")?);
        if !(low < high && (low..=high).contains(&value)) {
            return Err(
                field.bad(&format!("`low` {low} and `high` {high} must hold `value` {value} between them"))
            );
        }
        let unit = own.field("unit").map(|unit| unit.string().map(str::to_owned)).transpose()?;
        system.parameters.push(Parameter {
            name: field.key.into(),
            value,
            unit: unit.unwrap_or_default(),
            calibrate: None,
            std: None,
            line: field.at.line,
        });
        parameters.push(OwnParameter { index: system.parameters.len() - 1, low, high });
    }
    if parameters.is_empty() {
        return Err(fields.bad("an effect needs at least one parameter, with `value`, `low` and `high`"));
    }
    Ok(OwnEffect { effect: Effect::Own(Own::new(name)), place, parameters, adds: text, line: table.at.line })
}

/// Adds the equation to the system's.
pub(super) fn add(system: &mut System, own: &OwnEffect) -> Result<(), SystemError> {
    let (file, line, key) = (system.file.clone(), own.line, own.place.key.as_str());
    let adds = &own.adds;
    let parse =
        |text: String| Expression::parse(&text, &file, line, &format!("effect `{}`", own.effect.name()));
    let plus = |expression: &Expression| parse(format!("({}) + ({adds})", expression.text()));
    match own.place.kind {
        PlaceKind::Joint => {
            let Some(joint) = system.joints.iter().find(|joint| joint.name == key) else { return Ok(()) };
            match joint.entry() {
                Ok(Entry::Let(index)) => {
                    system.lets[index].expression = plus(&system.lets[index].expression)?;
                }
                Ok(Entry::Derivative(state)) => {
                    let inertia = joint.inertia.as_ref().map_or("1", Expression::text);
                    let text = system.states[state].derivative.text();
                    system.states[state].derivative = parse(format!("({text}) + ({adds})/({inertia})"))?;
                }
                Err(reason) => {
                    return Err(SystemError::Toml {
                        at: super::error::Location::new(&file, line),
                        message: format!(
                            "effect `{}` cannot act at joint `{key}`: {reason}",
                            own.effect.name()
                        )
                        .into(),
                    });
                }
            }
        }
        PlaceKind::Output => {
            if let Some(output) = system.outputs.iter_mut().find(|output| output.name == key) {
                // What the sensor reads otherwise stays its text: others look there which state it reads.
                output.value = plus(&output.value)?.shown_as(&output.value);
            }
        }
        _ => {
            let acting = format!("({key} + ({adds}))");
            for one in &mut system.lets {
                one.expression = parse(replaced(one.expression.text(), key, &acting))?;
            }
            for state in &mut system.states {
                if state.derivative.names().any(|name| name == key) {
                    state.derivative = parse(replaced(state.derivative.text(), key, &acting))?;
                }
            }
            for output in &mut system.outputs {
                if output.value.names().any(|name| name == key) {
                    output.value = parse(replaced(output.value.text(), key, &acting))?;
                }
            }
        }
    }
    Ok(())
}

/// The text with another expression for a name.
fn replaced(text: &str, name: &str, by: &str) -> String {
    let mut out = String::with_capacity(text.len() + by.len());
    let mut word = String::new();
    for c in text.chars().chain([' ']) {
        if is_name_part(c) && (!word.is_empty() || is_name_start(c)) {
            word.push(c);
            continue;
        }
        out.push_str(if word == name { by } else { &word });
        word.clear();
        out.push(c);
    }
    out.pop();
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::system::Point;

    fn system(joint: &str, effect: &str) -> String {
        format!(
            "format = 1\nname = \"axis\"\n[parameters]\nM = {{ value = 2.0 }}\n[inputs]\nu = {{ signal = \"u\" }}\n\
             [let]\nf = \"M*u\"\n[state]\nq = {{ derivative = \"v\" }}\nv = {{ derivative = \"f/M\" }}\n[outputs]\n\
             x = {{ value = \"q\", unit = \"m\" }}\n[joints]\naxis = {{ position = \"q\", velocity = \"v\", {joint} }}\n\
             [effects.magnet]\n{effect}\n"
        )
    }

    /// The derivative of v and the output at q = 2, v = 3, u = 5, with the parameter c.
    fn at(joint: &str, effect: &str, c: f64) -> (f64, f64) {
        let text = system(joint, effect);
        let equations = System::parse(&text, "axis.toml").unwrap().equations().unwrap();
        let point = Point { parameters: &[2.0, c], states: &[2.0, 3.0], inputs: &[5.0], time: 0.0 };
        let values = equations.values(&point, &[]);
        (values.derivatives[1], values.outputs[0])
    }

    const C: &str = "parameters = { c = { value = 0.0, low = -9.0, high = 9.0, unit = \"N\" } }";

    #[test]
    fn an_equation_acts_where_it_is_put_and_vanishes_at_its_value() {
        for (joint, place, adds, expected) in [
            ("force = \"f\"", "joint:axis", "c*q", (5.0 + 4.0 * 2.0 / 2.0, 2.0)),
            ("inertia = \"M\"", "joint:axis", "c*q", (5.0 + 4.0 * 2.0 / 2.0, 2.0)),
            ("inertia = \"M\"", "input:u", "c*u^2", (5.0 + 4.0 * 25.0, 2.0)),
            ("inertia = \"M\"", "output:x", "c*v", (5.0, 2.0 + 4.0 * 3.0)),
        ] {
            let effect = format!("place = \"{place}\"\nadds = \"{adds}\"\n{C}");
            assert_eq!(at(joint, &effect, 4.0), expected, "{place}");
            assert_eq!(at(joint, &effect, 0.0), (5.0, 2.0), "{place}");
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let refused = |effect: &str, parts: &[&str]| {
            let text = system("inertia = \"M\"", effect);
            let error =
                System::parse(&text, "axis.toml").and_then(|s| s.equations()).unwrap_err().to_string();
            for part in parts {
                assert!(error.contains(part), "`{error}` lacks `{part}`");
            }
        };
        refused(&format!("place = \"joint:arm\"\nadds = \"c\"\n{C}"), &["axis.toml", "it has: axis"]);
        refused(&format!("place = \"state:q\"\nadds = \"c\"\n{C}"), &["joint, an input or an output"]);
        refused(&format!("place = \"joint:axis\"\n{C}"), &["adds"]);
        refused("place = \"joint:axis\"\nadds = \"1\"\nparameters = {}", &["at least one parameter"]);
        refused(&format!("place = \"joint:axis\"\nadds = \"c*nothing\"\n{C}"), &["`nothing`", "magnet"]);
        let outside = C.replace("value = 0.0", "value = 10.0");
        refused(&format!("place = \"joint:axis\"\nadds = \"c\"\n{outside}"), &["must hold `value` 10"]);
    }

    #[test]
    fn names_are_replaced_as_whole_words() {
        assert_eq!(replaced("u + up*sin(u)/2e3", "u", "(w)"), "(w) + up*sin((w))/2e3");
    }

    #[test]
    fn a_corrected_file_states_what_was_found() {
        let text = system("inertia = \"M\"", &format!("place = \"joint:axis\"\nadds = \"c*q\"\n{C}"));
        let parsed = System::parse(&text, "axis.toml").unwrap();
        let corrected = parsed.corrected(&text, &[("c".into(), 3.5)], &[]).unwrap();
        let again = System::parse(&corrected, "axis.toml").unwrap();
        assert_eq!(again.parameters[1].value, 3.5);
    }
}
