//! The gate alone: what it decides, step by step, and that it never allocates.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::alloc::{GlobalAlloc, Layout as Memory, System};
use std::cell::Cell;

use parallax_runtime::conformance::registry;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{
    ConnectionSpec, Graph, GraphSpec, JitterPolicy, NodeSpec, OnDeadSender, Scheduling,
};
use parallax_runtime::schedule::{GateError, Inbox, StepGate, Wait};

const MS: i64 = 1_000_000;

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call is handed to the system's allocator unchanged; counting touches no memory it manages.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Memory) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`, which is the same.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Memory) {
        // SAFETY: the pointer came from `System.alloc` with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A source and a sink, both at 100 Hz unless changed.
fn graph(change: impl FnOnce(&mut GraphSpec)) -> Graph {
    let mut connection = ConnectionSpec::new("source", "sink");
    connection.port = Some("in".into());
    let mut spec = GraphSpec {
        name: "test".into(),
        supervisor: "sink".into(),
        nodes: vec![
            NodeSpec::new("source", "conformance/counter", 100.0),
            NodeSpec::new("sink", "conformance/sum", 100.0),
        ],
        connections: vec![connection],
        plant: None,
    };
    change(&mut spec);
    spec.validate(&registry()).unwrap()
}

fn seqs(gate: &StepGate) -> Vec<Option<u64>> {
    let initial = std::iter::repeat_n(None, gate.initial(0));
    initial.chain(gate.visible(0).map(|(_, stamp)| stamp.seq)).collect()
}

/// Begins and ends a step, and says what it saw.
fn step(gate: &mut StepGate, start: i64, end: i64) -> Vec<Option<u64>> {
    gate.begin(start).unwrap();
    let seen = seqs(gate);
    gate.end(end).unwrap();
    seen
}

#[test]
fn the_steady_path_allocates_nothing() {
    for blocking in [true, false] {
        let graph = graph(|spec| {
            spec.nodes[0].rate = 250.0;
            spec.connections[0].blocking = blocking;
            spec.connections[0].window = 3;
            spec.connections[0].jitter = JitterPolicy::Buffer;
        });
        let mut inbox = Inbox::new(&graph, 1);
        let before = ALLOCATIONS.with(Cell::get);
        let mut sent = 0;
        let mut sum = 0.0;
        for k in 0..2_000_i64 {
            let start = k * 10 * MS;
            while sent * 4 * MS <= start {
                let arrival = inbox.arrive(0, sent as u64, sent * 4 * MS, sent * 4 * MS, &[1.0]).unwrap();
                assert!(arrival.slot.is_some());
                sent += 1;
            }
            assert_eq!(inbox.gate().ready(), Wait::Until(start));
            let step = inbox.begin(start).unwrap();
            sum += step.inputs()[0].payload(2)[0];
            inbox.end(start + MS).unwrap();
        }
        assert_eq!(ALLOCATIONS.with(Cell::get), before, "blocking: {blocking}");
        assert_eq!(sum, 2_000.0);
    }
}

#[test]
fn a_blocking_step_waits_and_ignores_what_belongs_to_later_ones() {
    let mut gate = StepGate::new(&graph(|spec| spec.connections[0].blocking = true), 1);
    assert_eq!(gate.ready(), Wait::Message { input: 0, seq: 0 });
    assert_eq!(gate.begin(0), Err(GateError::NotReady { seq: 0, wait: Wait::Message { input: 0, seq: 0 } }));
    for seq in 0..3 {
        gate.arrive(0, seq, 0, 3 * MS).unwrap();
    }
    assert_eq!(gate.ready(), Wait::Until(3 * MS));
    assert_eq!(gate.begin(2 * MS), Err(GateError::Early { seq: 0, start: 2 * MS, earliest: 3 * MS }));
    assert_eq!(step(&mut gate, 3 * MS, 4 * MS), [Some(0)]);
    assert_eq!(gate.ready(), Wait::Until(10 * MS));
    assert_eq!(step(&mut gate, 10 * MS, 10 * MS), [Some(1)]);
    assert_eq!(gate.account(0).waiting, 1);
}

