//! Nodes that end, hang, flood, are late or send garbage while the run goes on: what is done, told and accounted for.

use std::cell::Cell;
use std::path::Path;
use std::rc::Rc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use parallax_runtime::channel::{ChannelError, Endpoint, Space, Topic};
use parallax_runtime::graph::{GraphSpec, OnDeadSender, Scheduling};
use parallax_runtime::launch::{
    End, Event, EventKind, Exit, InputReport, LiveRun, Phase, RunOptions, RunReport, run,
};
use parallax_runtime::node::Layout;
use parallax_runtime::recording::{FaultKind, LossReason, Recording};
use parallax_runtime::schedule::verify;

use crate::Test;
use crate::nodes::{Number, graph, registry, troubled};
use crate::runs::options;
use crate::settings::launch;

pub(crate) const TESTS: &[Test] = &[
    ("a_killed_node_comes_back", a_killed_node_comes_back),
    ("a_killed_receiver_comes_back", a_killed_receiver_comes_back),
    ("a_thread_that_panics_comes_back", a_thread_that_panics_comes_back),
    ("a_node_that_keeps_its_frequency_comes_back", a_node_that_keeps_its_frequency_comes_back),
    ("a_node_that_always_dies_is_given_up", a_node_that_always_dies_is_given_up),
    ("an_exit_in_order_is_a_failure_only_to_always", an_exit_in_order_is_a_failure_only_to_always),
    ("a_node_that_hangs_is_noticed", a_node_that_hangs_is_noticed),
    ("a_stopped_process_goes_on", a_stopped_process_goes_on),
    ("late_steps_are_counted_told_and_acted_on", late_steps_are_counted_told_and_acted_on),
    ("outputs_that_are_no_numbers_are_told", outputs_that_are_no_numbers_are_told),
    ("a_flood_is_accounted_for", a_flood_is_accounted_for),
    ("a_node_that_sends_nothing_is_named", a_node_that_sends_nothing_is_named),
    ("garbage_is_counted_and_harms_nobody", garbage_is_counted_and_harms_nobody),
];

/// Runs a graph for so long under these settings; gives the report and the recording.
pub(crate) fn observe(graph: &GraphSpec, seconds: f64, settings: &str) -> (RunReport, Recording) {
    observe_with(graph, settings, |path| options(seconds, path))
}

/// Runs a graph until half a second after a node was started again.
pub(crate) fn observe_restart(graph: &GraphSpec, settings: &str) -> (RunReport, Recording) {
    let back = Rc::new(Cell::new(None));
    let seen = back.clone();
    observe_with(graph, settings, |path| RunOptions {
        events: Some(Box::new(move |event: &Event| {
            if matches!(event.kind, EventKind::Restarted { .. }) {
                seen.set(Some(Instant::now()));
            }
        })),
        progress: Some(Box::new(move |_| {
            back.get().is_none_or(|back: Instant| back.elapsed() < Duration::from_millis(500))
        })),
        ..options(30.0, path)
    })
}

fn observe_with(
    graph: &GraphSpec,
    settings: &str,
    options: impl FnOnce(&Path) -> RunOptions,
) -> (RunReport, Recording) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let options = RunOptions {
        launch: launch(settings),
        patience: Duration::from_secs(5),
        // Where the system allows it: other programs on a busy machine then delay no step by much.
        real_time: true,
        ..options(&path)
    };
    let report = run(graph, &registry(), options).unwrap();
    let recording = Recording::read(&path).unwrap();
    balance(&report, &recording);
    (report, recording)
}

/// Every message that a node sent is in exactly one place, and the recording agrees.
fn balance(report: &RunReport, recording: &Recording) {
    for node in &report.nodes {
        let track = recording.node(&node.node).unwrap();
        // A step that was killed between sending and recording is in the count only.
        let sent = track.messages.len() as u64;
        assert!(node.sent >= sent && node.sent <= sent + node.restarts + 1, "{} {sent}", node.sent);
        for input in &node.inputs {
            let lost: u64 = input.lost.iter().map(|(_, count)| count).sum();
            let malformed = reason(input, LossReason::Malformed);
            assert_eq!(
                input.sent,
                input.consumed + input.superseded + input.in_flight + lost - malformed,
                "{input:?}"
            );
            // What steps saw, as recorded. The last step before a death may be in the recording only.
            let mut seen: Vec<u64> = track
                .steps
                .iter()
                .flat_map(|step| step.inputs.iter().filter(|record| record.port == input.port))
                .flat_map(|record| record.consumed.iter().filter_map(|consumed| consumed.seq))
                .collect();
            seen.sort_unstable();
            seen.dedup();
            let recorded = seen.len() as u64;
            assert!(input.consumed.abs_diff(recorded) <= 4 * node.restarts + 4, "{input:?} {recorded}");
            for reason in [LossReason::NotSent, LossReason::Transport] {
                let losses = recording.losses.iter().filter(|l| l.to == node.node && l.reason == reason);
                let counted =
                    if reason == LossReason::NotSent { input.not_sent } else { self::reason(input, reason) };
                assert_eq!(losses.count() as u64, counted, "{input:?}");
            }
        }
    }
}

