//! Runs that go well.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use parallax_runtime::graph::NodeSpec;
use parallax_runtime::launch::{End, Exit, Mode, RunError, RunOptions, RunReport, run};
use parallax_runtime::recording::{Clock, Recording};

use crate::Test;
use crate::nodes::{SECRET, graph, registry};

pub(crate) const TESTS: &[Test] = &[
    ("processes_are_recorded", processes_are_recorded),
    ("threads_are_recorded", threads_are_recorded),
    ("two_runs_at_once_do_not_meet", two_runs_at_once_do_not_meet),
    ("a_secret_reaches_its_node_and_no_file", a_secret_reaches_its_node_and_no_file),
    ("cores_are_checked", cores_are_checked),
    ("progress_can_stop_a_run", progress_can_stop_a_run),
    ("real_time_is_granted_or_warned_of", real_time_is_granted_or_warned_of),
];

pub(crate) fn options(seconds: f64, recording: &Path) -> RunOptions {
    RunOptions {
        duration: Some((seconds * 1e9) as i64),
        recording: Some(recording.into()),
        seed: 5,
        ..RunOptions::default()
    }
}

fn processes_are_recorded() {
    recorded(Mode::Processes);
}

fn threads_are_recorded() {
    recorded(Mode::Threads);
}

/// The recording of half a second has every step, with what it consumed.
fn recorded(mode: Mode) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let report = run(&graph(), &registry(), RunOptions { mode, ..options(0.5, &path) }).unwrap();
    let recording = Recording::read(&path).unwrap();
    println!("  {mode:?}: start-up {} us, memory {} KiB", report.startup / 1000, report.shared_memory / 1024);
    for node in &report.nodes {
        println!("  {}: lateness {:?}, computation {:?}", node.node, node.lateness, node.computation);
    }
    check(&report, &recording);
}

/// Whether report and recording are those of half a second of [`graph`].
pub(crate) fn check(report: &RunReport, recording: &Recording) {
    assert!(report.clean(), "{report:#?}");
    assert_eq!((report.end.clone(), report.duration, report.failure()), (End::Duration, 500_000_000, None));
    assert_eq!(recording.truncated, None);
    assert_eq!((recording.graph.clone(), recording.duration), (graph(), 500_000_000));
    assert!(
        matches!(&recording.clock, Clock::Wall { start, seed: 5, .. } if *start > 1_600_000_000_000_000_000)
    );
    let [counter, adder] = &recording.nodes[..] else { panic!("two tracks") };
    // Ticks at 0, 5, … 495 ms and 0, 10, … 490 ms; on a busy machine the last may come after the end.
    for (track, report, ticks) in [(counter, &report.nodes[0], 100), (adder, &report.nodes[1], 50)] {
        assert!((ticks - 20..=ticks).contains(&track.steps.len()), "{report:?}");
        assert_eq!((report.steps, track.messages.len()), (track.steps.len() as u64, track.steps.len()));
    }
    for (k, (step, message)) in counter.steps.iter().zip(&counter.messages).enumerate() {
        assert_eq!((step.seq, message.seq, &*message.payload), (k as u64, k as u64, &[k as f64][..]));
        assert_eq!((step.due, message.sent), (k as i64 * 5_000_000, step.end));
        assert!(step.due <= step.start && step.start <= step.end);
    }
    for (k, (step, message)) in adder.steps.iter().zip(&adder.messages).enumerate() {
        // Step k waits for the messages due up to its own time: 0 for step 0, then 2, 4, …
        let consumed = &step.inputs[0].consumed;
        let newest = consumed.last().unwrap();
        assert_eq!(newest.seq, Some(2 * k as u64));
        assert_eq!(message.payload, [2.0 * k as f64 + 1.0]);
        assert_eq!(consumed.len(), 2);
        assert_eq!(consumed[0].seq, (2 * k as u64).checked_sub(1));
        assert_eq!(newest.sent, counter.messages[2 * k].sent, "stamps are those of the sender");
        assert!(newest.sent <= newest.received && newest.received <= step.start);
    }
}

