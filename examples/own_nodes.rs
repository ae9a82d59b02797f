//! A graph of nodes of your own: run as processes, recorded, replayed, and run again under the simulated clock.
//!
//! `cargo run --release --example own_nodes`

use parallax::model::tree::Tree;
use parallax::runtime::graph::GraphBuilder;
use parallax::runtime::launch::{self, NODE_COMMAND, RunOptions};
use parallax::runtime::node::{Message, Node, NodeError, Port, Step};
use parallax::runtime::recording::Recording;
use parallax::runtime::registry::{NodeKind, Registry};
use parallax::sim::{Executor, ReplayOptions, replay};

/// What the camera sends. Derived: its layout in shared memory, its ROS 2 schema in recordings.
#[derive(Tree, Clone, Default)]
struct Angle {
    angle: f64,
}

impl Message for Angle {
    const NAME: &'static str = "example/Angle";
}

/// What the controller sends.
#[derive(Tree, Clone, Default)]
struct Torque {
    torque: f64,
}

impl Message for Torque {
    const NAME: &'static str = "example/Torque";
}

struct Camera;

impl Node for Camera {
    type Output = Angle;

    fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
        Ok(Angle { angle: (step.start as f64 * 1e-9).sin() })
    }
}

/// The controller's input: a port carries one type of message, and connecting another does not compile.
const CAMERA: Port<Angle> = Port::new("camera");

struct Controller {
    gain: f64,
}

impl Node for Controller {
    type Output = Torque;

    fn step(&mut self, step: &Step<'_>) -> Result<Torque, NodeError> {
        // The window holds the last two messages, oldest first.
        let mut angles = step.window(CAMERA).map(|received| received.message.angle);
        let (before, now) = (angles.next().unwrap_or(0.0), angles.next().unwrap_or(0.0));
        Ok(Torque { torque: -self.gain * (now + 0.1 * (now - before)) })
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let registry = Registry::new()
        .with("camera", NodeKind::new(|_| Ok(Camera)))
        .with("controller", NodeKind::new(|_| Ok(Controller { gain: 2.0 })).input(CAMERA));

    // The launcher starts this program again for every node.
    let mut arguments = std::env::args().skip(1);
    if arguments.next().as_deref() == Some(NODE_COMMAND) {
        let code = launch::node_main(arguments, &registry);
        std::process::exit(i32::from(code != std::process::ExitCode::SUCCESS));
    }

    let mut graph = GraphBuilder::new("look and act");
    let camera = graph.node::<Camera>("camera", "camera", 60.0).add();
    let controller = graph.node::<Controller>("controller", "controller", 30.0).add();
    graph.connect(camera, controller, CAMERA).blocking().window(2).add();
    let graph = graph.supervisor(controller).validate(&registry)?;

    let path = std::env::temp_dir().join(format!("own_nodes_{}.mcap", std::process::id()));
    let options =
        RunOptions { duration: Some(2_000_000_000), recording: Some(path.clone()), ..RunOptions::default() };
    let report = launch::run(graph.spec(), &registry, options)?;
    if let Some(failure) = report.failure() {
        return Err(failure.into());
    }
    let recording = Recording::read(&path)?;
    std::fs::remove_file(&path)?;
    let replayed = replay(&recording, &registry, &ReplayOptions::default())?;
    println!(
        "2 s as processes: {} steps, replayed with the same bits: {}",
        replayed.steps(),
        replayed.is_exact()
    );

    let simulated = Executor::new(graph, 1).record(2_000_000_000)?;
    let steps: usize = simulated.nodes.iter().map(|node| node.steps.len()).sum();
    println!("2 s under the simulated clock: {steps} steps");
    Ok(())
}
