//! What a graph says.

use parallax_runtime::graph::{Graph, GraphSpec};
use parallax_runtime::time::to_seconds;
use serde_json::{Value, json};

use crate::cli::args::validate;
use crate::cli::failure::Failure;
use crate::cli::output;

pub(super) fn show(spec: &GraphSpec, as_json: bool) -> Result<(), Failure> {
    let graph = validate(spec)?;
    if as_json {
        return output::json(&summary(&graph));
    }
    let (nodes, connections) = (graph.nodes().len(), graph.connections().len());
    output::line(format!(
        "{}: {nodes} nodes, {connections} connections, stepped by {}",
        spec.name, spec.supervisor
    ));
    let rows: Vec<Vec<String>> = spec
        .nodes
        .iter()
        .zip(graph.nodes())
        .map(|(spec, plan)| {
            vec![
                spec.name.clone(),
                spec.kind.clone(),
                spec.rate.to_string(),
                output::seconds(to_seconds(plan.grid.phase())),
                output::seconds(plan.computation.expected()),
                plan.core.map_or_else(|| "any".into(), |core| core.to_string()),
                plan.kind.output().to_string(),
            ]
        })
        .collect();
    output::table(&["node", "kind", "rate (Hz)", "phase", "computation", "core", "sends"], &rows);
    let rows: Vec<Vec<String>> = graph
        .connections()
        .iter()
        .enumerate()
        .map(|(index, plan)| {
            let mut traits = vec![if plan.blocking { "blocking" } else { "not blocking" }];
            traits.extend(plan.skip.then_some("skip"));
            vec![
                graph.connection_name(index),
                traits.join(", "),
                plan.window.to_string(),
                output::seconds(plan.delay.expected()),
            ]
        })
        .collect();
    output::table(&["connection", "", "window", "delay"], &rows);
    Ok(())
}

fn summary(graph: &Graph) -> Value {
    let spec = graph.spec();
    let nodes: Vec<Value> = spec
        .nodes
        .iter()
        .zip(graph.nodes())
        .map(|(spec, plan)| {
            json!({
                "name": spec.name, "kind": spec.kind, "rate_hz": spec.rate, "phase_s": to_seconds(plan.grid.phase()),
                "computation_s": plan.computation.expected(), "core": plan.core,
                "stand_in": plan.kind.is_stand_in(), "message": plan.kind.output(),
            })
        })
        .collect();
    let connections: Vec<Value> = graph
        .connections()
        .iter()
        .enumerate()
        .map(|(index, plan)| {
            json!({
                "name": graph.connection_name(index), "from": graph.nodes()[plan.from].name,
                "to": graph.nodes()[plan.to].name, "port": plan.port, "blocking": plan.blocking,
                "window": plan.window, "skip": plan.skip, "delay_s": plan.delay.expected(),
            })
        })
        .collect();
    let warnings: Vec<String> = graph.warnings().iter().map(ToString::to_string).collect();
    json!({ "kind": "graph", "name": spec.name, "supervisor": spec.supervisor, "nodes": nodes,
            "connections": connections, "warnings": warnings })
}
