//! The command line as its users meet it: what it prints, what it leaves behind, and its exit codes.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;
use std::path::Path;

use command::{counts, fail, json, parallax, succeed};
use parallax::nodes::pendulum;
use parallax::runtime::recording::{Recording, write};
use serde_json::Value;
use tempfile::TempDir;

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

/// A folder with a small log in `log/`.
fn with_log() -> TempDir {
    let folder = folder();
    fs::create_dir(folder.path().join("log")).unwrap();
    let manifest = "format = 1\ntitle = \"a cart\"\n\n[constants]\nmass = 2\n\n\
        [[signal]]\nname = \"push\"\nrole = \"command\"\nunit = \"N\"\nfile = \"log.csv\"\ntime = \"t\"\nvalue = \"u\"\n\n\
        [[signal]]\nname = \"position\"\nrole = \"measurement\"\nunit = \"m\"\nfile = \"log.csv\"\ntime = \"t\"\nvalue = \"x\"\n";
    fs::write(folder.path().join("log/recording.toml"), manifest).unwrap();
    let rows: String =
        (0..200).map(|i| format!("{},{},{}\n", f64::from(i) * 0.01, i % 7, f64::from(i).sin())).collect();
    fs::write(folder.path().join("log/log.csv"), format!("t,u,x\n{rows}")).unwrap();
    let system = "format = 1\nname = \"cart\"\n[inputs]\nu = { signal = \"push\" }\n\
        [state]\nq = { derivative = \"v\" }\nv = { derivative = \"u/mass\" }\n\
        [outputs]\nposition = { value = \"q\", unit = \"m\" }\n";
    fs::write(folder.path().join("log/system.toml"), system).unwrap();
    folder
}

#[track_caller]
fn edit(folder: &TempDir, file: &str, from: &str, to: &str) {
    let path = folder.path().join(file);
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{file} has no `{from}`");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

#[test]
fn a_recording_toml_stands_for_its_folder() {
    let folder = with_log();
    assert_eq!(
        json(&folder, &["info", "log/recording.toml", "--json"]),
        json(&folder, &["info", "log", "--json"])
    );
    let cut = ["diagnose", "--system", "log/system.toml", "log/recording.toml", "--from", "9"];
    fail(&folder, &cut, 2, &["log/recording.toml has no measurement from 9 s on", "--from"]);
}

/// The pendulum's graph in `graph.toml`.
fn with_graph() -> TempDir {
    let folder = folder();
    fs::write(folder.path().join("graph.toml"), pendulum::graph().to_toml().unwrap()).unwrap();
    folder
}

#[test]
fn help_names_every_command_and_the_exit_codes() {
    let folder = folder();
    let help = succeed(&folder, &["--help"]);
    for command in ["demo", "run", "sim", "replay", "import", "info", "diagnose"] {
        assert!(help.contains(command), "{help}");
        assert!(succeed(&folder, &[command, "--help"]).contains("Exit codes:"));
    }
    assert!(!help.contains("__node"));
    fail(&folder, &["dance"], 2, &["unrecognized subcommand 'dance'"]);
    fail(&folder, &["sim", "pendulum", "--duration", "-3"], 2, &["--duration", "above zero"]);
    fail(&folder, &["sim", "pendulum", "--duration", "soon"], 2, &["a number of seconds"]);
}

#[test]
fn one_seed_gives_the_same_bytes_and_an_exact_replay() {
    let folder = folder();
    let sim = |seed: &str, out: &str| {
        json(&folder, &["sim", "pendulum", "--duration", "2", "--seed", seed, "--out", out, "--json"])
    };
    let report = sim("7", "a/first.mcap");
    sim("7", "second.mcap");
    sim("8", "third.mcap");
    assert_eq!(report["steps"], 1100);
    let bytes = |name: &str| fs::read(folder.path().join(name)).unwrap();
    assert!(bytes("a/first.mcap") == bytes("second.mcap"));
    assert!(bytes("a/first.mcap") != bytes("third.mcap"));

    let replay = json(&folder, &["replay", "a/first.mcap", "--json", "--out", "replay.json"]);
    assert_eq!((&replay["exact"], &replay["steps"]), (&Value::from(true), &Value::from(700)));
    let written: Value = serde_json::from_slice(&bytes("replay.json")).unwrap();
    assert_eq!(written, replay);
    assert!(succeed(&folder, &["replay", "a/first.mcap"]).contains("exact: 700 steps"));

    let info = json(&folder, &["info", "a/first.mcap", "--json"]);
    assert_eq!(info["nodes"][0]["steps"], 400);
    assert_eq!(info["nodes"][0]["stand_in"], true);
    assert_eq!(info["connections"][0]["name"], "world->camera");
    let delay = info["connections"][0]["delay"]["mean_s"].as_f64().unwrap();
    assert!((delay - 3e-4).abs() < 1e-4, "{delay}");
    assert_eq!(info["signals"][0]["name"], "camera.angle");
    assert_eq!(info["duration_s"], 2.0);
    assert!(succeed(&folder, &["info", "a/first.mcap"]).contains("under a simulated clock, seed 7"));
}

#[test]
fn a_replay_that_differs_exits_with_one() {
    let folder = folder();
    succeed(&folder, &["sim", "pendulum", "--duration", "1", "--out", "x.mcap"]);
    let path = folder.path().join("x.mcap");
    let mut recording = Recording::read(&path).unwrap();
    let agent = recording.nodes.iter_mut().find(|track| track.name == "agent").unwrap();
    agent.messages[10].payload[0] += 1e-12;
    write(&path, &recording).unwrap();
    let output = parallax(&folder, &["replay", "x.mcap"]);
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("step 10 of node `agent`: voltage is") && text.contains("not exact"), "{text}");
}

