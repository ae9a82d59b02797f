//! What happened in one run: every message, and which step of which node consumed it when.
//!
//! A [`Recording`] holds a run in memory. Executors write through a [`RecordingSink`], which is a recording being made
//! ([`MemorySink`]) or a file being written.

mod access;
pub mod cdr;
pub(crate) mod container;
mod convert;
mod description;
mod error;
pub mod follow;
mod join;
pub mod log;
mod packing;
mod reader;
pub mod ros2msg;
mod shape;
mod sink;
mod whole;
mod writer;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::any_number;
use crate::data::Data;
use crate::graph::GraphSpec;
use crate::node::{InputWindow, Layout};
use crate::time::Nanos;

pub use crate::node::Consumed;
pub use access::Access;
pub(crate) use access::claim;
pub use convert::IMPORTED_SIGNAL;
pub(crate) use description::DESCRIPTION;
pub use description::{Description, NodeDescription};
pub use error::RecordingError;
pub use join::{JoinError, join};
pub use packing::Packing;
pub use sink::{MemorySink, NoSink, RecordingSink, SinkError, StepView};
pub use whole::write;
pub use writer::RecordingWriter;

/// The messages and the schedule of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// The graph that ran.
    pub graph: GraphSpec,
    /// The clock that drove it.
    pub clock: Clock,
    /// How long it ran: no step started at or after this time.
    pub duration: Nanos,
    /// One track per node, in the order of the graph.
    pub nodes: Vec<NodeTrack>,
    /// Messages that were sent and never reached a window, with the reason; in the order in which it was noticed.
    pub losses: Vec<Loss>,
    /// Nodes that ended before the run did, and nodes that were started again.
    pub faults: Vec<Fault>,
    /// What was set and reset from outside while the run went on, in the order in which the nodes saw it.
    pub changes: Vec<Change>,
    /// The machine of each node, by node, where the graph ran on several. The times of a node are those of its machine's run
    /// clock; when a message was sent is stated by its receiver, on the receiver's clock.
    pub hosts: BTreeMap<String, String>,
    /// How the clocks of those machines stood to each other, as it was estimated while the run went on.
    pub clocks: Vec<ClockReading>,
    /// When the file that it was read from lacks its end: where it stops. The recording is then only its beginning.
    pub truncated: Option<String>,
}

/// How the clock of another machine stood to one's own, at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClockReading {
    /// The machine that estimated it.
    pub host: String,
    /// The other one.
    pub other: String,
    /// When, on the run clock of `host`, ns.
    pub time: Nanos,
    /// How far the run clock of `other` was ahead of that of `host`, ns.
    pub ahead: Nanos,
    /// `ahead` is no further from the truth than this, ns: it follows from the round trips, whatever the network did.
    pub bound: Nanos,
    /// How much faster the clock of `other` ran, seconds per second.
    pub skew: f64,
    /// `skew` is no further from the truth than this.
    pub skew_bound: f64,
    /// The shortest round trip that this rests on, ns.
    pub round_trip: Nanos,
    /// What the monotonic clock of `other` showed more than that of `host`, ns.
    pub offset: Nanos,
    /// Exchanges so far.
    pub exchanges: u64,
}

/// The clock that drove a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "clock", rename_all = "snake_case", deny_unknown_fields)]
pub enum Clock {
    /// Real time.
    Wall {
        /// The run's common start, nanoseconds since 1970-01-01 UTC.
        start: Nanos,
        /// The machine's name.
        host: String,
        /// The seed of the nodes' random streams.
        seed: u64,
    },
    /// Simulated time. Everything follows from the graph and the seed.
    Simulated {
        /// The seed of all random streams.
        seed: u64,
    },
}

impl Clock {
    /// The seed of the run.
    pub fn seed(&self) -> u64 {
        match self {
            Self::Wall { seed, .. } | Self::Simulated { seed } => *seed,
        }
    }
}

/// What one node did.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeTrack {
    /// The node.
    pub name: String,
    /// The layout of its messages.
    pub layout: Layout,
    /// The leaves of its initial message.
    pub initial: Vec<f64>,
    /// Whether it stands in for hardware: the diagnosis must not read its messages.
    pub stand_in: bool,
    /// What it sent, in order.
    pub messages: Vec<MessageRecord>,
    /// Its steps, in order.
    pub steps: Vec<StepRecord>,
}

impl NodeTrack {
    /// The message with this number.
    pub fn message(&self, seq: u64) -> Option<&MessageRecord> {
        // Step k sends message k, so the place is known unless the recording begins late or has holes.
        match self.messages.get(usize::try_from(seq).ok()?) {
            Some(message) if message.seq == seq => Some(message),
            _ => {
                let place = self.messages.binary_search_by_key(&seq, |message| message.seq).ok()?;
                self.messages.get(place)
            }
        }
    }
}

/// One message as it was sent.
#[derive(Debug, Clone, PartialEq)]
pub struct MessageRecord {
    /// The number of the step that made it.
    pub seq: u64,
    /// When it was sent: the end of that step.
    pub sent: Nanos,
    /// Its leaves.
    pub payload: Vec<f64>,
    /// Its data; empty for kinds without.
    pub data: Data,
}

