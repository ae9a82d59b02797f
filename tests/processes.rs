//! Graphs in real time, from the command line: their end, their recordings, and what they leave behind.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use parallax::runtime::recording::Recording;
use serde_json::Value;

fn parallax(arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_parallax"))
        .args(arguments)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// The process of the node `name` that `launcher` started, once it is there.
fn node_of(launcher: &Child, name: &str) -> u32 {
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(20) {
        for entry in fs::read_dir("/proc").unwrap().flatten() {
            let Ok(pid) = entry.file_name().to_string_lossy().parse::<u32>() else { continue };
            let read = |file: &str| fs::read_to_string(entry.path().join(file)).unwrap_or_default();
            let parent =
                read("stat").rsplit(')').next().and_then(|rest| rest.split_whitespace().nth(1)?.parse().ok());
            let arguments: Vec<String> = read("cmdline").split('\0').map(str::to_owned).collect();
            if parent == Some(launcher.id()) && arguments.windows(2).any(|pair| pair == ["--node", name]) {
                return pid;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("no process of node {name}");
}

fn signal(name: &str, pid: u32) {
    assert!(Command::new("kill").args([format!("-{name}"), pid.to_string()]).status().unwrap().success());
}

/// Waits until the recording holds something: the run is under way.
fn until_recorded(path: &Path) {
    let start = Instant::now();
    while fs::metadata(path).map_or(0, |metadata| metadata.len()) < 20_000 {
        assert!(start.elapsed() < Duration::from_secs(30), "nothing is recorded");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_run_is_recorded_and_replayed_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let out = path.to_str().unwrap();
    let output = parallax(&["run", "pendulum", "--duration", "1.5", "--out", out, "--json"])
        .wait_with_output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["nodes"].as_array().unwrap().len(), 5);

    let replay = parallax(&["replay", out, "--json"]).wait_with_output().unwrap();
    assert_eq!(replay.status.code(), Some(0), "{}", text(&replay));
    let replay: Value = serde_json::from_slice(&replay.stdout).unwrap();
    assert_eq!(replay["exact"], true);
    assert!(replay["steps"].as_u64().unwrap() > 450, "{replay}");
}

#[test]
fn a_killed_node_is_noticed_and_the_recording_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let launcher = parallax(&["run", "pendulum", "--duration", "60", "--out", path.to_str().unwrap()]);
    until_recorded(&path);
    let pid = node_of(&launcher, "camera");
    signal("KILL", pid);
    let output = launcher.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(3), "{}", text(&output));
    assert!(text(&output).contains("error: node camera: "), "{}", text(&output));
    let recording = Recording::read(&path).unwrap();
    assert!(recording.faults.iter().any(|fault| fault.node == "camera"), "{:?}", recording.faults);
    assert!(recording.node("camera").unwrap().steps.len() > 10);
}

#[test]
fn a_run_goes_on_when_nobody_reads_what_it_says() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let out = path.to_str().unwrap();
    let restart = "camera.restart=on-failure";
    let mut launcher = parallax(&["run", "pendulum", "--duration", "3", "--set", restart, "--out", out]);
    drop(launcher.stderr.take());
    until_recorded(&path);
    signal("KILL", node_of(&launcher, "camera"));
    let output = launcher.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output));
    let recording = Recording::read(&path).unwrap();
    assert_eq!((recording.truncated, recording.duration), (None, 3_000_000_000));
    assert!(recording.faults.iter().any(|fault| fault.node == "camera"), "{:?}", recording.faults);
}

#[test]
fn an_interrupted_run_ends_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let launcher = parallax(&["run", "pendulum", "--out", path.to_str().unwrap()]);
    until_recorded(&path);
    signal("INT", launcher.id());
    let output = launcher.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", text(&output));
    let recording = Recording::read(&path).unwrap();
    assert_eq!((recording.truncated, recording.faults), (None, vec![]));
}

#[test]
fn a_node_process_is_not_for_people() {
    let output =
        parallax(&["__node", "--run-dir", "/nowhere", "--node", "camera"]).wait_with_output().unwrap();
    assert!(!output.status.success());
    assert!(text(&output).contains("started by the launcher only"), "{}", text(&output));
}

fn succeeds(arguments: &[&str]) -> String {
    let output = parallax(arguments).wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", text(&output));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn outputs_that_were_replaced_are_replayed_as_what_was_sent() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let out = path.to_str().unwrap();
    // Nobody keeps this deadline.
    let settings = ["agent.deadline=0.000000001", "agent.on_deadline=safe", "agent.safe={ voltage = 0.5 }"];
    let settings = settings.iter().flat_map(|setting| ["--set", setting]);
    let arguments: Vec<&str> =
        ["run", "pendulum", "--duration", "1", "--out", out].into_iter().chain(settings).collect();
    succeeds(&arguments);
    let recording = Recording::read(&path).unwrap();
    let agent = recording.node("agent").unwrap();
    assert!(agent.messages.iter().all(|message| message.payload[0] == 0.5), "{:?}", agent.messages.first());
    assert_eq!(recording.faults.len(), agent.steps.len());
    let replay: Value = serde_json::from_str(&succeeds(&["replay", out, "--json"])).unwrap();
    assert_eq!(replay["exact"], true, "{replay}");
    assert!(succeeds(&["info", out]).contains("`agent` sent its safe output in place of"));
}

#[test]
fn the_parts_of_a_rotated_recording_are_joined() {
    let folder = tempfile::tempdir().unwrap();
    let place = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let first = place("run.mcap");
    succeeds(&["run", "pendulum", "--duration", "3.5", "--rotate", "1s", "--out", &first]);
    let parts: Vec<String> =
        std::iter::once(first.clone()).chain((1..3).map(|part| place(&format!("run.{part}.mcap")))).collect();
    let whole = place("whole.mcap");
    let mut arguments = vec!["join"];
    arguments.extend(parts.iter().map(String::as_str));
    // The last one is there, too.
    let last = place("run.3.mcap");
    if Path::new(&last).exists() {
        arguments.push(&last);
    }
    arguments.extend(["--out", &whole]);
    succeeds(&arguments);
    let replay: Value = serde_json::from_str(&succeeds(&["replay", &whole, "--json"])).unwrap();
    assert_eq!(replay["exact"], true, "{replay}");
    let recording = Recording::read(&whole).unwrap();
    assert!(recording.nodes.iter().all(|track| track.steps.len() > 150), "not all parts are in it");
    // Twice the same, another run, and a part as the whole.
    let refused = |arguments: &[&str], expected: &str| {
        let output = parallax(arguments).wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{}", text(&output));
        assert!(text(&output).contains(expected), "{}", text(&output));
    };
    refused(&["join", &first, &first, "--out", &whole], "it was given twice");
    let other = place("other.mcap");
    succeeds(&["sim", "pendulum", "--duration", "0.5", "--out", &other]);
    refused(&["join", &first, &other, "--out", &whole], "is no part of the run");
    refused(&["join", &first, &parts[1], "--out", &first], "would be written over");
    // A part that was left out is missed.
    let output = parallax(&["join", &first, &parts[2], "--out", &whole]).wait_with_output().unwrap();
    assert!(output.status.success() && text(&output).contains("are in no part"), "{}", text(&output));
}

#[test]
fn a_group_without_a_recording_is_refused() {
    let output =
        parallax(&["run", "pendulum", "--duration", "1", "--group", "root"]).wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(text(&output).contains("--record or --out"), "{}", text(&output));
}
