//! What to identify, as data.

use parallax_runtime::graph::{ConnectionSpec, Parameters};
use serde::{Deserialize, Serialize};

use crate::compiled::Interpolation;

/// What is to be found, and what it is judged by. See the [module](super).
#[derive(Debug, Clone, PartialEq)]
pub struct Specification {
    /// Nodes that are computed otherwise than they were recorded.
    pub nodes: Vec<Simulated>,
    /// Parameters and first states to be found.
    pub unknowns: Vec<Unknown>,
    /// Hidden delays to be found, each of a connection of the graph or of a new one.
    pub delays: Vec<HiddenDelay>,
    /// New connections whose delays are known: the mean that each states, always the same.
    pub connections: Vec<ConnectionSpec>,
    /// What is compared with the recordings.
    pub outputs: Vec<Output>,
    /// The time that counts, s since the start of each recording: from, to.
    pub span: (f64, f64),
    /// The share of that time, at its end, that no fit sees, from 0 to below 1.
    pub hold_out: f64,
}

impl Default for Specification {
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            unknowns: Vec::new(),
            delays: Vec::new(),
            connections: Vec::new(),
            outputs: Vec::new(),
            span: (0.0, f64::INFINITY),
            hold_out: 0.2,
        }
    }
}

/// A node that is computed otherwise than it was recorded, or that was not there: a simulator.
#[derive(Debug, Clone, PartialEq)]
pub struct Simulated {
    /// The node, one of the graph or a new one.
    pub node: String,
    /// Its kind; absent: the recorded one.
    pub kind: Option<String>,
    /// Its parameters; absent: the recorded ones, or none where the kind is another.
    pub parameters: Option<Parameters>,
    /// Steps a second, from the run's start on, in the place of the recorded times: for simulators. Absent: it steps when
    /// it did.
    pub rate: Option<f64>,
}

/// A number to be found.
#[derive(Debug, Clone, PartialEq)]
pub struct Unknown {
    /// What people call it.
    pub name: String,
    /// What it sets; several are tied to each other.
    pub targets: Vec<Target>,
    /// The least it can be.
    pub low: f64,
    /// The most it can be.
    pub high: f64,
    /// Where the search begins; absent: in the middle, by the transform.
    pub start: Option<f64>,
    /// The scale on which it is searched; absent: [`Transform::suited`] to the bounds.
    pub transform: Option<Transform>,
    /// What is believed of it beforehand.
    pub prior: Option<Prior>,
    /// Its unit, for people.
    pub unit: String,
}

/// A number that a model starts with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// A leaf of a node's parameters.
    Parameter {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
    },
    /// A leaf of a node's first state: another unknown for each recording.
    State {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
    },
}

/// What is believed of a number: a normal distribution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Its mean.
    pub mean: f64,
    /// Its standard deviation.
    pub std: f64,
}

/// The scale on which a number is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transform {
    /// The number itself.
    Linear,
    /// Its logarithm, for what is positive.
    Log,
    /// The logarithm of its odds, for shares between 0 and 1.
    Logit,
}

impl Transform {
    /// The logarithm where the bounds are positive and far apart, else the number itself.
    pub fn suited(low: f64, high: f64) -> Self {
        if low > 0.0 && high > 2.0 * low { Transform::Log } else { Transform::Linear }
    }
}

/// What is to be found of a delay that is another one for every message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scatter {
    /// Mean and standard deviation.
    Normal,
    /// These, and whether delays come in one hump or in two, as a camera's that needs one or two periods of its shutter: two
    /// normal distributions with their shares, where the recordings tell them apart. No other delay may scatter beside it.
    Mixture,
}

/// A delay that no stamp shows: constant over the recordings, unless it scatters.
#[derive(Debug, Clone, PartialEq)]
pub struct HiddenDelay {
    /// What people call it.
    pub name: String,
    /// The sender.
    pub from: String,
    /// The receiver.
    pub to: String,
    /// The receiver's input; absent: the one named like the sender.
    pub port: Option<String>,
    /// The shortest, s.
    pub min: f64,
    /// The longest, s; absent: it is found, [`super::identify`] widens it while the estimate lies near it.
    pub max: Option<f64>,
    /// Where the search begins, s.
    pub start: Option<f64>,
    /// What is believed of it beforehand, s.
    pub prior: Option<Prior>,
    /// How payloads follow; absent: a node that steps when it did sees what lies between two messages, a simulator with a
    /// rate of its own gets whole messages with the time at which each arrives.
    pub interpolation: Option<Interpolation>,
    /// Whether every message takes another time, and which is to be found then. Only where what the receiver sends is compared.
    pub scatter: Option<Scatter>,
    /// How many messages the receiver sees; absent: the connection's window, at least 3 for a simulator that gets whole
    /// messages.
    pub window: Option<usize>,
}

/// A recorded leaf that predictions are compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// The node that sent it; its prediction is computed at the times of its steps.
    pub node: String,
    /// The leaf.
    pub leaf: String,
    /// Standard deviation of its noise; absent: estimated.
    pub noise: Option<f64>,
    /// The period of an angle that wraps.
    pub wrap: Option<f64>,
    /// Absent of all: the leaf itself is the prediction. Else the prediction is a sum of leaves of the node, each times a
    /// coefficient that is solved for.
    pub linear: Vec<Term>,
}

/// One summand of a linear prediction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Term {
    /// What people call the coefficient. `NODE.PARAMETER` names the parameter of the graph that it sets.
    pub name: String,
    /// The leaf that it multiplies; absent: 1.
    pub leaf: Option<String>,
}