fn reason(input: &InputReport, reason: LossReason) -> u64 {
    input.lost.iter().filter(|(other, _)| *other == reason).map(|(_, count)| count).sum()
}

fn kinds<'a>(report: &'a RunReport, node: &'a str) -> impl Iterator<Item = &'a EventKind> {
    report.events.iter().filter(move |event| event.node == node).map(|event| &event.kind)
}

/// What was recorded is a schedule that the rules allow, restarts included.
fn lawful(recording: &Recording) {
    let graph = recording.graph.validate(&registry()).unwrap();
    for (index, track) in recording.nodes.iter().enumerate() {
        let check = verify(recording, &graph, index, &track.steps);
        assert!(check.deviation.is_none(), "{}", check.deviation.unwrap());
        assert_eq!(check.steps as usize, track.steps.len());
    }
}

const COMES_BACK: &str = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.1\n";

fn a_killed_node_comes_back() {
    let (report, recording) = observe_restart(&troubled("kill", 40), COMES_BACK);
    assert_eq!(report.end, End::Signal, "{report:#?}");
    let [counter, adder] = &report.nodes[..] else { panic!("two nodes") };
    assert_eq!(
        (counter.restarts, &counter.exit, &adder.exit),
        (1, &Exit::Clean, &Exit::Clean),
        "{report:#?}"
    );
    // The adder, which waits for it, waited, and takes up the grid again.
    let seqs: Vec<u64> = recording.nodes[0].messages.iter().map(|message| message.seq).collect();
    let back = seqs[40];
    assert!(seqs[..40].iter().copied().eq(0..40) && back >= 60, "down for at least 100 ms: {back}");
    assert!(seqs[40..].iter().copied().eq(back..back + (seqs.len() - 40) as u64));
    assert_eq!(adder.inputs[0].not_sent, back - 40, "each message that was not sent is counted");
    let last = recording.nodes[1].messages.last().unwrap();
    assert!(last.payload[0] > back as f64, "the newest number, after all: {last:?}");
    let seen: Vec<&EventKind> = kinds(&report, "counter").collect();
    assert!(
        matches!(
            seen[..],
            [
                EventKind::Ended { exit: Exit::Died { .. } },
                EventKind::Restarting { attempt: 1, .. },
                EventKind::Restarted { step }
            ] if *step == back
        ),
        "{seen:?}"
    );
    let faults: Vec<&FaultKind> = recording.faults.iter().map(|fault| &fault.kind).collect();
    assert!(
        matches!(faults[..], [FaultKind::Died { .. }, FaultKind::Restarted { step, shift: 0 }] if *step == back),
        "{faults:?}"
    );
    lawful(&recording);
}

fn a_killed_receiver_comes_back() {
    let mut graph = graph();
    let parameters = &mut graph.node_mut("adder").unwrap().parameters;
    parameters.insert("what".into(), "kill".into());
    parameters.insert("at".into(), 20.into());
    let settings = "[node.adder]\nrestart = \"on-failure\"\nrestart_delay = 0.1\n";
    let (report, recording) = observe_restart(&graph, settings);
    let [counter, adder] = &report.nodes[..] else { panic!("two nodes") };
    assert_eq!(
        (report.end.clone(), adder.restarts, &adder.exit),
        (End::Signal, 1, &Exit::Clean),
        "{report:#?}"
    );
    assert!(counter.steps > 60, "the sender was not held up: {report:#?}");
    let lost = reason(&adder.inputs[0], LossReason::ReceiverDown);
    assert!(lost >= 20, "what was sent meanwhile is lost with its reason: {report:#?}");
    assert!(adder.inputs[0].in_flight <= 4, "{report:#?}");
    let last = recording.nodes[1].messages.last().unwrap();
    assert!(last.payload[0] > 60.0, "{last:?}");
    lawful(&recording);
}

fn a_thread_that_panics_comes_back() {
    let settings = format!("{COMES_BACK}run_as = \"thread\"\n[node.adder]\nrun_as = \"thread\"\n");
    let (report, recording) = observe_restart(&troubled("panic", 40), &settings);
    assert_eq!((report.end.clone(), report.nodes[0].restarts), (End::Signal, 1), "{report:#?}");
    assert!(recording.nodes[0].messages.len() > 45, "{report:#?}");
    lawful(&recording);
}

