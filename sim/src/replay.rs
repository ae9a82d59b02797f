//! Runs the nodes of a recording again, on exactly what they consumed.

mod error;
mod report;

use std::collections::BTreeSet;
use std::fmt;

use parallax_runtime::data::DataSpace;
use parallax_runtime::graph::Graph;
use parallax_runtime::node::{ErasedNode, InputWindow, NodeContext, NodeError, Step};
use parallax_runtime::recording::{Change, Fault, FaultKind, NodeTrack, Recording, StepRecord};
use parallax_runtime::registry::Registry;
use parallax_runtime::schedule::{ScheduleCheck, verify};
use parallax_runtime::tuning::apply;

pub use error::ReplayError;
pub use report::{Difference, NodeReplay, ReplayReport};

/// Builds a node in place of the one that the graph names; `None` leaves that node as it is.
pub type Override = dyn Fn(&NodeContext) -> Option<Result<Box<dyn ErasedNode>, NodeError>>;

/// How to replay.
#[derive(Default)]
pub struct ReplayOptions {
    /// Nodes to run in place of recorded ones. A node that stands in for hardware runs again only if it is overridden;
    /// without that its recorded messages are injected.
    pub overrides: Option<Box<Override>>,
}

impl fmt::Debug for ReplayOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ReplayOptions").field("overrides", &self.overrides.is_some()).finish()
    }
}

/// Replays a recording: every node alone, in recorded order, each step on exactly the messages that it consumed then,
/// with their recorded times. Outputs are compared with the recorded ones bit for bit, and the schedule is fed through
/// the gates that decide schedules, to see whether they decide the same.
///
/// Because every node is given recorded inputs, a node that differs does not make others differ.
///
/// # Errors
///
/// When the recording does not fit together or does not fit the registry.
pub fn replay(
    recording: &Recording,
    registry: &Registry,
    options: &ReplayOptions,
) -> Result<ReplayReport, ReplayError> {
    let graph = recording.graph.validate(registry)?;
    let tracks = tracks(recording, &graph)?;
    let mut report = ReplayReport { nodes: Vec::with_capacity(tracks.len()), beyond_cut: 0 };
    for index in 0..tracks.len() {
        let usable = usable_steps(recording, &graph, &tracks, index)?;
        report.beyond_cut += (tracks[index].steps.len() - usable) as u64;
        let steps = &tracks[index].steps[..usable];
        let mut node = rerun(recording, &graph, &tracks, index, steps, options)?;
        node.schedule = verify(recording, &graph, index, steps);
        report.nodes.push(node);
    }
    Ok(report)
}

/// The tracks in the order of the graph.
pub(crate) fn tracks<'a>(recording: &'a Recording, graph: &Graph) -> Result<Vec<&'a NodeTrack>, ReplayError> {
    let mut tracks = Vec::with_capacity(graph.nodes().len());
    for plan in graph.nodes() {
        let track =
            recording.node(&plan.name).ok_or_else(|| ReplayError::MissingNode { node: plan.name.clone() })?;
        if track.layout != *plan.kind.output() {
            return Err(ReplayError::Layout {
                node: plan.name.clone(),
                recorded: track.layout.to_string(),
                known: plan.kind.output().to_string(),
            });
        }
        let expected = track.layout.leaves.len();
        let initial = std::iter::once((0, track.initial.len()));
        let messages = track.messages.iter().map(|message| (message.seq, message.payload.len()));
        if let Some((seq, found)) = initial.chain(messages).find(|&(_, found)| found != expected) {
            return Err(ReplayError::Payload { node: plan.name.clone(), seq, found, expected });
        }
        tracks.push(track);
    }
    Ok(tracks)
}

/// How many steps of a node can be replayed: all, unless the recording was cut. Checks that they fit together.
pub(crate) fn usable_steps(
    recording: &Recording,
    graph: &Graph,
    tracks: &[&NodeTrack],
    index: usize,
) -> Result<usize, ReplayError> {
    let restarts = restarts(recording, &graph.nodes()[index].name);
    let mut expected = 0;
    for (place, step) in tracks[index].steps.iter().enumerate() {
        // A node that is started again may leave out steps.
        if step.seq > expected && restarts.contains(&step.seq) {
            expected = step.seq;
        }
        let checked = check_step(graph, tracks, index, expected, step);
        expected += 1;
        match checked {
            // Tracks of a cut recording end at different times.
            Err(ReplayError::MissingMessage { .. } | ReplayError::MissingOutput { .. })
                if recording.truncated.is_some() =>
            {
                return Ok(place);
            }
            result => result?,
        }
    }
    Ok(tracks[index].steps.len())
}