#[test]
fn a_folder_is_imported_and_described() {
    let folder = with_log();
    let report = json(&folder, &["import", "log", "--out", "made/log.mcap", "--json"]);
    assert_eq!((&report["signals"], &report["samples"]), (&Value::from(2), &Value::from(400)));
    let from_folder = json(&folder, &["info", "log", "--json"]);
    let from_file = json(&folder, &["info", "made/log.mcap", "--json"]);
    assert_eq!(from_folder, from_file);
    assert_eq!(from_folder["signals"][0]["unit"], "N");
    assert_eq!(from_folder["constants"]["mass"], 2.0);
    assert!(succeed(&folder, &["info", "log/recording.toml"]).contains("a cart: 2 signals"));
    fail(&folder, &["replay", "made/log.mcap"], 2, &["is an imported log", "diagnose it instead"]);

    let system = json(&folder, &["info", "log/system.toml", "--json"]);
    assert_eq!(
        (&system["name"], &system["constants_needed"][0]),
        (&Value::from("cart"), &Value::from("mass"))
    );
}

#[test]
fn graphs_are_described_and_nodes_changed() {
    let folder = with_graph();
    let graph = json(&folder, &["info", "graph.toml", "--json"]);
    assert_eq!(graph, json(&folder, &["info", "pendulum", "--json"]));
    assert_eq!(graph["supervisor"], "agent");
    let slow = json(&folder, &["sim", "graph.toml", "--duration", "1", "--node", "world.rate=100", "--json"]);
    assert_eq!(slow["steps"], 450);
    fail(
        &folder,
        &["sim", "pendulum", "--node", "camra.rate=10"],
        2,
        &["the graph has no node `camra`", "did you mean `camera`?"],
    );
    fail(&folder, &["sim", "pendulum", "--node", "camera=10"], 2, &["NODE.KEY=VALUE"]);
    fail(&folder, &["sim", "pendulum", "--node", "camera.rate=fast"], 2, &["is no number"]);
    fail(&folder, &["sim", "pendulum", "--node", "camera.colour=1"], 2, &["node `camera` cannot be built"]);
}

#[test]
fn recordings_that_cannot_be_read() {
    let folder = folder();
    for command in ["info", "replay", "diagnose"] {
        fail(&folder, &[command, "nowhere.mcap"], 2, &["nowhere.mcap"]);
        fs::write(folder.path().join("empty.mcap"), "").unwrap();
        fail(&folder, &[command, "empty.mcap"], 2, &["empty.mcap"]);
        fs::write(folder.path().join("poem.mcap"), "Shall I compare thee to a summer's day?").unwrap();
        fail(&folder, &[command, "poem.mcap"], 2, &["poem.mcap"]);
    }
}

#[test]
fn a_truncated_recording_is_read_as_far_as_it_goes() {
    let folder = folder();
    succeed(&folder, &["sim", "pendulum", "--duration", "4", "--out", "whole.mcap"]);
    let bytes = fs::read(folder.path().join("whole.mcap")).unwrap();
    fs::write(folder.path().join("cut.mcap"), &bytes[..bytes.len() * 3 / 4]).unwrap();
    let info = json(&folder, &["info", "cut.mcap", "--json"]);
    assert!(info["truncated"].as_str().unwrap().contains("the end of the file is missing"), "{info}");
    assert!(info["nodes"][0]["steps"].as_u64().unwrap() > 100);
    assert_eq!(json(&folder, &["replay", "cut.mcap", "--json"])["exact"], true);
    // Cut before the first whole chunk: nothing is compared, which is not an exact replay.
    fs::write(folder.path().join("early.mcap"), &bytes[..40_000]).unwrap();
    fail(&folder, &["replay", "early.mcap"], 2, &["early.mcap", "no whole step"]);
    // Cut before anything is said of what is in it.
    fs::write(folder.path().join("stub.mcap"), &bytes[..40]).unwrap();
    fail(&folder, &["info", "stub.mcap"], 2, &["stub.mcap"]);
}

