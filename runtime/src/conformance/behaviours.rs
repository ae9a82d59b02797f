//! What every executor must show.

use super::nodes::INITIAL;
use super::{Behaviour, ExecutorUnderTest, registry};
use crate::delay::Delay;
use crate::graph::{ConnectionSpec, GraphSpec, JitterPolicy, NodeSpec, OnDeadSender, SafeValue, Scheduling};
use crate::node::Consumed;
use crate::recording::{FaultKind, NodeTrack, Recording, StepRecord};
use crate::schedule::verify;
use crate::time::{Grid, Nanos, from_seconds};

/// The safe output of senders that have one.
const SAFE: f64 = 77.0;
const MILLISECOND: Nanos = 1_000_000;
const DURATION: Nanos = 300 * MILLISECOND;

/// All behaviours with their names.
pub const BEHAVIOURS: &[(&str, Behaviour)] = &[
    ("blocking inputs get exactly their messages", blocking),
    ("other inputs get what has arrived", not_blocking),
    ("windows are contiguous, oldest first", windows),
    ("the initial message fills a window", initial_message),
    ("skip breaks a cycle and leaves simultaneous messages", skip),
    ("a buffer holds messages until they are expected", buffer),
    ("advance does not wait for the tick", advance),
    ("frequency shifts after an overrun", frequency),
    ("phase catches up after an overrun", phase),
    ("a slow sender holds nobody up", slow_sender),
    ("a fast sender is counted", fast_sender),
    ("a dead sender stops a node that waits", dead_sender_stops),
    ("a dead sender lets a node continue", dead_sender_continues),
    ("a dead sender leaves its safe output", dead_sender_leaves_its_safe_output),
];

fn counter(name: &str, rate: f64) -> NodeSpec {
    NodeSpec::new(name, "conformance/counter", rate)
}

fn sum(name: &str, rate: f64) -> NodeSpec {
    NodeSpec::new(name, "conformance/sum", rate)
}

fn connect(from: &str, to: &str) -> ConnectionSpec {
    ConnectionSpec { port: Some("in".into()), ..ConnectionSpec::new(from, to) }
}

fn blocks(from: &str, to: &str) -> ConnectionSpec {
    ConnectionSpec { blocking: true, ..connect(from, to) }
}

fn graph(nodes: Vec<NodeSpec>, connections: Vec<ConnectionSpec>) -> GraphSpec {
    GraphSpec {
        name: "conformance".into(),
        supervisor: nodes[0].name.clone(),
        nodes,
        connections,
        plant: None,
    }
}

/// Runs a graph and checks what holds for every run: the schedule follows the rules, every message is accounted for, and
/// outputs follow from inputs.
fn run(executor: &dyn ExecutorUnderTest, spec: &GraphSpec) -> Recording {
    let recording = executor.run(spec, DURATION);
    let graph = spec.validate(&registry()).expect("the graph is valid");
    for (index, plan) in graph.nodes().iter().enumerate() {
        let track = track(&recording, &plan.name);
        let check = verify(&recording, &graph, index, &track.steps);
        assert_eq!(
            check.deviation,
            None,
            "{}",
            check.deviation.as_ref().map_or(String::new(), |d| d.to_string())
        );
        assert_eq!(track.steps.len(), track.messages.len(), "node `{}`: one message a step", plan.name);
        for (place, (step, message)) in track.steps.iter().zip(&track.messages).enumerate() {
            assert_eq!((step.seq, message.seq), (place as u64, place as u64), "node `{}`", plan.name);
            assert!(step.start < DURATION, "node `{}` started step {} after the end", plan.name, step.seq);
            let expected = match step.inputs.first() {
                None => step.seq as f64,
                Some(input) => input
                    .consumed
                    .iter()
                    .map(|consumed| match consumed.seq {
                        Some(seq) => payload(&recording, spec, &plan.name, seq),
                        None if consumed.is_safe_output() => SAFE,
                        None => INITIAL,
                    })
                    .sum(),
            };
            assert_eq!(message.payload, [expected], "node `{}`, step {}", plan.name, step.seq);
        }
    }
    for connection in &spec.connections {
        account(&recording, connection);
    }
    recording
}

fn track<'a>(recording: &'a Recording, name: &str) -> &'a NodeTrack {
    recording.node(name).unwrap_or_else(|| panic!("no track of node `{name}`"))
}

