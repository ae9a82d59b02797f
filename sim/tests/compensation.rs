//! Delays are compensated: where the pendulum will be when a command acts, against where it was when it was seen.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use crate::support::delayed::{errors, graph, kinds};
use parallax_nodes::{pendulum, registry};
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::node::Parameters;
use parallax_runtime::time::SECOND;
use parallax_sim::batch::{Batch, Precision};
use parallax_sim::compiled::{CompileOptions, compile};
use parallax_sim::{Episode, Executor};
use serde_json::json;

#[test]
fn a_prediction_over_the_delays_errs_far_less_than_the_filtered_state() {
    let graph = graph().validate(&kinds()).unwrap();
    let recording = Executor::new(graph, 4).record(20 * SECOND).unwrap();
    let (predicted, filtered) = (errors(&recording, "estimator"), errors(&recording, "filtered"));
    for (predicted, filtered) in predicted.iter().zip(filtered) {
        assert!(predicted * 5.0 < filtered, "{predicted} against {filtered}");
    }

    // The estimator of the equations is the same filter: it errs alike.
    let system = errors(&recording, "system");
    for (system, predicted) in system.iter().zip(predicted) {
        assert!((system / predicted - 1.0).abs() < 0.1, "{system} {predicted}");
    }
    let track = recording.node("system").unwrap();
    assert_eq!(track.layout.leaves[..4], ["q", "v", "stamp", "q_std"]);
    let last = track.messages.last().unwrap();
    let leaf = |name: &str| last.payload[track.layout.leaf(name).unwrap()];
    assert!(leaf("updates") > 1900.0 && leaf("late") == 0.0 && leaf("repaired") == 0.0, "{last:?}");
    assert!((leaf("nis_high") - 5.024).abs() < 1e-3);
}

#[test]
fn what_is_wrong_with_an_estimator_is_said() {
    let problem = |change: fn(&mut Parameters)| {
        let mut spec = graph();
        change(&mut spec.node_mut("system").unwrap().parameters);
        spec.validate(&kinds()).unwrap_err().to_string()
    };
    let unknown = problem(|parameters| {
        parameters.insert("disturbance".into(), json!({ "w": 1.0 }));
    });
    assert!(unknown.contains("`w`") && unknown.contains("q, v"), "{unknown}");
    let missing = problem(|parameters| {
        parameters.insert("std".into(), json!({ "v": 1.0 }));
    });
    assert!(missing.contains("`std`") && missing.contains("`q`"), "{missing}");
    let file = problem(|parameters| {
        parameters.insert("system".into(), "no_such.toml".into());
    });
    assert!(file.contains("no_such.toml"), "{file}");
    let field = problem(|parameters| {
        parameters.insert("ahaed".into(), 0.1.into());
    });
    assert!(field.contains("ahaed") && field.contains("system"), "{field}");
    let negative = problem(|parameters| {
        parameters.insert("ahead".into(), (-0.1).into());
    });
    assert!(negative.contains("ahead") && negative.contains("-0.1"), "{negative}");
}

#[test]
fn the_estimators_come_with_the_others() {
    assert!(graph().validate(&registry()).is_ok());
}

/// The loop of models with a camera and an estimator in the place of the encoder.
fn models() -> GraphSpec {
    let mut spec = pendulum::simulated();
    spec.node_mut("encoder").unwrap().kind = "pendulum/camera".into();
    let mut estimator = NodeSpec::new("estimator", "pendulum/ukf", 100.0);
    estimator.parameters =
        crate::support::delayed::parameters(json!({ "ahead": 0.01, "reorder": 1, "steps": 6 }));
    spec.nodes.push(estimator);
    let edge = spec.connections.iter_mut().find(|c| c.from == "encoder" && c.to == "agent").unwrap();
    (edge.from, edge.port) = ("estimator".into(), Some("estimator".into()));
    let camera = ConnectionSpec::new("encoder", "estimator");
    spec.connections.push(ConnectionSpec { port: Some("camera".into()), blocking: true, ..camera });
    let motor = ConnectionSpec::new("motor", "estimator");
    spec.connections.push(ConnectionSpec { skip: true, window: 4, ..motor });
    spec
}

#[test]
fn an_estimator_is_compiled_with_its_graph() {
    let graph = models().validate(&registry()).unwrap();
    let recording = Executor::new(graph.clone(), 2).record(2 * SECOND).unwrap();
    let episode = Episode::from_recording(&graph, &recording).unwrap();
    let compiled = compile(&graph, &[episode], &CompileOptions::default()).unwrap();
    let batch = Batch::new(&graph, &compiled, 2).unwrap();
    let mut environments = batch.environments(1);
    environments.set_seeds(&[2]).unwrap();
    let run = |precision| batch.rollout(&environments, precision, &["estimator"]).unwrap();
    let (plain, lanes) = (run(Precision::Double), run(Precision::DoubleLanes));
    let track = recording.node("estimator").unwrap();
    let mut compared = 0;
    for step in 0..plain.outputs[0].steps {
        let message = plain.outputs[0].message(0, step);
        if message[0].is_nan() {
            continue;
        }
        assert_eq!(message, track.message(step as u64).unwrap().payload, "{step}");
        for (a, b) in message.iter().zip(lanes.outputs[0].message(0, step)) {
            assert!((a - b).abs() <= 1e-7 * a.abs().max(1.0), "{step}: {a} {b}");
        }
        compared += 1;
    }
    assert!(compared > 150, "{compared}");
}

#[test]
fn the_example_runs_and_its_text_goes_into_the_graph() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/compensation");
    let text = std::fs::read_to_string(folder.join("graph.toml")).unwrap();
    let mut spec = GraphSpec::from_toml(&text).unwrap();
    // Elsewhere the file is not there; what was put into the graph is.
    assert!(spec.validate(&registry()).is_err());
    parallax_nodes::estimator::embed(&mut spec, &folder).unwrap();
    let recording = Executor::new(spec.validate(&registry()).unwrap(), 1).record(5 * SECOND).unwrap();
    assert_eq!(recording.node("estimator").unwrap().layout.name, "pendulum/Estimate");
    let monitor = recording.node("monitor").unwrap();
    let last = monitor.messages.last().unwrap();
    let leaf = |name: &str| last.payload[monitor.layout.leaf(name).unwrap()];
    assert!(leaf("updates") > 400.0 && leaf("blind") == 0.0, "{last:?}");
    assert!(leaf("q_std") < 0.01 && leaf("nis_low") < leaf("nis_high"), "{last:?}");
}
