//! Graphs of models under the simulated clock do what their agents want.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::f64::consts::{PI, TAU};

use parallax::model::system::System;
use parallax::nodes::{equations, pendulum, quadrotor, registry};
use parallax::runtime::graph::GraphSpec;
use parallax::runtime::recording::Recording;
use parallax::runtime::registry::Registry;
use parallax::runtime::time::{SECOND, to_seconds};
use parallax::sim::Executor;

fn record(spec: &GraphSpec, registry: &Registry, seconds: i64) -> Recording {
    Executor::new(spec.validate(registry).unwrap(), 1).record(seconds * SECOND).unwrap()
}

#[test]
fn the_quadrotor_flies_its_circle_in_spite_of_its_delays() {
    let recording = record(&quadrotor::simulated(), &registry(), 20);
    let world = recording.node("world").unwrap();
    let worst = world
        .messages
        .iter()
        .filter(|message| message.sent > 5 * SECOND)
        .map(|message| {
            let [x, y, z] = message.payload[..3] else { panic!("a position") };
            let angle = TAU * to_seconds(message.sent) / 6.0;
            ((x - angle.cos()).powi(2) + (y - angle.sin()).powi(2) + (z - 1.0).powi(2)).sqrt()
        })
        .fold(0.0, f64::max);
    assert!(worst < 0.05, "it is {worst} m from where it should be");
}

#[test]
fn the_simulated_pendulum_is_swung_up_and_balanced() {
    let mut spec = pendulum::simulated();
    let agent = spec.node_mut("agent").unwrap();
    agent.parameters.insert("balance_only".into(), true.into());
    // A little shaking: from rest, dry friction would hold it.
    agent.parameters.insert("excitation".into(), 0.5.into());
    let recording = record(&spec, &registry(), 15);
    let world = recording.node("world").unwrap();
    let late = world.messages.iter().filter(|message| message.sent > 12 * SECOND);
    let worst = late
        .map(|message| (message.payload[0] + PI).rem_euclid(TAU) - PI)
        .fold(0.0, |worst: f64, angle| worst.max(angle.abs()));
    assert!(worst < 0.3, "upright within {worst} rad");
}

#[test]
fn a_system_of_equations_takes_the_place_of_world_and_camera() {
    let spec = pendulum::graph();
    let graph = spec.validate(&registry()).unwrap();
    let system = System::parse(pendulum::SYSTEM, "system.toml").unwrap();
    let layout = |node: &str| graph.index(node).map(|node| graph.nodes()[node].kind.output().clone());
    let kinds = registry().with("plant", equations::kind(&system, layout).unwrap());

    let mut simulated = spec.clone();
    simulated.nodes.retain(|node| node.name != "world");
    simulated.connections.retain(|connection| connection.from != "world" && connection.to != "world");
    let camera = simulated.node_mut("camera").unwrap();
    camera.kind = "plant".into();
    camera.parameters.insert("initial".into(), serde_json::json!({"q": PI, "v": 0.0}));
    simulated.connections.push(parallax::runtime::graph::ConnectionSpec {
        skip: true,
        ..parallax::runtime::graph::ConnectionSpec::new("motor", "camera")
    });
    let recording = record(&simulated, &kinds, 10);
    let camera = recording.node("camera").unwrap();
    assert_eq!(camera.layout.name, "pendulum/Angle");
    let fastest = camera
        .messages
        .windows(2)
        .map(|pair| (pair[1].payload[0] - pair[0].payload[0]).abs())
        .fold(0.0, f64::max);
    assert!((0.05..0.5).contains(&fastest), "it swings, {fastest} rad from tick to tick");

    // What the file leaves open has to be said.
    let camera = simulated.node_mut("camera").unwrap();
    camera.parameters.remove("initial");
    let graph = simulated.validate(&kinds).unwrap();
    let error = graph.build(graph.index("camera").unwrap(), 1).err().unwrap().to_string();
    assert!(error.contains("`q`") && error.contains("initial"), "{error}");
}