/// The steps with which a node was started again.
fn restarts(recording: &Recording, node: &str) -> Vec<u64> {
    let restart = |fault: &Fault| match fault.kind {
        FaultKind::Restarted { step, .. } if fault.node == node => Some(step),
        _ => None,
    };
    recording.faults.iter().filter_map(restart).collect()
}

/// The steps whose output was replaced by the safe one.
fn replaced(recording: &Recording, node: &str) -> BTreeSet<u64> {
    let replaced = |fault: &Fault| match fault.kind {
        FaultKind::Replaced { step } if fault.node == node => Some(step),
        _ => None,
    };
    recording.faults.iter().filter_map(replaced).collect()
}

fn check_step(
    graph: &Graph,
    tracks: &[&NodeTrack],
    index: usize,
    expected: u64,
    step: &StepRecord,
) -> Result<(), ReplayError> {
    let plan = &graph.nodes()[index];
    let node = || plan.name.clone();
    if step.seq != expected {
        return Err(ReplayError::StepOrder { node: node(), expected, found: step.seq });
    }
    let ports = || plan.inputs.iter().map(|&connection| graph.connections()[connection].port.as_str());
    if !step.inputs.iter().map(|input| input.port.as_str()).eq(ports()) {
        let found: Vec<&str> = step.inputs.iter().map(|input| input.port.as_str()).collect();
        return Err(ReplayError::Inputs {
            node: node(),
            step: step.seq,
            found: format!("[{}]", found.join(", ")),
            expected: format!("[{}]", ports().collect::<Vec<_>>().join(", ")),
        });
    }
    for (input, &connection) in step.inputs.iter().zip(&plan.inputs) {
        let sender = tracks[graph.connections()[connection].from];
        for seq in input.consumed.iter().filter_map(|consumed| consumed.seq) {
            if sender.message(seq).is_none() {
                let from = sender.name.clone();
                return Err(ReplayError::MissingMessage { node: node(), step: step.seq, from, seq });
            }
        }
    }
    if tracks[index].message(step.seq).is_none() {
        return Err(ReplayError::MissingOutput { node: node(), step: step.seq });
    }
    Ok(())
}

/// Runs one node again and compares its outputs.
fn rerun(
    recording: &Recording,
    graph: &Graph,
    tracks: &[&NodeTrack],
    index: usize,
    steps: &[StepRecord],
    options: &ReplayOptions,
) -> Result<NodeReplay, ReplayError> {
    let plan = &graph.nodes()[index];
    let track = tracks[index];
    let mut result = NodeReplay {
        name: plan.name.clone(),
        injected: false,
        steps: 0,
        consumed: 0,
        differing: 0,
        first_difference: None,
        schedule: ScheduleCheck::default(),
    };
    let context = graph.context(index, recording.clock.seed());
    let replacement = options.overrides.as_ref().and_then(|overrides| overrides(&context));
    let injected = track.stand_in || plan.kind.is_stand_in() || !plan.kind.is_deterministic();
    let built = match replacement {
        Some(built) => built,
        None if injected => {
            result.injected = true;
            return Ok(result);
        }
        None => plan.kind.build(&context),
    };
    let mut node = built.map_err(|source| ReplayError::Build { node: plan.name.clone(), source })?;

    let mut windows = empty_windows(graph, index);
    let mut output = track.initial.clone();
    let mut room = vec![0; plan.kind.data_capacity()];
    let restarts = restarts(recording, &plan.name);
    let replaced = replaced(recording, &plan.name);
    for step in steps {
        if restarts.contains(&step.seq) {
            // It was started again there, with a fresh state.
            node = options
                .overrides
                .as_ref()
                .and_then(|overrides| overrides(&context))
                .unwrap_or_else(|| plan.kind.build(&context))
                .map_err(|source| ReplayError::Build { node: plan.name.clone(), source })?;
        }
        let changes = changes_before(recording, &plan.name, step.seq);
        apply(node.tuning(), &plan.name, &changes)
            .map_err(|source| ReplayError::Change { step: step.seq, source })?;
        result.consumed += fill_windows(graph, tracks, index, step, &mut windows);
        let view = Step::new(step.seq, step.due, step.start, &windows);
        let mut space = DataSpace::new(&mut room);
        node.step_with_data(&view, &mut output, &mut space).map_err(|source| ReplayError::Failed {
            node: plan.name.clone(),
            step: step.seq,
            source,
        })?;
        let used = space.used();
        result.steps += 1;
        let Some(recorded) = track.message(step.seq) else { continue };
        let used = match (&plan.safe, replaced.contains(&step.seq)) {
            (Some(safe), true) => {
                // What it gave was sent to nobody, and is not recorded: the safe output went over what was sent before.
                let before = track.messages.partition_point(|message| message.seq < step.seq);
                let last = before.checked_sub(1).map_or(&track.initial, |last| &track.messages[last].payload);
                output.copy_from_slice(last);
                safe.write_over(&mut output);
                0
            }
            _ => used,
        };
        let differs = |(a, b): (&f64, &f64)| a.to_bits() != b.to_bits();
        if let Some(leaf) = recorded.payload.iter().zip(&output).position(differs) {
            result.differing += 1;
            result.first_difference.get_or_insert_with(|| Difference {
                node: plan.name.clone(),
                seq: step.seq,
                leaf: track.layout.leaves[leaf].clone(),
                recorded: recorded.payload[leaf],
                replayed: output[leaf],
            });
        } else if let Some((leaf, recorded, replayed)) = data_difference(&recorded.data, &room[..used]) {
            result.differing += 1;
            result.first_difference.get_or_insert_with(|| Difference {
                node: plan.name.clone(),
                seq: step.seq,
                leaf,
                recorded,
                replayed,
            });
        }
    }
    Ok(result)
}

