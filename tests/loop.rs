//! The loop with the user at the command line: choices, questions, the next experiment, and a graph that plays it. The
//! machine is simulated by code of its own.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

use command::ends;
use parallax::nodes::command_file::CommandFile;
use parallax::runtime::recording::Recording;
use serde_json::Value;
use tempfile::TempDir;

const SYSTEM: &str = r#"
format = 1
name = "axis"
[parameters]
M = { value = 2.0, unit = "kg" }
k = { value = 3.0, unit = "N/V", calibrate = [1.0, 9.0] }
b = { value = 4.0, unit = "N s/m", calibrate = [0.5, 20.0] }
s = { value = 30.0, unit = "N/m" }
[inputs]
u = { signal = "voltage" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(k*u - b*v - s*q)/M" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "k*u", load = "-s*q" }
"#;

/// The machine: its amplifier follows commands 30 ms late. Records a log into `name` under `folder`.
fn record(folder: &Path, name: &str, duration: f64, command: impl Fn(f64) -> f64) {
    let (h, mut q, mut v) = (1e-4, 0.0_f64, 0.0_f64);
    let mut rows = String::from("t,u,x\n");
    let mut noise = 7_u32;
    for step in 0..(duration / h).round() as usize {
        let t = step as f64 * h;
        if step % 100 == 0 {
            let mut sum = -6.0;
            for _ in 0..12 {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                sum += f64::from(noise) / f64::from(u32::MAX);
            }
            rows.push_str(&format!("{t:.2},{},{}\n", command(t), q + 2e-4 * sum));
        }
        // What is commanded is held for the 10 ms of a sample.
        let held = ((t - 0.03 + 1e-9) * 100.0).floor() / 100.0;
        v += h * (3.1 * command(held.max(0.0)) - 4.2 * v - 30.0 * q) / 2.0;
        q += h * v;
    }
    let log = folder.join(name);
    fs::create_dir(&log).unwrap();
    fs::write(log.join("log.csv"), rows).unwrap();
    let manifest = "format = 1\ntitle = \"an axis\"\n\n\
        [[signal]]\nname = \"voltage\"\nrole = \"command\"\nunit = \"V\"\nfile = \"log.csv\"\ntime = \"t\"\nvalue = \"u\"\n\n\
        [[signal]]\nname = \"position\"\nrole = \"measurement\"\nunit = \"m\"\nfile = \"log.csv\"\ntime = \"t\"\nvalue = \"x\"\n";
    fs::write(log.join("recording.toml"), manifest).unwrap();
}

fn with_sine() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("system.toml"), SYSTEM).unwrap();
    record(folder.path(), "sine", 12.0, |t| 4.0 * (TAU * 0.5 * t).sin());
    folder
}

const DIAGNOSE: [&str; 7] = ["diagnose", "--system", "system.toml", "--only", "delay@input", "--only", "lag"];

fn report(folder: &TempDir, name: &str) -> Value {
    serde_json::from_str(&fs::read_to_string(folder.path().join(name).join("report.json")).unwrap()).unwrap()
}

#[test]
fn what_a_log_leaves_open_the_next_one_decides() {
    let folder = with_sine();
    ends(&folder, 0, &[&DIAGNOSE[..], &["sine", "--out", "first"]].concat());
    let first = report(&folder, "first");
    assert_eq!(first["which"][0]["class"].as_array().unwrap().len(), 2, "{}", first["which"]);
    assert_eq!(first["confusable"][0]["experiment"]["separates"], true, "{}", first["confusable"]);

    let (said, _) = ends(&folder, 0, &["experiment", "first", "--duration", "10"]);
    for part in ["delay@input:u", "lag@input:u", "voltage", "written to", "right in"] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    let file = CommandFile::read(&folder.path().join("first/experiment.csv")).unwrap();
    assert_eq!(file.units["voltage"], "V");
    assert!(file.duration() < 10.0 && file.duration() > 9.5);

    record(folder.path(), "second", 10.0, |t| file.at("voltage", t + 1e-9).unwrap());
    ends(&folder, 0, &[&DIAGNOSE[..], &["sine", "second", "--out", "then"]].concat());
    let then = report(&folder, "then");
    assert_eq!(then["which"][0]["class"], serde_json::json!(["delay@input:u"]), "{}", then["which"]);
    assert_eq!(then["made_from"]["recordings"].as_array().unwrap().len(), 2);
    // Then there is nothing left to ask.
    let (said, _) = ends(&folder, 1, &["experiment", "then"]);
    assert!(said.contains("nothing to tell apart"), "{said}");
}

#[test]
fn an_experiment_says_what_it_cannot_use() {
    let folder = with_sine();
    let refused = |arguments: &[&str], parts: &[&str]| {
        let (_, errors) = ends(&folder, 2, arguments);
        for part in parts {
            assert!(errors.contains(part), "{arguments:?}: no `{part}` in: {errors}");
        }
    };
    refused(&["experiment", "nowhere"], &["nowhere", "parallax diagnose"]);
    fs::write(folder.path().join("report.json"), "{}").unwrap();
    refused(&["experiment", "report.json"], &["report.json", "no report"]);
    refused(&["experiment", ".", "--limit", "voltage=3"], &["--limit", "SIGNAL=LOW:HIGH"]);
}

