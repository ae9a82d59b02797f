//! What drivers do at the end, whatever ends: a node, the run, the launcher.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use parallax_runtime::graph::{GraphSpec, NodeSpec, OnDeadSender, SafeValue};
use parallax_runtime::launch::{EventKind, Exit, Mode, RunError, RunOptions, run};

use crate::Test;
use crate::failures::{alive, remains, signal};
use crate::faults::{node_process, observe, observe_restart};
use crate::nodes::{driving, registry};
use crate::settings::launch;

pub(crate) const TESTS: &[Test] = &[
    ("a_driver_ends_on_safe_commands", a_driver_ends_on_safe_commands),
    ("a_killed_sender_leaves_safe_commands", a_killed_sender_leaves_safe_commands),
    ("a_driver_that_waits_for_a_dead_sender_ends_safely", a_driver_that_waits_for_a_dead_sender_ends_safely),
    ("a_sender_that_hangs_leaves_safe_commands", a_sender_that_hangs_leaves_safe_commands),
    ("a_driver_that_fails_or_panics_stops", a_driver_that_fails_or_panics_stops),
    ("a_killed_driver_is_stopped_by_a_fresh_process", a_killed_driver_is_stopped_by_a_fresh_process),
    ("a_start_that_is_given_up_stops_a_driver_in_order", a_start_that_is_given_up_stops_a_driver_in_order),
    ("without_a_launcher_everything_ends_safely", without_a_launcher_everything_ends_safely),
    ("what_a_crash_of_everybody_leaves_is_removed", what_a_crash_of_everybody_leaves_is_removed),
];

const SAFE: f64 = -42.0;

/// A counter whose safe output is [`SAFE`] commands a driver; something happens to the counter, or to the driver.
fn graph(log: &Path, node: &str, what: &str, at: u64) -> GraphSpec {
    let mut graph = driving(log);
    graph.nodes[0].safe = Some([("value".to_owned(), SafeValue::Number(SAFE))].into());
    let trouble = serde_json::json!({ "what": what, "at": at });
    let parameters = &mut graph.node_mut(node).unwrap().parameters;
    match (what, node) {
        ("", _) => {}
        (_, "driver") => {
            parameters.insert("trouble".into(), trouble);
        }
        _ => parameters.extend(trouble.as_object().unwrap().clone()),
    }
    graph
}

/// What a driver wrote.
fn read(log: &Path) -> Vec<String> {
    std::fs::read_to_string(log).unwrap().lines().map(str::to_owned).collect()
}

fn logged() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    (folder, log)
}

/// The last two lines: the safe command, and why the driver stopped.
#[track_caller]
fn ends(lines: &[String], why: &str) {
    let [.., drive, stop] = lines else { panic!("{lines:?}") };
    assert_eq!((drive.as_str(), stop.as_str()), ("drive -42", format!("stop {why}").as_str()), "{lines:?}");
}

fn a_driver_ends_on_safe_commands() {
    let (_folder, log) = logged();
    let (report, recording) = observe(&graph(&log, "counter", "", 0), 0.3, "");
    let lines = read(&log);
    ends(&lines, "Over");
    assert_eq!(lines.iter().filter(|line| *line == "drive -42").count(), 1, "not before the end: {lines:?}");
    // One command more than the schedule has steps.
    assert_eq!(lines.len() as u64, report.nodes[1].steps + 2);
    assert!(report.nodes[1].made_safe.is_some() && report.nodes[0].made_safe.is_none(), "{report:#?}");
    assert!(recording.nodes[1].messages.iter().all(|message| message.payload != [SAFE]));
}

