//! Parameters and state of a node while it runs: what may be set, seen and reset from outside, between two steps.
//!
//! A node that allows it returns its [`Tuning`] from [`Node::tuning`](crate::node::Node::tuning). A new value takes effect at
//! the start of a step, and the recording says of which: a replay sets the same value at the same step.
//!
//! ```
//! use parallax_runtime::tuning::{Parameter, Tuning};
//!
//! struct Amplifier { gain: f64, low: f64, high: f64 }
//!
//! impl Tuning for Amplifier {
//!     fn parameters(&self) -> Vec<Parameter> {
//!         vec![Parameter::new("gain", "V/rad").at_least(0.0), Parameter::new("low", "V"), Parameter::new("high", "V")]
//!     }
//!     fn value(&self, parameter: usize) -> f64 {
//!         [self.gain, self.low, self.high][parameter]
//!     }
//!     fn set(&mut self, parameter: usize, value: f64) {
//!         *[&mut self.gain, &mut self.low, &mut self.high][parameter] = value;
//!     }
//!     fn settle(&mut self) -> Result<(), String> {
//!         if self.low < self.high { Ok(()) } else { Err("`low` must be below `high`".into()) }
//!     }
//! }
//! ```

use std::fmt;

use parallax_model::system::Suggestion;
use serde::{Deserialize, Serialize};

use crate::recording::{Change, ChangeKind};

/// A parameter that may be set while its node runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Its name, as in the graph where it stands there, too.
    pub name: String,
    /// Its unit; empty where it has none.
    pub unit: String,
    /// The lowest value; `None` for no bound.
    pub low: Option<f64>,
    /// The highest value; `None` for no bound.
    pub high: Option<f64>,
}

impl Parameter {
    /// A parameter without bounds.
    pub fn new(name: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { name: name.into(), unit: unit.into(), low: None, high: None }
    }

    /// With this lowest value.
    #[must_use]
    pub fn at_least(self, low: f64) -> Self {
        Self { low: Some(low), ..self }
    }

    /// With this highest value.
    #[must_use]
    pub fn at_most(self, high: f64) -> Self {
        Self { high: Some(high), ..self }
    }

    /// Above zero.
    #[must_use]
    pub fn positive(self) -> Self {
        self.at_least(f64::MIN_POSITIVE)
    }

    fn takes(&self, value: f64) -> bool {
        value.is_finite()
            && self.low.is_none_or(|low| value >= low)
            && self.high.is_none_or(|high| value <= high)
    }

    /// What values it takes, in words.
    fn range(&self) -> String {
        let low = self.low.map(|low| {
            if low == f64::MIN_POSITIVE { "above 0".to_owned() } else { format!("at least {low}") }
        });
        let high = self.high.map(|high| format!("at most {high}"));
        let both: Vec<String> = low.into_iter().chain(high).collect();
        if both.is_empty() { "finite".into() } else { both.join(" and ") }
    }
}

/// What may be set, seen and reset of a node while it runs.
///
/// [`set`](Self::set), [`settle`](Self::settle), [`read_state`](Self::read_state) and [`reset`](Self::reset) are called on
/// the real-time path, before a step: as long as nothing is refused they must not allocate, lock or wait.
pub trait Tuning {
    /// The parameters, always the same ones in the same order.
    fn parameters(&self) -> Vec<Parameter>;

    /// The value of a parameter.
    fn value(&self, parameter: usize) -> f64;

    /// Takes a value that is finite and within the parameter's bounds.
    fn set(&mut self, parameter: usize, value: f64);

    /// All values that belong together have been set: what follows from them is worked out.
    ///
    /// # Errors
    ///
    /// When they do not fit each other, in words. The old ones are set again then, and settled.
    fn settle(&mut self) -> Result<(), String> {
        Ok(())
    }

    /// The names of the numbers of its state; none where it has no state, or does not show it.
    fn state(&self) -> Vec<String> {
        Vec::new()
    }

    /// Writes its state, a number for each name.
    fn read_state(&self, values: &mut [f64]) {
        let _ = values;
    }

    /// Goes back to the state before the first step. Parameters stay.
    fn reset(&mut self) {}
}