#[test]
fn an_experiment_says_what_it_leaves_alike_and_what_a_sensor_would_tell() {
    let folder = with_sine();
    ends(&folder, 0, &[&DIAGNOSE[..], &["sine", "--out", "first"]].concat());
    let (command, reading) = ("delay@input:u", "delay@output:position");
    let (_, errors) = ends(&folder, 2, &["experiment", "first", "--effect", "delay@input:v"]);
    assert!(errors.contains("did you mean `delay@input:u`"), "{errors}");
    let (_, errors) = ends(&folder, 2, &["experiment", "first", "--effect", command]);
    assert!(errors.contains("two candidates"), "{errors}");
    // With these sensors the answer is no.
    let (said, _) = ends(&folder, 1, &["experiment", "first", "--effect", command, "--effect", reading]);
    assert!(said.contains("impossible with these sensors; add a sensor of"), "{said}");
    let three = ["experiment", "first", "--effect", command, "--effect", "lag@input:u", "--effect", reading];
    let (said, _) = ends(&folder, 0, &three);
    assert!(said.contains(&format!("leaves {command} and {reading} alike; with a sensor of")), "{said}");
}

#[test]
fn choices_of_effects_are_checked_and_followed() {
    let folder = with_sine();
    let refused = |more: &[&str], parts: &[&str]| {
        let all = [&["diagnose", "--system", "system.toml", "sine"][..], more].concat();
        let (_, errors) = ends(&folder, 2, &all);
        for part in parts {
            assert!(errors.contains(part), "{more:?}: no `{part}` in: {errors}");
        }
    };
    refused(&["--only", "coulom"], &["--only", "did you mean `coulomb`"]);
    refused(&["--exclude", "coulomb@joint:axle"], &["--exclude", "did you mean `coulomb@joint:axis`"]);
    refused(&["--prior", "coulomb"], &["--prior", "EFFECT[@PLACE]=WEIGHT"]);
    refused(&["--only", "lag", "--exclude", "input:u"], &["leave no effect"]);

    let choice =
        ["--prior", "lag=1000000", "--explain", "delay", "--explain", "coulomb", "--explain", "viscous"];
    let all = [&DIAGNOSE[..], &["--only", "viscous", "sine", "--out", "out", "--json"], &choice].concat();
    let (said, _) = ends(&folder, 0, &all);
    let found: Value = serde_json::from_str(&said).unwrap();
    // A sine leaves it to the prior which of the two leads the others' probabilities.
    let explained = |effect: &str| {
        let list = found["explanations"].as_array().unwrap();
        list.iter()
            .find(|e| e["effect"] == effect)
            .unwrap_or_else(|| panic!("no {effect} in {list:?}"))
            .clone()
    };
    let delay = explained("delay@input:u");
    assert!(delay["parameters"]["delay"]["value"].as_f64().unwrap() > 0.02, "{delay}");
    assert!(delay["against_no_effect"].as_f64().unwrap() > 10.0, "{delay}");
    let dry = explained("coulomb@joint:axis");
    assert_eq!(dry["fate"]["not_testable"]["reason"], "you left it out", "{dry}");
    let wet = explained("viscous@joint:axis");
    assert_eq!(wet["fate"]["absorbed"]["by"], "b", "{wet}");
}

#[test]
fn a_graph_plays_a_command_file() {
    let folder = tempfile::tempdir().unwrap();
    let text = "time,motor.voltage\n0,0\n0.5,1.5\n1.0,-2\n1.5,0\n";
    fs::write(folder.path().join("c.csv"), text).unwrap();
    let arguments = ["sim", "pendulum", "--duration", "2", "--play", "motor=c.csv", "--out", "played.mcap"];
    ends(&folder, 0, &arguments);
    let log = Recording::read(folder.path().join("played.mcap")).unwrap().log();
    let voltage = log.signal("motor.voltage").unwrap();
    for (time, value) in voltage.times.iter().zip(&voltage.values) {
        let seconds = *time as f64 * 1e-9;
        let expected = [0.0, 1.5, -2.0, 0.0][((seconds - 0.02) / 0.5).max(0.0) as usize % 4];
        let edge = (seconds / 0.5 - (seconds / 0.5).round()).abs() < 0.06;
        assert!(edge || *value == expected, "{value} V at {seconds} s");
    }
    assert_eq!(voltage.values.iter().copied().fold(0.0, f64::min), -2.0);
    // The recording holds what was played, so that its replay needs no file.
    fs::remove_file(folder.path().join("c.csv")).unwrap();
    ends(&folder, 0, &["replay", "played.mcap"]);
    fs::write(folder.path().join("bad.csv"), "time,motor.volts\n0,0\n").unwrap();
    let arguments = ["sim", "pendulum", "--play", "motor=bad.csv"];
    let (_, errors) = ends(&folder, 2, &arguments);
    assert!(errors.contains("motor.volts") && errors.contains("voltage"), "{errors}");
}
