//! What happened in a run between two looks at it.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::sample::{InputSample, NodeSample, ThreadSample};
use super::{LiveRun, Sample};
use crate::launch::about::{NodeAbout, Phase};
use crate::launch::ledger::Ledger;
use crate::launch::report::{End, Percentiles};
use crate::launch::settings::Policy;
use crate::recording::LossReason;
use crate::time::{Nanos, SECOND};

/// What happened in a run between two looks at it; times are in nanoseconds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The run.
    pub run: String,
    /// Its graph.
    pub graph: String,
    /// The launcher's process.
    pub launcher: u32,
    /// How far it is.
    pub phase: Phase,
    /// Why it ends, if it does.
    pub end: Option<End>,
    /// Time since the common start.
    pub elapsed: Nanos,
    /// How long it will run, if that is known.
    pub duration: Option<Nanos>,
    /// The time between the two looks: that of all rates and percentiles.
    pub interval: Nanos,
    /// The nodes, in the order of the graph.
    pub nodes: Vec<NodeView>,
    /// The connections, by receiver, in the order of its inputs.
    pub connections: Vec<ConnectionView>,
    /// The recorder, if the run is recorded.
    pub recorder: Option<RecorderView>,
}

/// What a node is at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NodeState {
    /// It has not begun.
    Starting,
    /// It waits until its next step is due.
    Idle,
    /// It is in a step, which could have begun so long ago.
    Stepping {
        /// ns.
        since: Nanos,
    },
    /// It waits for a message.
    Waiting {
        /// The sender.
        sender: String,
    },
    /// It has given no sign of life for longer than its heartbeat allows.
    Silent {
        /// ns.
        since: Nanos,
    },
    /// Its process or thread has ended.
    Gone,
}

/// One node. Rates and percentiles are those of the interval; counts are those of the run so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeView {
    /// Its name.
    pub node: String,
    /// Its kind.
    pub kind: String,
    /// What it is at.
    pub state: NodeState,
    /// Steps a second, as the graph declares them.
    pub declared_rate: f64,
    /// Steps a second, measured from step to step; `None` when fewer than two ended.
    pub rate: Option<f64>,
    /// How much later than it could have a step began.
    pub lateness: Percentiles,
    /// How long a step took.
    pub computation: Percentiles,
    /// Steps so far.
    pub steps: u64,
    /// Messages sent so far.
    pub sent: u64,
    /// Steps that ended after the next one was due.
    pub overruns: u64,
    /// Steps that ended after their deadline.
    pub late: u64,
    /// Of these, in the interval.
    pub late_now: u64,
    /// The largest time by which one did.
    pub late_by: Nanos,
    /// The deadline, if it has one.
    pub deadline: Option<Nanos>,
    /// Safe outputs sent in place of outputs.
    pub replaced: u64,
    /// Outputs that held a NaN or an infinity.
    pub non_finite: u64,
    /// Messages that did not reach a receiver.
    pub undelivered: u64,
    /// How often it was started again.
    pub restarts: u64,
    /// The core that it is pinned to.
    pub core: Option<usize>,
    /// The core that it was on when it was looked at.
    pub on_core: Option<usize>,
    /// Its scheduling policy, as it was asked for.
    pub policy: Policy,
    /// Its priority under a real-time policy.
    pub priority: Option<u8>,
    /// Its process, while it lives.
    pub process: Option<u32>,
    /// Its thread, while it lives.
    pub thread: Option<u32>,
    /// The share of a core that its thread took.
    pub cpu: Option<f64>,
}

/// One connection. Rates and percentiles are those of the interval; counts are those of the run so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConnectionView {
    /// The sender.
    pub from: String,
    /// The receiver.
    pub to: String,
    /// The receiver's input.
    pub port: String,
    /// Whether a step waits for its messages.
    pub blocking: bool,
    /// Messages that arrived, or are known to be lost, a second.
    pub rate: f64,
    /// From the end of the step that made a message to its arrival in the receiver's hands; of messages that a step saw.
    pub delay: Percentiles,
    /// Messages that the last step saw ...
    pub filled: u64,
    /// ... of so many that it may see.
    pub window: usize,
    /// Messages that have arrived and that a later step may see ...
    pub waiting: u64,
    /// ... of so many for which there is room.
    pub capacity: usize,
    /// Messages that the sender has sent.
    pub sent: u64,
    /// Messages that at least one step saw.
    pub consumed: u64,
    /// Messages that newer ones pushed out before any step saw them.
    pub superseded: u64,
    /// Messages that were lost, by reason.
    pub lost: Vec<(LossReason, u64)>,
    /// Messages that were lost in the interval.
    pub lost_now: u64,
    /// Messages that the sender was to send and did not, because it was down.
    pub not_sent: u64,
    /// Messages that stayed on their machine, because the connection lets only one of so many cross.
    pub held_back: u64,
    /// Safe outputs that stood in for messages.
    pub safe: u64,
}

impl ConnectionView {
    /// All messages that were lost.
    pub fn lost_in_all(&self) -> u64 {
        self.lost.iter().fold(0, |sum: u64, (_, count)| sum.saturating_add(*count))
    }
}

/// What the recorder has written down last: about once a second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecorderView {
    /// The files so far.
    pub files: Vec<PathBuf>,
    /// Records that it has taken.
    pub records: u64,
    /// Records that did not reach it.
    pub lost: u64,
    /// Records that reached it and not the disk.
    pub unwritten: u64,
    /// What went wrong last.
    pub problem: Option<String>,
}

