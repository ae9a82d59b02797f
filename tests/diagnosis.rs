//! Diagnoses from the command line: the demo's own machine, and a real one.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::{Mutex, PoisonError};

use parallax::runtime::recording::Recording;
use serde_json::Value;

/// The demo runs in real time, and a diagnosis takes every core: one after the other.
static TURN: Mutex<()> = Mutex::new(());

/// Runs the program in `folder` and reads the JSON that it prints.
fn json(folder: &Path, arguments: &[&str]) -> Value {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let output =
        Command::new(env!("CARGO_BIN_EXE_parallax")).current_dir(folder).args(arguments).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn the_demo_finds_what_its_world_hides() {
    let folder = tempfile::tempdir().unwrap();
    // This seed hides a lag, which no other effect resembles on these commands.
    let demo = json(folder.path(), &["demo", "--seed", "3", "--json"]);
    assert_eq!(demo["hidden"], "lag@input:voltage");
    assert_eq!((&demo["replay_exact"], &demo["world_exact"]), (&Value::from(true), &Value::from(true)));
    assert_eq!(demo["right"], true, "{}", demo["report"]["summary"]);

    let out = folder.path().join("out/demo");
    let report: Value = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report, demo["report"]);
    assert!(fs::read_to_string(out.join("report.html")).unwrap().contains("</html>"));
    // What is corrected is a system like any other.
    let system = json(folder.path(), &["info", "out/demo/system.corrected.toml", "--json"]);
    assert_eq!(system["effects"][0]["name"], "lag");
    // The recording tells neither what was hidden nor the seed that drew it.
    let recording = Recording::read(out.join("recording.mcap")).unwrap();
    assert_ne!(recording.clock.seed(), 3);
    let graph = recording.graph.to_json();
    assert!(!graph.contains("hidden") && !graph.contains("lag"), "{graph}");
}

#[test]
fn the_friction_of_a_real_axis_is_named() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/emps");
    if !data.exists() {
        println!("not run: {} does not exist", data.display());
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| data.join(name).to_str().unwrap().to_owned();
    let (system, log) = (path("system.toml"), path("estimation"));
    let report = json(folder.path(), &["diagnose", "--system", &system, &log, "--out", "emps", "--json"]);

    assert_eq!(report["gap"]["detected"], true);
    let first = &report["which"][0]["effects"][0];
    assert_eq!(first["place"], "joint:axis");
    let name = first["name"].as_str().unwrap();
    assert!(["coulomb", "asymmetric_friction"].contains(&name), "{name}");
    // Published: Janot, Gautier, Brunot 2019.
    let close = |found: &Value, published: f64| {
        let found = found.as_f64().unwrap();
        assert!((found / published - 1.0).abs() < 0.05, "{found} is not within 5 % of {published}");
    };
    let calibrated = |name: &str| {
        let all = report["calibration"].as_array().unwrap();
        all.iter().find(|entry| entry["name"] == name).unwrap()["value"].clone()
    };
    close(&calibrated("M"), 95.109);
    close(&calibrated("Fv"), 203.50);
    let value = |parameter: &str| first["parameters"][parameter]["value"].as_f64();
    // With a calibrated offset the two forms differ by it alone: their mean force is the same.
    let force =
        value("force").unwrap_or_else(|| 0.5 * (value("forward").unwrap() + value("backward").unwrap()));
    close(&force.into(), 20.394);
    assert!(report["how_far"]["closed_by_effect"]["value"].as_f64().unwrap() > 0.9, "{}", report["how_far"]);
}
