//! Messages with data: written and read where they lie, recorded, accounted for.

use parallax_model::tree::Tree;
use parallax_runtime::channel::{Endpoint, Space, Topic};
use parallax_runtime::data::{DataNode, DataSpace};
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::launch::{Mode, RunOptions, run};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};

use crate::Test;
use crate::allocation;
use crate::nodes::{Number, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("data_of_processes_arrive_whole", data_of_processes_arrive_whole),
    ("data_of_threads_arrive_whole", data_of_threads_arrive_whole),
    ("a_step_with_data_allocates_nothing", a_step_with_data_allocates_nothing),
    ("too_much_data_ends_a_node", too_much_data_ends_a_node),
    ("a_view_is_given_back_where_it_was_taken", a_view_is_given_back_where_it_was_taken),
];

/// The most bytes of a frame.
const MOST: usize = 30_000;

#[derive(Tree, Clone, Default)]
pub(crate) struct Frame<T = f64> {
    length: T,
    allocations: T,
}
impl Message for Frame<f64> {
    const NAME: &'static str = "test/Frame";
}
const FRAMES: Port<Frame<f64>> = Port::new("frames");

/// How long the data of a frame are. The viewers run at a half and a quarter of the camera's rate: lengths
/// repeat after five frames, so that neither meets the same length at every step (an empty one, at worst).
fn length(seq: u64) -> usize {
    match seq % 5 {
        0 => 0,
        1 => MOST,
        _ => seq as usize * 7919 % MOST,
    }
}

/// Sends frames that are full of their number.
struct Camera {
    greedy: bool,
}
impl DataNode for Camera {
    type Output = Frame<f64>;
    fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Frame<f64>, NodeError> {
        let length = length(step.seq) + usize::from(self.greedy && step.seq == 6);
        data.take(length)?.fill(step.seq as u8);
        Ok(Frame { length: length as f64, allocations: allocation::count() as f64 })
    }
}

/// Counts the bytes that it sees, and gives up when one of them is not what was written.
struct Viewer;
impl Node for Viewer {
    type Output = Number<f64>;
    fn step(&mut self, step: &Step<'_>) -> Result<Number<f64>, NodeError> {
        let input = step.input(FRAMES);
        let mut bytes = 0;
        for (index, stamp) in input.stamps().iter().enumerate() {
            let data = input.data(index);
            let Some(seq) = stamp.seq else { continue };
            if data.len() != length(seq) || data.iter().any(|byte| *byte != seq as u8) {
                return Err(NodeError::failed(format!("frame {seq} is not what was sent")));
            }
            bytes += data.len();
        }
        Ok(Number { value: bytes as f64 })
    }
}

pub(crate) fn kinds(registry: Registry) -> Registry {
    let camera = |greedy| NodeKind::with_data(MOST, move |_| Ok(Camera { greedy }));
    registry
        .with("camera", camera(false))
        .with("greedy", camera(true))
        .with("viewer", NodeKind::new(|_| Ok(Viewer)).input(FRAMES))
}

/// A camera at 100 Hz and two viewers, one of which waits for it.
fn watching() -> GraphSpec {
    let connection = |to: &str, window, blocking| {
        let connection = ConnectionSpec::new("camera", to);
        ConnectionSpec { port: Some("frames".into()), window, blocking, ..connection }
    };
    GraphSpec {
        name: "watching".into(),
        supervisor: "viewer".into(),
        nodes: vec![
            NodeSpec::new("camera", "camera", 100.0),
            NodeSpec::new("viewer", "viewer", 50.0),
            NodeSpec::new("other", "viewer", 25.0),
        ],
        connections: vec![connection("viewer", 3, true), connection("other", 1, false)],
        plant: None,
    }
}

fn arrive_whole(mode: Mode) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let report = run(&watching(), &registry(), RunOptions { mode, ..options(1.0, &path) }).unwrap();
    assert!(report.clean(), "{report:#?}");
    let recording = Recording::read(&path).unwrap();
    let camera = recording.node("camera").unwrap();
    assert!(camera.messages.len() > 5, "{}", camera.messages.len());
    for message in &camera.messages {
        assert_eq!(message.data.len(), length(message.seq));
        assert!(message.data.iter().all(|byte| *byte == message.seq as u8), "frame {}", message.seq);
    }
    for viewer in ["viewer", "other"] {
        let viewer = recording.node(viewer).unwrap();
        let seen: f64 = viewer.messages.iter().map(|message| message.payload[0]).sum();
        assert!(seen > 0.0, "{} saw nothing", viewer.name);
        for (step, message) in viewer.steps.iter().zip(&viewer.messages) {
            let bytes: usize = step.inputs[0].consumed.iter().filter_map(|c| c.seq).map(length).sum();
            assert_eq!(message.payload[0], bytes as f64, "step {} of {}", step.seq, viewer.name);
        }
    }
}

fn data_of_processes_arrive_whole() {
    arrive_whole(Mode::Processes);
}

fn data_of_threads_arrive_whole() {
    arrive_whole(Mode::Threads);
}

fn a_step_with_data_allocates_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let report =
        run(&watching(), &registry(), RunOptions { mode: Mode::Threads, ..options(1.0, &path) }).unwrap();
    assert!(report.clean(), "{report:#?}");
    let recording = Recording::read(&path).unwrap();
    let counts = recording.node("camera").unwrap().messages.iter().map(|message| message.payload[1] as u64);
    let counts: Vec<u64> = counts.collect();
    // A message and a record each allocate inside the transport.
    let each = allocation::transport(64);
    let per_step: Vec<u64> = counts.windows(2).skip(3).map(|pair| pair[1] - pair[0]).collect();
    assert!(per_step.len() > 2 && per_step.iter().all(|count| *count <= 2 * each), "{per_step:?}, {each}");
}

fn too_much_data_ends_a_node() {
    let folder = tempfile::tempdir().unwrap();
    let mut graph = watching();
    graph.node_mut("camera").unwrap().kind = "greedy".into();
    let report = run(&graph, &registry(), options(20.0, &folder.path().join("run.mcap"))).unwrap();
    let failure = report.failure().unwrap();
    assert!(failure.contains("camera") && failure.contains("30001 bytes of data"), "{failure}");
}

fn a_view_is_given_back_where_it_was_taken() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let topic = Topic { name: "any".into(), layout: 1, words: 8, buffer: 2, subscribers: 1, held: 2 };
    let publisher = here.create(&topic).unwrap().publisher().unwrap();
    let subscriber = here.open(&topic).unwrap().subscriber().unwrap();
    publisher.send(8, |word| word as u64).unwrap();
    let view = subscriber.take().unwrap().unwrap();
    // Another thread may read it and let go of it; its place is lost then, and nothing is damaged.
    std::thread::spawn(move || assert_eq!(view[7], 7)).join().unwrap();
    publisher.send(8, |word| word as u64 + 1).unwrap();
    assert_eq!(subscriber.take().unwrap().unwrap()[7], 8);
}
