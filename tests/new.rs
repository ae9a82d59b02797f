//! `parallax new`: every file that it writes is used as it was written.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use command::{Noise, fail, json, succeed};
use parallax::model::plant::Plant;
use parallax::model::program::Workspace;
use parallax::model::system::System;
use parallax::runtime::import::foreign::{Converted, write_folder};
use parallax::runtime::recording::log::{Log, Role, Signal};
use serde_json::Value;

/// A log of the machine that the file describes: its commands go up and down, and its sensors have noise.
fn simulate(folder: &Path, file: &str, around: f64, swing: f64) {
    let text = fs::read_to_string(folder.join(file)).unwrap();
    let system = System::parse(&text, file).unwrap();
    let plant = Plant::alone(system.equations().unwrap()).unwrap();
    let program = plant.rate_program();
    let parameters: Vec<f64> = system.parameters.iter().map(|parameter| parameter.value).collect();
    let (states, inputs) = (plant.states(), system.inputs.len());
    let mut noise = Noise(1);
    // A machine at rest: rotors turn already.
    let mut x: Vec<f64> =
        plant.state_names().iter().map(|name| if name == "m" { around } else { 0.0 }).collect();
    let mut results = vec![0.0; states + system.outputs.len()];
    let mut workspace = Workspace::new();
    let (mut times, mut commands, mut readings) =
        (vec![], vec![vec![]; inputs], vec![vec![]; system.outputs.len()]);
    for k in 0..800_i32 {
        let t = f64::from(k) * 0.01;
        // Each input has tones of its own.
        let u: Vec<f64> = (0..inputs)
            .map(|i| {
                around + swing * ((2.1 + i as f64) * t).sin() + swing * ((5.3 + 1.7 * i as f64) * t).cos()
            })
            .collect();
        let mut at = |x: &[f64]| {
            program.evaluate(&[&parameters[..], x, &u, &[t]].concat(), &mut workspace, &mut results);
            results.clone()
        };
        times.push(i64::from(k) * 10_000_000);
        for (signal, value) in commands.iter_mut().zip(&u) {
            signal.push(*value);
        }
        for (signal, value) in readings.iter_mut().zip(&at(&x)[states..]) {
            signal.push(value + 1e-3 * noise.draw());
        }
        // The midpoint rule, a millisecond at a time.
        for _ in 0..10 {
            let half: Vec<f64> = x.iter().zip(at(&x)).map(|(x, rate)| x + 0.0005 * rate).collect();
            x.iter_mut().zip(at(&half)).for_each(|(x, rate)| *x += 0.001 * rate);
        }
    }
    let of = |name: &str, role, unit: &str, values| Signal::new(name, role, unit, times.clone(), values);
    let mut signals: Vec<Signal> = system
        .inputs
        .iter()
        .zip(commands)
        .map(|(input, values)| of(&input.signal, Role::Command, "", values))
        .collect();
    signals.extend(
        system
            .outputs
            .iter()
            .zip(readings)
            .map(|(output, values)| of(&output.signal, Role::Measurement, &output.unit, values)),
    );
    let log = Log { title: file.into(), signals, ..Log::default() };
    let changed = vec![String::new(); log.signals.len()];
    write_folder(&folder.join("log"), &Converted { log, origin: 0, changed }).unwrap();
}

#[test]
fn every_template_is_diagnosed_as_it_is_written() {
    for (template, around, swing) in [
        ("joint", 0.0, 0.1),
        ("axis", 0.0, 20.0),
        ("first-order", 0.0, 1.0),
        ("arm", 0.0, 0.5),
        ("quadrotor", 0.5, 0.1),
        ("blank", 0.0, 1.0),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let said = succeed(&folder, &["new", "system", "--template", template]);
        assert!(
            said.contains("system.toml written") && said.contains("parallax diagnose --system system.toml"),
            "{said}"
        );
        simulate(folder.path(), "system.toml", around, swing);
        let found = json(
            &folder,
            &[
                "diagnose",
                "--system",
                "system.toml",
                "log",
                "--json",
                "--out",
                "out",
                "--only",
                "delay",
                "--only",
                "saturation",
            ],
        );
        assert!(found["gap"]["detected"] == false, "{template}: {found}");
        assert!(found["gap"]["p_value"].is_number(), "{template}: {found}");
        fail(&folder, &["new", "system"], 2, &["system.toml exists already", "--out"]);
    }
}

