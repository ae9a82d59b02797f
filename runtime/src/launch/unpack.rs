//! What the words of a record say: a step with its message, losses, or a change; the other side of [`records`](super::records).

use std::path::PathBuf;

use super::desk::{self, By};
use super::plan::{
    self, CHANGE, CHANGE_WORDS, CONSUMED, INITIAL, INPUT_HEAD, LOSS, LOSS_WORDS, REPLACED, RESET, STEP_HEAD,
};
use crate::channel::Space;
use crate::data::bytes;
use crate::graph::{Graph, NodePlan};
use crate::node::Consumed;
use crate::recording::{
    Change, ChangeKind, Fault, FaultKind, InputRecord, Loss, RecordingError, RecordingWriter, StepRecord,
};
use crate::time::Nanos;
use crate::tuning::{Parameter, Setting};

/// Messages that one record may call lost: more cannot have been under way.
const MOST_LOST: u64 = 1 << 20;
/// What is said of what comes as a record and is none.
pub(super) const NO_RECORD: &str =
    "a record has a form that no record has: somebody wrote into the shared memory of the run";

/// Takes records apart and writes them into files; what it needs for that is kept from one record to the next.
pub(super) struct Unpacker<'a> {
    graph: &'a Graph,
    space: &'a Space,
    /// The latest step of each node.
    steps: Vec<StepRecord>,
    /// The latest payload.
    payload: Vec<f64>,
}

impl<'a> Unpacker<'a> {
    pub(super) fn new(graph: &'a Graph, space: &'a Space) -> Self {
        let input = |&connection: &usize| {
            let port = graph.connections()[connection].port.clone();
            InputRecord { port, consumed: Vec::new(), superseded: 0 }
        };
        let step = |node: &NodePlan| {
            let inputs = node.inputs.iter().map(input).collect();
            StepRecord { seq: 0, due: 0, start: 0, end: 0, inputs }
        };
        let steps = graph.nodes().iter().map(step).collect();
        Self { graph, space, steps, payload: Vec::new() }
    }

    /// Writes one record of a node into a file.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Unwritable`] for what is no record; [`RecordingError::Write`].
    pub(super) fn write(
        &mut self,
        file: &mut RecordingWriter,
        node: usize,
        words: &[u64],
    ) -> Result<(), RecordingError> {
        let (graph, space) = (self.graph, self.space);
        let no_record = || file_refuses(graph, node);
        if words[0] == CHANGE {
            let words = words.get(..CHANGE_WORDS).ok_or_else(no_record)?;
            return file.change(&change(graph, space, node, words));
        }
        if words[0] == LOSS {
            let words = words.get(..LOSS_WORDS).ok_or_else(no_record)?;
            return losses(graph, node, words).try_for_each(|loss| file.loss(&loss));
        }
        let data = self.step(node, words).ok_or_else(no_record)?;
        let step = &self.steps[node];
        if words[0] == REPLACED {
            let node = graph.nodes()[node].name.clone();
            file.fault(&Fault { node, time: step.end, kind: FaultKind::Replaced { step: step.seq } })?;
        }
        file.message_with_data(node, step.seq, step.end, &self.payload, data)?;
        file.step_record(node, step)
    }

    /// Takes in a step and the payload that it sent; gives the data of that.
    fn step<'w>(&mut self, node: usize, words: &'w [u64]) -> Option<&'w [u8]> {
        let (head, mut rest) = words.split_at_checked(STEP_HEAD)?;
        let step = &mut self.steps[node];
        step.seq = head[2];
        [step.due, step.start, step.end] = [head[3], head[4], head[5]].map(|time| time as Nanos);
        for InputRecord { consumed, superseded, .. } in &mut step.inputs {
            let (input, after) = rest.split_at_checked(INPUT_HEAD)?;
            let (stamps, after) = after.split_at_checked(CONSUMED.checked_mul(input[1] as usize)?)?;
            *superseded = input[0];
            consumed.clear();
            consumed.extend(stamps.chunks_exact(CONSUMED).map(|stamp| Consumed {
                seq: (stamp[0] != INITIAL).then_some(stamp[0]),
                sent: stamp[1] as Nanos,
                received: stamp[2] as Nanos,
            }));
            rest = after;
        }
        let kind = &self.graph.nodes()[node].kind;
        let (leaves, rest) = rest.split_at_checked(kind.output().leaves.len())?;
        self.payload.clear();
        self.payload.extend(leaves.iter().map(|word| f64::from_bits(*word)));
        match rest.split_first() {
            Some((length, words)) => bytes(words).get(..usize::try_from(*length).ok()?),
            None => Some(&[]),
        }
    }
}

/// What is said of a record that has not the length that it tells.
fn file_refuses(graph: &Graph, node: usize) -> RecordingError {
    RecordingError::Unwritable {
        path: PathBuf::new(),
        node: graph.nodes()[node].name.clone(),
        what: "a record".into(),
        reason: NO_RECORD.into(),
    }
}

/// The losses that a record tells of, one for each message.
fn losses<'a>(graph: &'a Graph, node: usize, words: &[u64]) -> impl Iterator<Item = Loss> + use<'a> {
    let (input, first, count, time) = (words[2] as usize, words[3], words[4], words[5] as Nanos);
    let reason = plan::reason_of(words[6]);
    let receiver = &graph.nodes()[node];
    let connection = receiver.inputs.get(input).map(|&connection| &graph.connections()[connection]);
    (first..first.saturating_add(count.min(MOST_LOST))).filter_map(move |seq| {
        connection.map(|connection| Loss {
            from: graph.nodes()[connection.from].name.clone(),
            to: receiver.name.clone(),
            port: connection.port.clone(),
            seq,
            time,
            reason,
        })
    })
}

/// What was set or reset.
fn change(graph: &Graph, space: &Space, node: usize, words: &[u64]) -> Change {
    let name = &graph.nodes()[node].name;
    let kind = match words[3] {
        RESET => ChangeKind::Reset,
        parameter => {
            // Seldom, and the node has written it down before its first step.
            let file = space.read(&plan::parameters_file(name)).unwrap_or_default();
            let parameters: Vec<Parameter> = serde_json::from_slice(&file).unwrap_or_default();
            let parameter = usize::try_from(parameter).unwrap_or(usize::MAX);
            let (old, new) = (f64::from_bits(words[4]), f64::from_bits(words[6]));
            desk::describe(&parameters, &Setting { parameter, old, new })
        }
    };
    let by = By::of_word(words[7]).text();
    Change { node: name.clone(), step: words[2], time: words[5] as Nanos, by, kind }
}