/// What was set and reset in a node before one of its steps.
pub(crate) fn changes_before(recording: &Recording, node: &str, step: u64) -> Vec<Change> {
    let changes = recording.changes.iter().filter(|change| change.step == step && change.node == node);
    changes.cloned().collect()
}

/// What differs between recorded and replayed data: what it is called, and both values.
fn data_difference(recorded: &[u8], replayed: &[u8]) -> Option<(String, f64, f64)> {
    if recorded.len() != replayed.len() {
        return Some(("the length of its data".into(), recorded.len() as f64, replayed.len() as f64));
    }
    let at = recorded.iter().zip(replayed).position(|(a, b)| a != b)?;
    Some((format!("byte {at} of its data"), recorded[at].into(), replayed[at].into()))
}

/// Windows for the inputs of a node, still empty.
pub(crate) fn empty_windows(graph: &Graph, index: usize) -> Vec<InputWindow> {
    let connections = graph.nodes()[index].inputs.iter().map(|&connection| &graph.connections()[connection]);
    connections.map(|plan| InputWindow::new(plan.port.clone(), plan.leaves, plan.window)).collect()
}

/// Fills a node's windows with what a recorded step consumed; gives how many of the messages were sent ones.
pub(crate) fn fill_windows(
    graph: &Graph,
    tracks: &[&NodeTrack],
    index: usize,
    step: &StepRecord,
    windows: &mut [InputWindow],
) -> u64 {
    let mut count = 0;
    for ((window, input), &connection) in
        windows.iter_mut().zip(&step.inputs).zip(&graph.nodes()[index].inputs)
    {
        let from = graph.connections()[connection].from;
        let sender = tracks[from];
        window.clear(input.superseded);
        for &consumed in &input.consumed {
            if let (true, Some(safe)) = (consumed.is_safe_output(), &graph.nodes()[from].safe) {
                // Over the last message that had been sent by then.
                let before = sender.messages.partition_point(|message| message.sent <= consumed.received);
                let last =
                    before.checked_sub(1).map_or(&sender.initial, |last| &sender.messages[last].payload);
                let mut payload = last.clone();
                safe.write_over(&mut payload);
                window.push(consumed, &payload);
                continue;
            }
            match consumed.seq.map(|seq| sender.message(seq)) {
                None => window.push(consumed, &sender.initial),
                Some(Some(message)) => {
                    window.push_with_data(consumed, &message.payload, message.data.clone())
                }
                // `check_step` has found every message.
                Some(None) => continue,
            }
            count += u64::from(consumed.seq.is_some());
        }
    }
    count
}
