//! The recorder when it is killed, stopped, or the disk is full: the graph goes on, and every record is accounted for.

use std::path::Path;

use parallax_runtime::graph::GraphSpec;
use parallax_runtime::launch::{End, Mode, Progress, RecordingReport, Rotate, RunOptions, RunReport, run};
use parallax_runtime::recording::Recording;

use crate::Test;
use crate::failures::signal;
use crate::nodes::{graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("ten_times_the_demos_load_is_recorded_whole", ten_times_the_demos_load),
    ("a_killed_recorder_is_started_again", a_killed_recorder),
    ("a_disk_that_takes_nothing_stops_no_graph", a_disk_that_takes_nothing),
    ("a_file_that_may_not_grow_is_followed_by_another", a_file_that_may_not_grow),
    ("a_recording_goes_on_in_another_file", a_recording_goes_on_in_another_file),
];

/// Both nodes at this rate.
fn at_rate(rate: f64) -> GraphSpec {
    let mut graph = graph();
    graph.nodes.iter_mut().for_each(|node| node.rate = rate);
    graph
}

/// The recorder's process.
fn recorder() -> u32 {
    let pid = std::process::id();
    let children = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap();
    let name = |pid: &&str| std::fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    let found = children.split_whitespace().find(|pid| name(pid).trim() == "@recorder");
    found.expect("the recorder is a process of its own").parse().unwrap()
}

/// Does something to the recorder once, so many milliseconds after the start.
fn at(milliseconds: i64, mut act: impl FnMut(u32) + 'static) -> Option<Box<dyn FnMut(Progress) -> bool>> {
    let mut done = false;
    Some(Box::new(move |progress| {
        if !done && progress.elapsed > milliseconds * 1_000_000 {
            done = true;
            act(recorder());
        }
        true
    }))
}

/// How many steps of a node all files of a recording hold; each file can be read by itself.
fn recorded(files: &RecordingReport, node: &str) -> u64 {
    let count =
        |path: &std::path::PathBuf| Recording::read(path).unwrap().node(node).unwrap().steps.len() as u64;
    files.files.iter().map(count).sum()
}

fn of(counts: &[(String, u64)], node: &str) -> u64 {
    counts.iter().find(|(name, _)| name == node).map_or(0, |(_, count)| *count)
}

/// Every step of every node is in a file, or counted as missing.
fn balance(report: &RunReport) {
    assert_eq!(report.end, End::Duration);
    let recording = report.recording.as_ref().unwrap();
    for node in &report.nodes {
        assert_eq!(node.exit, parallax_runtime::launch::Exit::Clean, "{report:?}");
        let (lost, unwritten) = (of(&recording.lost, &node.node), of(&recording.unwritten, &node.node));
        let recorded = recorded(recording, &node.node);
        // A chunk may have reached the file just before the recorder died, without its being written down.
        assert!(
            recorded + lost + unwritten >= node.steps,
            "{}: {recorded} {lost} {unwritten}: {report:?}",
            node.node
        );
        assert!(recorded <= node.steps, "{report:?}");
    }
}

fn ten_times_the_demos_load() {
    // The demo's five nodes make 510 steps a second together.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let memory = std::sync::Arc::new(std::sync::atomic::AtomicU64::new(0));
    let seen = memory.clone();
    // The recorder is kept from running for a while: what waits is taken when it goes on.
    let mut stopped = false;
    let mut stopper = at(500, |pid| signal(pid, libc::SIGSTOP)).unwrap();
    let progress = move |progress: Progress| {
        stopper(progress);
        if !stopped && progress.elapsed > 1_300_000_000 {
            stopped = true;
            signal(recorder(), libc::SIGCONT);
        }
        if progress.elapsed > 1_600_000_000 {
            let status = std::fs::read_to_string(format!("/proc/{}/status", recorder())).unwrap();
            let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
            let kilobytes = line.trim().trim_end_matches("kB").trim().parse().unwrap();
            seen.fetch_max(kilobytes, std::sync::atomic::Ordering::Relaxed);
        }
        true
    };
    let options = RunOptions { progress: Some(Box::new(progress)), ..options(2.0, &path) };
    let report = run(&at_rate(2550.0), &registry(), options).unwrap();
    balance(&report);
    let recording = report.recording.as_ref().unwrap();
    assert!(recording.complete() && recording.restarts == 0 && recording.problem.is_none(), "{report:?}");
    let steps: u64 = report.nodes.iter().map(|node| node.steps).sum();
    let kilobytes = memory.load(std::sync::atomic::Ordering::Relaxed);
    println!(
        "  {steps} steps in {} bytes, recorder's memory at most {} MiB",
        recording.bytes,
        kilobytes / 1024
    );
    assert!(steps > 2000 && recorded(recording, "counter") == report.nodes[0].steps);
    assert!((1..128 * 1024).contains(&kilobytes), "{kilobytes} kB");
    assert_eq!(Recording::read(&path).unwrap().truncated, None);
}

