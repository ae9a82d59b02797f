//! What a run tells when it is over.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::event::Event;
use super::link::Crossing;
use crate::recording::{ClockReading, LossReason};
use crate::time::{Nanos, to_seconds};

/// How one node fared, over all its restarts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeReport {
    /// Name of the node.
    pub node: String,
    /// Core that it was pinned to.
    pub core: Option<usize>,
    /// Steps that it made.
    pub steps: u64,
    /// Steps that took longer than a period from when they could begin: due, what they waited for there, the one before over.
    pub overruns: u64,
    /// How much later than it could have a step began: later than both its due time and the arrival of what
    /// it waited for.
    pub lateness: Percentiles,
    /// How long a step took.
    pub computation: Percentiles,
    /// Messages that it sent.
    pub sent: u64,
    /// Messages that it sent, and that did not reach a receiver, counted per receiver.
    pub undelivered: u64,
    /// What became of the messages of each of its inputs.
    pub inputs: Vec<InputReport>,
    /// Messages that were sent to it and lost, by sender.
    pub lost: Vec<(String, u64)>,
    /// Steps that ended after their deadline.
    pub late: u64,
    /// The largest time by which one did, ns.
    pub late_by: Nanos,
    /// Safe outputs that it sent in place of late ones, or of ones that were no numbers.
    pub replaced: u64,
    /// Its outputs that held a NaN or an infinity.
    pub non_finite: Option<NonFinite>,
    /// How often it was started again.
    pub restarts: u64,
    /// How often it gave no sign of life for too long.
    pub hangs: u64,
    /// When it applied the safe outputs of its senders before it ended; `None` when it has no such senders, or did not
    /// come to it.
    pub made_safe: Option<Nanos>,
    /// How it ended.
    pub exit: Exit,
}

/// What became of the messages of one input: `sent = consumed + superseded + in flight + lost + held back`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputReport {
    /// The sender.
    pub from: String,
    /// The input.
    pub port: String,
    /// Messages that the sender sent.
    pub sent: u64,
    /// Messages that at least one step saw.
    pub consumed: u64,
    /// Messages that newer ones pushed out before any step saw them.
    pub superseded: u64,
    /// Messages that were still under way, or waited for a step, when the run ended.
    pub in_flight: u64,
    /// Messages that were lost, by reason. What was [never sent](LossReason::NotSent), or held back, is not among them.
    pub lost: Vec<(LossReason, u64)>,
    /// Messages that the sender was to send and did not, because it was down.
    pub not_sent: u64,
    /// Messages that stayed on their machine, because the connection lets only one of so many cross.
    #[serde(default)]
    pub held_back: u64,
    /// Safe outputs that stood in for messages while the sender was gone.
    pub safe: u64,
}

/// Outputs that were no numbers.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NonFinite {
    /// How many.
    pub count: u64,
    /// The step of the first.
    pub step: u64,
    /// Its leaf.
    pub leaf: String,
}

/// How a node ended.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exit {
    /// In order: the run was over, or it was told to stop.
    #[default]
    Clean,
    /// Its step returned an error or panicked, or it could not be built.
    Failed {
        /// What the node said.
        reason: String,
    },
    /// A node that it waited for is gone, and it was to stop then.
    DeadSender {
        /// That node.
        sender: String,
    },
    /// It gave no sign of life, and was ended.
    Hung {
        /// For how long, ns.
        silent: Nanos,
    },
    /// It died.
    Died {
        /// Its process, when it was one.
        pid: Option<u32>,
        /// Exit status or signal, in words.
        status: String,
    },
}

impl std::fmt::Display for Exit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Exit::Clean => write!(f, "ended in order"),
            Exit::Failed { reason } => write!(f, "failed: {reason}"),
            Exit::DeadSender { sender } => write!(f, "stopped because {sender} is gone"),
            Exit::Hung { silent } => {
                write!(f, "gave no sign of life for {:.2} s and was ended", to_seconds(*silent))
            }
            Exit::Died { pid: Some(pid), status } => write!(f, "process {pid} died ({status})"),
            Exit::Died { pid: None, status } => write!(f, "died ({status})"),
        }
    }
}

