//! The step path allocates nothing of our own.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use parallax_runtime::channel::{Endpoint, Space, Topic};
use parallax_runtime::launch::{Mode, RunOptions, read_node, run, set_parameters};
use parallax_runtime::node::{Node, NodeError, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::tuning::{Assignment, Parameter, Tuning};

use crate::Test;
use crate::nodes::{Number, graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("a_step_allocates_only_what_the_transport_does", a_step_allocates),
    ("to_set_a_parameter_allocates_nothing_in_the_step", to_set_a_parameter_allocates_nothing),
];

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
#[derive(Default)]
pub(crate) struct Counted {
    gain: f64,
}

impl Node for Counted {
    type Output = Number<f64>;

    fn step(&mut self, _: &Step<'_>) -> Result<Number<f64>, NodeError> {
        Ok(Number { value: COUNT.with(Cell::get) as f64 })
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        Some(self)
    }
}

impl Tuning for Counted {
    fn parameters(&self) -> Vec<Parameter> {
        vec![Parameter::new("gain", "")]
    }

    fn value(&self, _: usize) -> f64 {
        self.gain
    }

    fn set(&mut self, _: usize, value: f64) {
        self.gain = value;
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

fn to_set_a_parameter_allocates_nothing() {
    let each = transport(3);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = graph();
    graph.node_mut("adder").unwrap().kind = "allocations".into();
    let setting = std::thread::spawn(|| {
        let (own, patience) = (std::process::id().to_string(), std::time::Duration::from_secs(5));
        let mut told = Vec::new();
        // Until the run is over; before it has begun there is none.
        let start = std::time::Instant::now();
        while start.elapsed() < std::time::Duration::from_secs(30) {
            let gain = Assignment { parameter: "gain".into(), value: told.len() as f64 + 0.5, unit: None };
            match set_parameters(Some(&own), "adder", &[gain], patience) {
                Ok(done) => told.extend(done.changes),
                Err(_) if told.is_empty() => std::thread::sleep(std::time::Duration::from_millis(2)),
                Err(_) => break,
            }
            let _ = read_node(Some(&own), "adder", patience);
        }
        told
    });
    let options = RunOptions { mode: Mode::Threads, ..options(0.7, &path) };
    let report = run(&graph, &registry(), options).unwrap();
    assert!(report.clean(), "{report:?}");
    let told = setting.join().unwrap();
    let recording = Recording::read(&path).unwrap();
    // The answer to the last one may not have come any more.
    assert!(told.len() > 3 && recording.changes.starts_with(&told), "{told:?} {:?}", recording.changes);
    let messages = &recording.node("adder").unwrap().messages;
    let counts: Vec<u64> = messages.iter().map(|message| message.payload[0] as u64).collect();
    let per_step: Vec<u64> = counts.windows(2).skip(5).map(|pair| pair[1] - pair[0]).collect();
    // A step sends its message and its record, and where something was set the record of that.
    let most = per_step.iter().max();
    assert!(most.is_some_and(|most| *most <= 3 * each), "{per_step:?}, the transport takes {each} a message");
}
