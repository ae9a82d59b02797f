//! The step path allocates nothing of our own.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use parallax_runtime::channel::{Endpoint, Space, Topic};
use parallax_runtime::launch::{Mode, RunOptions, run};
use parallax_runtime::node::{Node, NodeError, Step};
use parallax_runtime::recording::Recording;

use crate::Test;
use crate::nodes::{Number, graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[("a_step_allocates_only_what_the_transport_does", a_step_allocates)];

thread_local! {
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, counting what each thread takes.
pub(crate) struct Counting;

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract; counting uses a
// thread-local number without a destructor and does not allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        COUNT.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`, and `alloc` above took the memory from the system.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Sends how often its thread has allocated so far.
pub(crate) struct Counted;

impl Node for Counted {
    type Output = Number<f64>;

    fn step(&mut self, _: &Step<'_>) -> Result<Number<f64>, NodeError> {
        Ok(Number { value: COUNT.with(Cell::get) as f64 })
    }
}

/// How often this thread has allocated.
pub(crate) fn count() -> u64 {
    COUNT.with(Cell::get)
}

/// How often one message over a channel allocates, inside the transport.
pub(crate) fn transport(words: usize) -> u64 {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let topic = Topic { name: "any".into(), layout: 1, words, buffer: 8, subscribers: 1, held: 0 };
    let publisher = here.create(&topic).unwrap().publisher().unwrap();
    let subscriber = here.open(&topic).unwrap().subscriber().unwrap();
    let count = |rounds: u64| {
        let before = COUNT.with(Cell::get);
        for _ in 0..rounds {
            publisher.send(words, |word| word as u64).unwrap();
            assert!(subscriber.receive(|_| {}).unwrap());
        }
        COUNT.with(Cell::get) - before
    };
    count(10);
    let each = count(100);
    assert_eq!(each % 100, 0, "a message allocates the same every time");
    each / 100
}

fn a_step_allocates() {
    let each = transport(3);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = graph();
    graph.node_mut("adder").unwrap().kind = "allocations".into();
    let report = run(&graph, &registry(), RunOptions { mode: Mode::Threads, ..options(0.5, &path) }).unwrap();
    assert!(report.clean(), "{report:?}");
    let recording = Recording::read(&path).unwrap();
    let counts = recording.node("adder").unwrap().messages.iter().map(|message| message.payload[0] as u64);
    let counts: Vec<u64> = counts.collect();
    // Each step sends one message and one record, and receives two messages.
    let per_step: Vec<u64> = counts.windows(2).skip(5).map(|pair| pair[1] - pair[0]).collect();
    println!("  a message allocates {each} times inside the transport; a step {:?} times", per_step.first());
    assert!(per_step.len() > 30);
    assert!(
        per_step.iter().all(|count| *count <= 2 * each),
        "{per_step:?}, the transport takes {each} a message"
    );
}
