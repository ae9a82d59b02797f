//! Programs: their tables for the JAX interpreter, and their evaluation and derivatives in f64.

use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use parallax_model::program::Workspace;
use parallax_model::trace::trace_model;
use parallax_model::{Program, Tree};
use parallax_nodes::models::{pendulum, quadrotor};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::array;
use crate::error::raise;

/// A computation, written down.
#[pyclass(frozen, name = "Program", module = "parallax._native")]
pub(crate) struct NativeProgram {
    pub(crate) program: Program,
}

#[pymethods]
impl NativeProgram {
    /// From the JSON that `json` gives.
    #[new]
    fn new(json: &str) -> PyResult<Self> {
        Ok(Self { program: Program::from_json(json).map_err(raise)? })
    }

    /// The program as JSON.
    fn json(&self) -> String {
        self.program.to_json()
    }

    /// Its outputs in f64 for every row of `inputs`: `[n, inputs]` to `[n, outputs]`.
    fn evaluate<'py>(
        &self,
        py: Python<'py>,
        inputs: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let [rows, columns] = [inputs.shape()[0], inputs.shape()[1]];
        self.check(columns)?;
        let inputs: Vec<f64> = inputs.as_array().iter().copied().collect();
        let outputs = self.program.outputs().len();
        let mut values = vec![0.0; rows * outputs];
        py.detach(|| {
            let mut workspace = Workspace::new();
            for row in 0..rows {
                let values = &mut values[row * outputs..(row + 1) * outputs];
                self.program.evaluate(&inputs[row * columns..(row + 1) * columns], &mut workspace, values);
            }
        });
        array(py, values, [rows, outputs])
    }

    /// The derivative of every output with respect to each input in `wrt`, exact: `[outputs, len(wrt)]`.
    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        inputs: PyReadonlyArray1<'py, f64>,
        wrt: Vec<usize>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let inputs: Vec<f64> = inputs.as_array().iter().copied().collect();
        self.check(inputs.len())?;
        if let Some(place) = wrt.iter().find(|place| **place >= inputs.len()) {
            return Err(raise(format!("there is no input {place}; the program has {}", inputs.len())));
        }
        let jacobian = self.program.jacobian(&inputs, &wrt);
        let rows = jacobian.row_iter().flat_map(|row| row.iter().copied().collect::<Vec<f64>>()).collect();
        array(py, rows, [self.program.outputs().len(), wrt.len()])
    }
}

impl NativeProgram {
    fn check(&self, given: usize) -> PyResult<()> {
        let expected = self.program.inputs().len();
        if given == expected {
            return Ok(());
        }
        Err(raise(format!("program `{}` takes {expected} inputs and is given {given}", self.program.name())))
    }
}

/// The ready-made models by name: each the program of one step, with inputs `params.*`, `state.*`, `input.*`, `dt` (s)
/// and outputs `state.*`, `output.*`, and its nominal parameters.
#[pyfunction]
pub(crate) fn models(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let result = PyDict::new(py);
    let add = |name: &str, program: Program, params: Vec<f64>| {
        result.set_item(name, (Bound::new(py, NativeProgram { program })?, params))
    };
    add("pendulum", trace_model::<pendulum::Pendulum>(), pendulum::Params::<f64>::default().to_vec())?;
    add("quadrotor", trace_model::<quadrotor::Quadrotor>(), quadrotor::Params::<f64>::default().to_vec())?;
    Ok(result)
}
