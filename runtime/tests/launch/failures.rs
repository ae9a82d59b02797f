//! Runs that go wrong: what is told, what is saved, and that nothing stays behind.

use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use parallax_runtime::graph::{NodeSpec, OnDeadSender};
use parallax_runtime::launch::{End, Exit, Mode, RunError, RunOptions, run};
use parallax_runtime::recording::{FaultKind, Recording};

use crate::Test;
use crate::nodes::{graph, registry, troubled};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("a_killed_node_is_noticed", a_killed_node_is_noticed),
    ("an_error_a_panic_and_an_exit_are_told_apart", an_error_a_panic_and_an_exit_are_told_apart),
    ("a_thread_that_panics_is_noticed", a_thread_that_panics_is_noticed),
    ("receivers_may_go_on_without_a_dead_sender", receivers_may_go_on_without_a_dead_sender),
    ("a_node_that_hangs_is_ended", a_node_that_hangs_is_ended),
    ("a_node_that_cannot_be_built_is_named", a_node_that_cannot_be_built_is_named),
    (
        "a_run_that_is_stopped_before_its_nodes_are_ready_ends",
        a_run_that_is_stopped_before_its_nodes_are_ready_ends,
    ),
    ("a_recording_that_cannot_be_written_is_refused", a_recording_that_cannot_be_written_is_refused),
    ("ctrl_c_stops_in_order", ctrl_c_stops_in_order),
    ("nodes_die_with_their_launcher", nodes_die_with_their_launcher),
    ("a_node_by_hand_is_refused", a_node_by_hand_is_refused),
];

fn a_killed_node_is_noticed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let start = Instant::now();
    let report = run(&troubled("kill", 40), &registry(), options(60.0, &path)).unwrap();
    assert!(start.elapsed() < Duration::from_secs(20), "noticed at once, not at the end");
    assert_eq!(report.end, End::Node { node: "counter".into() });
    let text = report.failure().unwrap();
    assert!(text.contains("counter") && text.contains("SIGKILL") && text.contains("process "), "{text}");
    assert!(matches!(report.nodes[0].exit, Exit::Died { pid: Some(_), .. }), "{report:?}");
    // The adder waits for it, was told, and stopped as nodes do by default.
    assert_eq!(report.nodes[1].exit, Exit::DeadSender { sender: "counter".into() });

    // The recording is whole up to there: every message that was sent before.
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.truncated, None);
    let messages = &recording.node("counter").unwrap().messages;
    assert_eq!(messages.iter().map(|message| message.seq).collect::<Vec<_>>(), (0..40).collect::<Vec<_>>());
    let fault = recording.faults.iter().find(|fault| fault.node == "counter").expect("the death is recorded");
    assert!(matches!(&fault.kind, FaultKind::Died { message } if message.contains("SIGKILL")));
    let fault =
        recording.faults.iter().find(|fault| fault.node == "adder").expect("the adder's stop is recorded");
    assert_eq!(fault.kind, FaultKind::DeadSender { sender: "counter".into() });
    assert!(recording.duration >= 195_000_000);
}

fn an_error_a_panic_and_an_exit_are_told_apart() {
    let end = |what: &str| run(&troubled(what, 10), &registry(), RunOptions::default()).unwrap();
    let report = end("error");
    assert!(
        matches!(&report.nodes[0].exit, Exit::Failed { reason } if reason.contains("step 10") && reason.contains("on fire"))
    );
    assert_eq!(report.nodes[0].steps, 10, "a node that fails still reports");
    let report = end("panic");
    assert!(
        matches!(&report.nodes[0].exit, Exit::Failed { reason } if reason == "step 10 panicked: the test wants it"),
        "{report:?}"
    );
    let report = end("exit");
    assert!(
        matches!(&report.nodes[0].exit, Exit::Died { status, .. } if status == "exit status 3"),
        "{report:?}"
    );
}

fn a_thread_that_panics_is_noticed() {
    let options = RunOptions { mode: Mode::Threads, ..RunOptions::default() };
    let report = run(&troubled("panic", 10), &registry(), options).unwrap();
    let text = report.failure().unwrap();
    assert!(text.contains("counter") && text.contains("the test wants it"), "{text}");
}

