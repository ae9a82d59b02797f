//! What stands in a graph of an estimator, and what can be wrong with it.

use std::collections::BTreeMap;

use parallax_model::filter::{FilterError, Scaling};
use parallax_model::plant::Unfit;
use parallax_model::system::SystemError;
use serde::Deserialize;

/// Why there is no estimator.
#[derive(Debug, thiserror::Error)]
pub enum EstimatorError {
    /// Parameters that are not understood.
    #[error("{0}")]
    Parameters(#[from] serde_json::Error),
    /// There are no equations.
    #[error("no system is given: add `system = \"system.toml\"`, or give the graph a plant")]
    NoSystem,
    /// The file cannot be read.
    #[error("the system {file} cannot be read: {source}")]
    File {
        /// The file.
        file: String,
        /// Why.
        source: std::io::Error,
    },
    /// The equations are not whole.
    #[error(transparent)]
    System(#[from] SystemError),
    /// An effect that cannot act in an estimator.
    #[error(transparent)]
    Effect(#[from] Unfit),
    /// A signal that is no node's leaf.
    #[error(
        "{file}: {what} is bound to the signal `{signal}`; in a graph that has to be NODE.LEAF, a leaf of a node's messages"
    )]
    Signal {
        /// The file.
        file: String,
        /// An input or output.
        what: String,
        /// The signal.
        signal: String,
    },
    /// A name that nothing has.
    #[error("`{table}` names `{name}`; there is {known}")]
    Unknown {
        /// The parameter's table.
        table: &'static str,
        /// The name.
        name: String,
        /// What there is.
        known: String,
    },
    /// A value that is needed.
    #[error("`{table}` has no value for `{name}`: {why}")]
    Missing {
        /// The parameter's table.
        table: &'static str,
        /// Whose value.
        name: String,
        /// What it is for.
        why: &'static str,
    },
    /// A value that makes no sense.
    #[error("`{what}` is {value}; it must be {must}")]
    Value {
        /// The parameter.
        what: String,
        /// Its value.
        value: f64,
        /// What it has to be.
        must: &'static str,
    },
    /// A state whose name no message can carry.
    #[error(
        "the state `{state}` cannot name a leaf of a message (lower-case letters, digits, underscores; not `stamp`): name the \
         leaves by `sends`"
    )]
    Leaf {
        /// The state.
        state: String,
    },
    /// Leaves without values, or the other way round.
    #[error("`sends` has {leaves} leaves and {values} values; each leaf needs one")]
    Sends {
        /// How many leaves.
        leaves: usize,
        /// How many values.
        values: usize,
    },
    /// The filter itself.
    #[error(transparent)]
    Filter(#[from] FilterError),
}

/// What stands in a graph of an estimator.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Settings {
    /// The file of the system, as long as its text is not in the graph.
    pub(crate) system: Option<String>,
    /// The text of the system.
    pub(crate) equations: Option<String>,
    /// Values of parameters, instead of the nominal ones.
    #[serde(default)]
    pub(crate) parameters: BTreeMap<String, f64>,
    /// Standard deviation of the noise of each output, in its unit.
    #[serde(default)]
    pub(crate) noise: BTreeMap<String, f64>,
    /// Density of the white noise that drives a state, in its unit over √s.
    #[serde(default)]
    pub(crate) disturbance: BTreeMap<String, f64>,
    /// Hidden delays by node, s: of a sensor, from what it saw to its stamp; of an actuator, from its stamp to when it acts.
    #[serde(default)]
    pub(crate) delay: BTreeMap<String, f64>,
    /// From the start of a step to when what follows from its estimate acts, s.
    #[serde(default)]
    pub(crate) ahead: f64,
    /// What is believed of the state before the first reading.
    #[serde(default)]
    pub(crate) initial: BTreeMap<String, f64>,
    /// Its standard deviation.
    #[serde(default)]
    pub(crate) std: BTreeMap<String, f64>,
    /// States after whose period the system is the same again.
    #[serde(default)]
    pub(crate) circular: BTreeMap<String, f64>,
    /// Whether it predicts to `ahead`, or tells the filtered state at the time of the newest reading.
    #[serde(default = "yes")]
    pub(crate) predict: bool,
    /// The integrator's step, s.
    #[serde(default = "step")]
    pub(crate) step: f64,
    /// The most steps between readings, and after the last one.
    #[serde(default = "steps")]
    pub(crate) steps: usize,
    /// How many later readings may arrive before one.
    #[serde(default)]
    pub(crate) reorder: usize,
    /// The points of the unscented transform.
    #[serde(default)]
    pub(crate) scaling: Points,
    /// The message, instead of the one that holds everything.
    pub(crate) sends: Option<Sends>,
}

fn yes() -> bool {
    true
}

fn step() -> f64 {
    0.01
}

fn steps() -> usize {
    24
}

/// [`Scaling`], as it stands in a graph.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Points {
    pub(crate) alpha: f64,
    pub(crate) beta: f64,
    pub(crate) kappa: Option<f64>,
}

impl Default for Points {
    fn default() -> Self {
        let Scaling { alpha, beta, kappa } = Scaling::default();
        Self { alpha, beta, kappa }
    }
}

/// A message of somebody else's, such as the one that an agent takes.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Sends {
    /// Its name.
    pub(crate) message: String,
    /// Its leaves.
    pub(crate) leaves: Vec<String>,
    /// What each holds: a leaf of the estimator's own message.
    pub(crate) values: Vec<String>,
}

/// The value for a name in a table, which has to be above zero, or may be zero.
pub(crate) fn check(what: String, value: f64, zero: bool) -> Result<f64, EstimatorError> {
    if value.is_finite() && (value > 0.0 || (zero && value == 0.0)) {
        return Ok(value);
    }
    let must = if zero { "zero or above" } else { "above zero" };
    Err(EstimatorError::Value { what, value, must })
}

/// Whether a table names only what there is.
pub(crate) fn known<'a>(
    table: &'static str,
    given: &BTreeMap<String, f64>,
    names: impl Iterator<Item = &'a str>,
) -> Result<(), EstimatorError> {
    let names: Vec<&str> = names.collect();
    match given.keys().find(|name| !names.contains(&name.as_str())) {
        Some(name) => Err(EstimatorError::Unknown {
            table,
            name: name.clone(),
            known: if names.is_empty() { "none".into() } else { names.join(", ") },
        }),
        None => Ok(()),
    }
}
