//! Graphs: where they come from, and what their nodes are.

use std::path::PathBuf;

use parallax_model::node_model::PortShape;
use parallax_nodes::{GRAPHS, estimator, registry};
use parallax_runtime::graph::{Graph, GraphSpec};
use parallax_runtime::node::{Layout, NodeError};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::to_seconds;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::list;
use crate::error::raise;
use crate::program::NativeProgram;
use crate::worker::PYTHON;

/// A kind of node that is written in Python: its name, its inputs (port, message, leaves), its output (message, leaves)
/// and the leaves of its initial message.
type PythonKind = (String, Vec<(String, String, Vec<String>)>, (String, Vec<String>), Vec<f64>);

/// A graph that was checked.
#[pyclass(frozen, name = "Graph", module = "parallax._native")]
pub(crate) struct NativeGraph {
    pub(crate) graph: Graph,
    /// What nodes draw their starting values from: the recording's, or 0.
    pub(crate) seed: u64,
}

#[pymethods]
impl NativeGraph {
    /// From the text of a graph, `toml` or `json`; `kinds` are those of nodes written in Python. The files that nodes name
    /// are relative to `folder`, and become part of the graph.
    #[new]
    fn new(text: &str, format: &str, kinds: Vec<PythonKind>, folder: PathBuf) -> PyResult<Self> {
        let spec = match format {
            "toml" => GraphSpec::from_toml(text),
            _ => GraphSpec::from_json(text),
        };
        let mut spec = spec.map_err(raise)?;
        estimator::embed(&mut spec, &folder).map_err(raise)?;
        Self::checked(&spec, kinds, 0)
    }

    /// The graph that is attached to a recording.
    #[staticmethod]
    fn from_recording(py: Python<'_>, path: PathBuf, kinds: Vec<PythonKind>) -> PyResult<Self> {
        let recording = py.detach(|| Recording::read(&path)).map_err(raise)?;
        Self::checked(&recording.graph, kinds, recording.clock.seed())
    }

    /// A graph that comes with Parallax.
    #[staticmethod]
    fn built_in(name: &str) -> PyResult<Self> {
        match parallax_nodes::graph(name) {
            Some(spec) => Self::checked(&spec, Vec::new(), 0),
            None => Err(raise(format!("there is no graph `{name}`; the graphs are: {}", GRAPHS.join(", ")))),
        }
    }

    /// The graph as JSON.
    fn json(&self) -> String {
        self.graph.spec().to_json()
    }

    /// The graph as the text of a `graph.toml`.
    fn toml(&self) -> PyResult<String> {
        self.graph.spec().to_toml().map_err(raise)
    }

    /// Index of the supervisor.
    #[getter]
    fn supervisor(&self) -> usize {
        self.graph.supervisor()
    }

    /// The connections' names.
    pub(crate) fn connections(&self) -> Vec<String> {
        (0..self.graph.connections().len()).map(|index| self.graph.connection_name(index)).collect()
    }

    /// What is probably not meant.
    fn warnings(&self) -> Vec<String> {
        self.graph.warnings().iter().map(ToString::to_string).collect()
    }

    /// Every node: its kind, ports, message and, where it has one, its model.
    fn nodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let nodes =
            (0..self.graph.nodes().len()).map(|node| self.node(py, node)).collect::<PyResult<Vec<_>>>()?;
        PyList::new(py, nodes)
    }
}

impl NativeGraph {
    fn checked(spec: &GraphSpec, kinds: Vec<PythonKind>, seed: u64) -> PyResult<Self> {
        let graph = spec.validate(&with_python(registry(), kinds)?).map_err(raise)?;
        Ok(Self { graph, seed })
    }

