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

/// A folder of real recordings, which are not part of the repository.
fn data(name: &str) -> Option<std::path::PathBuf> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if !data.exists() {
        println!("not run: {} does not exist", data.display());
    }
    data.exists().then_some(data)
}

/// Diagnoses recordings in `data` with the system there, or with the one at `system`.
fn diagnosed(data: &Path, system: Option<&Path>, recordings: &[&str], options: &[&str]) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    let system = text(system.unwrap_or(&data.join("system.toml")));
    let recordings: Vec<String> = recordings.iter().map(|name| text(&data.join(name))).collect();
    let mut arguments = vec!["diagnose", "--system", &system, "--out", "out", "--json"];
    arguments.extend(recordings.iter().map(String::as_str));
    arguments.extend(options);
    let report = json(folder.path(), &arguments);
    let named = report["which"][0]["effects"].as_array().map_or(&[][..], Vec::as_slice);
    let first = &report["where"][0]["place"];
    assert!(
        named.is_empty() || named.iter().any(|effect| effect["place"] == *first),
        "{}: what is named acts elsewhere than the likeliest place, {first}",
        report["summary"]
    );
    report
}

/// The effects of the leading answer, as `name@place`.
fn leading(report: &Value) -> Vec<String> {
    let effects = report["which"][0]["effects"].as_array().unwrap().iter();
    effects.map(|e| format!("{}@{}", e["name"].as_str().unwrap(), e["place"].as_str().unwrap())).collect()
}

fn closed_by_effect(report: &Value) -> f64 {
    report["how_far"]["closed_by_effect"]["value"].as_f64().unwrap()
}

#[test]
fn the_friction_of_a_real_axis_is_named() {
    let Some(data) = data("emps") else { return };
    let report = diagnosed(&data, None, &["estimation"], &[]);

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
    assert!(closed_by_effect(&report) > 0.9, "{}", report["how_far"]);
}

/// The torque reading follows the command one period late, and the motion tells that it is the reading.
#[test]
fn a_late_torque_reading_is_told_from_a_late_command() {
    let Some(data) = data("torque-pendulum") else { return };
    let report = diagnosed(&data, None, &["ilqr"], &[]);
    assert_eq!(leading(&report), ["delay@output:torque"], "{}", report["summary"]);
    let delay = &report["which"][0]["effects"][0]["parameters"]["delay"]["value"];
    assert!((delay.as_f64().unwrap() - 0.020).abs() < 0.001, "{delay}");

    // In five milliseconds the motion cannot tell the two apart.
    let report = diagnosed(&data, None, &["energy_shaping"], &[]);
    let class = report["which"][0]["class"].as_array().unwrap();
    for member in ["delay@input:tau", "delay@output:torque"] {
        assert!(class.iter().any(|name| name == member), "{class:?}");
    }
}

/// A motor with a controller of its own does not give the torque that it is sent. Driven by the measured one, the pendulum
/// loses force against its motion; a spring in its drive, which the innovations prefer, predicts held-out time worse than
/// no effect does.
#[test]
fn a_pendulum_driven_by_its_measured_torque_rubs() {
    let Some(data) = data("torque-pendulum") else { return };
    let folder = tempfile::tempdir().unwrap();
    let edited = |from: &str, change: &dyn Fn(&str) -> String| {
        let text = change(&fs::read_to_string(data.join(from)).unwrap());
        fs::write(folder.path().join(Path::new(from).file_name().unwrap()), text).unwrap();
    };
    edited("ddp/log.csv", &|text| text.to_owned());
    edited("ddp/recording.toml", &|text| {
        let signals = text.split("[[signal]]").filter(|signal| !signal.contains("\"torque_command\""));
        let driven = |signal: &str| match signal.contains("name = \"torque\"") {
            true => signal.replace("\"measurement\"", "\"command\""),
            false => signal.to_owned(),
        };
        signals.map(driven).collect::<Vec<_>>().join("[[signal]]")
    });
    edited("system.toml", &|text| {
        let text = text.replace("\"torque_command\"", "\"torque\"");
        text.lines().filter(|line| !line.starts_with("torque ")).collect::<Vec<_>>().join("\n")
    });
    let report = diagnosed(folder.path(), None, &["."], &[]);
    let first = leading(&report)[0].clone();
    assert!(
        ["coulomb@joint:shoulder", "asymmetric_friction@joint:shoulder"].contains(&first.as_str()),
        "{}",
        report["summary"]
    );
    assert!(closed_by_effect(&report) > 0.8, "{}", report["how_far"]);
}

