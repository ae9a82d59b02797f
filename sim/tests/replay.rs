//! What replay finds, and what it refuses.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_model::tree::Tree;
use parallax_runtime::data::{DataNode, DataSpace};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphBuilder, GraphError};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::recording::{FaultKind, Recording};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::schedule::DeviationKind;
use parallax_sim::{Executor, ReplayError, ReplayOptions, SimError, replay};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

#[derive(Tree, Clone, Default)]
struct State {
    angle: f64,
    speed: f64,
}
impl Message for State {
    const NAME: &'static str = "test/State";
}

#[derive(Tree, Clone, Default)]
struct Torque {
    torque: f64,
}
impl Message for Torque {
    const NAME: &'static str = "test/Torque";
}

const AGENT: Port<Torque> = Port::new("agent");
const WORLD: Port<State> = Port::new("world");

/// Stands in for hardware: a damped pendulum with a bent truth.
struct World {
    state: State,
    bend: f64,
}
impl Node for World {
    type Output = State;
    fn step(&mut self, step: &Step<'_>) -> Result<State, NodeError> {
        let torque = step.latest(AGENT).message.torque;
        self.state.speed += 0.01 * (torque - self.state.angle.sin() - self.bend * self.state.speed);
        self.state.angle += 0.01 * self.state.speed;
        Ok(self.state.clone())
    }
}

struct Agent {
    random: ChaCha8Rng,
}
impl Node for Agent {
    type Output = Torque;
    fn step(&mut self, step: &Step<'_>) -> Result<Torque, NodeError> {
        let noise = (self.random.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        let speed: f64 = step.window(WORLD).map(|received| received.message.speed).sum();
        Ok(Torque { torque: noise - 0.1 * speed })
    }
}

fn world(bend: f64) -> NodeKind {
    NodeKind::new(move |_| Ok(World { state: State { angle: 1.0, speed: 0.0 }, bend }))
        .input(AGENT)
        .stand_in()
}

fn registry() -> Registry {
    Registry::new()
        .with("world", world(0.3))
        .with("agent", NodeKind::new(|context| Ok(Agent { random: context.random() })).input(WORLD))
}

fn executor(seed: u64) -> Executor {
    let mut graph = GraphBuilder::new("loop");
    let world = graph
        .node::<World>("world", "world", 100.0)
        .computation(Delay::Uniform { low: 0.0, high: 0.002 })
        .add();
    let agent = graph.node::<Agent>("agent", "agent", 40.0).add();
    graph.connect(world, agent, WORLD).window(3).delay(Delay::Normal { mean: 0.003, std: 0.001 }).add();
    graph.connect(agent, world, AGENT).skip().delay(Delay::constant(0.002)).add();
    Executor::new(graph.supervisor(agent).validate(&registry()).unwrap(), seed)
}

fn recording() -> Recording {
    executor(3).record(2_000_000_000).unwrap()
}

fn deviation(change: impl FnOnce(&mut Recording)) -> DeviationKind {
    let mut recording = recording();
    change(&mut recording);
    let report = replay(&recording, &registry(), &ReplayOptions::default()).unwrap();
    assert!(!report.is_exact());
    report.nodes.into_iter().find_map(|node| node.schedule.deviation).expect("a deviation").kind
}

fn refused(change: impl FnOnce(&mut Recording)) -> ReplayError {
    let mut recording = recording();
    change(&mut recording);
    replay(&recording, &registry(), &ReplayOptions::default()).expect_err("the recording is damaged")
}

#[test]
fn different_seeds_differ() {
    assert_eq!(recording(), recording());
    assert_ne!(executor(4).record(2_000_000_000).unwrap().nodes, recording().nodes);
}

#[test]
fn two_runs_of_one_seed_are_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, recording: &Recording| {
        let path = folder.path().join(name);
        parallax_runtime::recording::write(&path, recording).unwrap();
        (std::fs::read(&path).unwrap(), Recording::read(&path).unwrap())
    };
    let (bytes, read) = file("first.mcap", &recording());
    assert!(bytes == file("second.mcap", &recording()).0, "the files differ");
    // What was read replays as what was recorded.
    assert_eq!(read, recording());
    assert!(replay(&read, &registry(), &ReplayOptions::default()).unwrap().is_exact());
}