fn receivers_may_go_on_without_a_dead_sender() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = troubled("kill", 20);
    graph.node_mut("adder").unwrap().on_dead_sender = OnDeadSender::Continue;
    let report = run(&graph, &registry(), options(0.5, &path)).unwrap();
    assert!(report.end == End::Duration && report.nodes[1].steps > 30, "{report:?}");
    let recording = Recording::read(&path).unwrap();
    let last = recording.node("adder").unwrap().messages.last().unwrap();
    assert_eq!(last.payload, [20.0], "the newest message of the dead sender is 19");
    assert_eq!(recording.faults.len(), 1);
}

fn a_node_that_hangs_is_ended() {
    let options = RunOptions {
        duration: Some(100_000_000),
        patience: Duration::from_millis(400),
        ..RunOptions::default()
    };
    let report = run(&troubled("hang", 5), &registry(), options).unwrap();
    assert!(
        matches!(&report.nodes[0].exit, Exit::Died { status, .. } if status.contains("did not stop")),
        "{report:?}"
    );
}

fn a_node_that_cannot_be_built_is_named() {
    let mut graph = graph();
    graph.nodes.push(NodeSpec::new("eye", "unbuildable", 10.0));
    let folder = tempfile::tempdir().unwrap();
    let (new, old) = (folder.path().join("new.mcap"), folder.path().join("old.mcap"));
    std::fs::write(&old, "an older recording").unwrap();
    for (mode, path) in [(Mode::Processes, &new), (Mode::Threads, &old)] {
        let error = run(&graph, &registry(), RunOptions { mode, ..options(0.1, path) }).unwrap_err();
        assert!(matches!(&error, RunError::Start { node, .. } if node == "eye"), "{error}");
        assert!(error.to_string().contains("not plugged in"), "{error}");
    }
    assert!(!new.exists(), "a run that was not made leaves no empty recording");
    assert_eq!(std::fs::read_to_string(&old).unwrap(), "an older recording");
}

fn a_run_that_is_stopped_before_its_nodes_are_ready_ends() {
    let mut graph = graph();
    // Such as a driver that waits for its hardware.
    graph.nodes.push(NodeSpec::new("eye", "sleepy", 10.0));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let began = Instant::now();
    let progress = move |_| began.elapsed() < Duration::from_millis(300);
    let options = RunOptions {
        progress: Some(Box::new(progress)),
        patience: Duration::from_secs(300),
        ..options(0.1, &path)
    };
    let error = run(&graph, &registry(), options).unwrap_err();
    assert!(matches!(error, RunError::Interrupted), "{error}");
    println!("  stopped after 0.3 s, over after {:?}", began.elapsed());
    assert!(began.elapsed() < Duration::from_secs(60), "{:?}", began.elapsed());
    assert!(!path.exists(), "a run that was not made leaves no empty recording");
}

fn a_recording_that_cannot_be_written_is_refused() {
    let error = run(&graph(), &registry(), options(0.1, Path::new("/nonexistent/run.mcap"))).unwrap_err();
    assert!(error.to_string().contains("/nonexistent/run.mcap"), "{error}");
}

/// Under this argument this program is a launcher that runs until it is stopped: `RECORDING`.
pub(crate) const LAUNCHER_COMMAND: &str = "__launcher";

pub(crate) fn launcher(mut arguments: impl Iterator<Item = String>) -> ExitCode {
    let mut said = false;
    let progress = move |progress: parallax_runtime::launch::Progress| {
        if progress.elapsed > 100_000_000 && !said {
            said = true;
            println!("running");
        }
        true
    };
    let options = RunOptions {
        recording: arguments.next().map(Into::into),
        progress: Some(Box::new(progress)),
        ..RunOptions::default()
    };
    match run(&graph(), &registry(), options) {
        Ok(report) if report.end == End::Signal && report.clean() => ExitCode::SUCCESS,
        other => {
            eprintln!("{other:?}");
            ExitCode::FAILURE
        }
    }
}