fn a_node_that_keeps_its_frequency_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let mut graph = troubled("kill", 40);
    graph.nodes[0].scheduling = Scheduling::Frequency;
    // The step during which it died comes again.
    let once = folder.path().join("once");
    graph.nodes[0].parameters.insert("once".into(), once.to_str().unwrap().into());
    let (report, recording) = observe_restart(&graph, COMES_BACK);
    let seqs = recording.nodes[0].messages.iter().map(|message| message.seq);
    assert!(seqs.eq(0..recording.nodes[0].messages.len() as u64), "no number is left out");
    assert!(recording.nodes[0].messages.len() > 50, "{report:#?}");
    assert_eq!((report.nodes[0].restarts, report.nodes[1].inputs[0].not_sent), (1, 0));
    lawful(&recording);
}

fn a_node_that_always_dies_is_given_up() {
    let mut graph = troubled("exit", 10);
    graph.nodes[0].parameters.insert("lasting".into(), true.into());
    let settings = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.02\nrestart_limit = 2\n";
    let (report, _) = observe(&graph, 60.0, settings);
    assert_eq!(report.end, End::Node { node: "counter".into() });
    let delays: Vec<i64> = kinds(&report, "counter")
        .filter_map(|kind| if let EventKind::Restarting { delay, .. } = kind { Some(*delay) } else { None })
        .collect();
    assert_eq!(delays, [20_000_000, 40_000_000], "the delay doubles");
    assert!(kinds(&report, "counter").any(|kind| *kind == EventKind::GivenUp { restarts: 2 }), "{report:#?}");
    let text = report.failure().unwrap();
    assert!(text.contains("exit status 3"), "{text}");
}

fn an_exit_in_order_is_a_failure_only_to_always() {
    for (policy, restarts) in [("on-failure", 0), ("always", 1)] {
        let settings = format!("[node.counter]\nrestart = \"{policy}\"\nrestart_delay = 0.01\n");
        let (report, _) = observe(&troubled("leave", 10), 0.4, &settings);
        assert_eq!(report.nodes[0].restarts, restarts, "{policy}: {report:#?}");
    }
}

fn a_node_that_hangs_is_noticed() {
    let settings = |more: &str| format!("[node.counter]\nheartbeat = 0.15\n{more}");
    let hang = || troubled("hang", 20);
    let noticed = |report: &RunReport| {
        let hung = kinds(report, "counter").find_map(|kind| match kind {
            EventKind::Hangs { silent, step: Some(20) } => Some(*silent),
            _ => None,
        });
        assert!(hung.is_some_and(|silent| silent >= 150_000_000), "{report:#?}");
        assert_eq!(report.nodes[0].hangs, 1);
    };
    // By default it is said, and waited for: here until the time is over.
    let start = Instant::now();
    let (report, _) = observe(&hang(), 0.6, &settings(""));
    noticed(&report);
    assert_eq!(report.end, End::Duration);
    assert!(matches!(report.nodes[0].exit, Exit::Hung { .. }), "{report:#?}");
    assert!(
        start.elapsed() < Duration::from_secs(4),
        "a node that hangs is not waited for as long as others"
    );

    let (report, recording) = observe(
        &hang(),
        1.0,
        &settings("on_hang = \"restart\"\nrestart = \"on-failure\"\nrestart_delay = 0.05\n"),
    );
    noticed(&report);
    assert_eq!((report.end.clone(), report.nodes[0].restarts), (End::Duration, 1), "{report:#?}");
    assert!(recording.nodes[0].messages.len() > 40, "{report:#?}");

    let start = Instant::now();
    let (report, _) = observe(&hang(), 60.0, &settings("on_hang = \"stop\"\n"));
    noticed(&report);
    assert_eq!(report.end, End::Node { node: "counter".into() });
    assert!(start.elapsed() < Duration::from_secs(20));
    assert!(report.failure().unwrap().contains("no sign of life"), "{:?}", report.failure());
}

/// The processes of this one's nodes with this name.
pub(crate) fn node_process(launcher: u32, node: &str) -> Option<u32> {
    let mut found = Vec::new();
    for task in std::fs::read_dir(format!("/proc/{launcher}/task")).ok()?.flatten() {
        let children = std::fs::read_to_string(task.path().join("children")).unwrap_or_default();
        found.extend(children.split_whitespace().filter_map(|pid| pid.parse::<u32>().ok()));
    }
    let named = |pid: &u32| {
        std::fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|name| name.trim() == node)
    };
    found.into_iter().find(named)
}