    fn node<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        let plan = &self.graph.nodes()[index];
        let result = PyDict::new(py);
        result.set_item("name", &plan.name)?;
        result.set_item("kind", &self.graph.spec().nodes[index].kind)?;
        result.set_item("rate", self.graph.spec().nodes[index].rate)?;
        result.set_item("phase", to_seconds(plan.grid.phase()))?;
        result.set_item("message", &plan.kind.output().name)?;
        result.set_item("leaves", &plan.kind.output().leaves)?;
        result.set_item("initial", list(py, plan.kind.initial_message().to_vec()))?;
        let ports = PyList::empty(py);
        let mut shapes = Vec::new();
        for (input, &connection) in plan.kind.inputs().iter().zip(&plan.inputs) {
            let connected = &self.graph.connections()[connection];
            let port = PyDict::new(py);
            port.set_item("name", &input.name)?;
            port.set_item("connection", connection)?;
            port.set_item("from", connected.from)?;
            port.set_item("window", connected.window)?;
            port.set_item("message", &input.layout.name)?;
            port.set_item("leaves", &input.layout.leaves)?;
            ports.append(port)?;
            shapes.push(PortShape {
                name: input.name.clone(),
                leaves: input.layout.leaves.clone(),
                window: connected.window,
            });
        }
        result.set_item("ports", ports)?;
        let Some(kind) = plan.kind.node_model() else {
            result.set_item("model", py.None())?;
            return Ok(result);
        };
        let start = kind.start(&self.graph.context(index, self.seed)).map_err(raise)?;
        let model = PyDict::new(py);
        model.set_item("name", kind.model().name())?;
        model.set_item("params", kind.model().params())?;
        model.set_item("state", kind.model().state())?;
        model.set_item("noise", kind.model().noise())?;
        model.set_item("params_start", list(py, start.params))?;
        model.set_item("state_start", list(py, start.state))?;
        let program = py.detach(|| kind.model().program(&shapes));
        model.set_item("program", Bound::new(py, NativeProgram { program })?)?;
        result.set_item("model", model)?;
        Ok(result)
    }
}

/// The registry with kinds of which only the shape is known: they are scheduled and compiled, never run here.
pub(crate) fn with_python(mut registry: Registry, kinds: Vec<PythonKind>) -> PyResult<Registry> {
    for (name, inputs, (message, leaves), initial) in kinds {
        if leaves.len() != initial.len() {
            return Err(raise(format!(
                "kind `{name}`: its message has {} leaves and its initial message {}",
                leaves.len(),
                initial.len()
            )));
        }
        let key = name.clone();
        let kind = NodeKind::erased(Layout { name: message, leaves }, initial, move |_| {
            Err(NodeError::failed(format!(
                "kind `{key}` is written in Python and runs only in a compiled graph"
            )))
        });
        let kind = inputs
            .into_iter()
            .fold(kind, |kind, (port, name, leaves)| kind.input_with_layout(port, Layout { name, leaves }));
        registry.insert(name, kind);
    }
    if registry.get(PYTHON).is_none() {
        let run = "it is written in Python: `parallax run` steps it in real time, and a compiled graph takes it by name";
        registry.insert(PYTHON, NodeKind::external(move |_, _, _| Err(NodeError::failed(run))));
    }
    Ok(registry)
}

/// The names of the graphs that come with Parallax.
#[pyfunction]
pub(crate) fn graphs() -> Vec<&'static str> {
    GRAPHS.to_vec()
}

/// The kinds of node that come with Parallax: their inputs' and outputs' messages and leaves.
#[pyfunction]
pub(crate) fn kinds(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let registry = registry();
    let result = PyDict::new(py);
    for name in registry.names() {
        let Some(kind) = registry.get(name) else { continue };
        let entry = PyDict::new(py);
        let inputs = PyDict::new(py);
        for input in kind.inputs() {
            inputs.set_item(&input.name, (&input.layout.name, &input.layout.leaves))?;
        }
        entry.set_item("inputs", inputs)?;
        entry.set_item("output", (&kind.output().name, &kind.output().leaves))?;
        result.set_item(name, entry)?;
    }
    Ok(result)
}
