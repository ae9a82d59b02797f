//! What the launcher and its nodes must agree on: the run's settings, and the channels of a graph.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::Rotate;
use super::link::Placement;
use super::settings::NodeSettings;
use crate::channel::Topic;
use crate::graph::{Graph, GraphSpec, few};
use crate::node::Layout;
use crate::recording::{Access, LossReason, Packing};
use crate::time::Nanos;

/// The file in the run's directory that holds a [`RunFile`].
pub(super) const RUN_FILE: &str = "graph.json";

/// What a node process is told by its launcher.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct RunFile {
    pub(super) graph: GraphSpec,
    pub(super) settings: Settings,
}

/// What holds for all nodes of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Settings {
    pub(super) seed: u64,
    /// No step starts at or after this time.
    pub(super) duration: Option<Nanos>,
    pub(super) recording: bool,
    /// Where the recorder writes, if there is one.
    pub(super) recorder: Option<RecordingPlan>,
    /// How each node is run.
    pub(super) nodes: Vec<NodeSettings>,
    /// Which nodes run here, where they run on several machines.
    pub(super) placement: Option<Placement>,
}

impl Settings {
    /// Whether a node runs on this machine.
    pub(super) fn is_here(&self, node: usize) -> bool {
        self.placement.as_ref().is_none_or(|placement| placement.is_here(node))
    }

    /// Whether this machine keeps a copy of what its nodes record, beside the machine that records all.
    pub(super) fn copies(&self) -> bool {
        self.recorder.is_some() && self.placement.as_ref().is_some_and(|placement| !placement.records_here())
    }

    /// Of how many messages from one node to another one crosses; 1 where the two are on one machine.
    pub(super) fn every(&self, to: usize, from: usize) -> u64 {
        let placement = self.placement.as_ref().filter(|placement| placement.of[to] != placement.of[from]);
        placement.map_or(1, |placement| placement.ways[from].every)
    }
}

/// Where a recording goes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct RecordingPlan {
    pub(super) path: PathBuf,
    pub(super) rotate: Option<Rotate>,
    pub(super) access: Access,
    pub(super) packing: Packing,
}

/// Words before the payload of a message: its number and the time it was sent.
pub(super) const MESSAGE_HEAD: usize = 2;
/// Words before the data of a message: their length in bytes.
pub(super) const DATA_HEAD: usize = 1;
/// Words before the inputs in the record of a step: kind, number of the record, seq, due, start, end.
pub(super) const STEP_HEAD: usize = 6;
/// Words before the messages of an input in the record of a step: superseded, number of messages.
pub(super) const INPUT_HEAD: usize = 2;
/// Words of a message in the record of a step: number, sent, received.
pub(super) const CONSUMED: usize = 3;
/// The number that stands for "initial message".
pub(super) const INITIAL: u64 = u64::MAX;
/// Kinds of records.
pub(super) const STEP: u64 = 0;
pub(super) const LOSS: u64 = 1;
pub(super) const CHANGE: u64 = 2;
/// A step whose output was replaced by the safe one; written like any step.
pub(super) const REPLACED: u64 = 3;
/// Words of the record of a change: kind, number of the record, step, parameter, old value, time, new value, who.
pub(super) const CHANGE_WORDS: usize = 8;
/// In place of a parameter: the state was put back.
pub(super) const RESET: u64 = u64::MAX;
/// Words of the record of a loss: kind, number of the record, input, first, count, time, reason.
pub(super) const LOSS_WORDS: usize = 7;

/// How the reason of a loss is written into a record.
pub(super) fn reason_code(reason: LossReason) -> u64 {
    LossReason::ALL.iter().position(|other| *other == reason).map_or(0, |code| code as u64)
}

/// The reason with this code.
pub(super) fn reason_of(code: u64) -> LossReason {
    LossReason::ALL.get(code as usize).copied().unwrap_or(LossReason::Transport)
}

/// The channel of a node's output.
pub(super) fn output(graph: &Graph, node: usize) -> Topic {
    let plan = &graph.nodes()[node];
    let rate = graph.spec().nodes[node].rate;
    let windows = plan.outputs.iter().map(|&connection| graph.connections()[connection].capacity);
    // A receiver empties its end before each step; while it computes, messages queue here. A quarter of a
    // second is more than a step of a robot may take, and beyond it the oldest are counted as lost.
    let capacity = windows.max().unwrap_or(1);
    let data = plan.kind.data_capacity();
    let queue = match data {
        0 => capacity.max((rate * 0.25) as usize).clamp(8, 8192),
        // Those that a receiver has taken keep their places, too.
        _ => ((rate * 0.25) as usize).clamp(2, few(data)),
    };
    Topic {
        name: plan.name.clone(),
        layout: plan.kind.output().hash(),
        words: message_words(graph, node),
        buffer: queue,
        subscribers: plan.outputs.len(),
        held: if data > 0 { capacity } else { 0 },
    }
}

