//! What a run under the simulated clock comes to, and why it may not.

use parallax_runtime::node::NodeError;
use parallax_runtime::recording::{Fault, SinkError};
use parallax_runtime::schedule::{Account, GateError};
use parallax_runtime::time::Nanos;
use parallax_runtime::tuning::TuningError;

use crate::changes::ChangesError;

/// Why a graph could not be run under the simulated clock.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// A node could not be built.
    #[error("node `{node}` cannot be built: {source}")]
    Build {
        /// The node.
        node: String,
        /// Why.
        source: NodeError,
    },
    /// The recording could not be written.
    #[error(transparent)]
    Sink(#[from] SinkError),
    /// The executor and a gate disagree: a fault of this program, not of the graph.
    #[error("the schedule of node `{node}` broke at {time} ns, please report this: {source}")]
    Gate {
        /// The node.
        node: String,
        /// When.
        time: Nanos,
        /// How.
        source: GateError,
    },
    /// Real time cannot be scaled by this.
    #[error("a real-time factor of {factor} is not possible; it has to be a positive number")]
    RealTimeFactor {
        /// The factor.
        factor: f64,
    },
    /// What is planned to be changed does not fit the graph.
    #[error(transparent)]
    Changes(#[from] ChangesError),
    /// A node does not take what is planned to be changed in it.
    #[error("before step {step}: {source}")]
    Change {
        /// The step.
        step: u64,
        /// Why.
        source: TuningError,
    },
    /// Nothing can run for this long.
    #[error("a duration of {duration} ns is not possible; it has to be positive")]
    Duration {
        /// The duration.
        duration: Nanos,
    },
}

/// What a run came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// Steps that ran to their end.
    pub steps: u64,
    /// Where the messages of each connection are, in the order of the graph.
    pub connections: Vec<ConnectionAccount>,
    /// Nodes that ended before the run did.
    pub faults: Vec<Fault>,
    /// Changes that were planned for steps that were never made.
    pub changes_left: usize,
    /// When a node said that the run is over ([`NodeError::Over`]): it took so long, and no longer.
    pub over: Option<Nanos>,
}

/// Where the messages of one connection are at the end of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionAccount {
    /// The connection, `from->to`.
    pub connection: String,
    /// Messages sent into it.
    pub sent: u64,
    /// Messages under way, or arrived and not yet seen.
    pub in_flight: u64,
    /// The rest.
    pub account: Account,
}