#[test]
fn step_zero_also_takes_all_earlier_messages() {
    let graph = graph(|spec| {
        spec.connections[0].blocking = true;
        spec.connections[0].window = 4;
        // The sink's phase is 25 ms: messages 0, 1 and 2 have ideal send times before it.
        spec.connections[0].delay = Delay::constant(0.025);
    });
    let mut gate = StepGate::new(&graph, 1);
    assert_eq!((gate.due(), gate.ready()), (25 * MS, Wait::Message { input: 0, seq: 2 }));
    for seq in 0..3 {
        gate.arrive(0, seq, 0, 30 * MS).unwrap();
    }
    assert_eq!(step(&mut gate, 30 * MS, 30 * MS), [None, Some(0), Some(1), Some(2)]);
}

#[test]
fn skip_leaves_a_message_that_arrives_at_the_start() {
    for (skip, seen) in [(false, Some(0)), (true, None)] {
        let mut gate = StepGate::new(&graph(|spec| spec.connections[0].skip = skip), 1);
        gate.arrive(0, 0, 0, 5 * MS).unwrap();
        assert_eq!(step(&mut gate, 5 * MS, 6 * MS), [seen]);
        assert_eq!(step(&mut gate, 10 * MS, 10 * MS), [Some(0)]);
    }
}

#[test]
fn a_buffer_holds_early_messages_and_passes_late_ones() {
    let graph = graph(|spec| {
        spec.connections[0].jitter = JitterPolicy::Buffer;
        spec.connections[0].delay = Delay::constant(0.004);
    });
    let mut gate = StepGate::new(&graph, 1);
    gate.arrive(0, 0, 0, MS).unwrap();
    gate.arrive(0, 1, 10 * MS, 11 * MS).unwrap();
    assert_eq!(step(&mut gate, 13 * MS, 13 * MS), [Some(0)], "message 1 is held until 14 ms");
    assert_eq!(step(&mut gate, 14 * MS, 14 * MS), [Some(1)]);
    gate.arrive(0, 2, 20 * MS, 29 * MS).unwrap();
    assert_eq!(step(&mut gate, 29 * MS, 29 * MS), [Some(2)], "a late message is usable at once");
}

#[test]
fn frequency_shifts_by_the_overrun_and_phase_catches_up() {
    for (scheduling, next) in [(Scheduling::Frequency, 25 * MS), (Scheduling::Phase, 20 * MS)] {
        let graph = graph(|spec| spec.nodes[0].scheduling = scheduling);
        let mut gate = StepGate::new(&graph, 0);
        gate.begin(0).unwrap();
        gate.end(15 * MS).unwrap();
        assert_eq!(gate.ready(), Wait::Until(15 * MS));
        gate.begin(15 * MS).unwrap();
        gate.end(16 * MS).unwrap();
        assert_eq!(gate.ready(), Wait::Until(next), "{scheduling:?}");
        assert_eq!(gate.due(), 20 * MS, "the due time itself does not shift");
    }
}

#[test]
fn waiting_for_a_message_shifts_nothing() {
    let graph = graph(|spec| {
        spec.connections[0].blocking = true;
        spec.nodes[1].scheduling = Scheduling::Frequency;
    });
    let mut gate = StepGate::new(&graph, 1);
    gate.arrive(0, 0, 0, 7 * MS).unwrap();
    step(&mut gate, 7 * MS, 8 * MS);
    assert_eq!(gate.shift(), 0);
    assert_eq!(gate.ready(), Wait::Message { input: 0, seq: 1 });
}

#[test]
fn a_dead_sender_stops_or_lets_go() {
    for (reaction, expected) in
        [(OnDeadSender::Stop, Wait::Stop { input: 0 }), (OnDeadSender::Continue, Wait::Until(10 * MS))]
    {
        let graph = graph(|spec| {
            spec.connections[0].blocking = true;
            spec.nodes[1].on_dead_sender = reaction;
        });
        let mut gate = StepGate::new(&graph, 1);
        gate.arrive(0, 0, 0, MS).unwrap();
        gate.sender_dead(0);
        // What has arrived is still used.
        assert_eq!(step(&mut gate, MS, MS), [Some(0)]);
        assert_eq!(gate.ready(), expected);
    }
}