/// Why a parameter or a state cannot be had.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TuningError {
    /// The node allows nothing.
    #[error("node `{node}` has no parameters that can be set while it runs, and shows no state")]
    Closed {
        /// The node.
        node: String,
    },
    /// No such parameter.
    #[error(
        "node `{node}` has no parameter `{parameter}` that can be set while it runs{suggestion} (it has: {known})"
    )]
    Unknown {
        /// The node.
        node: String,
        /// What was asked for.
        parameter: String,
        /// The nearest one.
        suggestion: Suggestion,
        /// All there are.
        known: String,
    },
    /// Another unit than the parameter's. Units are labels: nothing is converted.
    #[error("`{node}.{parameter}` is in {}, not in {given}", named(unit))]
    Unit {
        /// The node.
        node: String,
        /// The parameter.
        parameter: String,
        /// Its unit.
        unit: String,
        /// What was given.
        given: String,
    },
    /// A value that it does not take.
    #[error("`{node}.{parameter}` cannot be {value}: it must be {range}")]
    Range {
        /// The node.
        node: String,
        /// The parameter.
        parameter: String,
        /// The value.
        value: f64,
        /// What it takes.
        range: String,
    },
    /// The node refuses it.
    #[error("node `{node}` refuses: {reason}")]
    Refused {
        /// The node.
        node: String,
        /// What it says.
        reason: String,
    },
    /// No state to be read or reset.
    #[error("node `{node}` has no state that could be reset")]
    Stateless {
        /// The node.
        node: String,
    },
    /// What was written is no assignment.
    #[error(
        "`{text}` is no assignment: it must look like NODE.PARAMETER=VALUE, such as motor.rated=6 or motor.rated=6V"
    )]
    Assignment {
        /// What was written.
        text: String,
    },
}

fn named(unit: &str) -> &str {
    if unit.is_empty() { "no unit" } else { unit }
}

/// A value for a parameter, as somebody gives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Assignment {
    /// The parameter.
    pub parameter: String,
    /// The value.
    pub value: f64,
    /// Its unit, when it was given one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
}

impl Assignment {
    /// Reads `NODE.PARAMETER=VALUE` or `NODE.PARAMETER=VALUE UNIT`; gives the node, too.
    ///
    /// # Errors
    ///
    /// [`TuningError::Assignment`].
    pub fn parse(text: &str) -> Result<(String, Self), TuningError> {
        let wrong = || TuningError::Assignment { text: text.into() };
        let (place, value) = text.split_once('=').ok_or_else(wrong)?;
        let (node, parameter) = place.trim().split_once('.').ok_or_else(wrong)?;
        let value = value.trim();
        // The longest beginning that is a number: units may begin with an e.
        let number = (1..=value.len())
            .rev()
            .filter(|end| value.is_char_boundary(*end))
            .find_map(|end| Some((value[..end].trim_end().parse::<f64>().ok()?, end)));
        let (value, unit) = number.map(|(number, end)| (number, value[end..].trim())).ok_or_else(wrong)?;
        if node.is_empty() || parameter.is_empty() {
            return Err(wrong());
        }
        let unit = (!unit.is_empty()).then(|| unit.to_owned());
        Ok((node.into(), Self { parameter: parameter.into(), value, unit }))
    }
}

impl fmt::Display for Assignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}{}", self.parameter, self.value, self.unit.as_deref().unwrap_or(""))
    }
}

/// A parameter's place among those of its node, the value that it had, and the one that it gets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Setting {
    pub(crate) parameter: usize,
    pub(crate) old: f64,
    pub(crate) new: f64,
}

/// Finds the parameters that are meant, and checks units and bounds.
pub(crate) fn resolve(
    node: &str,
    parameters: &[Parameter],
    assignments: &[Assignment],
) -> Result<Vec<Setting>, TuningError> {
    let (node, names) = (node.to_owned(), || parameters.iter().map(|parameter| parameter.name.as_str()));
    if parameters.is_empty() {
        return Err(TuningError::Closed { node });
    }
    let resolve = |assignment: &Assignment| {
        let (node, name) = (node.clone(), assignment.parameter.clone());
        let Some(place) = parameters.iter().position(|parameter| parameter.name == name) else {
            let suggestion = Suggestion::nearest(&name, names());
            let known = names().collect::<Vec<_>>().join(", ");
            return Err(TuningError::Unknown { node, parameter: name, suggestion, known });
        };
        let parameter = &parameters[place];
        if let Some(given) = assignment.unit.as_ref().filter(|unit| **unit != parameter.unit) {
            let (unit, given) = (parameter.unit.clone(), given.clone());
            return Err(TuningError::Unit { node, parameter: name, unit, given });
        }
        if !parameter.takes(assignment.value) {
            let (value, range) = (assignment.value, parameter.range());
            return Err(TuningError::Range { node, parameter: name, value, range });
        }
        Ok(Setting { parameter: place, old: f64::NAN, new: assignment.value })
    };
    assignments.iter().map(resolve).collect()
}

/// Sets all of these, or none. Allocates nothing unless the node refuses.
pub(crate) fn set_all(tuning: &mut dyn Tuning, settings: &mut [Setting]) -> Result<(), String> {
    for setting in &mut *settings {
        setting.old = tuning.value(setting.parameter);
        tuning.set(setting.parameter, setting.new);
    }
    tuning.settle().inspect_err(|_| {
        // In reverse: the first old value of one that is named twice counts.
        for setting in settings.iter().rev() {
            tuning.set(setting.parameter, setting.old);
        }
        // They fitted before.
        let _ = tuning.settle();
    })
}