fn steps<'a>(recording: &'a Recording, name: &str) -> &'a [StepRecord] {
    let steps = &track(recording, name).steps;
    assert!(steps.len() > 5, "node `{name}` made only {} steps", steps.len());
    steps
}

/// What message `seq` at the input of `receiver` said.
fn payload(recording: &Recording, spec: &GraphSpec, receiver: &str, seq: u64) -> f64 {
    let from = spec.connections.iter().find(|connection| connection.to == receiver).map(|c| c.from.as_str());
    let sender = track(recording, from.unwrap_or_default());
    sender.message(seq).unwrap_or_else(|| panic!("message {seq} of `{}`", sender.name)).payload[0]
}

/// Every message up to the newest one seen was consumed, superseded or lost, exactly once; newer ones are in flight.
fn account(recording: &Recording, connection: &ConnectionSpec) {
    let mut consumed = std::collections::BTreeSet::new();
    let (mut superseded, mut safe) = (0, false);
    for step in &track(recording, &connection.to).steps {
        for input in step.inputs.iter().filter(|input| input.port == connection.port()) {
            consumed.extend(input.consumed.iter().filter_map(|consumed| consumed.seq));
            superseded += input.superseded;
            safe |= input.consumed.iter().any(Consumed::is_safe_output);
        }
    }
    let known = consumed.last().map_or(0, |last| last + 1);
    let lost = recording
        .losses
        .iter()
        .filter(|loss| loss.to == connection.to && loss.port == connection.port() && loss.seq < known)
        .count() as u64;
    let sent = track(recording, &connection.from).messages.len() as u64;
    let place = format!("{} -> {}", connection.from, connection.to);
    let accounted = consumed.len() as u64 + superseded + lost;
    // What a safe output pushed out was newer than what was seen.
    let newer = if safe { sent - known } else { 0 };
    assert!((known..=known + newer).contains(&accounted), "{place}: a message is not accounted for");
    assert!(known <= sent, "{place}: {known} messages came out, {sent} went in");
}

fn newest(step: &StepRecord) -> Option<u64> {
    step.inputs[0].consumed.last().and_then(|consumed| consumed.seq)
}

fn blocking(executor: &dyn ExecutorUnderTest) {
    let mut spec = graph(
        vec![counter("source", 150.0), sum("sink", 60.0)],
        vec![ConnectionSpec { window: 3, ..blocks("source", "sink") }],
    );
    spec.nodes[0].computation = Delay::Uniform { low: 0.0, high: 0.002 };
    let recording = run(executor, &spec);
    let source = Grid::new(0, 150.0).expect("a rate");
    for step in steps(&recording, "sink") {
        // All messages whose ideal send time is not after the due time, whatever their jitter.
        assert_eq!(newest(step).map(|seq| seq + 1), Some(source.count_until(step.due)), "step {}", step.seq);
    }
}

fn not_blocking(executor: &dyn ExecutorUnderTest) {
    let mut spec = graph(vec![counter("source", 200.0), sum("sink", 70.0)], vec![connect("source", "sink")]);
    spec.connections[0].delay = Delay::Uniform { low: 0.0, high: 0.004 };
    let recording = run(executor, &spec);
    let mut fresh = 0;
    for step in steps(&recording, "sink") {
        for consumed in &step.inputs[0].consumed {
            assert!(consumed.sent <= consumed.received && consumed.received <= step.start);
            fresh += usize::from(consumed.seq.is_some());
        }
    }
    assert!(fresh > 0, "no message ever arrived");
}

fn windows(executor: &dyn ExecutorUnderTest) {
    let spec = graph(
        vec![counter("source", 100.0), sum("sink", 50.0)],
        vec![ConnectionSpec { window: 4, ..connect("source", "sink") }],
    );
    let recording = run(executor, &spec);
    let mut full = 0;
    for step in steps(&recording, "sink") {
        let window = &step.inputs[0].consumed;
        assert_eq!(window.len(), 4);
        let initial = window.iter().take_while(|consumed| consumed.seq.is_none()).count();
        let seqs: Vec<u64> = window[initial..].iter().filter_map(|consumed| consumed.seq).collect();
        assert_eq!(seqs.len(), 4 - initial, "initial messages come first: {window:?}");
        assert!(seqs.windows(2).all(|pair| pair[1] == pair[0] + 1), "not contiguous: {seqs:?}");
        assert!(window.windows(2).all(|pair| pair[0].received <= pair[1].received), "{window:?}");
        full += usize::from(initial == 0);
    }
    assert!(full > 0, "no window was ever full");
}