fn a_stopped_process_goes_on() {
    let stopper = std::thread::spawn(|| {
        let start = Instant::now();
        let own = std::process::id();
        // Not while it comes up: what is late then is no hang.
        while !LiveRun::find(Some(&own.to_string())).is_ok_and(|run| run.phase() == Phase::Running) {
            assert!(start.elapsed() < Duration::from_secs(20), "the run does not begin");
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(300));
        let pid = node_process(own, "counter").expect("it runs");
        crate::failures::signal(pid, libc::SIGSTOP);
        std::thread::sleep(Duration::from_secs(1));
        crate::failures::signal(pid, libc::SIGCONT);
    });
    let (report, recording) = observe(&graph(), 2.0, "[node.counter]\nheartbeat = 0.3\n");
    stopper.join().unwrap();
    let [counter, adder] = &report.nodes[..] else { panic!("two nodes") };
    assert_eq!((report.end.clone(), &counter.exit, &adder.exit), (End::Duration, &Exit::Clean, &Exit::Clean));
    // It catches up with the grid: no step is left out, and everything has arrived.
    assert!(counter.steps >= 380, "{report:#?}");
    let numbers: Vec<u64> = recording.nodes[0].messages.iter().map(|message| message.seq).collect();
    assert!(numbers.into_iter().eq(0..counter.steps));
    assert_eq!(counter.hangs, 1);
    let told: Vec<&EventKind> = kinds(&report, "counter").collect();
    assert!(
        matches!(told[..], [EventKind::Hangs { .. }, EventKind::Returns { silent }] if *silent > 800_000_000),
        "{told:?}"
    );
    lawful(&recording);
}

fn late_steps_are_counted_told_and_acted_on() {
    let slow = || {
        let mut graph = troubled("slow", 20);
        graph.nodes[0].safe =
            Some([("value".to_owned(), parallax_runtime::graph::SafeValue::Number(-7.0))].into());
        graph
    };
    // 60 ms where 40 ms are allowed, and 20 ms of room for a busy machine.
    let settings = |reaction: &str| format!("[node.counter]\ndeadline = 0.04\n{reaction}");
    let (report, recording) = observe(&slow(), 0.4, &settings(""));
    assert!(report.nodes[0].late >= 1 && report.nodes[0].late_by >= 20_000_000, "{report:#?}");
    assert_eq!(recording.nodes[0].messages[20].payload, [20.0], "it is sent all the same");
    assert_eq!(kinds(&report, "counter").count(), 0, "counted, not told");

    let (report, _) = observe(&slow(), 0.4, &settings("on_deadline = \"warn\"\n"));
    assert!(kinds(&report, "counter").any(|kind| matches!(kind, EventKind::Late { .. })), "{report:#?}");

    let (report, recording) = observe(&slow(), 0.4, &settings("on_deadline = \"safe\"\n"));
    assert_eq!(recording.nodes[0].messages[20].payload, [-7.0], "the safe output in its place");
    assert!(report.nodes[0].replaced >= 1, "{report:#?}");

    let (report, _) = observe(&slow(), 60.0, &settings("on_deadline = \"stop\"\n"));
    assert_eq!(report.end, End::Node { node: "counter".into() });
    assert!(report.failure().unwrap().contains("deadline"), "{:?}", report.failure());
}

fn outputs_that_are_no_numbers_are_told() {
    let nan = || {
        let mut graph = troubled("nan", 20);
        graph.nodes[0].parameters.insert("lasting".into(), true.into());
        graph.nodes[0].safe = Some([("value".to_owned(), parallax_runtime::graph::SafeValue::Hold)].into());
        graph
    };
    let (report, recording) = observe(&nan(), 0.3, "");
    let first = report.nodes[0].non_finite.as_ref().unwrap();
    assert_eq!((first.step, &*first.leaf, first.count), (20, "value", report.nodes[0].steps - 20));
    assert!(recording.nodes[0].messages[20].payload[0].is_nan());
    let told =
        |kind: &EventKind| matches!(kind, EventKind::NonFinite { step: 20, leaf, .. } if leaf == "value");
    assert!(kinds(&report, "counter").any(told), "{report:#?}");

    let (report, recording) = observe(&nan(), 0.3, "[node.counter]\non_non_finite = \"safe\"\n");
    assert!(
        recording.nodes[0].messages[20..].iter().all(|message| message.payload == [19.0]),
        "the last is held"
    );
    assert_eq!(report.nodes[0].replaced, report.nodes[0].steps - 20);

    let (report, recording) = observe(&nan(), 60.0, "[node.counter]\non_non_finite = \"fail\"\n");
    let text = report.failure().unwrap();
    assert!(text.contains("step 20") && text.contains("leaf value"), "{text}");
    assert_eq!(recording.nodes[0].messages.len(), 20);
}