/// Makes changes before one step of one node, as a recording or a plan has them; gives them with the values that they
/// replaced. A reset comes before what is set.
///
/// # Errors
///
/// When the node has no such parameter, or refuses.
pub fn apply(
    tuning: Option<&mut (dyn Tuning + '_)>,
    node: &str,
    changes: &[Change],
) -> Result<Vec<Change>, TuningError> {
    if changes.is_empty() {
        return Ok(Vec::new());
    }
    let Some(tuning) = tuning else { return Err(TuningError::Closed { node: node.into() }) };
    let mut made = changes.to_vec();
    let assignments: Vec<Assignment> = changes
        .iter()
        .filter_map(|change| match &change.kind {
            ChangeKind::Set { parameter, new, .. } => {
                Some(Assignment { parameter: parameter.clone(), value: *new, unit: None })
            }
            ChangeKind::Reset => None,
        })
        .collect();
    if assignments.len() < changes.len() {
        if tuning.state().is_empty() {
            return Err(TuningError::Stateless { node: node.into() });
        }
        tuning.reset();
    }
    let parameters = tuning.parameters();
    let mut settings =
        if assignments.is_empty() { Vec::new() } else { resolve(node, &parameters, &assignments)? };
    set_all(tuning, &mut settings).map_err(|reason| TuningError::Refused { node: node.into(), reason })?;
    let mut settings = settings.iter();
    for change in &mut made {
        if let ChangeKind::Set { old, unit, .. } = &mut change.kind
            && let Some(setting) = settings.next()
        {
            *old = setting.old;
            unit.clone_from(&parameters[setting.parameter].unit);
        }
    }
    Ok(made)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Limits([f64; 2]);

    impl Tuning for Limits {
        fn parameters(&self) -> Vec<Parameter> {
            vec![Parameter::new("low", "V").at_least(-5.0), Parameter::new("high", "V").at_most(5.0)]
        }
        fn value(&self, parameter: usize) -> f64 {
            self.0[parameter]
        }
        fn set(&mut self, parameter: usize, value: f64) {
            self.0[parameter] = value;
        }
        fn settle(&mut self) -> Result<(), String> {
            if self.0[0] < self.0[1] { Ok(()) } else { Err("low is not below high".into()) }
        }
    }

    fn set(limits: &mut Limits, texts: &[&str]) -> Result<Vec<Setting>, TuningError> {
        let assignments = texts.iter().map(|text| Ok(Assignment::parse(&format!("n.{text}"))?.1));
        let assignments = assignments.collect::<Result<Vec<_>, _>>()?;
        let mut settings = resolve("n", &limits.parameters(), &assignments)?;
        set_all(limits, &mut settings).map_err(|reason| TuningError::Refused { node: "n".into(), reason })?;
        Ok(settings)
    }

    #[test]
    fn values_are_set_together_or_not_at_all() {
        let mut limits = Limits([-1.0, 1.0]);
        let settings = set(&mut limits, &["low=2", "high=3 V"]).unwrap();
        assert_eq!((limits.0, settings[0].old, settings[1].new), ([2.0, 3.0], -1.0, 3.0));
        let error = set(&mut limits, &["low=4", "low=4.5"]).unwrap_err().to_string();
        assert!(error.contains("low is not below high"), "{error}");
        assert_eq!(limits.0, [2.0, 3.0]);
    }

    #[test]
    fn what_cannot_be_is_said() {
        let mut limits = Limits([-1.0, 1.0]);
        for (text, says) in [
            ("lo=1", "did you mean `low`"),
            ("low=1 A", "is in V, not in A"),
            ("low=-6", "at least -5"),
            ("high=nan", "at most 5"),
            ("high=inf", "at most 5"),
            ("high", "NODE.PARAMETER=VALUE"),
            ("high=V", "NODE.PARAMETER=VALUE"),
        ] {
            let error = set(&mut limits, &[text]).unwrap_err().to_string();
            assert!(error.contains(says), "{error}");
        }
        assert_eq!(limits.0, [-1.0, 1.0]);
        assert!(matches!(resolve("n", &[], &[]), Err(TuningError::Closed { .. })));
    }

    #[test]
    fn an_assignment_is_read_with_its_unit() {
        let parse =
            |text: &str| Assignment::parse(text).map(|(node, a)| (node, a.parameter, a.value, a.unit));
        let read = |value, unit: Option<&str>| {
            Ok(("arm".to_owned(), "a.b".to_owned(), value, unit.map(str::to_owned)))
        };
        assert_eq!(parse("arm.a.b=1e3"), read(1e3, None));
        assert_eq!(parse("arm.a.b = -2.5 N m/A"), read(-2.5, Some("N m/A")));
        assert_eq!(parse("arm.a.b=3eV"), read(3.0, Some("eV")));
        assert!(parse("arm=3").is_err() && parse(".a=3").is_err() && parse("arm.=3").is_err());
    }
}