fn two_runs_at_once_do_not_meet() {
    let folder = tempfile::tempdir().unwrap();
    std::thread::scope(|scope| {
        for name in ["one.mcap", "two.mcap"] {
            let path = folder.path().join(name);
            scope.spawn(move || {
                let report = run(&graph(), &registry(), options(0.5, &path)).unwrap();
                check(&report, &Recording::read(&path).unwrap());
            });
        }
    });
}

fn a_secret_reaches_its_node_and_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = graph();
    graph.nodes.push(NodeSpec::new("vault", "secret", 20.0));
    let secret = BTreeMap::from([(SECRET.to_owned(), "1234.56789".to_owned())]);
    let private = BTreeMap::from([("vault".to_owned(), secret)]);
    let options = || RunOptions { private: private.clone(), ..options(0.1, &path) };
    let report = run(&graph, &registry(), options()).unwrap();
    assert_eq!(report.nodes[2].exit, Exit::Clean);
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.node("vault").unwrap().messages[0].payload, [1234.56789]);
    let bytes = std::fs::read(&path).unwrap();
    assert!(
        !bytes.windows(10).any(|window| window == b"1234.56789"),
        "the text of the secret was written down"
    );

    let error = run(&graph, &registry(), RunOptions { mode: Mode::Threads, ..options() }).unwrap_err();
    assert!(matches!(error, RunError::PrivateNeedsProcesses { .. }), "{error}");
    graph.nodes.pop();
    let error = run(&graph, &registry(), options()).unwrap_err();
    assert!(matches!(error, RunError::PrivateForNobody { .. }), "{error}");
}

fn cores_are_checked() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = graph();
    // Not every core of the machine may be this process's to use.
    let own = core_affinity::get_core_ids().unwrap()[0].id;
    graph.nodes.iter_mut().for_each(|node| node.core = Some(own));
    let report = run(&graph, &registry(), options(0.05, &path)).unwrap();
    let shared = format!("core {own}");
    assert!(report.warnings.iter().any(|warning| warning.contains(&shared)), "{:?}", report.warnings);
    assert!(report.nodes.iter().all(|node| node.core == Some(own)));
    graph.nodes[1].core = Some(4096);
    let error = run(&graph, &registry(), options(0.05, &path)).unwrap_err().to_string();
    assert!(error.contains("adder") && error.contains("4096"), "{error}");
}

fn real_time_is_granted_or_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    for mode in [Mode::Processes, Mode::Threads] {
        let options = RunOptions { real_time: true, mode, ..options(0.5, &path) };
        let report = run(&graph(), &registry(), options).unwrap();
        check(&report, &Recording::read(&path).unwrap());
        let refused = report.warnings.iter().filter(|warning| warning.contains("like any program")).count();
        assert!(refused == 0 || refused == 2, "both nodes ask for the same: {:?}", report.warnings);
        println!("  {mode:?}: {refused} of 2 nodes refused");
        for node in &report.nodes {
            println!("  {}: lateness {:?}", node.node, node.lateness);
        }
    }
}

fn progress_can_stop_a_run() {
    let mut seen = 0;
    let progress = move |progress: parallax_runtime::launch::Progress| {
        // It is asked while the nodes get ready, too.
        seen += u32::from(progress.elapsed >= 0);
        seen < 4
    };
    let options = RunOptions {
        duration: Some(Duration::from_secs(60).as_nanos() as i64),
        progress: Some(Box::new(progress)),
        ..RunOptions::default()
    };
    let report = run(&graph(), &registry(), options).unwrap();
    assert_eq!(report.end, End::Signal);
    assert!(report.duration < 30_000_000_000 && report.nodes[0].exit == Exit::Clean);
}
