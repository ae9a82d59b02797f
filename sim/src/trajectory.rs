//! What the models of a recorded run went through: the state before every step, and the noise that it drew.

use parallax_runtime::graph::Graph;
use parallax_runtime::node::{ErasedNode, Step};
use parallax_runtime::recording::{NodeTrack, Recording};
use parallax_runtime::registry::Registry;
use parallax_runtime::tuning::apply;

use crate::replay::{ReplayError, changes_before, empty_windows, fill_windows, tracks, usable_steps};

/// What one model node went through, step by step.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeTrajectory {
    /// The node.
    pub name: String,
    /// Its place in the graph.
    pub node: usize,
    /// How many steps it made.
    pub steps: usize,
    /// The leaves of its parameters before the first step.
    pub params: Vec<f64>,
    /// The leaves of its state before every step, and after the last: `[steps + 1][leaf]`.
    pub states: Vec<f64>,
    /// The standard normal numbers of every step, `[steps][number]`.
    pub noise: Vec<f64>,
    /// The leaves of every output, `[steps][leaf]`.
    pub outputs: Vec<f64>,
    /// Steps whose output is not the recorded one, bit for bit.
    pub differing: u64,
}

impl NodeTrajectory {
    /// The state before step `step`, or after the last one.
    ///
    /// # Panics
    ///
    /// When there is no such step.
    pub fn state(&self, step: usize) -> &[f64] {
        let width = self.states.len() / (self.steps + 1);
        &self.states[step * width..(step + 1) * width]
    }
}

/// Runs the nodes of a recording again that are models, each step on exactly what it consumed then, and writes down what
/// they went through. Nodes that are plain Rust are left out. A model that stands in for hardware runs again as well: if
/// the recording is of hardware, or of another program, [`differing`](NodeTrajectory::differing) tells.
///
/// A run under the simulated clock is recorded first: [`Executor::record`](crate::Executor::record).
///
/// # Errors
///
/// As [`replay`](crate::replay()).
pub fn trajectories(recording: &Recording, registry: &Registry) -> Result<Vec<NodeTrajectory>, ReplayError> {
    let graph = recording.graph.validate(registry)?;
    let tracks = tracks(recording, &graph)?;
    let mut found = Vec::new();
    for (index, plan) in graph.nodes().iter().enumerate() {
        if plan.kind.node_model().is_some() {
            found.push(trajectory(recording, &graph, &tracks, index)?);
        }
    }
    Ok(found)
}

fn trajectory(
    recording: &Recording,
    graph: &Graph,
    tracks: &[&NodeTrack],
    index: usize,
) -> Result<NodeTrajectory, ReplayError> {
    let plan = &graph.nodes()[index];
    let usable = usable_steps(recording, graph, tracks, index)?;
    let mut result = NodeTrajectory {
        name: plan.name.clone(),
        node: index,
        steps: usable,
        params: Vec::new(),
        states: Vec::new(),
        noise: Vec::new(),
        outputs: Vec::new(),
        differing: 0,
    };
    let Some(kind) = plan.kind.node_model() else { return Ok(result) };
    let context = graph.context(index, recording.clock.seed());
    let mut node =
        kind.node(&context).map_err(|source| ReplayError::Build { node: plan.name.clone(), source })?;
    result.params.extend_from_slice(node.params());
    let mut windows = empty_windows(graph, index);
    let mut output = tracks[index].initial.clone();
    for step in &tracks[index].steps[..usable] {
        let changes = changes_before(recording, &plan.name, step.seq);
        apply(node.tuning(), &plan.name, &changes)
            .map_err(|source| ReplayError::Change { step: step.seq, source })?;
        fill_windows(graph, tracks, index, step, &mut windows);
        result.states.extend_from_slice(node.state());
        let view = Step::new(step.seq, step.due, step.start, &windows);
        node.step_into(&view, &mut output).map_err(|source| ReplayError::Failed {
            node: plan.name.clone(),
            step: step.seq,
            source,
        })?;
        result.noise.extend_from_slice(node.noise());
        result.outputs.extend_from_slice(&output);
        let recorded = tracks[index].message(step.seq);
        let same = |payload: &[f64]| payload.iter().zip(&output).all(|(a, b)| a.to_bits() == b.to_bits());
        result.differing += u64::from(!recorded.is_some_and(|message| same(&message.payload)));
    }
    result.states.extend_from_slice(node.state());
    Ok(result)
}