#[test]
fn hardware_is_injected_unless_it_is_overridden() {
    let recording = recording();
    let report = replay(&recording, &registry(), &ReplayOptions::default()).unwrap();
    assert!(report.is_exact());
    assert_eq!(report.injected().collect::<Vec<_>>(), ["world"]);
    assert_eq!(report.steps(), recording.node("agent").unwrap().steps.len() as u64);

    let with_bend = |bend: f64| ReplayOptions {
        overrides: Some(Box::new(move |context| {
            (context.name == "world").then(|| world(bend).build(context))
        })),
    };
    let truth = replay(&recording, &registry(), &with_bend(0.3)).unwrap();
    assert!(truth.is_exact());
    assert_eq!(truth.injected().count(), 0);
    assert_eq!(truth.nodes[0].steps, recording.node("world").unwrap().steps.len() as u64);

    let guess = replay(&recording, &registry(), &with_bend(0.31)).unwrap();
    assert!(!guess.is_exact());
    let first = guess.first_difference().unwrap();
    assert_eq!((first.node.as_str(), first.leaf.as_str()), ("world", "angle"));
    assert!(first.recorded != first.replayed);
    assert!(first.to_string().contains("node `world`"), "{first}");
    // The agent was given the recorded world, so it does not differ.
    assert_eq!(guess.nodes[1].differing, 0);
}

#[test]
fn one_flipped_bit_is_found() {
    let mut recording = recording();
    let value = &mut recording.nodes[1].messages[7].payload[0];
    *value = f64::from_bits(value.to_bits() ^ 1);
    let report = replay(&recording, &registry(), &ReplayOptions::default()).unwrap();
    let first = report.first_difference().unwrap();
    assert_eq!((first.node.as_str(), first.seq, first.leaf.as_str()), ("agent", 7, "torque"));
    assert_eq!(report.nodes[1].differing, 1);
}

#[test]
fn schedules_that_the_rules_do_not_allow_are_found() {
    let found = deviation(|r| r.nodes[0].steps[5].start -= 1);
    assert!(matches!(found, DeviationKind::Early { .. }), "{found:?}");
    let found = deviation(|r| r.nodes[0].steps[5].start += 1);
    assert!(matches!(found, DeviationKind::Late { .. }), "{found:?}");
    let found = deviation(|r| r.nodes[0].steps[5].due += 1);
    assert!(matches!(found, DeviationKind::Due { .. }), "{found:?}");
    let found = deviation(|r| {
        r.nodes[1].steps[9].inputs[0].consumed.remove(0);
    });
    assert!(matches!(found, DeviationKind::Window { .. }), "{found:?}");
    let found = deviation(|r| r.nodes[0].steps[9].inputs[0].superseded += 1);
    assert!(matches!(found, DeviationKind::Superseded { recorded: 1, expected: 0, .. }), "{found:?}");
    let found = deviation(|r| {
        let message = r.nodes[1].steps[9].inputs[0].consumed[2].seq.unwrap();
        r.nodes[0].messages[message as usize].sent += 1;
    });
    assert!(matches!(found, DeviationKind::Sent { .. }), "{found:?}");
    // An older message than the newest that had arrived.
    let found = deviation(|r| {
        let late = r.nodes[1].steps[10].inputs[0].consumed.clone();
        r.nodes[1].steps[11].inputs[0].consumed = late;
    });
    assert!(matches!(found, DeviationKind::Window { .. } | DeviationKind::Superseded { .. }), "{found:?}");
}

#[test]
fn damaged_recordings_are_refused_with_the_place() {
    let error = refused(|r| r.graph.nodes[1].kind = "agnet".into());
    assert!(matches!(error, ReplayError::Graph(GraphError::UnknownKind { .. })), "{error}");
    let error = refused(|r| drop(r.nodes.remove(0)));
    assert!(matches!(&error, ReplayError::MissingNode { node } if node == "world"), "{error}");
    let error = refused(|r| r.nodes[1].steps[9].inputs[0].consumed[2].seq = Some(90_000));
    assert!(matches!(&error, ReplayError::MissingMessage { seq: 90_000, step: 9, .. }), "{error}");
    assert!(error.to_string().contains("message 90000 of `world`"), "{error}");
    let error = refused(|r| drop(r.nodes[0].messages.remove(20)));
    assert!(matches!(&error, ReplayError::MissingOutput { node, step: 20 } if node == "world"), "{error}");
    let error = refused(|r| drop(r.nodes[1].steps.remove(4)));
    assert!(matches!(error, ReplayError::StepOrder { expected: 4, found: 5, .. }), "{error}");
    let error = refused(|r| r.nodes[1].steps[4].inputs[0].port = "wrld".into());
    assert!(matches!(error, ReplayError::Inputs { step: 4, .. }), "{error}");
    let error = refused(|r| r.nodes[0].messages[3].payload.truncate(1));
    assert!(matches!(error, ReplayError::Payload { seq: 3, found: 1, expected: 2, .. }), "{error}");
    let error = refused(|r| r.nodes[0].layout.leaves[0] = "tilt".into());
    assert!(matches!(error, ReplayError::Layout { .. }), "{error}");
}

