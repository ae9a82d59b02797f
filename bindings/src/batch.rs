//! Batch rollouts of compiled graphs without JAX: lanes times threads.

use numpy::{PyReadonlyArray1, PyReadonlyArray3, PyUntypedArrayMethods};
use parallax_sim::batch::{Batch, Given, Precision, Rollout};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::array;
use crate::compiled::NativeCompiled;
use crate::error::raise;

/// A node, one of its leaves, and a value for every environment.
type Values<'py> = Vec<(String, String, PyReadonlyArray1<'py, f64>)>;

/// The same, copied out of Python.
type Owned = Vec<(String, String, Vec<f64>)>;

#[pymethods]
impl NativeCompiled {
    /// Runs environments through their episodes. `params`, `states` and `delays` hold one value for each environment,
    /// `given` the outputs of pinned nodes `[environment, step, leaf]`. Gives the outputs of the nodes in `keep`,
    /// `[environment, step, leaf]` (not a number where a step did not run), and all last states, `[environment, leaf]`.
    #[allow(clippy::too_many_arguments, reason = "called from one place in Python, by keyword")]
    #[pyo3(signature = (*, episodes, seeds, params, states, delays, given, keep, precision))]
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        episodes: Vec<u32>,
        seeds: Vec<u64>,
        params: Values<'py>,
        states: Values<'py>,
        delays: Vec<(String, PyReadonlyArray1<'py, f64>)>,
        given: Vec<(String, PyReadonlyArray3<'py, f64>)>,
        keep: Vec<String>,
        precision: &str,
    ) -> PyResult<Bound<'py, PyDict>> {
        let precision = match precision {
            "double" => Precision::Double,
            "double lanes" => Precision::DoubleLanes,
            "single lanes" => Precision::SingleLanes,
            other => {
                let message = format!("`{other}` is no precision; use double, double lanes or single lanes");
                return Err(raise(message));
            }
        };
        let (params, states) = (owned(params), owned(states));
        let delays: Vec<(String, Vec<f64>)> =
            delays.into_iter().map(|(name, values)| (name, copied(&values))).collect();
        let given: Vec<(String, [usize; 3], Vec<f64>)> = given
            .into_iter()
            .map(|(name, values)| {
                let shape = values.shape();
                (name, [shape[0], shape[1], shape[2]], values.as_array().iter().copied().collect())
            })
            .collect();
        let rollout = py.detach(|| {
            let batch = Batch::new(&self.graph, &self.compiled, 0).map_err(|error| error.to_string())?;
            run(&batch, &episodes, &seeds, &[&params, &states], &delays, &given, &keep, precision)
        });
        let (rollout, names) = (rollout.map_err(raise)?, self.compiled.nodes.iter().map(|node| &node.name));
        let count = episodes.len();
        let outputs = PyDict::new(py);
        for kept in rollout.outputs {
            outputs.set_item(&kept.node, array(py, kept.values, [count, kept.steps, kept.leaves])?)?;
        }
        let states = PyDict::new(py);
        for (name, values) in names.zip(rollout.states) {
            let leaves = values.len() / count.max(1);
            states.set_item(name, array(py, values, [count, leaves])?)?;
        }
        let result = PyDict::new(py);
        result.set_item("outputs", outputs)?;
        result.set_item("states", states)?;
        Ok(result)
    }
}

#[allow(clippy::too_many_arguments, reason = "what `rollout` was given, out of Python's hands")]
fn run(
    batch: &Batch<'_>,
    episodes: &[u32],
    seeds: &[u64],
    [params, states]: &[&Owned; 2],
    delays: &[(String, Vec<f64>)],
    given: &[(String, [usize; 3], Vec<f64>)],
    keep: &[String],
    precision: Precision,
) -> Result<Rollout, String> {
    let mut environments = batch.environments(episodes.len());
    let text = |error: parallax_sim::batch::BatchError| error.to_string();
    environments.set_episodes(episodes).map_err(text)?;
    environments.set_seeds(seeds).map_err(text)?;
    for (node, leaf, values) in params.iter() {
        environments.set_param(node, leaf, values).map_err(text)?;
    }
    for (node, leaf, values) in states.iter() {
        environments.set_state(node, leaf, values).map_err(text)?;
    }
    for (connection, alphas) in delays {
        environments.set_delay(connection, alphas).map_err(text)?;
    }
    for (node, [_, steps, _], values) in given {
        environments.give(node, Given::PerEnvironment { steps: *steps, values }).map_err(text)?;
    }
    let keep: Vec<&str> = keep.iter().map(String::as_str).collect();
    batch.rollout(&environments, precision, &keep).map_err(text)
}

fn owned(values: Values<'_>) -> Owned {
    values.into_iter().map(|(node, leaf, values)| (node, leaf, copied(&values))).collect()
}

fn copied(values: &PyReadonlyArray1<'_, f64>) -> Vec<f64> {
    values.as_array().iter().copied().collect()
}