fn initial_message(executor: &dyn ExecutorUnderTest) {
    let mut spec = graph(
        vec![sum("sink", 100.0), counter("source", 100.0)],
        // Without skip the sink would be due only after the first message.
        vec![ConnectionSpec { skip: true, window: 2, ..connect("source", "sink") }],
    );
    spec.connections[0].delay = Delay::constant(0.002);
    let recording = run(executor, &spec);
    let first = &steps(&recording, "sink")[0];
    assert_eq!(first.inputs[0].consumed[0].seq, None);
    assert!(track(&recording, "sink").messages[0].payload[0] < 0.0, "the initial messages are -1");
}

fn skip(executor: &dyn ExecutorUnderTest) {
    // Under an exact clock, what `right` sends arrives exactly when `left` starts again.
    let spec = graph(
        vec![sum("left", 100.0), sum("right", 100.0)],
        vec![
            blocks("left", "right"),
            ConnectionSpec { skip: true, delay: Delay::constant(0.01), ..connect("right", "left") },
        ],
    );
    let recording = run(executor, &spec);
    for step in steps(&recording, "left") {
        for consumed in step.inputs[0].consumed.iter().filter(|consumed| consumed.seq.is_some()) {
            assert!(consumed.received < step.start, "a message that arrived at the start was not left");
        }
    }
    // The same with both directions blocking: each step of `left` waits for the one of `right` before it.
    let mut spec = spec;
    spec.connections[1].blocking = true;
    let recording = run(executor, &spec);
    for step in steps(&recording, "left") {
        assert_eq!(newest(step), step.seq.checked_sub(1));
    }
    assert!(steps(&recording, "right").iter().all(|step| newest(step) == Some(step.seq)));
}

fn buffer(executor: &dyn ExecutorUnderTest) {
    let mut spec = graph(
        vec![counter("source", 100.0), sum("sink", 100.0)],
        vec![ConnectionSpec { jitter: JitterPolicy::Buffer, ..connect("source", "sink") }],
    );
    spec.connections[0].delay = Delay::Uniform { low: 0.0, high: 0.008 };
    let recording = run(executor, &spec);
    let source = Grid::new(0, 100.0).expect("a rate");
    let mut consumed = 0;
    for step in steps(&recording, "sink") {
        for seq in step.inputs[0].consumed.iter().filter_map(|consumed| consumed.seq) {
            assert!(source.time(seq) + 4 * MILLISECOND <= step.start, "message {seq} was not held");
            consumed += 1;
        }
    }
    assert!(consumed > 0);
}

fn advance(executor: &dyn ExecutorUnderTest) {
    let mut spec = graph(vec![counter("source", 100.0), sum("sink", 100.0)], vec![blocks("source", "sink")]);
    // Steps are expected to take 5 ms, and take less about half of the time.
    spec.nodes[0].computation = Delay::Uniform { low: 0.0, high: 0.01 };
    let recording = run(executor, &spec);
    assert!(steps(&recording, "sink").iter().all(|step| step.start >= step.due));
    spec.nodes[1].advance = true;
    let recording = run(executor, &spec);
    assert!(steps(&recording, "sink").iter().any(|step| step.start < step.due));
}

/// A node that runs over now and then, under both clocks: it sleeps, and its computation delay says so.
fn overrunning(scheduling: Scheduling) -> GraphSpec {
    let mut spec = graph(vec![counter("node", 100.0)], vec![]);
    let node = &mut spec.nodes[0];
    node.scheduling = scheduling;
    node.computation = Delay::Empirical { samples: vec![0.0, 0.0, 0.0, 0.0, 0.025] };
    node.parameters.insert("sleep_every".into(), 5.into());
    node.parameters.insert("sleep".into(), 0.025.into());
    spec
}

/// How far each step ran over the due time of the next one.
fn overrun(step: &StepRecord, grid: &Grid) -> Nanos {
    (step.end - grid.time(step.seq + 1)).max(0)
}

fn frequency(executor: &dyn ExecutorUnderTest) {
    let recording = run(executor, &overrunning(Scheduling::Frequency));
    let grid = Grid::new(0, 100.0).expect("a rate");
    let mut shift = 0;
    for step in steps(&recording, "node") {
        assert!(step.start >= step.due + shift, "step {} ignored a shift of {shift} ns", step.seq);
        shift = shift.max(overrun(step, &grid));
    }
    assert!(shift >= 10 * MILLISECOND, "nothing ran over");
}