fn a_killed_sender_leaves_safe_commands() {
    let (_folder, log) = logged();
    let (report, recording) = observe(&graph(&log, "counter", "kill", 20), 0.5, "");
    // The driver goes on at its rate, on the safe command, until the end.
    let lines = read(&log);
    ends(&lines, "Over");
    let first = lines.iter().position(|line| line == "drive -42").unwrap();
    assert!(first < 25 && lines[first..lines.len() - 1].iter().all(|line| line == "drive -42"), "{lines:?}");
    assert_eq!(report.nodes[1].inputs[0].safe, 1, "{report:#?}");
    // The recording says what the driver saw: a safe output is no message, and no initial one either.
    let step = recording.nodes[1].steps.last().unwrap();
    assert!(step.inputs[0].consumed[0].is_safe_output(), "{step:?}");
    let recorded = recording.graph.validate(&registry()).unwrap();
    let check = parallax_runtime::schedule::verify(&recording, &recorded, 1, &recording.nodes[1].steps);
    assert!(check.deviation.is_none(), "{:?}", check.deviation);

    // When it comes back, its commands count again.
    let (_folder, log) = logged();
    let settings = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.1\n";
    let (report, _) = observe_restart(&graph(&log, "counter", "kill", 20), settings);
    let lines = read(&log);
    let safe = lines.iter().filter(|line| *line == "drive -42").count();
    assert!(safe > 5 && safe < lines.len() - 10, "{lines:?}");
    assert_ne!(lines[lines.len() - 3], "drive -42", "{report:#?} {lines:?}");
}

fn a_driver_that_waits_for_a_dead_sender_ends_safely() {
    let (_folder, log) = logged();
    let mut graph = graph(&log, "counter", "kill", 20);
    graph.connections[0].blocking = true;
    graph.nodes[1].on_dead_sender = OnDeadSender::Stop;
    let (report, _) = observe(&graph, 60.0, "");
    assert_eq!(report.nodes[1].exit, Exit::DeadSender { sender: "counter".into() });
    ends(&read(&log), "SenderGone");
}

fn a_sender_that_hangs_leaves_safe_commands() {
    let (_folder, log) = logged();
    let (report, _) = observe(&graph(&log, "counter", "hang", 20), 0.8, "[node.counter]\nheartbeat = 0.1\n");
    let lines = read(&log);
    assert!(lines.iter().filter(|line| *line == "drive -42").count() > 20, "{report:#?} {lines:?}");
    // A deadline does the same, and sooner.
    let (_folder, log) = logged();
    let settings = "[node.counter]\nheartbeat = 1\ndeadline = 0.05\non_deadline = \"safe\"\n";
    let (report, _) = observe(&graph(&log, "counter", "hang", 20), 0.8, settings);
    let lines = read(&log);
    assert!(lines.iter().filter(|line| *line == "drive -42").count() > 20, "{report:#?} {lines:?}");
}

fn a_driver_that_fails_or_panics_stops() {
    for what in ["error", "panic"] {
        let (_folder, log) = logged();
        let (report, _) = observe(&graph(&log, "driver", what, 10), 60.0, "");
        assert!(matches!(report.nodes[1].exit, Exit::Failed { .. }), "{report:#?}");
        assert_eq!(read(&log).last().unwrap(), "stop Failed");
    }
}

fn a_killed_driver_is_stopped_by_a_fresh_process() {
    let (_folder, log) = logged();
    let (report, _) =
        observe(&graph(&log, "driver", "kill", 10), 60.0, "[node.driver]\nstop_after_crash = true\n");
    let lines = read(&log);
    assert_eq!((lines.len(), lines.last().unwrap().as_str()), (11, "stop AfterCrash"), "{lines:?}");
    assert!(report.events.iter().any(|event| event.kind == EventKind::StoppedAfterCrash), "{report:#?}");
    // A driver that hangs until the end cannot stop by itself either.
    let (_folder, log) = logged();
    let settings = "[node.driver]\nstop_after_crash = true\nheartbeat = 0.1\n";
    observe(&graph(&log, "driver", "hang", 10), 0.4, settings);
    assert_eq!(read(&log).last().unwrap(), "stop AfterCrash");
    // Nor can one that was to be started again when the run ended.
    let (_folder, log) = logged();
    let settings = "[node.driver]\nstop_after_crash = true\nrestart = \"on-failure\"\nrestart_delay = 5\nrestart_delay_max = 5\n";
    let (report, _) = observe(&graph(&log, "driver", "kill", 10), 0.6, settings);
    assert_eq!(read(&log).last().unwrap(), "stop AfterCrash", "{report:#?}");
}

