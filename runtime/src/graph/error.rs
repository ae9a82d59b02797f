//! What can be wrong with a graph.

use parallax_model::system::Suggestion;

use crate::time::{MAX_RATE, MIN_RATE};

/// What is wrong with a graph, and what to do about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GraphError {
    /// The text is not a graph.
    #[error("this is not a graph in {format}: {problem}")]
    Text {
        /// TOML or JSON.
        format: &'static str,
        /// What the parser says, with line and column.
        problem: String,
    },
    /// There is nothing to run.
    #[error("graph `{graph}` has no nodes; add at least one [[node]]")]
    NoNodes {
        /// The graph.
        graph: String,
    },
    /// A name that topics and files cannot carry.
    #[error("`{name}` cannot name a node: use letters, digits and underscores, starting with a letter")]
    NodeName {
        /// The name.
        name: String,
    },
    /// Two nodes share a name.
    #[error("two nodes are called `{name}`; rename one")]
    DuplicateNode {
        /// The name.
        name: String,
    },
    /// The supervisor is not a node.
    #[error("the supervisor `{name}` is not a node of the graph{suggestion}")]
    UnknownSupervisor {
        /// The name.
        name: String,
        /// The nearest node.
        suggestion: Suggestion,
    },
    /// The program does not know this kind of node.
    #[error(
        "node `{node}` is of kind `{kind}`, which this program does not know{suggestion}; it knows {known}"
    )]
    UnknownKind {
        /// The node.
        node: String,
        /// The kind.
        kind: String,
        /// The nearest kind.
        suggestion: Suggestion,
        /// All kinds.
        known: String,
    },
    /// A node that another program runs, and of which the graph does not say what is needed.
    #[error("node `{node}`: {problem}")]
    External {
        /// The node.
        node: String,
        /// What is missing, or wrong.
        problem: String,
    },
    /// A rate that no node can run at.
    #[error("node `{node}` cannot run at {rate} Hz; a rate lies between {MIN_RATE} and {MAX_RATE} Hz")]
    Rate {
        /// The node.
        node: String,
        /// Its rate, Hz.
        rate: f64,
    },
    /// A delay that no step or message can take.
    #[error("the {what} {problem}")]
    Delay {
        /// Whose delay.
        what: String,
        /// What is wrong with it.
        problem: &'static str,
    },
    /// A node's computation delay follows from a leaf that its output does not have.
    #[error(
        "the computation delay of node `{node}` follows from the leaf `{leaf}`, which its output lacks{suggestion}; its \
         leaves are {known}"
    )]
    DelayLeaf {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
        /// The nearest leaf.
        suggestion: Suggestion,
        /// All leaves of its output.
        known: String,
    },
    /// A safe output names a leaf that the node's output does not have.
    #[error(
        "the safe output of node `{node}` names the leaf `{leaf}`, which its output lacks{suggestion}; its leaves are \
         {known}"
    )]
    SafeLeaf {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
        /// The nearest leaf.
        suggestion: Suggestion,
        /// All leaves of its output.
        known: String,
    },
    /// A safe output leaves a leaf open.
    #[error(
        "the safe output of node `{node}` says nothing about the leaf `{leaf}`; give it a number or \"hold\" (or all \
         others at once: \"*\" = \"hold\")"
    )]
    SafeMissing {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
    },
    /// A safe output that nobody could apply.
    #[error("the safe output of node `{node}` is not a finite number at the leaf `{leaf}`")]
    SafeNotFinite {
        /// The node.
        node: String,
        /// The leaf.
        leaf: String,
    },
    /// A connection's delay cannot follow from an output.
    #[error(
        "the delay of connection {from} -> {to} follows from the output's leaf `{leaf}`; only a node's `computation` can \
         do that. Put it there, or give the connection a distribution"
    )]
    DelayOfOutput {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The leaf.
        leaf: String,
    },
    /// A connection names a node that does not exist.
    #[error("connection {from} -> {to}: there is no node `{name}`{suggestion}")]
    UnknownNode {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The one that does not exist.
        name: String,
        /// The nearest node.
        suggestion: Suggestion,
    },
    /// A connection names an input that the receiver does not have.
    #[error(
        "connection {from} -> {to}: node `{to}` has no input `{port}`{suggestion}; its inputs are {known}. \
         Set `port` on the connection"
    )]
    UnknownPort {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The input.
        port: String,
        /// The nearest input.
        suggestion: Suggestion,
        /// All inputs.
        known: String,
    },
    /// Two connections feed one input.
    #[error("input `{port}` of node `{node}` is fed by both `{first}` and `{second}`; remove one connection")]
    DuplicateConnection {
        /// The receiver.
        node: String,
        /// Its input.
        port: String,
        /// One sender.
        first: String,
        /// The other.
        second: String,
    },
    /// The two ends of a connection disagree about the message.
    #[error("connection {from} -> {to}: `{from}` sends {sent}, but input `{port}` takes {taken}")]
    LayoutMismatch {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The receiver's input.
        port: String,
        /// What is sent.
        sent: String,
        /// What is expected.
        taken: String,
    },
    /// An input that nothing feeds.
    #[error("input `{port}` of node `{node}` is not connected; add a [[connection]] with to = \"{node}\"")]
    Unconnected {
        /// The receiver.
        node: String,
        /// Its input.
        port: String,
    },
    /// A window without room for a message, or for more than a step could ever use.
    #[error("connection {from} -> {to}: a window of {window} messages; it holds 1 to {MAX_WINDOW}")]
    Window {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The window.
        window: usize,
    },
    /// Connections without `skip` that lead back to where they began: no node could start first.
    #[error("{} is a cycle in which no connection has `skip`; set skip = true on one of them", path(.nodes))]
    Cycle {
        /// The nodes along the cycle; the last sends to the first.
        nodes: Vec<String>,
    },
    /// `advance` on a node that has no way of knowing when its inputs are complete.
    #[error(
        "node `{node}` has `advance`, but its connection from `{from}` is not blocking; make it blocking, or remove \
         `advance`"
    )]
    AdvanceNotBlocking {
        /// The node.
        node: String,
        /// The sender that it does not wait for.
        from: String,
    },
    /// `advance` on a node that nothing would ever hold back.
    #[error("node `{node}` has `advance` but no inputs: nothing would hold it back; remove `advance`")]
    AdvanceWithoutInputs {
        /// The node.
        node: String,
    },
    /// A cycle in which every node has `advance`: nothing would tie it to the clock.
    #[error("in the cycle {} every node has `advance`: nothing ties it to the clock; remove one `advance`", path(.nodes))]
    AdvanceCycle {
        /// The nodes along the cycle; the last sends to the first.
        nodes: Vec<String>,
    },
    /// A core that this machine does not have.
    #[error(
        "node `{node}` is to run on core {core}, which does not exist here; this process may use cores {available}"
    )]
    UnknownCore {
        /// The node.
        node: String,
        /// The core.
        core: usize,
        /// The cores there are.
        available: String,
    },
}

/// The widest window.
pub const MAX_WINDOW: usize = 65_536;

fn path(nodes: &[String]) -> String {
    let mut text = nodes.join(" -> ");
    if let Some(first) = nodes.first() {
        text.push_str(" -> ");
        text.push_str(first);
    }
    text
}

/// Something that runs but is probably not meant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GraphWarning {
    /// Several nodes are pinned to one core.
    SharedCore {
        /// The core.
        core: usize,
        /// The nodes on it.
        nodes: Vec<String>,
    },
}

impl std::fmt::Display for GraphWarning {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::SharedCore { core, nodes } => {
                write!(f, "nodes {} share core {core}: they will wait for each other", nodes.join(", "))
            }
        }
    }
}