fn a_flood_is_accounted_for() {
    let mut graph = graph();
    graph.nodes[0].rate = 4000.0;
    graph.nodes[1].rate = 20.0;
    graph.connections[0].blocking = false;
    graph.connections[0].window = 1;
    let (report, _) = observe(&graph, 0.5, "");
    let input = &report.nodes[1].inputs[0];
    assert!(input.sent > 500 && input.consumed <= 10 && input.superseded > 300, "{report:#?}");
    assert!(report.nodes[0].undelivered == 0, "{report:#?}");
}

fn a_node_that_sends_nothing_is_named() {
    let (report, recording) = observe(&troubled("hang", 0), 0.3, "[node.counter]\nheartbeat = 0.1\n");
    assert!(recording.nodes.iter().all(|track| track.messages.is_empty()));
    let warns = |parts: [&str; 2]| {
        report.warnings.iter().any(|warning| parts.iter().all(|part| warning.contains(part)))
    };
    assert!(warns(["adder made no step", "nothing came from counter"]), "{:?}", report.warnings);
    assert!(warns(["counter made no step", "its first step did not end"]), "{:?}", report.warnings);
}

/// While a sender is down, somebody of the same user takes its place and sends what no node would.
fn garbage_is_counted_and_harms_nobody() {
    let mut graph = troubled("kill", 20);
    graph.nodes[1].on_dead_sender = OnDeadSender::Continue;
    let (tell, told) = channel();
    let (done, finished) = channel::<()>();
    let rogue = std::thread::spawn(move || {
        told.recv_timeout(Duration::from_secs(20)).expect("the counter goes down");
        let base = std::fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.path());
        let own = format!("{}-", std::process::id());
        let run = base
            .filter(|path| path.file_name().unwrap().to_string_lossy().starts_with("parallax-"))
            .flat_map(|base| std::fs::read_dir(base).into_iter().flatten().flatten())
            .map(|entry| entry.path())
            .find(|path| path.is_dir() && path.file_name().unwrap().to_string_lossy().starts_with(&own))
            .expect("the run has a directory");
        let here = Endpoint::new(&Space::attach(&run).unwrap()).unwrap();
        let layout = Layout::of::<Number<f64>>().hash();
        let topic = Topic { name: "counter".into(), layout, words: 3, buffer: 1, subscribers: 1, held: 0 };
        let another = here.open(&Topic { layout: !layout, ..topic.clone() });
        assert!(matches!(another, Err(ChannelError::Layout { .. })), "another layout is refused");
        let start = Instant::now();
        let publisher = loop {
            here.remove_dead();
            match here.open(&topic).unwrap().publisher() {
                Ok(publisher) => break publisher,
                Err(error) => assert!(start.elapsed() < Duration::from_secs(5), "{error}"),
            }
        };
        let message = |words: &[u64]| publisher.send(words.len(), |word| words[word]).unwrap();
        message(&[1]);
        message(&[]);
        message(&[u64::MAX, 5, 5]);
        message(&[1 << 40, 5, 5]);
        message(&[3, u64::MAX, u64::MAX]);
        // It stays in the channel until it has been taken.
        std::thread::sleep(Duration::from_millis(100));
        drop(publisher);
        done.send(()).unwrap();
    });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let settings = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.6\n";
    let options = RunOptions {
        launch: launch(settings),
        events: Some(Box::new(move |event: &Event| {
            if matches!(event.kind, EventKind::Restarting { .. }) {
                let _ = tell.send(());
            }
        })),
        // Long enough for it to come back on a machine that has other things to do.
        ..options(3.0, &path)
    };
    let report = run(&graph, &registry(), options).unwrap();
    rogue.join().unwrap();
    finished.recv().unwrap();
    let [counter, adder] = &report.nodes[..] else { panic!("two nodes") };
    assert_eq!(
        (counter.restarts, &counter.exit, &adder.exit),
        (1, &Exit::Clean, &Exit::Clean),
        "{report:#?}"
    );
    assert_eq!(reason(&adder.inputs[0], LossReason::Malformed), 5, "{report:#?}");
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.losses.iter().filter(|loss| loss.reason == LossReason::Malformed).count(), 5);
    balance(&report, &recording);
    let last = recording.nodes[1].messages.last().unwrap();
    assert!(last.payload[0] > 200.0, "the counter is heard again: {last:?}");
}