fn a_start_that_is_given_up_stops_a_driver_in_order() {
    for mode in [Mode::Processes, Mode::Threads] {
        let (folder, log) = logged();
        let mut graph = graph(&log, "counter", "", 0);
        // The launcher waits for it, and gives up once the driver is there.
        let slow = if mode == Mode::Processes { "sleepy" } else { "tardy" };
        graph.nodes.push(NodeSpec::new("eye", slow, 10.0));
        let built = log.clone();
        let options = RunOptions {
            mode,
            recording: Some(folder.path().join("run.mcap")),
            progress: Some(Box::new(move |_| !built.exists())),
            ..RunOptions::default()
        };
        let error = run(&graph, &registry(), options).unwrap_err();
        assert!(matches!(error, RunError::Interrupted), "{error}");
        // It is told so, and does not take its launcher for dead, which it would look for.
        ends(&read(&log), "Over");
    }
}

/// Under this argument this program is a launcher of a driver that runs until it is stopped: `LOG`.
pub(crate) const DRIVING_COMMAND: &str = "__driving";

pub(crate) fn drive(mut arguments: impl Iterator<Item = String>) -> ExitCode {
    let log = PathBuf::from(arguments.next().unwrap());
    let options = RunOptions { launch: launch("[defaults]\nheartbeat = inf\n"), ..RunOptions::default() };
    match run(&graph(&log, "counter", "", 0), &registry(), options) {
        Ok(_) => ExitCode::SUCCESS,
        Err(_) => ExitCode::FAILURE,
    }
}

/// Waits until this holds.
#[track_caller]
fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < Duration::from_secs(15), "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn driven(log: &Path) -> (Child, [u32; 2]) {
    let launcher = Command::new("/proc/self/exe")
        .args([DRIVING_COMMAND, log.to_str().unwrap()])
        .stdin(Stdio::null())
        .spawn()
        .unwrap();
    until("the driver drives", || log.exists() && read(log).len() > 20);
    let nodes = ["counter", "driver"].map(|node| node_process(launcher.id(), node).unwrap());
    (launcher, nodes)
}

fn without_a_launcher_everything_ends_safely() {
    // Nothing in the way; a sender that somebody has stopped; a sender that is dead, too.
    for also in [None, Some(libc::SIGSTOP), Some(libc::SIGKILL)] {
        let (_folder, log) = logged();
        let (mut launcher, nodes) = driven(&log);
        assert!(!remains(launcher.id()).is_empty(), "the test must look where the run is");
        if let Some(also) = also {
            signal(nodes[0], also);
        }
        // Of what a dying process holds, the kernel may free the lock last, when the nodes have long seen its line closed.
        let lock = remains(launcher.id()).into_iter().find(|path| path.ends_with(".lock")).unwrap();
        let lock = std::fs::File::open(lock).unwrap();
        lock.lock_shared().unwrap();
        signal(launcher.id(), libc::SIGKILL);
        launcher.wait().unwrap();
        until("the driver has stopped", || read(&log).last().is_some_and(|line| line.starts_with("stop")));
        std::thread::sleep(Duration::from_millis(100));
        drop(lock);
        until("the nodes end", || !nodes.iter().any(|node| alive(*node)));
        until("shared memory is free again", || remains(launcher.id()).is_empty());
        ends(&read(&log), "LauncherGone");
    }
}

fn what_a_crash_of_everybody_leaves_is_removed() {
    let (_folder, log) = logged();
    let (mut launcher, nodes) = driven(&log);
    // Nobody is given the time to notice that others are gone.
    signal(launcher.id(), libc::SIGSTOP);
    nodes.iter().for_each(|node| signal(*node, libc::SIGKILL));
    signal(launcher.id(), libc::SIGKILL);
    launcher.wait().unwrap();
    until("the nodes end", || !nodes.iter().any(|node| alive(*node)));
    assert!(!remains(launcher.id()).is_empty(), "there is nobody who could have removed it");
    let (_folder, log) = logged();
    observe(&graph(&log, "counter", "", 0), 0.1, "");
    assert_eq!(remains(launcher.id()), Vec::<String>::new(), "the next run has");
}
