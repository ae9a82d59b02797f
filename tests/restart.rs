//! A node of a running graph is killed and comes back; the recording of that replays to the bit.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use command::succeed;
use serde_json::Value;

/// The process of this node, a child of `launcher`.
fn node(launcher: u32, name: &str) -> Option<u32> {
    let children = std::fs::read_to_string(format!("/proc/{launcher}/task/{launcher}/children")).ok()?;
    let named = |pid: &u32| {
        std::fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|comm| comm.trim() == name)
    };
    children.split_whitespace().filter_map(|pid| pid.parse().ok()).find(named)
}

#[test]
fn nodes_that_were_killed_come_back_and_replay() {
    let folder = tempfile::tempdir().unwrap();
    let run = "run pendulum --duration 2 --json --out run.mcap --set defaults.restart=on-failure --set";
    let launcher = Command::new(env!("CARGO_BIN_EXE_parallax"))
        .current_dir(&folder)
        .args(run.split(' '))
        .arg("agent.safe={ voltage = 0 }")
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_millis(600));
    for name in ["agent", "estimator"] {
        let start = Instant::now();
        let pid = loop {
            if let Some(pid) = node(launcher.id(), name) {
                break pid;
            }
            assert!(start.elapsed() < Duration::from_secs(10), "{name} does not run");
            std::thread::sleep(Duration::from_millis(5));
        };
        // Only ever a child of this test's own launcher.
        assert!(Path::new(&format!("/proc/{pid}")).exists());
        let killed = Command::new("kill").args(["-9", &pid.to_string()]).status().unwrap();
        assert!(killed.success());
        std::thread::sleep(Duration::from_millis(400));
    }
    let output = launcher.wait_with_output().unwrap();
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{told}");
    for part in ["node agent process", "SIGKILL", "node estimator runs again"] {
        assert!(told.contains(part), "no `{part}` while it happened: {told}");
    }
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    for name in ["agent", "estimator"] {
        let nodes = report["nodes"].as_array().unwrap();
        let node = nodes.iter().find(|node| node["node"] == name).unwrap();
        assert_eq!(node["restarts"], 1, "{node}");
    }
    let replayed = succeed(&folder, &["replay", "run.mcap"]);
    assert!(replayed.contains("exact:"), "{replayed}");
}