#[test]
fn a_cut_recording_is_replayed_as_far_as_it_goes() {
    let mut recording = recording();
    recording.truncated = Some("the file ends at byte 1000".into());
    recording.nodes[0].messages.truncate(150);
    let report = replay(&recording, &registry(), &ReplayOptions::default()).unwrap();
    assert!(report.is_exact());
    assert!(report.steps() > 40 && report.beyond_cut > 0, "{report:?}");
}

#[test]
fn a_node_that_gives_up_is_a_fault_and_its_run_still_replays() {
    struct Mortal;
    impl Node for Mortal {
        type Output = State;
        fn step(&mut self, step: &Step<'_>) -> Result<State, NodeError> {
            if step.seq == 30 { Err(NodeError::failed("out of fuel")) } else { Ok(State::default()) }
        }
    }
    let registry = registry().with("world", NodeKind::new(|_| Ok(Mortal)).input(AGENT));
    let graph = executor(1).graph().spec().validate(&registry).unwrap();
    let recording = Executor::new(graph, 1).record(1_000_000_000).unwrap();
    assert_eq!(recording.faults[0].kind, FaultKind::Failed { message: "out of fuel".into() });
    assert_eq!(recording.node("world").unwrap().steps.len(), 30);
    assert!(recording.node("agent").unwrap().steps.len() > 35, "the agent does not wait for the world");
    assert!(replay(&recording, &registry, &ReplayOptions::default()).unwrap().is_exact());
}

#[test]
fn the_clock_is_held_back_on_request() {
    let began = std::time::Instant::now();
    let throttled = executor(3).real_time_factor(10.0).record(1_000_000_000).unwrap();
    assert!(began.elapsed().as_secs_f64() > 0.09);
    assert_eq!(throttled, executor(3).record(1_000_000_000).unwrap());
    for factor in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = executor(3).real_time_factor(factor).record(1).unwrap_err();
        assert!(matches!(error, SimError::RealTimeFactor { .. }), "{error}");
    }
    assert!(matches!(executor(3).record(0), Err(SimError::Duration { duration: 0 })));
}

#[derive(Tree, Clone, Default)]
struct Length {
    length: f64,
}
impl Message for Length {
    const NAME: &'static str = "test/Length";
}
const CAMERA: Port<Length> = Port::new("camera");

/// Sends as many bytes as its step has a number, each the sum of the byte that came last and this number.
struct Echo {
    last: u8,
    from: Option<Port<Length>>,
}
impl DataNode for Echo {
    type Output = Length;
    fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Length, NodeError> {
        if let Some(port) = self.from {
            self.last = step.latest_data(port).last().copied().unwrap_or(self.last);
        }
        let length = step.seq as usize;
        data.take(length)?.fill(self.last.wrapping_add(step.seq as u8));
        Ok(Length { length: length as f64 })
    }
}

fn echoes(last: u8) -> Registry {
    let camera = NodeKind::with_data(200, move |_| Ok(Echo { last, from: None }));
    let viewer = NodeKind::with_data(100, |_| Ok(Echo { last: 0, from: Some(CAMERA) })).input(CAMERA);
    Registry::new().with("camera", camera).with("viewer", viewer)
}

#[test]
fn data_are_recorded_and_replayed_exactly() {
    let mut graph = GraphBuilder::new("echo");
    let camera = graph.data_node::<Echo>("camera", "camera", 100.0).add();
    let viewer = graph.data_node::<Echo>("viewer", "viewer", 50.0).add();
    graph.connect(camera, viewer, CAMERA).window(3).add();
    let graph = graph.supervisor(viewer).validate(&echoes(3)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sim.mcap");
    let recording = Executor::new(graph, 1).record(1_000_000_000).unwrap();
    parallax_runtime::recording::write(&path, &recording).unwrap();
    let read = Recording::read(&path).unwrap();
    assert_eq!(read.nodes, recording.nodes);
    let viewer = read.node("viewer").unwrap();
    let (step, message) = (&viewer.steps[40], &viewer.messages[40]);
    let seen = step.inputs[0].consumed.last().unwrap().seq.unwrap();
    assert_eq!(&*message.data, &[(3 + seen as u8).wrapping_add(40); 40][..]);

    let report = replay(&read, &echoes(3), &ReplayOptions::default()).unwrap();
    assert!(report.is_exact() && report.steps() > 140, "{report:?}");
    let other = replay(&read, &echoes(4), &ReplayOptions::default()).unwrap();
    let difference = other.first_difference().unwrap();
    assert_eq!(
        (difference.leaf.as_str(), difference.recorded, difference.replayed),
        ("byte 0 of its data", 4.0, 5.0)
    );
}