#[test]
fn an_advancing_node_with_a_dead_sender_keeps_to_its_ticks() {
    let graph = graph(|spec| {
        spec.connections[0].blocking = true;
        spec.nodes[1].advance = true;
        spec.nodes[1].on_dead_sender = OnDeadSender::Continue;
    });
    let mut gate = StepGate::new(&graph, 1);
    gate.arrive(0, 0, 0, 0).unwrap();
    gate.arrive(0, 1, 0, 0).unwrap();
    step(&mut gate, 0, 0);
    assert_eq!(gate.ready(), Wait::Until(0), "the message is there, the tick is not waited for");
    gate.sender_dead(0);
    assert_eq!(gate.ready(), Wait::Until(10 * MS));
}

#[test]
fn holes_in_the_numbers_are_losses_and_no_reason_to_wait() {
    let mut gate = StepGate::new(&graph(|spec| spec.connections[0].blocking = true), 1);
    let arrival = gate.arrive(0, 2, 0, 25 * MS).unwrap();
    assert_eq!(arrival.missing, 0..2);
    assert_eq!(step(&mut gate, 25 * MS, 25 * MS), [None]);
    assert_eq!(step(&mut gate, 25 * MS, 25 * MS), [None]);
    assert_eq!(step(&mut gate, 25 * MS, 25 * MS), [Some(2)]);
    let account = gate.account(0);
    assert_eq!((account.lost_transport, account.arrived, account.consumed), (2, 1, 1));
}

#[test]
fn a_receiver_that_is_too_far_behind_loses_messages_by_number() {
    let mut gate = StepGate::new(&graph(|spec| spec.connections[0].blocking = true), 1);
    let room = gate.capacity(0) as u64;
    for seq in 0..room + 5 {
        assert_eq!(gate.arrive(0, seq, 0, 0).unwrap().slot.is_some(), seq < room, "message {seq}");
    }
    assert_eq!(gate.account(0).lost_overflow, 5);
    // The steps that waited for the lost ones see the last that is left, and nothing blocks.
    for k in 0..room + 5 {
        let due = k as i64 * 10 * MS;
        assert_eq!(step(&mut gate, due, due), [Some(k.min(room - 1))]);
    }
}

#[test]
fn a_step_that_wants_only_the_newest_supersedes_what_does_not_fit() {
    for blocking in [true, false] {
        let mut gate = StepGate::new(
            &graph(|spec| {
                spec.nodes[0].rate = 10_000.0;
                spec.nodes[1].rate = 0.01;
                spec.connections[0].blocking = blocking;
            }),
            1,
        );
        gate.arrive(0, 0, 0, 0).unwrap();
        assert_eq!(step(&mut gate, 0, 0), [Some(0)]);
        // A hundred seconds of messages, far more than there is room for.
        for seq in 1..=1_000_000_u64 {
            gate.arrive(0, seq, seq as i64 * 100_000, seq as i64 * 100_000).unwrap();
        }
        gate.begin(100_000 * MS).unwrap();
        assert_eq!(seqs(&gate), [Some(1_000_000)]);
        assert_eq!(gate.superseded(0), 999_999, "blocking: {blocking}");
        assert_eq!(gate.account(0).lost_overflow, 0);
    }
}

#[test]
fn what_cannot_be_is_refused() {
    let mut gate = StepGate::new(&graph(|_| {}), 1);
    gate.arrive(0, 3, 0, 5).unwrap();
    assert_eq!(gate.arrive(0, 3, 0, 6), Err(GateError::Overtaken { seq: 3, after: 3 }));
    assert_eq!(gate.arrive(0, 4, 0, 4), Err(GateError::Backwards { time: 4, after: 5 }));
    assert_eq!(gate.end(0), Err(GateError::NotRunning { seq: 0 }));
    gate.begin(10).unwrap();
    assert_eq!(gate.ready(), Wait::End);
    assert!(gate.begin(11).is_err());
    assert_eq!(gate.end(9), Err(GateError::Backwards { time: 9, after: 10 }));
}
