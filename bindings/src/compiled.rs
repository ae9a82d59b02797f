//! Compiled graphs: the tables that the JAX functions run.

use parallax_runtime::graph::Graph;
use parallax_runtime::time::{from_seconds, to_seconds};
use parallax_sim::compiled::{
    CompileOptions, CompiledGraph, InputRows, Interpolation, OutputDelays, Slot, TrainableConnection, compile,
};
use parallax_sim::supergraph::{Cut, Method, StartUp};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{array, list};
use crate::episodes::NativeEpisodes;
use crate::error::raise;
use crate::graph::NativeGraph;

/// A trainable delay: the connection, its bounds (s), and whether payloads are interpolated.
pub(crate) type Trainable = (usize, f64, f64, bool);

#[pymethods]
impl NativeGraph {
    /// Compiles the graph and its episodes. `keep` and `pinned` name nodes by place; `cut` is `balanced` or
    /// `ancestors`; `method` is `mcs`, `topological` or `generational`; `at_run_time` says that computation delays
    /// follow from the outputs that are computed then.
    #[allow(clippy::too_many_arguments, reason = "called from one place in Python, by keyword")]
    #[pyo3(signature = (episodes, *, trainable, keep, pinned, cut, method, stateful, at_run_time=false))]
    fn compile(
        &self,
        py: Python<'_>,
        episodes: &NativeEpisodes,
        trainable: Vec<Trainable>,
        keep: Vec<usize>,
        pinned: Vec<usize>,
        cut: &str,
        method: &str,
        stateful: Vec<bool>,
        at_run_time: bool,
    ) -> PyResult<NativeCompiled> {
        let options = CompileOptions {
            method: match method {
                "mcs" => Method::default(),
                "topological" => Method::Topological,
                "generational" => Method::Generational,
                other => {
                    return Err(raise(format!(
                        "`{other}` is no method; use mcs, topological or generational"
                    )));
                }
            },
            cut: match cut {
                "balanced" => Cut::default(),
                "ancestors" => Cut::Ancestors,
                other => {
                    return Err(raise(format!("`{other}` is no partitioning; use balanced or ancestors")));
                }
            },
            start: StartUp::First,
            keep,
            pinned,
            stateful: Some(stateful),
            trainable: trainable
                .into_iter()
                .map(|(connection, min, max, linear)| TrainableConnection {
                    connection,
                    min: from_seconds(min),
                    max: from_seconds(max),
                    interpolation: if linear { Interpolation::Linear } else { Interpolation::Hold },
                })
                .collect(),
            output_delays: if at_run_time { OutputDelays::AtRunTime } else { OutputDelays::AsScheduled },
        };
        let compiled = py.detach(|| compile(&self.graph, &episodes.episodes, &options)).map_err(raise)?;
        Ok(NativeCompiled { graph: self.graph.clone(), compiled })
    }
}

/// A graph and its episodes, compiled.
#[pyclass(frozen, name = "Compiled", module = "parallax._native")]
pub(crate) struct NativeCompiled {
    pub(crate) graph: Graph,
    pub(crate) compiled: CompiledGraph,
}

#[pymethods]
impl NativeCompiled {
    /// The tables, `[episode, pass]`; times in ns.
    fn tables<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        tables(py, &self.graph, &self.compiled)
    }
}

fn tables<'py>(py: Python<'py>, graph: &Graph, compiled: &CompiledGraph) -> PyResult<Bound<'py, PyDict>> {
    let result = PyDict::new(py);
    result.set_item("episodes", compiled.episodes)?;
    result.set_item("steps", compiled.steps)?;
    result.set_item("lengths", list(py, compiled.lengths.clone()))?;
    result.set_item("efficiency", compiled.efficiency())?;
    let nodes = PyList::empty(py);
    for node in &compiled.nodes {
        let entry = PyDict::new(py);
        entry.set_item("name", &node.name)?;
        entry.set_item("history", node.history)?;
        nodes.append(entry)?;
    }
    result.set_item("nodes", nodes)?;
    let slots = compiled
        .slots
        .iter()
        .map(|slot| self::slot(py, graph, compiled, slot))
        .collect::<PyResult<Vec<_>>>()?;
    result.set_item("slots", PyList::new(py, slots)?)?;
    Ok(result)
}

fn slot<'py>(
    py: Python<'py>,
    graph: &Graph,
    compiled: &CompiledGraph,
    slot: &Slot,
) -> PyResult<Bound<'py, PyDict>> {
    let shape = [compiled.episodes, compiled.passes()];
    let rows = &slot.rows;
    let result = PyDict::new(py);
    result.set_item("node", slot.node)?;
    result.set_item("always", slot.always)?;
    result.set_item("run", array(py, rows.run.clone(), shape)?)?;
    result.set_item("seq", array(py, rows.seq.clone(), shape)?)?;
    result.set_item("due", array(py, rows.due.clone(), shape)?)?;
    result.set_item("start", array(py, rows.start.clone(), shape)?)?;
    result.set_item("write", array(py, rows.write.clone(), shape)?)?;
    let inputs =
        rows.inputs.iter().map(|rows| input(py, graph, compiled, rows)).collect::<PyResult<Vec<_>>>()?;
    result.set_item("inputs", PyList::new(py, inputs)?)?;
    Ok(result)
}

fn input<'py>(
    py: Python<'py>,
    graph: &Graph,
    compiled: &CompiledGraph,
    rows: &InputRows,
) -> PyResult<Bound<'py, PyDict>> {
    let shape = [compiled.episodes, compiled.passes(), rows.candidates];
    let result = PyDict::new(py);
    result.set_item("connection", rows.connection)?;
    result.set_item("from", rows.from)?;
    result.set_item("window", rows.window)?;
    result.set_item("candidates", rows.candidates)?;
    result.set_item("seq", array(py, rows.seq.clone(), shape)?)?;
    result.set_item("sent", array(py, rows.sent.clone(), shape)?)?;
    result.set_item("received", array(py, rows.received.clone(), shape)?)?;
    result.set_item("read", array(py, rows.read.clone(), shape)?)?;
    let trainable = rows.trainable.map(|delay| {
        let linear = delay.interpolation != Interpolation::Hold;
        (to_seconds(delay.min), to_seconds(delay.max), if linear { "linear" } else { "hold" }, delay.skip)
    });
    result.set_item("trainable", trainable)?;
    let from_output = rows.from_output.map(|delay| {
        let rule = delay.computation;
        let leaf = graph.nodes()[rows.from].kind.output().leaves[rule.leaf].clone();
        (leaf, rule.offset, rule.scale, rule.min, rule.max, to_seconds(delay.travel), delay.skip)
    });
    result.set_item("from_output", from_output)?;
    Ok(result)
}