/// The channel of a node's output on this machine: those who receive it here, and the link where it crosses.
pub(super) fn output_here(graph: &Graph, settings: &Settings, node: usize) -> Topic {
    let topic = output(graph, node);
    let Some(placement) = &settings.placement else { return topic };
    let outputs = &graph.nodes()[node].outputs;
    let here = outputs.iter().filter(|&&connection| placement.is_here(graph.connections()[connection].to));
    Topic { subscribers: here.count() + usize::from(placement.crosses(graph, node)), ..topic }
}

/// The channels of a run on this machine, each with how many may send on it: where it crosses, the link does beside the node.
pub(super) fn channels(graph: &Graph, settings: &Settings) -> Vec<(Topic, usize)> {
    let mut channels = Vec::new();
    for node in 0..graph.nodes().len() {
        let (mut sends, mut records) = (true, settings.recording);
        let (mut crosses, mut records_cross) = (false, false);
        if let Some(placement) = &settings.placement {
            crosses = placement.crosses(graph, node);
            records_cross = placement.records_cross(node);
            sends = placement.is_here(node) || crosses;
            records &= placement.is_here(node) || records_cross;
        }
        if sends {
            channels.push((output_here(graph, settings, node), 1 + usize::from(crosses)));
        }
        if records {
            let topic = self::records(graph, node);
            // The link reads what it sends itself, too; and where it takes records away, a copy may be kept.
            let both = records_cross && (!settings.is_here(node) || settings.copies());
            let subscribers = 1 + usize::from(both);
            channels.push((Topic { subscribers, ..topic }, 1 + usize::from(records_cross)));
        }
    }
    channels
}

/// Words of a message: the head, the leaves, and, for kinds with data, their length in bytes and the room for them.
pub(super) fn message_words(graph: &Graph, node: usize) -> usize {
    let kind = &graph.nodes()[node].kind;
    MESSAGE_HEAD + kind.output().leaves.len() + data_words(kind.data_capacity())
}

/// Words of a message that hold its data.
pub(super) fn data_words(most: usize) -> usize {
    if most == 0 { 0 } else { DATA_HEAD + most.div_ceil(8) }
}

/// How long the recorder may be kept from running, or the disk from writing, before records are lost (s). Three seconds
/// were seen on two cores that compile at the same time.
const RECORDER_SLACK: f64 = 15.0;

/// Bytes of data that may wait for the recorder, by node.
const WAITING_RECORDS: usize = 64 << 20;

/// The channel of a node's records: its steps with their messages, and its losses.
pub(super) fn records(graph: &Graph, node: usize) -> Topic {
    let plan = &graph.nodes()[node];
    let layout = plan.kind.output();
    let inputs = plan.inputs.iter().map(|&connection| &graph.connections()[connection]);
    let data = plan.kind.data_capacity();
    let buffer = ((graph.spec().nodes[node].rate * RECORDER_SLACK) as usize).clamp(64, 32_768);
    let words: usize = inputs.map(|input| INPUT_HEAD + CONSUMED * input.window).sum();
    let description = Layout { name: format!("record of {}", layout.name), leaves: layout.leaves.clone() };
    Topic {
        name: format!("{}/record", plan.name),
        layout: description.hash(),
        words: (STEP_HEAD + words + layout.leaves.len() + data_words(data)).max(LOSS_WORDS.max(CHANGE_WORDS)),
        buffer: WAITING_RECORDS.checked_div(data).map_or(buffer, |most| buffer.min(most.max(8))),
        subscribers: 1,
        held: 0,
    }
}

/// The file in the run's directory with the parameters of a node that may be set.
pub(super) fn parameters_file(node: &str) -> String {
    format!("{node}.parameters")
}

/// The name of a node's wake-up.
pub(super) fn wake(graph: &Graph, node: usize) -> String {
    format!("{}/wake", graph.nodes()[node].name)
}

/// The nodes that a node's messages wake, each once.
pub(super) fn receivers(graph: &Graph, node: usize) -> Vec<usize> {
    let outputs = &graph.nodes()[node].outputs;
    let mut receivers: Vec<usize> =
        outputs.iter().map(|&connection| graph.connections()[connection].to).collect();
    receivers.sort_unstable();
    receivers.dedup();
    receivers
}

/// Shared memory that a run takes, in bytes, roughly.
pub(super) fn memory(graph: &Graph, settings: &Settings) -> u64 {
    // What iceoryx2 keeps for a participant, a wake-up and the files that describe them.
    let fixed = graph.nodes().len() as u64 * 512 * 1024;
    let channels = channels(graph, settings);
    // Where two may send, each has its own memory; the link's grows by powers of two.
    let memory = |(topic, senders): &(Topic, usize)| topic.memory() * if *senders > 1 { 3 } else { 1 };
    fixed + channels.iter().map(memory).sum::<u64>()
}