#[test]
fn logs_that_cannot_be_read() {
    let wrong = |file: &str, from: &str, to: &str, expected: &[&str]| {
        let folder = with_log();
        edit(&folder, file, from, to);
        fail(&folder, &["import", "log", "--out", "x.mcap"], 2, expected);
        fail(&folder, &["diagnose", "log", "--system", "log/system.toml"], 2, expected);
        assert!(!folder.path().join("x.mcap").exists());
    };
    wrong("log/log.csv", "t,u,x", "t,u,y", &["log.csv has no column `x`", "it has: t, u, y"]);
    wrong("log/log.csv", "\n0.05,5,", "\n0.05,NaN,", &["log.csv:7: column `u`: `NaN` is not finite"]);
    wrong("log/log.csv", "\n0.05,", "\n0.03,", &["log.csv:7: column `t`: time runs backwards"]);
    wrong("log/log.csv", "\n0.05,", "\n0.04,", &["log.csv:7: column `t`: the time 0.04 s repeats"]);
    wrong(
        "log/recording.toml",
        "role = \"command\"",
        "role = \"order\"",
        &["recording.toml:9: signal `push`: unknown role"],
    );
    wrong("log/recording.toml", "format = 1", "", &["`format` is missing"]);
    wrong("log/recording.toml", "log.csv", "lug.csv", &["`lug.csv`, which does not exist"]);

    let folder = with_log();
    fail(&folder, &["import", "nowhere", "--out", "x.mcap"], 2, &["nowhere does not exist"]);
    fs::remove_file(folder.path().join("log/recording.toml")).unwrap();
    fail(&folder, &["import", "log", "--out", "x.mcap"], 2, &["has no recording.toml"]);
}

#[test]
fn systems_that_do_not_fit() {
    let wrong = |from: &str, to: &str, expected: &[&str]| {
        let folder = with_log();
        edit(&folder, "log/system.toml", from, to);
        fail(&folder, &["diagnose", "log", "--system", "log/system.toml"], 2, expected);
    };
    wrong("\"push\"", "\"posh\"", &["system.toml:4", "`posh`", "did you mean `push`?"]);
    wrong("unit = \"m\"", "unit = \"mm\"", &["system.toml:9", "`mm`", "`m`"]);
    wrong(
        "u/mass",
        "u/mess",
        &["system.toml:7", "unknown name `mess`; did you mean `mass`?", "u/mess\n      ^"],
    );
    wrong("u/mass", "u/(mass", &["this parenthesis is never closed"]);
    wrong("format = 1", "format = 9", &["system.toml:1: format 9 is not supported"]);

    let folder = with_log();
    fail(&folder, &["diagnose", "log"], 2, &["--system, such as log/system.toml"]);
    fail(&folder, &["diagnose", "log", "log", "--system", "log"], 2, &["Record longer"]);
    fail(&folder, &["diagnose", "log", "--system", "gone.toml"], 2, &["gone.toml does not exist"]);
    let brief = ["diagnose", "log", "--system", "log", "--horizon", "0.001"];
    fail(&folder, &brief, 2, &["a horizon of 0.001 s", "every 0.0100 s"]);
    // A sensor that is not connected.
    let rows: String = (0..200).map(|i| format!("{},{},0.5\n", f64::from(i) * 0.01, i % 7)).collect();
    fs::write(folder.path().join("log/log.csv"), format!("t,u,x\n{rows}")).unwrap();
    fail(&folder, &["diagnose", "log", "--system", "log"], 2, &["reads the same value throughout"]);
    fail(&folder, &["info", "gone.toml"], 2, &["gone.toml does not exist"]);
}

#[test]
fn benchmarks_that_cannot_be_made() {
    let folder = with_log();
    let none = counts(&[]);
    let none: Vec<&str> = ["withheld"].into_iter().chain(none.iter().map(String::as_str)).collect();
    fail(&folder, &none, 2, &["no case is asked for"]);
    fail(&folder, &["withheld", "--out", "log/log.csv"], 2, &["log/log.csv/cases cannot be made"]);
    fail(&folder, &["withheld", "--shard", "3/2"], 2, &["--shard", "such as 2/4"]);
}