fn a_killed_recorder() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let progress = at(1300, |pid| signal(pid, libc::SIGKILL));
    let report = run(&at_rate(100.0), &registry(), RunOptions { progress, ..options(3.0, &path) }).unwrap();
    balance(&report);
    let recording = report.recording.as_ref().unwrap();
    assert_eq!((recording.restarts, recording.files.len()), (1, 2), "{recording:?}");
    assert_eq!(recording.files, [path.clone(), folder.path().join("run.1.mcap")]);
    assert!(report.warnings.iter().any(|warning| warning.contains("recorder died")), "{:?}", report.warnings);
    // What the first one had made sure of is there, and the second one has what came after it.
    let (first, second) = (Recording::read(&path).unwrap(), Recording::read(&recording.files[1]).unwrap());
    let steps = |recording: &Recording| recording.node("counter").unwrap().steps.clone();
    assert!(first.truncated.is_some() && steps(&first).len() > 20, "{}", steps(&first).len());
    let (before, after) = (steps(&first).last().unwrap().seq, steps(&second).first().unwrap().seq);
    assert!(after > before && steps(&second).len() > 20);
    assert_eq!(steps(&second).last().unwrap().seq + 1, report.nodes[0].steps);
}

fn a_disk_that_takes_nothing() {
    // A device that takes no byte stands for a full disk.
    for mode in [Mode::Processes, Mode::Threads] {
        let options = RunOptions { mode, ..options(0.5, Path::new("/dev/full")) };
        let report = run(&graph(), &registry(), options).unwrap();
        assert_eq!(report.end, End::Duration);
        let recording = report.recording.as_ref().unwrap();
        assert!(!recording.complete() && !report.clean());
        for node in &report.nodes {
            assert_eq!(of(&recording.unwritten, &node.node), node.steps, "{report:?}");
        }
        let problem = recording.problem.as_ref().unwrap();
        assert!(problem.contains("/dev/full"), "{problem}");
        let warnings = report.warnings.join("\n");
        assert!(warnings.contains("could not be written") && warnings.contains("counter"), "{warnings}");
    }
}

fn a_file_that_may_not_grow() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let progress = at(50, |pid| {
        let limit = libc::rlimit { rlim_cur: 40_000, rlim_max: 40_000 };
        // SAFETY: the process is a child of ours, `limit` a valid rlimit that outlives the call.
        let answer = unsafe { libc::prlimit(pid as i32, libc::RLIMIT_FSIZE, &limit, std::ptr::null_mut()) };
        assert_eq!(answer, 0);
    });
    let report = run(&at_rate(500.0), &registry(), RunOptions { progress, ..options(4.0, &path) }).unwrap();
    balance(&report);
    let recording = report.recording.as_ref().unwrap();
    assert!(of(&recording.unwritten, "counter") > 0 && recording.files.len() > 1, "{recording:?}");
    assert_eq!(recording.restarts, 0, "an error is no death: {recording:?}");
    assert!(recording.problem.is_some());
}

fn a_recording_goes_on_in_another_file() {
    for (rotate, seconds) in [(Rotate::Bytes(60_000), 1.0), (Rotate::Time(300_000_000), 1.0)] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        let options = RunOptions { rotate: Some(rotate), ..options(seconds, &path) };
        let report = run(&at_rate(500.0), &registry(), options).unwrap();
        balance(&report);
        let recording = report.recording.as_ref().unwrap();
        assert!(recording.complete() && recording.files.len() > 2, "{recording:?}");
        assert!(report.warnings.iter().all(|warning| !warning.contains("record")), "{:?}", report.warnings);
        let mut next = 0;
        for file in &recording.files {
            let part = Recording::read(file).unwrap();
            assert_eq!(part.truncated, None);
            for step in &part.node("counter").unwrap().steps {
                assert_eq!(step.seq, next, "nothing twice and nothing left out");
                next += 1;
            }
        }
        assert_eq!(next, report.nodes[0].steps);
    }
}
