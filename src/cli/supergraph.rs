//! How well a schedule fits a fixed order of slots, by each method of finding them.

use std::collections::HashSet;

use parallax_runtime::graph::Graph;
use parallax_sim::Episode;
use parallax_sim::supergraph::{
    Cut, Dag, DagInput, DagNode, Method, Plan, PlanOptions, SupergraphError, plan,
};
use serde_json::{Value, json};

use super::output;

/// The slots that one method found.
pub(crate) struct Found {
    /// How the schedule was cut into partitions, and how slots were found for them.
    pub(crate) cut: &'static str,
    pub(crate) method: &'static str,
    pub(crate) plan: Plan,
}

/// The ways of cutting and of finding slots, the one that compiled graphs use first.
fn methods() -> [(&'static str, &'static str, PlanOptions); 4] {
    let with = |cut: Cut, method: Method| PlanOptions { cut, method, ..PlanOptions::default() };
    [
        ("balanced", "minimum common", PlanOptions::default()),
        ("balanced", "generational", with(Cut::default(), Method::Generational)),
        ("balanced", "topological", with(Cut::default(), Method::Topological)),
        ("ancestors", "minimum common", with(Cut::Ancestors, Method::default())),
    ]
}

/// Finds the slots of one episode by every method.
pub(crate) fn find(graph: &Graph, episode: &Episode) -> Result<Vec<Found>, SupergraphError> {
    let nodes = graph.nodes().iter().zip(&episode.nodes).map(|(node, steps)| DagNode {
        start: &steps.start,
        stateful: node.kind.node_model().is_none_or(|kind| !kind.model().state().is_empty()),
        keep: false,
        inputs: node
            .inputs
            .iter()
            .map(|&connection| DagInput {
                from: graph.connections()[connection].from as u32,
                window: graph.connections()[connection].window,
                seq: &episode.connections[connection].seq,
            })
            .collect(),
    });
    let dag = Dag { nodes: nodes.collect() };
    methods()
        .into_iter()
        .map(|(cut, method, options)| {
            let plan = plan(std::slice::from_ref(&dag), graph.supervisor() as u32, &options)?;
            Ok(Found { cut, method, plan })
        })
        .collect()
}

impl Found {
    /// How many partitions differ.
    fn distinct(&self) -> usize {
        self.plan.episodes.iter().flat_map(|episode| &episode.partitions).collect::<HashSet<_>>().len()
    }

    /// How well the slots are filled, in a sentence.
    pub(crate) fn about(&self) -> String {
        format!(
            "{} partitions, {} of them different; {} slots in {} generations; {:.1} % of the slots are filled.",
            self.plan.partitions(),
            self.distinct(),
            self.plan.supergraph.labels.len(),
            self.plan.supergraph.generations.len(),
            100.0 * self.plan.efficiency()
        )
    }

    fn row(&self) -> Vec<String> {
        let found = &self.plan.supergraph;
        vec![
            self.method.into(),
            self.cut.into(),
            self.plan.partitions().to_string(),
            self.distinct().to_string(),
            found.labels.len().to_string(),
            found.bound.to_string(),
            found.generations.len().to_string(),
            format!("{:.1} %", 100.0 * self.plan.efficiency()),
        ]
    }

    /// The slots for scripts.
    pub(crate) fn summary(&self, graph: &Graph) -> Value {
        let found = &self.plan.supergraph;
        let names: Vec<&str> =
            found.labels.iter().map(|&label| graph.nodes()[label as usize].name.as_str()).collect();
        json!({
            "method": self.method, "cut": self.cut, "partitions": self.plan.partitions(),
            "distinct_partitions": self.distinct(), "slots": names, "least_slots": found.bound,
            "generations": found.generations, "edges": found.edges, "efficiency": self.plan.efficiency(),
        })
    }
}

/// Prints a row a method.
pub(crate) fn print(found: &[Found]) {
    let rows: Vec<Vec<String>> = found.iter().map(Found::row).collect();
    let header =
        ["supergraph", "cut", "partitions", "different", "slots", "at least", "generations", "efficiency"];
    output::table(&header, &rows);
}
