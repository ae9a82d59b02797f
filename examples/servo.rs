//! A servo on a serial bus that is moved to and fro: the driver `servo/dynamixel`, a node of your own, a recording.
//!
//! `cargo run --release --example servo` moves one that is emulated at the other end of a pseudo-terminal, by the code with
//! which the driver is tested. `cargo run --release --example servo -- /dev/ttyUSB0` moves the one with the id 1 on that port, by
//! half a radian to either side of its middle.

#[path = "../nodes/tests/dynamixel/emulator.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "it is the tests' emulator, and they use more of it")]
mod emulator;

use emulator::Emulator;
use parallax::nodes::dynamixel::{COMMAND, Command, Servo, State};
use parallax::runtime::graph::GraphBuilder;
use parallax::runtime::launch::{self, NODE_COMMAND, RunOptions};
use parallax::runtime::node::{Node, NodeError, Port, Step};
use parallax::runtime::recording::Recording;
use parallax::runtime::registry::NodeKind;
use parallax::runtime::time::to_seconds;

const SERVO: Port<State> = Port::new("servo");

/// To and fro, once in two seconds.
struct Sweep;

impl Node for Sweep {
    type Output = Command;

    fn step(&mut self, step: &Step<'_>) -> Result<Command, NodeError> {
        let angle = 0.5 * (std::f64::consts::PI * to_seconds(step.due)).sin();
        // A servo that does not answer is not moved on.
        let answers = step.latest(SERVO).message.errors < 5.0;
        Ok(Command { goal: angle, torque: f64::from(u8::from(answers)) })
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // What the servo sees when the sweep is gone, and when the run ends: the motor is off.
    let limp = Command { goal: 0.0, torque: 0.0 };
    let sweep = NodeKind::new(|_| Ok(Sweep)).input(SERVO).safe(&limp);
    let registry = parallax::nodes::registry().with("sweep", sweep);

    let mut arguments = std::env::args().skip(1);
    let first = arguments.next();
    if first.as_deref() == Some(NODE_COMMAND) {
        let code = launch::node_main(arguments, &registry);
        std::process::exit(i32::from(code != std::process::ExitCode::SUCCESS));
    }

    let emulated = first.is_none().then(|| Emulator::new(&[1]));
    let port = match &emulated {
        Some(emulator) => emulator.path.display().to_string(),
        None => first.unwrap_or_default(),
    };
    let mut graph = GraphBuilder::new("servo");
    // One line apart from the same servo in equations: `servo/simulated`.
    let servo = graph.node::<Servo>("servo", "servo/dynamixel", 100.0);
    let servo = servo.parameter("port", port).parameter("id", 1).parameter("mode", "position").add();
    let sweep = graph.node::<Sweep>("sweep", "sweep", 50.0).add();
    graph.connect(servo, sweep, SERVO).add();
    graph.connect(sweep, servo, COMMAND).skip().add();
    let graph = graph.supervisor(sweep);

    let path = std::env::temp_dir().join(format!("servo_{}.mcap", std::process::id()));
    let options =
        RunOptions { duration: Some(2_000_000_000), recording: Some(path.clone()), ..RunOptions::default() };
    let report = launch::run(&graph, &registry, options).map_err(|error| error.to_string())?;
    if let Some(failure) = report.failure() {
        return Err(failure.into());
    }
    let recording = Recording::read(&path)?;
    std::fs::remove_file(&path)?;
    let servo = recording.node("servo").ok_or("the servo is not in its recording")?;
    let column = |leaf: &str| servo.layout.leaves.iter().position(|name| name == leaf).unwrap_or_default();
    let (position, errors) = (column("position"), column("errors"));
    let positions = servo.messages.iter().map(|message| message.payload[position]);
    let (low, high) = positions.fold((f64::MAX, f64::MIN), |(low, high), at| (low.min(at), high.max(at)));
    let errors = servo.messages.last().map_or(0.0, |message| message.payload[errors]);
    println!(
        "{} steps of the servo, {errors} questions without a good answer; it was between {low:.3} and {high:.3} rad",
        servo.messages.len()
    );
    Ok(())
}