impl Snapshot {
    pub(super) fn between(run: &LiveRun, before: &Sample, after: &Sample) -> Self {
        let about = &run.about;
        let nodes = about.nodes.iter().zip(before.nodes.iter().zip(&after.nodes));
        let interval = after.time.saturating_sub(before.time).max(1);
        let mut connections = Vec::new();
        for (node, (earlier, later)) in nodes.clone() {
            for (input, (earlier, later)) in earlier.inputs.iter().zip(&later.inputs).enumerate() {
                connections.push(connection(run, after, node, input, earlier, later, interval));
            }
        }
        let recorder = about.recording.is_some().then(|| recorder(run)).flatten();
        let epoch = run.page.epoch();
        Self {
            run: run.name.id.clone(),
            graph: about.graph.clone(),
            launcher: about.launcher,
            phase: run.phase(),
            end: run.end(),
            elapsed: epoch.map_or(0, |epoch| after.time.saturating_sub(epoch)),
            duration: about.duration,
            interval,
            nodes: nodes
                .map(|(node, (earlier, later))| view(run, node, earlier, later, after.time, interval))
                .collect(),
            connections,
            recorder,
        }
    }
}

fn view(
    run: &LiveRun,
    about: &NodeAbout,
    before: &NodeSample,
    after: &NodeSample,
    now: Nanos,
    interval: Nanos,
) -> NodeView {
    let settings = &about.settings;
    let between = after.ended.saturating_sub(before.ended);
    let made = after.steps.saturating_sub(before.steps);
    let rate = (made > 0 && between > 0 && before.steps > 0)
        .then(|| made as f64 * SECOND as f64 / between as f64)
        // From rest to the first steps: over the whole time.
        .or_else(|| (made > 1).then(|| made as f64 * SECOND as f64 / interval as f64));
    NodeView {
        node: about.name.clone(),
        kind: about.kind.clone(),
        state: state(run, about, after, now),
        declared_rate: about.rate,
        rate,
        lateness: after.lateness.since(&before.lateness).percentiles(),
        computation: after.computation.since(&before.computation).percentiles(),
        steps: after.steps,
        sent: after.sent,
        overruns: after.overruns,
        late: after.late,
        late_now: after.late.saturating_sub(before.late),
        late_by: after.late_by,
        deadline: settings.deadline,
        replaced: after.replaced,
        non_finite: after.non_finite,
        undelivered: after.undelivered,
        restarts: after.starts,
        core: settings.core,
        on_core: after.thread.map(|thread| thread.core),
        policy: settings.policy,
        priority: (settings.policy != Policy::Other).then_some(settings.priority),
        process: after.thread.map(|thread| thread.process),
        thread: after.thread.map(|thread| thread.thread),
        cpu: share(before.thread, after.thread, interval),
    }
}

/// The share of a core that a thread took, if it is the same one.
fn share(before: Option<ThreadSample>, after: Option<ThreadSample>, interval: Nanos) -> Option<f64> {
    let (before, after) = (before?, after?);
    (before.thread == after.thread).then(|| after.run.saturating_sub(before.run) as f64 / interval as f64)
}

fn state(run: &LiveRun, about: &NodeAbout, node: &NodeSample, now: Nanos) -> NodeState {
    if node.thread.is_none() {
        return if node.beat == 0 { NodeState::Starting } else { NodeState::Gone };
    }
    // The clocks of two cores agree to within less than anybody sees.
    let silent = now.saturating_sub(node.beat);
    match node.awaits.checked_sub(1) {
        _ if node.beat == 0 => NodeState::Starting,
        _ if silent > about.settings.heartbeat => NodeState::Silent { since: silent },
        _ if node.stepping > 0 => NodeState::Stepping { since: now.saturating_sub(node.stepping).max(0) },
        Some(input) => match about.inputs.get(input as usize) {
            Some(input) => NodeState::Waiting { sender: run.about.nodes[input.from].name.clone() },
            None => NodeState::Idle,
        },
        None => NodeState::Idle,
    }
}

fn connection(
    run: &LiveRun,
    sample: &Sample,
    node: &NodeAbout,
    input: usize,
    before: &InputSample,
    after: &InputSample,
    interval: Nanos,
) -> ConnectionView {
    let about = &node.inputs[input];
    let count = |sample: &InputSample| -> u64 {
        let lost = sample.lost.iter().filter(|(reason, _)| reason.is_loss());
        lost.fold(0, |sum: u64, (_, count)| sum.saturating_add(*count))
    };
    let delay = after.delay.since(&before.delay);
    let lost = after.lost.iter().filter(|(reason, count)| reason.is_loss() && *count > 0);
    let of = |wanted: LossReason| {
        let found = after.lost.iter().find(|(reason, _)| *reason == wanted);
        found.map_or(0, |(_, count)| *count)
    };
    ConnectionView {
        from: run.about.nodes[about.from].name.clone(),
        to: node.name.clone(),
        port: about.port.clone(),
        blocking: about.blocking,
        rate: after.known.saturating_sub(before.known) as f64 * SECOND as f64 / interval as f64,
        delay: delay.percentiles(),
        filled: after.filled,
        window: about.window,
        waiting: after.waiting,
        capacity: about.capacity,
        sent: sample.nodes[about.from].sent,
        consumed: after.consumed,
        superseded: after.superseded,
        lost: lost.copied().collect(),
        lost_now: count(after).saturating_sub(count(before)),
        not_sent: of(LossReason::NotSent),
        held_back: of(LossReason::HeldBack),
        safe: after.safe,
    }
}

fn recorder(run: &LiveRun) -> Option<RecorderView> {
    let Ledger { files, next, lost, unwritten, problem } = Ledger::look_at(&run.path)?;
    let sum = |counts: &[u64]| counts.iter().sum::<u64>();
    let lost = sum(&lost);
    let records = sum(&next).saturating_sub(lost);
    Some(RecorderView { files, records, lost, unwritten: sum(&unwritten), problem })
}
