//! A recording as numpy arrays.

use std::path::PathBuf;

use parallax_runtime::recording::{InputRecord, NodeTrack, Recording};
use parallax_sim::NodeTrajectory;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{array, list};
use crate::error::raise;

/// Reads a recording (MCAP). Times are int64 nanoseconds since the run's start; seq −1 marks an initial message.
#[pyfunction]
pub(crate) fn load(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let recording = py.detach(|| Recording::read(&path)).map_err(raise)?;
    let result = PyDict::new(py);
    result.set_item("graph", recording.graph.to_json())?;
    result.set_item("clock", serde_json::to_string(&recording.clock).map_err(raise)?)?;
    result.set_item("duration", recording.duration)?;
    result.set_item("truncated", &recording.truncated)?;
    result.set_item("losses", serde_json::to_string(&recording.losses).map_err(raise)?)?;
    result.set_item("faults", serde_json::to_string(&recording.faults).map_err(raise)?)?;
    let nodes = recording.nodes.iter().map(|track| node(py, track)).collect::<PyResult<Vec<_>>>()?;
    result.set_item("nodes", PyList::new(py, nodes)?)?;
    Ok(result)
}

/// The data of all messages of a node of a recording, such as its pictures: bytes, one array for each message.
#[pyfunction]
pub(crate) fn data<'py>(py: Python<'py>, path: PathBuf, node: &str) -> PyResult<Bound<'py, PyList>> {
    let recording = py.detach(|| Recording::read(&path)).map_err(raise)?;
    let track = recording.node(node).ok_or_else(|| {
        let known: Vec<&str> = recording.nodes.iter().map(|track| track.name.as_str()).collect();
        raise(format!("the recording has no node `{node}`; it has {}", known.join(", ")))
    })?;
    PyList::new(py, track.messages.iter().map(|message| list(py, message.data.to_vec())))
}

/// What the models of a recorded run went through: per node `params` `[leaf]`, `states` `[step + 1, leaf]`, `noise`
/// `[step, number]`, `outputs` `[step, leaf]`, and how many outputs are not the recorded ones, bit for bit.
#[pyfunction]
pub(crate) fn trajectories(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let found = py
        .detach(|| trajectories_of(&Recording::read(&path).map_err(|error| error.to_string())?))
        .map_err(raise)?;
    let result = PyDict::new(py);
    for node in found {
        let entry = PyDict::new(py);
        let steps = node.steps;
        let states = node.states.len() / (steps + 1);
        let [noise, outputs] = [&node.noise, &node.outputs].map(|values| values.len() / steps.max(1));
        entry.set_item("params", list(py, node.params))?;
        entry.set_item("states", array(py, node.states, [steps + 1, states])?)?;
        entry.set_item("noise", array(py, node.noise, [steps, noise])?)?;
        entry.set_item("outputs", array(py, node.outputs, [steps, outputs])?)?;
        entry.set_item("differing", node.differing)?;
        result.set_item(node.name, entry)?;
    }
    Ok(result)
}

fn trajectories_of(recording: &Recording) -> Result<Vec<NodeTrajectory>, String> {
    parallax_sim::trajectories(recording, &parallax_nodes::registry()).map_err(|error| error.to_string())
}

fn node<'py>(py: Python<'py>, track: &NodeTrack) -> PyResult<Bound<'py, PyDict>> {
    let result = PyDict::new(py);
    result.set_item("name", &track.name)?;
    result.set_item("message", &track.layout.name)?;
    result.set_item("leaves", &track.layout.leaves)?;
    result.set_item("initial", list(py, track.initial.clone()))?;
    result.set_item("stand_in", track.stand_in)?;
    result.set_item("seq", list(py, track.messages.iter().map(|message| number(message.seq)).collect()))?;
    result.set_item("sent", list(py, track.messages.iter().map(|message| message.sent).collect()))?;
    let leaves = track.layout.leaves.len();
    let payload: Vec<f64> =
        track.messages.iter().flat_map(|message| message.payload.iter().copied()).collect();
    result.set_item("payload", array(py, payload, [track.messages.len(), leaves])?)?;
    let times = |time: fn(&parallax_runtime::recording::StepRecord) -> i64| {
        list(py, track.steps.iter().map(time).collect())
    };
    result.set_item("step_seq", times(|step| number(step.seq)))?;
    result.set_item("due", times(|step| step.due))?;
    result.set_item("start", times(|step| step.start))?;
    result.set_item("end", times(|step| step.end))?;
    let ports = track.steps.first().map_or(0, |step| step.inputs.len());
    let inputs = (0..ports).map(|place| input(py, track, place)).collect::<PyResult<Vec<_>>>()?;
    result.set_item("inputs", PyList::new(py, inputs)?)?;
    Ok(result)
}

/// What all steps consumed at one port, `[step, window]`.
fn input<'py>(py: Python<'py>, track: &NodeTrack, place: usize) -> PyResult<Bound<'py, PyDict>> {
    let records: Vec<&InputRecord> = track.steps.iter().filter_map(|step| step.inputs.get(place)).collect();
    let window = records.first().map_or(0, |record| record.consumed.len());
    let shape = [records.len(), window];
    let consumed = || records.iter().flat_map(|record| record.consumed.iter());
    let result = PyDict::new(py);
    result.set_item("port", records.first().map(|record| record.port.as_str()))?;
    let seq = consumed().map(|stamp| stamp.seq.map_or(-1, number)).collect::<Vec<i64>>();
    result.set_item("seq", array(py, seq, shape)?)?;
    result.set_item("sent", array(py, consumed().map(|stamp| stamp.sent).collect::<Vec<i64>>(), shape)?)?;
    result.set_item(
        "received",
        array(py, consumed().map(|stamp| stamp.received).collect::<Vec<i64>>(), shape)?,
    )?;
    let superseded = records.iter().map(|record| number(record.superseded)).collect::<Vec<i64>>();
    result.set_item("superseded", list(py, superseded))?;
    Ok(result)
}

/// A counter as numpy's integers; one beyond 2^63 cannot occur in a run.
fn number(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}
