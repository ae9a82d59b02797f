//! Nodes of the graphs that come with Parallax, replayed alone: the one whose parameter was changed is named.

use parallax_gap::nodes::{NodeGap, Verdict, nodes};
use parallax_nodes::registry;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::Registry;
use parallax_runtime::time::from_seconds;
use parallax_sim::Executor;
use serde_json::{Value, json};

fn recorded(spec: &GraphSpec) -> Recording {
    let graph = spec.validate(&registry()).expect("the graph is valid");
    Executor::new(graph, 1).record(from_seconds(5.0)).expect("it runs")
}

/// A recording in which one node ran with another parameter than its graph declares.
fn changed(graph: &str, node: &str, parameter: &str, value: Value) -> Recording {
    let declared = parallax_nodes::graph(graph).expect("it is there");
    let mut truth = declared.clone();
    let found = truth.nodes.iter_mut().find(|n| n.name == node).expect("it is there");
    found.parameters.insert(parameter.into(), value);
    let mut recording = recorded(&truth);
    recording.graph = declared;
    recording
}

fn differing(found: &[NodeGap]) -> Vec<&str> {
    found.iter().filter(|n| n.verdict == Verdict::Differs).map(|n| n.place.as_str()).collect()
}

#[test]
fn nodes_that_explain_their_output_are_cleared() {
    for name in parallax_nodes::GRAPHS {
        let recording = recorded(&parallax_nodes::graph(name).expect("it is there"));
        let found = nodes(&recording, &registry()).expect("it can be replayed");
        assert_eq!(differing(&found.nodes), [""; 0], "{name}");
        let cleared = found.nodes.iter().filter(|n| n.verdict == Verdict::Cleared);
        assert!(cleared.clone().count() >= 3, "{name}: {:#?}", found.nodes);
        assert!(cleared.clone().all(|n| n.steps > 0 && n.differing == 0));
    }
}

#[test]
fn what_no_node_records_is_the_plant() {
    let recording = recorded(&parallax_nodes::graph("pendulum").expect("it is there"));
    let found = nodes(&recording, &registry()).expect("it can be replayed");
    let verdict = |name: &str| found.nodes.iter().find(|n| n.place == name).expect("it is there").verdict;
    assert_eq!(verdict("node:world"), Verdict::Hardware);
    assert_eq!(verdict("node:camera"), Verdict::Sensor);
    assert_eq!(verdict("node:estimator"), Verdict::Cleared);
    let pairs: Vec<_> = found.unrecorded.iter().map(|s| (s.actuator.as_str(), s.sensor.as_str())).collect();
    assert_eq!(pairs, [("node:motor", "node:camera")]);
    // The stand-in says the same where no plant is attached.
    let mut without = recording;
    without.graph.plant = None;
    assert_eq!(nodes(&without, &registry()).expect("it can be replayed").unrecorded, found.unrecorded);
}

#[test]
fn the_node_whose_parameter_was_changed_is_named() {
    for (graph, node, parameter, value) in [
        ("pendulum", "motor", "rated", json!(2.0)),
        ("pendulum", "estimator", "noise", json!(0.05)),
        ("pendulum-simulated", "motor", "rated", json!(2.0)),
        ("pendulum-simulated", "agent", "limit", json!(1.5)),
        ("quadrotor-simulated", "agent", "tilt", json!(0.05)),
    ] {
        let recording = changed(graph, node, parameter, value);
        let found = nodes(&recording, &registry()).expect("it can be replayed");
        assert_eq!(differing(&found.nodes), [format!("node:{node}")], "{graph}");
        let gap = found.nodes.iter().find(|n| n.verdict == Verdict::Differs).expect("one differs");
        assert!(gap.gap > 1.0 && !gap.leaves.is_empty() && gap.first_difference.is_some(), "{gap:#?}");
    }
}

#[test]
fn a_kind_that_no_one_knows_is_not_judged() {
    let recording = recorded(&parallax_nodes::graph("pendulum-simulated").expect("it is there"));
    let all = registry();
    let mut some = Registry::new();
    for name in all.names().filter(|name| *name != "pendulum/motor") {
        some.insert(name, all.get(name).expect("it is there").clone());
    }
    let found = nodes(&recording, &some).expect("it can be replayed");
    let motor = found.nodes.iter().find(|n| n.place == "node:motor").expect("it is there");
    assert_eq!(motor.verdict, Verdict::Unknown);
    assert_eq!(differing(&found.nodes), [""; 0]);
}