fn phase(executor: &dyn ExecutorUnderTest) {
    let recording = run(executor, &overrunning(Scheduling::Phase));
    let grid = Grid::new(0, 100.0).expect("a rate");
    let steps = steps(&recording, "node");
    let worst = steps.iter().map(|step| overrun(step, &grid)).max().unwrap_or(0);
    assert!(worst >= 10 * MILLISECOND, "nothing ran over");
    let first = steps.iter().position(|step| overrun(step, &grid) > 0).unwrap_or(0);
    // Later steps start closer to their due time than the overrun left them: the grid is caught up with.
    assert!(
        steps[first..].iter().any(|step| step.start - step.due < worst / 2),
        "the grid was never caught up with"
    );
}

fn slow_sender(executor: &dyn ExecutorUnderTest) {
    for blocking in [true, false] {
        let connection = ConnectionSpec { blocking, ..connect("source", "sink") };
        let recording =
            run(executor, &graph(vec![counter("source", 20.0), sum("sink", 100.0)], vec![connection]));
        let steps = steps(&recording, "sink");
        let repeated = steps.windows(2).filter(|pair| newest(&pair[0]) == newest(&pair[1])).count();
        assert!(
            steps.len() >= 10 && repeated * 2 > steps.len(),
            "{repeated} of {} steps repeat",
            steps.len()
        );
    }
}

fn fast_sender(executor: &dyn ExecutorUnderTest) {
    for blocking in [true, false] {
        let connection = ConnectionSpec { blocking, ..connect("source", "sink") };
        let recording =
            run(executor, &graph(vec![counter("source", 400.0), sum("sink", 50.0)], vec![connection]));
        let superseded: u64 = steps(&recording, "sink").iter().map(|step| step.inputs[0].superseded).sum();
        assert!(superseded > 10, "only {superseded} messages were superseded");
    }
}

fn dying(reaction: OnDeadSender) -> GraphSpec {
    let mut spec = graph(vec![sum("sink", 100.0), counter("source", 100.0)], vec![blocks("source", "sink")]);
    spec.nodes[0].on_dead_sender = reaction;
    spec.nodes[1].parameters.insert("dies_at".into(), 10.into());
    spec
}

fn dead_sender_stops(executor: &dyn ExecutorUnderTest) {
    let recording = run(executor, &dying(OnDeadSender::Stop));
    assert_eq!(steps(&recording, "source").len(), 10);
    assert_eq!(steps(&recording, "sink").len(), 10);
    let fault = |name: &str| {
        let found = recording.faults.iter().find(|fault| fault.node == name);
        &found.unwrap_or_else(|| panic!("no fault of `{name}`: {:?}", recording.faults)).kind
    };
    assert!(
        matches!(fault("source"), FaultKind::Failed { message } if message.contains("the end of its life")),
        "{:?}",
        fault("source")
    );
    assert_eq!(*fault("sink"), FaultKind::DeadSender { sender: "source".into() });
}

fn dead_sender_continues(executor: &dyn ExecutorUnderTest) {
    let recording = run(executor, &dying(OnDeadSender::Continue));
    let steps = steps(&recording, "sink");
    assert!(steps.len() > 15, "the sink made only {} steps", steps.len());
    assert_eq!(steps.last().and_then(newest), Some(9), "what is there is still seen");
    assert!(steps.last().is_some_and(|step| step.start > DURATION - from_seconds(0.1)));
    assert_eq!(recording.faults.len(), 1);
}

fn dead_sender_leaves_its_safe_output(executor: &dyn ExecutorUnderTest) {
    for blocking in [true, false] {
        let mut spec = dying(OnDeadSender::Continue);
        spec.connections[0].blocking = blocking;
        spec.nodes[1].safe = Some([("value".to_owned(), SafeValue::Number(SAFE))].into());
        let recording = run(executor, &spec);
        let steps = steps(&recording, "sink");
        let safe = |step: &&StepRecord| step.inputs[0].consumed.iter().all(Consumed::is_safe_output);
        let first = steps.iter().position(|step| safe(&step)).expect("no step saw the safe output");
        assert!(steps.len() > first + 5 && steps[first..].iter().all(|step| safe(&step)), "it stays");
        let sums = &recording.node("sink").expect("the sink is recorded").messages;
        assert!(sums[first..].iter().all(|sum| sum.payload == [SAFE]), "{:?}", sums.last());
    }
}
