//! Running graphs: parameters and state of their nodes.

use std::time::Duration;

use parallax_runtime::launch::{self, AskError, Told};
use parallax_runtime::tuning::Assignment;
use pyo3::prelude::*;

use crate::error::raise;

/// Sets parameters of one node of a running graph, all before the same step; gives what a node says as JSON.
#[pyfunction]
pub(crate) fn set_parameters(
    py: Python<'_>,
    run: Option<String>,
    node: String,
    values: Vec<(String, f64, Option<String>)>,
    patience: f64,
) -> PyResult<String> {
    let assignments =
        values.into_iter().map(|(parameter, value, unit)| Assignment { parameter, value, unit });
    let assignments: Vec<Assignment> = assignments.collect();
    ask(py, patience, |patience| launch::set_parameters(run.as_deref(), &node, &assignments, patience))
}

/// The parameters and the state of one node of a running graph, as JSON.
#[pyfunction]
pub(crate) fn read_node(
    py: Python<'_>,
    run: Option<String>,
    node: String,
    patience: f64,
) -> PyResult<String> {
    ask(py, patience, |patience| launch::read_node(run.as_deref(), &node, patience))
}

/// Puts the state of one node of a running graph back to what it was before its first step.
#[pyfunction]
pub(crate) fn reset_state(
    py: Python<'_>,
    run: Option<String>,
    node: String,
    patience: f64,
) -> PyResult<String> {
    ask(py, patience, |patience| launch::reset_state(run.as_deref(), &node, patience))
}

/// Asks without holding up other threads of Python.
fn ask(
    py: Python<'_>,
    patience: f64,
    question: impl FnOnce(Duration) -> Result<Told, AskError> + Send,
) -> PyResult<String> {
    let patience = Duration::try_from_secs_f64(patience).map_err(raise)?;
    let told = py.detach(|| question(patience)).map_err(raise)?;
    serde_json::to_string(&told).map_err(raise)
}
