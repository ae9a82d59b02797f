//! A node of a running graph, stepped by this interpreter.
//!
//! The launcher starts the interpreter as it starts any node; everything but the step is the same Rust code as there.

use std::process::ExitCode;

use numpy::PyArray1;
use numpy::PyArrayMethods as _;
use parallax_runtime::data::DataSpace;
use parallax_runtime::launch;
use parallax_runtime::node::{ErasedNode, InputWindow, Layout, NodeContext, NodeError, Step, Stopping};
use parallax_runtime::registry::{ExternalInput, NodeKind};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyList, PyTuple};

/// The kind of node that is written in Python, as graphs name it.
pub(crate) const PYTHON: &str = "python";

/// Runs one node by its launcher's orders, as `arguments` say; `build` makes the node. Says whether it ended in order.
///
/// `build(name, rate, seed, parameters, inputs, output)` takes the parameters as JSON, the inputs as `(port, window,
/// leaves)` and the output as `(message, leaves)`. What it gives has `step(seq, due, start, inputs)`, which returns the
/// leaves and the data of the output, and `stop(why)`.
#[pyfunction]
pub(crate) fn work(py: Python<'_>, arguments: Vec<String>, build: Py<PyAny>) -> bool {
    let registry = parallax_nodes::registry().with(PYTHON, python_kind(build));
    py.detach(|| launch::node_main(arguments.into_iter(), &registry)) == ExitCode::SUCCESS
}

/// The kind of node that is written in Python, stepped by this interpreter.
pub(crate) fn python_kind(build: Py<PyAny>) -> NodeKind {
    NodeKind::external(move |context, inputs, output| {
        Ok(Box::new(Python::attach(|py| PythonNode::build(py, &build, context, inputs, output))?))
    })
}

struct PythonNode {
    step: Py<PyAny>,
    stop: Py<PyAny>,
}

impl PythonNode {
    fn build(
        py: Python<'_>,
        build: &Py<PyAny>,
        context: &NodeContext,
        inputs: &[ExternalInput],
        output: &Layout,
    ) -> Result<Self, NodeError> {
        let make = || {
            let parameters = serde_json::Value::Object(context.parameters.clone()).to_string();
            let inputs: Vec<_> = inputs
                .iter()
                .map(|ExternalInput { port, window }| (&*port.name, *window, port.layout.leaves.clone()))
                .collect();
            let output = (&*output.name, output.leaves.clone());
            let arguments = (&*context.name, context.rate, context.seed, parameters, inputs, output);
            let node = build.bind(py).call1(arguments)?;
            Ok(Self { step: node.getattr("step")?.unbind(), stop: node.getattr("stop")?.unbind() })
        };
        make().map_err(|error| failed(py, &error))
    }
}

impl ErasedNode for PythonNode {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.step_with_data(step, output, &mut DataSpace::new(&mut []))
    }

    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        Python::attach(|py| {
            let made = call(py, &self.step, step).map_err(|error| failed(py, &error))?;
            let (leaves, bytes) = &made;
            if leaves.len() != output.len() {
                let (got, wanted) = (leaves.len(), output.len());
                return Err(NodeError::failed(format!("its output has {got} leaves in place of {wanted}")));
            }
            output.copy_from_slice(leaves);
            if !bytes.is_empty() {
                data.take(bytes.len())?.copy_from_slice(bytes);
            }
            Ok(())
        })
    }

    fn stop(&mut self, why: Stopping) {
        let why = serde_json::to_value(why).ok().and_then(|why| Some(why.as_str()?.to_owned()));
        Python::attach(|py| {
            if let Err(error) = self.stop.call1(py, (why.unwrap_or_default(),)) {
                // Nobody is left who could react; the launcher's standard error takes it.
                error.print(py);
            }
        });
    }
}

/// Calls the step; gives the leaves and the data of its output.
fn call(py: Python<'_>, step: &Py<PyAny>, view: &Step<'_>) -> PyResult<(Vec<f64>, Vec<u8>)> {
    let inputs = view.inputs().iter().map(|input| window(py, input)).collect::<PyResult<Vec<_>>>()?;
    let made = step.bind(py).call1((view.seq, view.due, view.start, PyList::new(py, inputs)?))?;
    let (leaves, data) = made.extract::<(Vec<f64>, Bound<'_, PyAny>)>()?;
    Ok((leaves, if data.is_none() { Vec::new() } else { data.cast::<PyBytes>()?.as_bytes().to_vec() }))
}

/// A window: the stamps `[message, 3]` of seq (−1 for none), sent and received (ns), the leaves `[message, leaf]`, and
/// the data of each message.
pub(crate) fn window<'py>(py: Python<'py>, input: &InputWindow) -> PyResult<Bound<'py, PyTuple>> {
    let count = input.stamps().len();
    let stamps = input
        .stamps()
        .iter()
        .flat_map(|stamp| [stamp.seq.map_or(-1, |seq| seq as i64), stamp.sent, stamp.received]);
    let stamps = PyArray1::from_iter(py, stamps).reshape([count, 3])?;
    let leaves = if count == 0 { 0 } else { input.payload(0).len() };
    let values = (0..count).flat_map(|index| input.payload(index).iter().copied());
    let values = PyArray1::from_iter(py, values).reshape([count, leaves])?;
    let data = (0..count).map(|index| PyBytes::new(py, input.data(index)));
    (stamps, values, PyList::new(py, data)?).into_pyobject(py)
}

/// An exception, with its traceback, as the node's fault.
fn failed(py: Python<'_>, error: &PyErr) -> NodeError {
    let formatted = || -> PyResult<String> {
        let traceback = py.import("traceback")?;
        let parts = (error.get_type(py), error.value(py), error.traceback(py));
        let lines = traceback.call_method1("format_exception", parts)?;
        Ok(lines.extract::<Vec<String>>()?.concat())
    };
    NodeError::failed(formatted().unwrap_or_else(|_| error.to_string()).trim_end())
}