/// Why a run ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum End {
    /// The time was over.
    Duration,
    /// Somebody asked: Ctrl-C, or a signal to terminate.
    Signal,
    /// A node ended that others depend on.
    Node {
        /// Its name.
        node: String,
    },
    /// Another machine's run ended, or it is gone.
    Host {
        /// Its name.
        host: String,
        /// Why.
        why: String,
    },
    /// The link to the other machines failed.
    Link {
        /// How.
        problem: String,
    },
}

/// What became of what crossed between this machine and others.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LinkReport {
    /// Every channel that crosses.
    pub crossings: Vec<Crossing>,
    /// How the clocks of the other machines stood to this one's at the end.
    pub clocks: Vec<ClockReading>,
    /// How often another machine was silent for too long.
    pub silences: u64,
    /// How often another machine was started again and took part again.
    #[serde(default)]
    pub rejoined: u64,
    /// How the nodes of other machines ended, as far as they said.
    pub exits: BTreeMap<String, Exit>,
    /// What went wrong with the link.
    pub problem: Option<String>,
}

/// What became of a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingReport {
    /// Its files, in the order of time; each can be read by itself.
    pub files: Vec<PathBuf>,
    /// Their length together.
    pub bytes: u64,
    /// Records that did not reach the recorder, by node: it was behind, or dead.
    pub lost: Vec<(String, u64)>,
    /// Records that reached the recorder and not the disk, by node.
    pub unwritten: Vec<(String, u64)>,
    /// How often the recorder died and was started again.
    pub restarts: u64,
    /// What went wrong last, in words.
    pub problem: Option<String>,
}

impl RecordingReport {
    /// Whether every record is in the files.
    pub fn complete(&self) -> bool {
        self.lost.is_empty() && self.unwritten.is_empty()
    }

    /// What is missing, one sentence each; empty when it is complete and nothing went wrong.
    pub fn warnings(&self) -> Vec<String> {
        let count = |counts: &[(String, u64)]| {
            counts.iter().map(|(node, count)| format!("{count} of {node}")).collect::<Vec<_>>().join(", ")
        };
        let mut warnings = Vec::new();
        if !self.lost.is_empty() {
            warnings.push(format!(
                "the recording has holes: records that did not reach the recorder: {}",
                count(&self.lost)
            ));
        }
        if !self.unwritten.is_empty() {
            warnings.push(format!(
                "the recording has holes: records that could not be written: {}",
                count(&self.unwritten)
            ));
        }
        if self.restarts > 0 {
            warnings.push(format!(
                "the recorder died and was started again ({} times); its file before has no end",
                self.restarts
            ));
        }
        if let Some(problem) = self.problem.as_ref().filter(|_| !self.complete()) {
            warnings.push(format!("the recorder says: {problem}"));
        }
        warnings
    }
}

/// What a run tells when it is over.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunReport {
    /// Name of the graph.
    pub graph: String,
    /// Why the run ended.
    pub end: End,
    /// Length of the run in nanoseconds, from the common start to the order to stop.
    pub duration: Nanos,
    /// Nanoseconds from the call to the common start: making channels, starting and connecting the nodes.
    pub startup: Nanos,
    /// Bytes of shared memory that the run took.
    pub shared_memory: u64,
    /// The nodes, in the graph's order.
    pub nodes: Vec<NodeReport>,
    /// What happened to the nodes while the run went on, in order.
    pub events: Vec<Event>,
    /// Events that are not in the list, because there were too many.
    pub events_omitted: u64,
    /// The link to other machines, if there are some.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<LinkReport>,
    /// The recording, if there is one.
    pub recording: Option<RecordingReport>,
    /// Things worth knowing that hinder nothing, such as shared cores.
    pub warnings: Vec<String>,
}

impl RunReport {
    /// What ended the run before its time, in words: the node, how it ended, and what to look at.
    pub fn failure(&self) -> Option<String> {
        let node = match &self.end {
            End::Node { node } => node,
            End::Host { host, why } => {
                return Some(format!("machine {host}: {why}. The nodes here were stopped in order"));
            }
            End::Link { problem } => return Some(format!("{problem}. The nodes here were stopped in order")),
            End::Duration | End::Signal => return None,
        };
        let exit = self.nodes.iter().find(|report| report.node == *node).map(|report| &report.exit)?;
        Some(format!(
            "node {node}: {exit}. The others were stopped in order, and what was recorded is complete"
        ))
    }