/// One step as it ran.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StepRecord {
    /// Its number, from 0.
    pub seq: u64,
    /// When it was due, without the shift of earlier overruns: `phase + seq / rate`.
    pub due: Nanos,
    /// When it started.
    pub start: Nanos,
    /// When it ended and its message was sent.
    pub end: Nanos,
    /// What it consumed, one entry per input, in the order in which the kind of node declares them.
    pub inputs: Vec<InputRecord>,
}

/// What one input of one step consumed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputRecord {
    /// The input.
    pub port: String,
    /// The window that the step saw, oldest first.
    pub consumed: Vec<Consumed>,
    /// How many messages left unseen between the last step and this one.
    pub superseded: u64,
}

impl From<&InputWindow> for InputRecord {
    fn from(window: &InputWindow) -> Self {
        Self {
            port: window.port().to_owned(),
            consumed: window.stamps().to_vec(),
            superseded: window.superseded(),
        }
    }
}

/// A message that never reached a window.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    /// The sender.
    pub from: String,
    /// The receiver.
    pub to: String,
    /// The receiver's input.
    pub port: String,
    /// The message.
    pub seq: u64,
    /// When the receiver noticed.
    pub time: Nanos,
    /// Why.
    pub reason: LossReason,
}

/// Why a message was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LossReason {
    /// It was sent and a later one arrived, but it did not.
    Transport,
    /// The receiver was so far behind that there was no room left for it.
    Overflow,
    /// The receiver was down when it was sent, or ended before any step of it saw the message.
    ReceiverDown,
    /// The sender was down when it was to make it: the message was never sent.
    NotSent,
    /// It had the wrong length, or a number that no message can have.
    Malformed,
    /// The connection goes to another machine, and lets only one of so many messages cross.
    HeldBack,
}

impl LossReason {
    /// All reasons.
    pub const ALL: [Self; 6] =
        [Self::Transport, Self::Overflow, Self::ReceiverDown, Self::NotSent, Self::Malformed, Self::HeldBack];

    /// Whether it is a loss at all: what was never sent was not lost, nor was what was held back as asked.
    pub fn is_loss(self) -> bool {
        !matches!(self, Self::NotSent | Self::HeldBack)
    }

    /// The reason in words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Transport => "on the way",
            Self::Overflow => "no room at the receiver",
            Self::ReceiverDown => "the receiver was down",
            Self::NotSent => "never sent: the sender was down",
            Self::Malformed => "malformed",
            Self::HeldBack => "held back: only some cross",
        }
    }
}

/// A node that ended before the run did, that was started again after that, or whose output was replaced.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// The node.
    pub node: String,
    /// When.
    pub time: Nanos,
    /// Why.
    pub kind: FaultKind,
}

/// What went wrong with a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum FaultKind {
    /// Its step returned an error.
    Failed {
        /// The error.
        message: String,
    },
    /// A node that it waited for was dead, and it was told to stop then.
    DeadSender {
        /// The dead node.
        sender: String,
    },
    /// Its process or thread ended.
    Died {
        /// How, as the operating system tells it.
        message: String,
    },
    /// What a step gave was too late, or no numbers: its safe output was sent in its place.
    Replaced {
        /// The step.
        step: u64,
    },
    /// It was started again after it had ended, with a fresh state.
    Restarted {
        /// Its first step since then.
        step: u64,
        /// By how much its ticks are shifted from then on.
        shift: Nanos,
    },
}

/// Something that was set or reset in a node from outside, while it ran.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// The node.
    pub node: String,
    /// The first step that saw it.
    pub step: u64,
    /// When it took effect.
    pub time: Nanos,
    /// Who wanted it.
    pub by: String,
    /// What was changed.
    pub kind: ChangeKind,
}

/// What was changed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ChangeKind {
    /// A parameter got another value.
    Set {
        /// The parameter.
        parameter: String,
        /// Its unit; empty where it has none.
        unit: String,
        /// The value that it had.
        #[serde(with = "any_number::one")]
        old: f64,
        /// The value that it got.
        #[serde(with = "any_number::one")]
        new: f64,
    },
    /// The node's state went back to what it was before its first step.
    Reset,
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { node, step, by, kind, .. } = self;
        match kind {
            ChangeKind::Set { parameter, unit, old, new } => {
                let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
                write!(f, "{node}.{parameter} from {old} to {new}{unit}, from step {step} on, by {by}")
            }
            ChangeKind::Reset => write!(f, "{node} reset before step {step}, by {by}"),
        }
    }
}

impl Recording {
    /// Whether messages from one node to the other went from one machine to another.
    pub fn crosses(&self, from: &str, to: &str) -> bool {
        self.hosts.get(from) != self.hosts.get(to)
    }

    /// The largest bound of an estimate of how the clocks of these nodes' machines stood to each other, made by the receiver's,
    /// ns; `None` where their messages do not cross, or nothing is known.
    pub fn clock_bound(&self, from: &str, to: &str) -> Option<Nanos> {
        let (from, to) = (self.hosts.get(from)?, self.hosts.get(to)?);
        let of = self.clocks.iter().filter(|reading| reading.host == *to && reading.other == *from);
        of.map(|reading| reading.bound).max().filter(|_| from != to)
    }

    /// What the node called `name` did.
    pub fn node(&self, name: &str) -> Option<&NodeTrack> {
        self.nodes.iter().find(|track| track.name == name)
    }
}
