//! What can be wrong with a batch.

use parallax_runtime::node::NodeError;

/// Why a batch cannot run.
#[derive(Debug, thiserror::Error)]
pub enum BatchError {
    /// The tables are not of this graph.
    #[error("the compiled graph has {compiled} nodes, the graph {graph}; compile this graph")]
    OtherGraph {
        /// Nodes of the compiled graph.
        compiled: usize,
        /// Nodes of the graph.
        graph: usize,
    },
    /// A node is plain Rust.
    #[error(
        "the kind of node `{node}` is no model: it cannot run in a batch; pin it when compiling and give its outputs"
    )]
    NoModel {
        /// The node.
        node: String,
    },
    /// A node does not start.
    #[error(transparent)]
    Start(#[from] NodeError),
    /// There is no such node.
    #[error("the graph has no node `{node}`")]
    NoNode {
        /// The name.
        node: String,
    },
    /// There is no such leaf.
    #[error("node `{node}` has no {what} `{leaf}`; it has {known}")]
    NoLeaf {
        /// The node.
        node: String,
        /// Parameter or state.
        what: &'static str,
        /// The name.
        leaf: String,
        /// The names that there are.
        known: String,
    },
    /// A list has another length.
    #[error("{found} {what}, expected {expected}")]
    Count {
        /// Of what.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// There is no such episode.
    #[error("there is no episode {episode}; {episodes} were compiled")]
    NoEpisode {
        /// The number.
        episode: u32,
        /// How many there are.
        episodes: usize,
    },
    /// Outputs are given for a node that computes them.
    #[error("node `{node}` computes its outputs; pin it when compiling to give them")]
    NotPinned {
        /// The node.
        node: String,
    },
    /// Outputs of a pinned node are missing.
    #[error("node `{node}` is pinned, but its outputs are not given")]
    NotGiven {
        /// The node.
        node: String,
    },
    /// Too few outputs are given.
    #[error("node `{node}` makes {needed} steps, but outputs of {steps} are given")]
    GivenSteps {
        /// The node.
        node: String,
        /// Steps given.
        steps: usize,
        /// Steps needed.
        needed: usize,
    },
    /// A connection has no trainable delay.
    #[error("`{connection}` is no connection whose delay was compiled as trainable")]
    NotTrainable {
        /// The connection.
        connection: String,
    },
}
