//! Delays as a recording's stamps tell them.

use std::fmt;

use parallax_runtime::recording::Recording;
use parallax_runtime::time::Nanos;
use serde::Serialize;

/// Whose delay.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub enum Place {
    /// How long a node's steps take: from start to end.
    Computation {
        /// The node.
        node: String,
    },
    /// How long a connection's messages travel: from sent to received.
    Communication {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The receiver's input.
        port: String,
    },
}

impl fmt::Display for Place {
    /// `camera`, `camera->agent`, or `camera->agent.image` where the port has another name than the sender.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Computation { node } => f.write_str(node),
            Self::Communication { from, to, port } if from == port => write!(f, "{from}->{to}"),
            Self::Communication { from, to, port } => write!(f, "{from}->{to}.{port}"),
        }
    }
}

/// The delays at one place, in the order in which they happened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Measured {
    /// Whose.
    pub place: Place,
    /// The delays, ns.
    pub delays: Vec<Nanos>,
    /// Whether a delay follows directly on the one before it: the next step, or the next message.
    pub successive: Vec<bool>,
    /// What the recording holds and the delays do not.
    pub left_out: LeftOut,
}

/// What is not among the delays of one place.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// Messages that no step saw: when they arrived is not recorded.
    pub unseen: usize,
    /// Delays below zero: the two stamps are of clocks that disagree.
    pub negative: usize,
}

/// Collects the computation delay of every node (end − start) and the communication delay of every connection (received −
/// sent, each message once), in the order of the graph, nodes first. Initial messages did not travel and do not count.
///
/// A connection whose receiver does not see every message shows a choice of them: under load those that were quick.
pub fn measured(recording: &Recording) -> Vec<Measured> {
    let nodes = recording.nodes.iter().map(|track| {
        let steps = track.steps.iter().map(|step| (step.seq, step.end - step.start));
        collect(Place::Computation { node: track.name.clone() }, steps.collect(), 0)
    });
    let connections = recording.graph.connections.iter().map(|spec| {
        let port = spec.port();
        let consumed = recording
            .node(&spec.to)
            .into_iter()
            .flat_map(|track| &track.steps)
            .flat_map(|step| &step.inputs)
            .filter(|input| input.port == port)
            .flat_map(|input| &input.consumed);
        // A window shows a message to several steps.
        let mut seen: Vec<(u64, Nanos)> = consumed
            .filter_map(|message| message.seq.map(|seq| (seq, message.received - message.sent)))
            .collect();
        seen.sort_unstable();
        seen.dedup_by_key(|(seq, _)| *seq);
        let sent = recording.node(&spec.from).map_or(0, |track| track.messages.len());
        let place =
            Place::Communication { from: spec.from.clone(), to: spec.to.clone(), port: port.to_owned() };
        let unseen = sent.saturating_sub(seen.len());
        collect(place, seen, unseen)
    });
    nodes.chain(connections).collect()
}

fn collect(place: Place, numbered: Vec<(u64, Nanos)>, unseen: usize) -> Measured {
    let mut left_out = LeftOut { unseen, negative: 0 };
    let (mut delays, mut successive) = (Vec::with_capacity(numbered.len()), Vec::new());
    let mut last = None;
    for (seq, delay) in numbered {
        if delay < 0 {
            left_out.negative += 1;
            continue;
        }
        successive.push(last.is_some_and(|last| last + 1 == seq));
        delays.push(delay);
        last = Some(seq);
    }
    Measured { place, delays, successive, left_out }
}
