//! A `system.toml` as programs.

use std::path::PathBuf;

use parallax_model::plant::Plant;
use parallax_model::system::{Initial, System};
use parallax_runtime::import::read_system;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::error::raise;
use crate::program::NativeProgram;

/// Reads a system described by equations; `constants` replace or add parameters, as those of a recording do.
#[pyfunction]
#[pyo3(signature = (path, constants = Vec::new()))]
pub(crate) fn system(
    py: Python<'_>,
    path: PathBuf,
    constants: Vec<(String, f64)>,
) -> PyResult<Bound<'_, PyDict>> {
    let system: System = read_system(&path).map_err(raise)?;
    let system = system.with_constants(&constants).map_err(raise)?;
    let plant = Plant::alone(system.equations().map_err(raise)?).map_err(raise)?;

    let result = PyDict::new(py);
    result.set_item("name", &system.name)?;
    let parameters = PyList::empty(py);
    for parameter in &system.parameters {
        parameters.append((&parameter.name, parameter.value, &parameter.unit, parameter.calibrate))?;
    }
    result.set_item("parameters", parameters)?;

    result.set_item("inputs", system.inputs.iter().map(|input| input.name.as_str()).collect::<Vec<_>>())?;
    let states = PyList::empty(py);
    for state in &system.states {
        let initial = match &state.initial {
            Initial::Fixed(value) => Some(*value),
            _ => None,
        };
        states.append((&state.name, initial))?;
    }
    result.set_item("states", states)?;
    let own = &plant.state_names()[system.states.len()..];
    result.set_item("hidden", own.iter().chain(&plant.memory_names()).collect::<Vec<_>>())?;
    result.set_item("memory", plant.memory_names())?;
    let outputs = PyList::empty(py);
    for output in &system.outputs {
        outputs.append((&output.name, &output.unit, output.wrap))?;
    }
    result.set_item("outputs", outputs)?;
    result.set_item("rates", Bound::new(py, NativeProgram { program: plant.rate_program() })?)?;
    result.set_item("tick", Bound::new(py, NativeProgram { program: plant.tick_program() })?)?;
    Ok(result)
}