/// A signal's name, role and unit.
type Told<'a> = (&'a str, Role, &'a str);

fn log(folder: &Path, signals: &[Told<'_>]) {
    let times: Vec<i64> = (0..400).map(|k| k * 10_000_000).collect();
    let values = |i: usize| (0..400).map(|k| (f64::from(k) * 0.05 + i as f64).sin()).collect::<Vec<_>>();
    let signals: Vec<Signal> = signals
        .iter()
        .enumerate()
        .map(|(i, (name, role, unit))| Signal::new(*name, *role, *unit, times.clone(), values(i)))
        .collect();
    let changed = vec![String::new(); signals.len()];
    write_folder(
        folder,
        &Converted { log: Log { title: "log".into(), signals, ..Log::default() }, origin: 0, changed },
    )
    .unwrap();
}

#[test]
fn a_file_is_made_for_the_signals_of_a_log() {
    use Role::{Command, Context, Measurement};
    let cases: [(&str, &[Told<'_>], &[&str]); 4] = [
        (
            "joint",
            &[
                ("motor voltage", Command, "V"),
                ("angle", Measurement, "deg"),
                ("speed", Measurement, "rpm"),
                ("vbat", Context, "V"),
            ],
            &[
                "signal = \"motor voltage\"",
                "q*57.29",
                "\"v*9.54",
                "unit = \"N m/V\"",
                "# \"vbat\" (context, V)",
            ],
        ),
        (
            "axis",
            &[("u", Command, ""), ("x \"1\"", Measurement, "mm")],
            &["signal = \"x \\\"1\\\"\"", "\"q*1000\"", "# speed"],
        ),
        (
            "arm",
            &[
                ("goal_elbow", Command, "rad"),
                ("goal_2nd", Command, "rad"),
                ("position_elbow", Measurement, "rad"),
                ("position_2nd", Measurement, "rad"),
            ],
            &["tau_elbow", "q_joint_2nd = ", "initial = \"position_elbow\""],
        ),
        (
            "first-order",
            &[("heat", Command, "W"), ("temperature", Measurement, "degC")],
            &["degC/W", "initial = \"temperature\""],
        ),
    ];
    for (template, signals, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        log(&folder.path().join("log"), signals);
        let said = succeed(&folder, &["new", "system", "--from", "log", "--out", "made/system.toml"]);
        assert!(said.contains(&format!("of the template `{template}`")), "{said}");
        let text = fs::read_to_string(folder.path().join("made/system.toml")).unwrap();
        for part in expected {
            assert!(text.contains(part), "{template}: no `{part}` in: {text}");
        }
        // Whatever such a log is: the file is accepted for it as it is.
        let found: Value = json(
            &folder,
            &["diagnose", "--system", "made/system.toml", "log", "--json", "--out", "out", "--only", "delay"],
        );
        assert!(found["gap"]["p_value"].is_number(), "{found}");
    }
}

#[test]
fn a_log_that_says_too_little_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    log(&folder.path().join("log"), &[("u", Role::Command, "V")]);
    fail(&folder, &["new", "system", "--from", "log"], 2, &["no measurement"]);
    fail(&folder, &["new", "system", "--from", "log", "--template", "arm"], 2, &["no measurement"]);
    fail(&folder, &["new", "system", "--from", "nowhere"], 2, &["nowhere"]);
    assert!(!folder.path().join("system.toml").exists());
}

#[test]
fn a_new_graph_runs_under_both_clocks() {
    for template in ["pendulum", "quadrotor"] {
        let folder = tempfile::tempdir().unwrap();
        let said = succeed(&folder, &["new", "graph", "--template", template, "--name", "mine"]);
        assert!(said.contains("graph.toml written"), "{said}");
        fail(&folder, &["new", "graph"], 2, &["graph.toml exists already", "--out"]);
        // What it says comes next.
        for line in said.lines().filter_map(|line| line.trim().strip_prefix("parallax ")) {
            let line = line.replace("--duration 10", "--duration 3");
            succeed(&folder, &line.split(' ').collect::<Vec<_>>());
        }
        let info = json(&folder, &["info", "out/mine/recording.mcap", "--json"]);
        assert!(info["nodes"].as_array().unwrap().iter().any(|node| node["name"] == "agent"), "{info}");
    }
}

/// The program that a new crate makes: cargo built it of the same files, as an example.
fn built() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_parallax")).parent().unwrap().join("examples/new_node")
}

#[test]
fn a_new_node_in_rust_is_a_crate_whose_program_runs_its_graph() {
    let folder = tempfile::tempdir().unwrap();
    let said = succeed(&folder, &["new", "node", "my_agent"]);
    assert!(said.contains("cargo run --release -- sim graph.toml"), "{said}");
    let crate_folder = folder.path().join("my_agent");
    // The sources are those that the example is built of.
    let templates = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/cli/new/templates/node");
    for file in ["main.rs", "my_agent.rs"] {
        let written = fs::read_to_string(crate_folder.join("src").join(file)).unwrap();
        assert_eq!(written, fs::read_to_string(templates.join(file)).unwrap());
    }
    // Cargo understands the crate, and finds this checkout.
    let metadata = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(&crate_folder)
        .output()
        .unwrap();
    assert!(metadata.status.success(), "{}", String::from_utf8_lossy(&metadata.stderr));
    let metadata: Value = serde_json::from_slice(&metadata.stdout).unwrap();
    let dependency = &metadata["packages"][0]["dependencies"][0];
    assert_eq!(dependency["path"], env!("CARGO_MANIFEST_DIR"), "{dependency}");

    let run = |arguments: &[&str]| {
        let output = Command::new(built()).args(arguments).current_dir(&crate_folder).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{arguments:?}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    };
    run(&["sim", "graph.toml", "--duration", "10", "--out", "out/sim.mcap"]);
    run(&["run", "graph.toml", "--duration", "2", "--out", "out/run.mcap"]);
    // Its own program knows the kind, so that it is replayed, bit for bit.
    assert!(run(&["replay", "out/sim.mcap"]).contains("exact: "));
    let recording = parallax::runtime::recording::Recording::read(crate_folder.join("out/sim.mcap")).unwrap();
    let log = recording.log();
    let angles = &log.signal("camera.angle").unwrap().values;
    assert!(angles[angles.len() - 100..].iter().all(|angle| angle.abs() < 0.4), "it never stood");
    // The ready-made program does not know it, and says so.
    fail(&crate_folder, &["sim", "graph.toml"], 2, &["my_agent"]);
}

#[test]
fn a_new_node_has_a_name_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    fail(&folder, &["new", "node", "My-Agent"], 2, &["cannot be a node's name", "my_agent"]);
    fail(&folder, &["new", "node", "match"], 2, &["`match` is taken"]);
    fail(
        &folder,
        &["new", "node", "eye", "--parallax", "nowhere"],
        2,
        &["nowhere is no checkout", "--parallax"],
    );
    assert!(!folder.path().join("eye").exists());
    succeed(&folder, &["new", "node", "eye", "--out", "deep/inside"]);
    assert!(fs::read_to_string(folder.path().join("deep/inside/src/eye.rs")).unwrap().contains("struct Eye"));
    fail(&folder, &["new", "node", "eye", "--out", "deep/inside"], 2, &["exists already"]);
    // The module in Python names the class that its graph asks for.
    succeed(&folder, &["new", "node", "eye", "--python"]);
    let graph = fs::read_to_string(folder.path().join("eye/graph.toml")).unwrap();
    assert!(graph.contains(r#"class = "eye:Eye""#), "{graph}");
    assert!(fs::read_to_string(folder.path().join("eye/eye.py")).unwrap().contains("class Eye:"));
}
