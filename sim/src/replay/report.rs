//! What a replay found, node by node.

use std::fmt;

use parallax_runtime::schedule::ScheduleCheck;

/// An output that is not the recorded one.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// The node.
    pub node: String,
    /// Its step.
    pub seq: u64,
    /// The leaf.
    pub leaf: String,
    /// The recorded value.
    pub recorded: f64,
    /// The replayed value.
    pub replayed: f64,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { node, seq, leaf, recorded, replayed } = self;
        write!(f, "step {seq} of node `{node}`: {leaf} is {replayed:?}, recorded was {recorded:?}")
    }
}

/// What the replay of one node found.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeReplay {
    /// The node.
    pub name: String,
    /// Whether its messages were taken from the recording: it stands in for hardware, or does not promise equal bits.
    pub injected: bool,
    /// Steps that ran again; 0 when injected.
    pub steps: u64,
    /// Recorded messages that its steps consumed, each counted once per step that saw it.
    pub consumed: u64,
    /// Steps whose output was not the recorded one, bit for bit.
    pub differing: u64,
    /// The first of them.
    pub first_difference: Option<Difference>,
    /// Whether its recorded schedule follows the rules.
    pub schedule: ScheduleCheck,
}

/// What a replay found.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayReport {
    /// Every node, in the order of the graph.
    pub nodes: Vec<NodeReplay>,
    /// Steps at the end of a cut recording that could not be replayed, because what they consumed or sent lies beyond
    /// the cut. Always 0 for a whole recording.
    pub beyond_cut: u64,
}

impl ReplayReport {
    /// Steps that ran again.
    pub fn steps(&self) -> u64 {
        self.nodes.iter().map(|node| node.steps).sum()
    }

    /// Messages that were consumed again.
    pub fn consumed(&self) -> u64 {
        self.nodes.iter().map(|node| node.consumed).sum()
    }

    /// The nodes whose messages were taken from the recording.
    pub fn injected(&self) -> impl Iterator<Item = &str> {
        self.nodes.iter().filter(|node| node.injected).map(|node| node.name.as_str())
    }

    /// The first difference of the node that comes first in the graph.
    pub fn first_difference(&self) -> Option<&Difference> {
        self.nodes.iter().find_map(|node| node.first_difference.as_ref())
    }

    /// Whether every output was the recorded one, bit for bit, and every recorded step follows the rules.
    pub fn is_exact(&self) -> bool {
        self.nodes.iter().all(|node| node.differing == 0 && node.schedule.deviation.is_none())
    }
}