    /// Whether every node ended in order and nothing was lost.
    pub fn clean(&self) -> bool {
        self.recording.as_ref().is_none_or(RecordingReport::complete)
            && self.nodes.iter().all(|n| n.exit == Exit::Clean && n.undelivered == 0 && n.lost.is_empty())
    }
}

/// Percentiles of a duration, in nanoseconds, to within an eighth.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Half of the values are smaller.
    pub p50: Nanos,
    /// 99 of 100 are smaller.
    pub p99: Nanos,
    /// The largest, exactly.
    pub max: Nanos,
}

/// Durations counted in bins whose width grows with the duration, so that counting allocates nothing.
#[derive(Debug, Clone)]
pub(super) struct Histogram {
    counts: Vec<u64>,
    max: Nanos,
}

impl Histogram {
    /// Eight bins for each power of two.
    pub(super) const BINS: usize = 8 * 62;

    /// The counts of the bins, and the largest duration.
    pub(super) fn new(counts: impl IntoIterator<Item = u64>, max: Nanos) -> Self {
        Self { counts: counts.into_iter().collect(), max }
    }

    /// The bin in which a duration of at least 0 is counted.
    #[inline]
    pub(super) fn bin(duration: Nanos) -> usize {
        let value = duration as u64;
        if value < 8 {
            return value as usize;
        }
        let power = 63 - value.leading_zeros() as usize;
        (power - 2) * 8 + ((value >> (power - 3)) & 7) as usize
    }

    /// The smallest duration of a bin.
    fn lower(bin: usize) -> Nanos {
        if bin < 8 { bin as Nanos } else { (8 + bin as Nanos % 8) << (bin / 8 - 1) }
    }

    /// What was counted since `earlier`. The largest duration is known to within an eighth then, unless it is a new one.
    pub(super) fn since(&self, earlier: &Self) -> Self {
        let mut counts = self.counts.clone();
        // Each cell was read by itself, and a count that is behind is no negative one.
        counts.iter_mut().zip(&earlier.counts).for_each(|(now, before)| *now = now.saturating_sub(*before));
        let largest = counts.iter().rposition(|count| *count > 0).map_or(0, Self::lower);
        let max = if self.max > earlier.max { self.max } else { largest };
        Self { counts, max }
    }

    pub(super) fn percentiles(&self) -> Percentiles {
        let total = self.counts.iter().fold(0, |sum: u64, count| sum.saturating_add(*count));
        let at = |share: f64| {
            let wanted = (share * total as f64).ceil() as u64;
            let mut seen: u64 = 0;
            for (bin, count) in self.counts.iter().enumerate() {
                seen = seen.saturating_add(*count);
                if seen >= wanted && *count > 0 {
                    return Self::lower(bin);
                }
            }
            0
        };
        if total == 0 {
            Percentiles::default()
        } else {
            Percentiles { p50: at(0.5), p99: at(0.99), max: self.max }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_bin_holds_its_values_to_an_eighth(value in 0..i64::MAX) {
            let bin = Histogram::bin(value);
            prop_assert!(bin < Histogram::BINS);
            let lower = Histogram::lower(bin);
            prop_assert!(lower <= value && value - lower <= value / 8);
        }

        #[test]
        fn percentiles_are_those_of_the_sorted_values(mut values in prop::collection::vec(0i64..10_000_000_000, 1..200)) {
            let mut counts = vec![0; Histogram::BINS];
            values.iter().for_each(|value| counts[Histogram::bin(*value)] += 1);
            values.sort_unstable();
            let got = Histogram::new(counts, values[values.len() - 1]).percentiles();
            for (share, got) in [(0.5, got.p50), (0.99, got.p99)] {
                let exact = values[(share * values.len() as f64).ceil() as usize - 1];
                prop_assert!(got <= exact && exact - got <= exact / 8);
            }
            prop_assert_eq!(got.max, values[values.len() - 1]);
        }
    }
}