/// A launcher as a process of its own, which is in the middle of its run.
fn launch(recording: &Path) -> Child {
    let mut child = Command::new("/proc/self/exe")
        .arg(LAUNCHER_COMMAND)
        .arg(recording)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(line, "running\n");
    child
}

pub(crate) fn signal(pid: u32, signal: i32) {
    // SAFETY: the call takes integers; the process is a child of ours that has not been waited for.
    assert_eq!(unsafe { libc::kill(pid as i32, signal) }, 0);
}

/// The processes that a process has started.
fn children(pid: u32) -> Vec<u32> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
    text.split_whitespace().map(|pid| pid.parse().unwrap()).collect()
}

pub(crate) fn remains(pid: u32) -> Vec<String> {
    let folder = std::fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.path());
    let runs = folder.flat_map(|path| match path.is_dir() {
        true => std::fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path()).collect(),
        false => vec![path],
    });
    let mark = |path: &Path| {
        path.file_name().is_some_and(|name| {
            let name = name.to_string_lossy();
            name.starts_with(&format!("{pid}-")) || name.contains(&format!("_{pid}-"))
        })
    };
    runs.filter(|path| mark(path)).map(|path| path.display().to_string()).collect()
}

fn ctrl_c_stops_in_order() {
    // A service that is stopped has its processes told all at once.
    for (number, everybody) in [(libc::SIGINT, false), (libc::SIGTERM, false), (libc::SIGTERM, true)] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        let mut launcher = launch(&path);
        let pid = launcher.id();
        assert_eq!(children(pid).len(), 3, "two nodes and the recorder");
        assert!(remains(pid).len() > 4, "the test must look where the run is");
        if everybody {
            children(pid).into_iter().for_each(|node| signal(node, number));
            std::thread::sleep(Duration::from_millis(50));
        }
        signal(pid, number);
        assert!(launcher.wait().unwrap().success());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "one recorder wrote one file");
        let recording = Recording::read(&path).unwrap();
        assert_eq!(recording.truncated, None);
        assert!(recording.node("counter").unwrap().messages.len() >= 20);
        assert_eq!(remains(pid), Vec::<String>::new());
    }
}

fn nodes_die_with_their_launcher() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut launcher = launch(&path);
    let (pid, nodes) = (launcher.id(), children(launcher.id()));
    assert_eq!(nodes.len(), 3, "two nodes and the recorder");
    // Long enough for a chunk to be complete.
    std::thread::sleep(Duration::from_millis(1200));
    signal(pid, libc::SIGKILL);
    assert_eq!(launcher.wait().unwrap().signal(), Some(libc::SIGKILL));
    let start = Instant::now();
    while nodes.iter().any(|node| alive(*node)) {
        assert!(start.elapsed() < Duration::from_secs(5), "nodes outlive their launcher");
        std::thread::sleep(Duration::from_millis(5));
    }
    let recording = Recording::read(&path).unwrap();
    // The recorder is the last to go, and closes its file.
    assert_eq!(recording.truncated, None);
    assert!(recording.node("counter").unwrap().messages.len() > 100);
    // The last of them has removed what the run had in shared memory.
    assert_eq!(remains(pid), Vec::<String>::new());
}

/// Whether a process runs: one that has ended and that nobody has waited for does not.
/// Whether any of its threads is: the first one may be gone while another one, on its way out, still holds files and locks.
pub(crate) fn alive(pid: u32) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let stats = threads.filter_map(|thread| std::fs::read_to_string(thread.path().join("stat")).ok());
    stats.into_iter().any(|stat| !stat.contains(") Z ") && !stat.contains(") X "))
}

fn a_node_by_hand_is_refused() {
    let refuse = |arguments: &[&str]| {
        let output = Command::new("/proc/self/exe").args(arguments).stdin(Stdio::null()).output().unwrap();
        assert!(!output.status.success());
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(text.contains("by the launcher only"), "{text}");
    };
    refuse(&["__node"]);
    refuse(&["__node", "--run-dir", "/tmp", "--node", "camera"]);
}
