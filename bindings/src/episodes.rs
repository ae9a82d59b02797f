//! Schedules: drawn from a graph, or read from recordings of it.

use std::path::PathBuf;

use parallax_runtime::recording::Recording;
use parallax_runtime::time::{from_seconds, to_seconds};
use parallax_sim::{Episode, generate_many};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, list};
use crate::error::raise;
use crate::graph::NativeGraph;

/// The schedules of several runs of one graph.
#[pyclass(frozen, name = "Episodes", module = "parallax._native")]
pub(crate) struct NativeEpisodes {
    pub(crate) episodes: Vec<Episode>,
    names: Vec<String>,
    connections: Vec<String>,
}

impl NativeEpisodes {
    pub(crate) fn of(graph: &NativeGraph, episodes: Vec<Episode>) -> Self {
        Self {
            episodes,
            names: graph.graph.nodes().iter().map(|node| node.name.clone()).collect(),
            connections: graph.connections(),
        }
    }
}

#[pymethods]
impl NativeEpisodes {
    fn __len__(&self) -> usize {
        self.episodes.len()
    }

    fn __repr__(&self) -> String {
        let steps: usize = self.episodes.iter().map(Episode::steps).sum();
        format!("Episodes({} episodes, {steps} steps of {} nodes)", self.episodes.len(), self.names.len())
    }

    /// These episodes and then the others, all of the same graph.
    fn __add__(&self, other: &Self) -> PyResult<Self> {
        if self.names != other.names || self.connections != other.connections {
            return Err(raise("the episodes are of different graphs"));
        }
        Ok(Self {
            episodes: self.episodes.iter().chain(&other.episodes).cloned().collect(),
            names: self.names.clone(),
            connections: self.connections.clone(),
        })
    }

    /// How long each lasts, s.
    #[getter]
    fn durations<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        list(py, self.episodes.iter().map(|episode| to_seconds(episode.duration)).collect())
    }

    /// One episode: per node `due`, `start` and `end` (int64 ns, `[step]`), and per connection `seq` and `received`
    /// (ns), `[step of the receiver, window]`, oldest first, −1 for an initial message.
    fn episode<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        let Some(episode) = self.episodes.get(index) else {
            return Err(raise(format!("there is no episode {index}; there are {}", self.episodes.len())));
        };
        let nodes = PyDict::new(py);
        for (name, steps) in self.names.iter().zip(&episode.nodes) {
            let node = PyDict::new(py);
            node.set_item("due", list(py, steps.due.clone()))?;
            node.set_item("start", list(py, steps.start.clone()))?;
            node.set_item("end", list(py, steps.end.clone()))?;
            nodes.set_item(name, node)?;
        }
        let connections = PyDict::new(py);
        for (name, consumed) in self.connections.iter().zip(&episode.connections) {
            let shape = [consumed.seq.len() / consumed.window.max(1), consumed.window];
            let connection = PyDict::new(py);
            connection.set_item("seq", array(py, consumed.seq.clone(), shape)?)?;
            connection.set_item("received", array(py, consumed.received.clone(), shape)?)?;
            connections.set_item(name, connection)?;
        }
        let result = PyDict::new(py);
        result.set_item("duration", episode.duration)?;
        result.set_item("nodes", nodes)?;
        result.set_item("connections", connections)?;
        Ok(result)
    }
}

#[pymethods]
impl NativeGraph {
    /// Draws the schedules of `episodes` runs of `duration` seconds.
    fn generate(
        &self,
        py: Python<'_>,
        seed: u64,
        duration: f64,
        episodes: usize,
    ) -> PyResult<NativeEpisodes> {
        let duration = from_seconds(duration);
        let drawn = py.detach(|| generate_many(&self.graph, seed, duration, episodes)).map_err(raise)?;
        Ok(NativeEpisodes::of(self, drawn))
    }

    /// The schedules of recordings of this graph.
    fn recorded(&self, py: Python<'_>, paths: Vec<PathBuf>) -> PyResult<NativeEpisodes> {
        let read = |path: &PathBuf| {
            let recording = Recording::read(path).map_err(raise)?;
            Episode::from_recording(&self.graph, &recording).map_err(raise)
        };
        let episodes = py.detach(|| paths.iter().map(read).collect::<PyResult<Vec<_>>>())?;
        Ok(NativeEpisodes::of(self, episodes))
    }
}
