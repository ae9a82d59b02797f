//! Why a recording cannot be replayed.

use parallax_runtime::graph::GraphError;
use parallax_runtime::node::NodeError;
use parallax_runtime::tuning::TuningError;

/// Why a recording cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// Its graph is not one that this program can run: most often it does not know a kind of node.
    #[error("the recorded graph cannot be run: {0}")]
    Graph(#[from] GraphError),
    /// It lacks a node of its own graph.
    #[error("the recording has no track of node `{node}`, which its graph names; record the run again")]
    MissingNode {
        /// The node.
        node: String,
    },
    /// Its messages have another layout than the kind of node has in this program.
    #[error(
        "node `{node}` sent {recorded}, but its kind sends {known} in this program; replay with the program that recorded"
    )]
    Layout {
        /// The node.
        node: String,
        /// The recorded layout.
        recorded: String,
        /// The layout of the kind.
        known: String,
    },
    /// A step consumed a message that the recording does not hold.
    #[error(
        "step {step} of node `{node}` consumed message {seq} of `{from}`, which the recording does not hold"
    )]
    MissingMessage {
        /// The receiver.
        node: String,
        /// Its step.
        step: u64,
        /// The sender.
        from: String,
        /// The message.
        seq: u64,
    },
    /// A step's output is not in the recording.
    #[error("node `{node}` made step {step}, but the recording does not hold the message that it sent")]
    MissingOutput {
        /// The node.
        node: String,
        /// Its step.
        step: u64,
    },
    /// Steps are not recorded in order, from 0, without holes.
    #[error(
        "node `{node}`: step {found} is recorded where step {expected} belongs: the recorder could not keep up and lost the steps between, or the file is damaged; record again on a machine with less load"
    )]
    StepOrder {
        /// The node.
        node: String,
        /// The step that belongs there.
        expected: u64,
        /// The step that is there.
        found: u64,
    },
    /// A step's inputs are not those of its kind of node.
    #[error("step {step} of node `{node}` has the inputs {found}, but its kind has {expected}")]
    Inputs {
        /// The node.
        node: String,
        /// Its step.
        step: u64,
        /// The recorded inputs.
        found: String,
        /// The inputs of the kind.
        expected: String,
    },
    /// A message has another number of leaves than its layout.
    #[error(
        "message {seq} of node `{node}` has {found} leaves, but its layout has {expected}; the recording is damaged"
    )]
    Payload {
        /// The sender.
        node: String,
        /// The message.
        seq: u64,
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// A node could not be built.
    #[error("node `{node}` cannot be built: {source}")]
    Build {
        /// The node.
        node: String,
        /// Why.
        source: NodeError,
    },
    /// A node does not take what was set in it while it was recorded.
    #[error("before step {step}: {source}")]
    Change {
        /// The step.
        step: u64,
        /// Why.
        source: TuningError,
    },
    /// A step that was recorded fails now.
    #[error("step {step} of node `{node}` fails in the replay, but did not in the recording: {source}")]
    Failed {
        /// The node.
        node: String,
        /// Its step.
        step: u64,
        /// Why.
        source: NodeError,
    },
}
