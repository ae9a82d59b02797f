//! Recorded graphs with simulators in the place of what no node records.

use parallax_nodes::registry;
use parallax_runtime::graph::{ConnectionSpec, NodeSpec};
use parallax_runtime::time::to_seconds;
use parallax_sim::augment::{Augmentation, EdgeDelay};
use parallax_sim::compiled::Interpolation;
use pyo3::prelude::*;
use serde::Deserialize;

use crate::compiled::Trainable;
use crate::episodes::NativeEpisodes;
use crate::error::raise;
use crate::graph::{NativeGraph, with_python};

/// The shortest and the longest delay, s, and how payloads follow.
type Bounds = (f64, f64, String);

/// What is to change about a recorded graph, as Python writes it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Changes {
    dropped: Vec<String>,
    /// Nodes that step when they did.
    recast: Vec<NodeSpec>,
    /// Nodes that step on a grid of their own, from these phases (s) on.
    nodes: Vec<(NodeSpec, f64)>,
    /// Connections; those with bounds have a delay that is found by training.
    connections: Vec<(ConnectionSpec, Option<Bounds>)>,
}

#[pymethods]
impl NativeGraph {
    /// The graph and its episodes with these changes (JSON), and its trainable delays; all that is drawn follows from `seed`.
    fn augment(
        &self,
        py: Python<'_>,
        episodes: &NativeEpisodes,
        changes: &str,
        seed: u64,
    ) -> PyResult<(Self, NativeEpisodes, Vec<Trainable>)> {
        let changes: Changes = serde_json::from_str(changes).map_err(raise)?;
        let mut augmentation = Augmentation::new(&self.graph);
        for name in changes.dropped {
            augmentation = augmentation.drop_node(name);
        }
        for node in changes.recast {
            augmentation = augmentation.recast(node);
        }
        for (node, phase) in changes.nodes {
            augmentation = augmentation.node(node, phase);
        }
        for (connection, bounds) in changes.connections {
            let delay = match bounds {
                None => EdgeDelay::Given(connection.delay.clone()),
                Some((min, max, how)) => {
                    let interpolation =
                        if how == "linear" { Interpolation::Linear } else { Interpolation::Hold };
                    EdgeDelay::Trainable { min, max, interpolation }
                }
            };
            augmentation = augmentation.connect(connection, delay);
        }
        let registry = with_python(registry(), Vec::new())?;
        let made = py.detach(|| augmentation.apply(&registry, &episodes.episodes, seed)).map_err(raise)?;
        let trainable = made.trainable.iter().map(|delay| {
            let linear = delay.interpolation != Interpolation::Hold;
            (delay.connection, to_seconds(delay.min), to_seconds(delay.max), linear)
        });
        let trainable = trainable.collect();
        let graph = Self { graph: made.graph, seed: self.seed };
        let episodes = NativeEpisodes::of(&graph, made.episodes);
        Ok((graph, episodes, trainable))
    }
}
