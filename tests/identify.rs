//! `parallax identify` from a recording to a graph that runs, and what it says of files that cannot be used.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;
use std::path::Path;

use command::{ends, fail, json, succeed};
use parallax::nodes::pendulum::{self, hidden::HiddenEffect};
use parallax::runtime::recording::write;
use parallax::runtime::registry::Registry;
use parallax::sim::Executor;

const SPEC: &str = include_str!("../examples/identify/pendulum.toml");

/// A recording of the demo's graph, whose world hides a delay of the commands.
fn record(path: &Path, delay: f64) {
    let registry = pendulum::kinds(Registry::new(), HiddenEffect::Delay { delay });
    let graph = pendulum::graph().validate(&registry).expect("the demo's graph");
    let recording = Executor::new(graph, 5).record(8_000_000_000).expect("a run");
    write(path, &recording).expect("a file");
}

#[test]
fn a_recording_becomes_a_graph_with_what_was_hidden_in_it() {
    let folder = tempfile::tempdir().unwrap();
    record(&folder.path().join("run.mcap"), 0.017);
    fs::write(folder.path().join("identify.toml"), SPEC).unwrap();
    let answer =
        json(folder.path(), &["identify", "run.mcap", "--spec", "identify.toml", "--out", "out", "--json"]);
    let estimate = |name: &str| {
        let all = answer["estimates"].as_array().unwrap();
        all.iter().find(|e| e["name"] == name).unwrap_or_else(|| panic!("no {name} in {answer}"))["value"]
            .as_f64()
            .unwrap()
    };
    assert!((estimate("actuator") - 0.01735).abs() < 1e-3, "{}", estimate("actuator"));
    assert!((estimate("J") / estimate("K") / (1.62e-4 / 0.0337) - 1.0).abs() < 0.01);
    assert!(answer["outputs"][0]["held_out"].as_f64().unwrap() < 0.006, "{answer}");
    for file in ["out/identified.toml", "out/identified.json", "out/report.html"] {
        assert!(folder.path().join(file).exists(), "{file}");
    }
    assert!(!folder.path().join("out/checkpoint.json").exists());
    let page = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    roxmltree::Document::parse_with_options(
        &page,
        roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() },
    )
    .unwrap();
    let graph = fs::read_to_string(folder.path().join("out/identified.toml")).unwrap();
    assert!(graph.contains("pendulum/simulator") && graph.contains("inertia = 0.000162"), "{graph}");
    succeed(folder.path(), &["sim", "out/identified.toml", "--duration", "1", "--out", "again.mcap"]);
}

#[test]
fn what_is_wrong_is_named_with_file_line_and_entry() {
    let folder = tempfile::tempdir().unwrap();
    record(&folder.path().join("run.mcap"), 0.0);
    let says = |change: (&str, &str), expected: &[&str]| {
        assert!(SPEC.contains(change.0), "{}", change.0);
        fs::write(folder.path().join("identify.toml"), SPEC.replacen(change.0, change.1, 1)).unwrap();
        fail(folder.path(), &["identify", "run.mcap", "--spec", "identify.toml"], 2, expected);
    };
    says(("pendulum.inertia", "inertia"), &["identify.toml:14", "`J`", "pendulum.inertia"]);
    says(("low = 0.015", "low = 0.15"), &["identify.toml:15", "`K`", "bounds"]);
    says(("motor -> world\" = {", "motor => world\" = {"), &["identify.toml:25", "FROM -> TO"]);
    says(("motor -> world\" = {", "motr -> world\" = {"), &["identify.toml:25", "motr", "motor"]);
    says(("camera.angle", "camera.angel"), &["identify.toml:32", "camera.angel", "angle"]);
    says(("hold_out", "hold_oot"), &["identify.toml", "hold_oot", "line 4"]);
    says(("low = 2.0, ", ""), &["identify.toml", "low", "line 20"]);
    let arguments = ["identify", "run.mcap", "--spec", "absent.toml"];
    fail(folder.path(), &arguments, 2, &["absent.toml"]);
    let (_, errors) = ends(folder.path(), 2, &["identify", "run.mcap"]);
    assert!(errors.contains("--spec"));
}