#[test]
fn the_friction_of_a_real_gearbox_grows_with_its_load() {
    let Some(data) = data("servo-xl330") else { return };
    let logs = ["sin_sin_kp100_00", "sin_time_square_kp400_07", "lift_and_drop_kp800_09", "sin_sin_kp400_04"];
    let report = diagnosed(&data, None, &logs, &[]);
    assert_eq!(leading(&report), ["load_friction@joint:shaft"], "{}", report["summary"]);
}

#[test]
fn a_servo_that_is_stuck_in_friction_has_play() {
    let Some(data) = data("arm-so101") else { return };
    let elbow = ["--only", "input:elbow", "--only", "output:position_elbow"];
    let report = diagnosed(&data, None, &["backlash_detection"], &elbow);
    assert_eq!(leading(&report), ["backlash@input:elbow"], "{}", report["summary"]);
    assert!(closed_by_effect(&report) > 0.9, "{}", report["how_far"]);
    // Only the piece of the machine that was asked for is looked at.
    let places = report["where"].as_array().unwrap();
    assert!(places.iter().all(|p| p["place"].as_str().unwrap().ends_with("elbow")), "{places:?}");
}

#[test]
fn a_servos_answer_to_its_goal_is_sluggish() {
    let Some(data) = data("arm-so101") else { return };
    let rotation = ["--only", "input:rotation", "--only", "output:position_rotation"];
    let report = diagnosed(&data, None, &["prbs_excitation"], &rotation);
    assert!(leading(&report).contains(&"lag@input:rotation".to_owned()), "{}", report["summary"]);
    assert!(closed_by_effect(&report) > 0.9, "{}", report["how_far"]);
}

#[test]
fn the_battery_of_a_quadrotor_sags() {
    let Some(data) = data("quadrotor-crazyflie") else { return };
    let system = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/systems/crazyflie-hover.toml");
    let flights = ["b2_circle_slow_rep1", "b3_figure8_slow_rep1"];
    let report = diagnosed(&data, Some(&system), &flights, &["--from", "6", "--to", "21"]);
    assert_eq!(leading(&report), ["supply_sag@input:u"], "{}", report["summary"]);
    assert!(closed_by_effect(&report) > 0.5, "{}", report["how_far"]);
}

#[test]
fn a_tank_that_overflows_is_named_without_being_read() {
    let Some(data) = data("cascaded-tanks") else { return };
    let overflows = |report: &Value| {
        let effects = report["which"][0]["effects"].as_array().unwrap().clone();
        let own = effects.into_iter().find(|e| e["place"] == "state:upper" && e["name"] == "saturation");
        own.unwrap_or_else(|| panic!("{}", report["summary"]))["parameters"]["share"]["value"].as_f64()
    };
    // Of what the upper tank cannot hold, a part runs into the lower one.
    let one = diagnosed(&data, None, &["estimation"], &[]);
    assert!(overflows(&one).is_some_and(|share| share > 0.0), "{}", one["summary"]);
    let both = diagnosed(&data, None, &["estimation", "validation"], &[]);
    let share = overflows(&both).unwrap();
    assert!((0.2..1.0).contains(&share), "{}", both["summary"]);
    assert!(closed_by_effect(&both) > 0.6, "{}", both["summary"]);
    // Longer predictions need the states of longer: what is flexible follows each log, and fails on the rest of it.
    let long = diagnosed(&data, None, &["validation"], &["--horizon", "300"]);
    assert!(overflows(&long).is_some_and(|share| share > 0.0), "{}", long["summary"]);
}