#[test]
fn graphs_that_cannot_be() {
    let wrong = |from: &str, to: &str, expected: &[&str]| {
        let folder = with_graph();
        edit(&folder, "graph.toml", from, to);
        fail(&folder, &["sim", "graph.toml"], 2, expected);
        fail(&folder, &["run", "graph.toml", "--duration", "1"], 2, expected);
    };
    wrong(
        "kind = \"pendulum/camera\"",
        "kind = \"pendulum/camra\"",
        &["`pendulum/camra`", "did you mean `pendulum/camera`?"],
    );
    wrong("from = \"world\"", "from = \"wurld\"", &["`wurld`"]);
    wrong("supervisor = \"agent\"", "supervisor = \"nobody\"", &["the supervisor `nobody`"]);
    wrong("rate = 200.0", "rate = 0.0", &["node `world` cannot run at 0 Hz"]);
    wrong("rate = 200.0", "rate = -5.0", &["node `world` cannot run at -5 Hz"]);
    wrong("rate = 200.0", "rate = 1e12", &["node `world` cannot run at"]);
    wrong("rate = 200.0", "rate = \"often\"", &["graph.toml", "line"]);
    wrong("skip = true", "skip = false", &["cycle"]);
    wrong("window = 1", "window = 0", &["window"]);

    let folder = with_graph();
    fail(&folder, &["sim", "gone.toml"], 2, &["gone.toml cannot be read", "pendulum-simulated"]);
}

#[test]
fn cores_that_do_not_exist_are_an_error_and_shared_ones_a_warning() {
    let folder = folder();
    fail(
        &folder,
        &["run", "pendulum", "--duration", "1", "--node", "camera.core=4095"],
        2,
        &["node `camera` is to run on core 4095, which does not exist here"],
    );
    let arguments =
        ["sim", "pendulum", "--duration", "1", "--node", "camera.core=0", "--node", "agent.core=0"];
    let output = parallax(&folder, &arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && errors.contains("warning: nodes camera, agent share core 0"),
        "{errors}"
    );
}

/// The example of the documentation, as it stands there.
fn documented_launch() -> String {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/real-time.md");
    let page = fs::read_to_string(page).unwrap();
    let (_, example) = page.split_once("```toml\n").unwrap();
    example.split_once("```").unwrap().0.to_owned()
}

#[test]
fn the_documented_launch_settings_run() {
    let folder = with_graph();
    fs::write(folder.path().join("launch.toml"), documented_launch()).unwrap();
    // It is found beside the graph, and what this machine refuses is said.
    let run = ["run", "graph.toml", "--duration", "0.3"];
    let json = |arguments: &[&str]| json(&folder, &[&run[..], arguments, &["--json"]].concat());
    let report = json(&[]);
    assert!(report["end"] == "duration", "{report}");
    let motor = &report["nodes"].as_array().unwrap()[4];
    // The agent's safe output is the last thing that the motor gets.
    assert!(motor["node"] == "motor" && motor["made_safe"].is_i64(), "{motor}");
    let sent = &motor["inputs"][0];
    let count = |what: &str| sent[what].as_u64().unwrap();
    assert_eq!(count("sent"), count("consumed") + count("superseded") + count("in_flight"), "{sent}");

    // A flag goes before the file, another file in its place.
    assert!(json(&["--set", "agent.safe={ voltage = \"hold\" }"])["end"] == "duration");
    fs::write(folder.path().join("none.toml"), "").unwrap();
    let report = json(&["--launch", "none.toml"]);
    assert!(report["nodes"][4]["made_safe"].is_null(), "{report}");

    let wrong = |settings: &str, says: &[&str]| {
        fs::write(folder.path().join("launch.toml"), settings).unwrap();
        fail(&folder, &run, 2, says);
    };
    // What is refused is said, at once and by name; or nothing is started.
    let settings = "[node.camera]\ncore = 1000\n";
    fs::write(folder.path().join("launch.toml"), settings).unwrap();
    let output = parallax(&folder, &run);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && errors.contains("warning: node camera was to run on core 1000"),
        "{errors}"
    );
    fs::write(folder.path().join("launch.toml"), format!("refused = \"stop\"\n{settings}")).unwrap();
    fail(&folder, &run, 3, &["refused", "camera", "core 1000"]);

    wrong("[node.agen]\n", &["launch.toml: [node.agen]", "did you mean `agent`?"]);
    wrong("[defaults]\npolicy = \"hard\"\n", &["launch.toml", "line 2", "hard"]);
    fs::remove_file(folder.path().join("launch.toml")).unwrap();
    fail(&folder, &["run", "graph.toml", "--launch", "gone.toml"], 2, &["gone.toml cannot be read"]);
    fail(&folder, &["run", "graph.toml", "--set", "agent.polcy=fifo"], 2, &["agent.polcy=fifo", "polcy"]);
}

#[test]
fn real_recordings_are_described() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/emps");
    if !data.exists() {
        println!("not run: {} does not exist", data.display());
        return;
    }
    let folder = folder();
    let log = json(&folder, &["info", data.join("estimation").to_str().unwrap(), "--json"]);
    assert_eq!(log["signals"][0]["samples"], 24841);
    let system = json(&folder, &["info", data.to_str().unwrap(), "--json"]);
    assert_eq!(system["joints"][0], "axis");
}
