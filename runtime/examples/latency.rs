//! Measures this machine: how long a message takes from node to node, how late steps begin, and what a run
//! costs to start.
//!
//! `cargo run --release -p parallax-runtime --example latency [SECONDS]`

use parallax_model::tree::Tree;
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::launch::{Mode, NODE_COMMAND, RunError, RunOptions, node_main, run};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};

#[derive(Tree, Clone, Default)]
struct Reading<T> {
    position: T,
    speed: T,
}

impl Message for Reading<f64> {
    const NAME: &'static str = "latency/Reading";
}

const SENSOR: Port<Reading<f64>> = Port::new("sensor");

struct Sensor;

impl Node for Sensor {
    type Output = Reading<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Reading<f64>, NodeError> {
        Ok(Reading { position: step.seq as f64, speed: 1.0 })
    }
}

struct Controller;

impl Node for Controller {
    type Output = Reading<f64>;

    fn step(&mut self, step: &Step<'_>) -> Result<Reading<f64>, NodeError> {
        Ok(step.latest(SENSOR).message)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let registry = Registry::new()
        .with("sensor", NodeKind::new(|_| Ok(Sensor)))
        .with("controller", NodeKind::new(|_| Ok(Controller)).input(SENSOR));
    let mut arguments = std::env::args().skip(1);
    let first = arguments.next();
    if first.as_deref() == Some(NODE_COMMAND) {
        let ended_in_order = node_main(arguments, &registry) == std::process::ExitCode::SUCCESS;
        std::process::exit(i32::from(!ended_in_order));
    }
    let seconds: f64 = first.map_or(Ok(2.0), |text| text.parse())?;
    println!(
        "mode       real time  spin      one way p50 / p99 / max       late p50 / p99       start-up   memory"
    );
    for mode in [Mode::Processes, Mode::Threads] {
        for real_time in [false, true] {
            for spin in [0, 100_000] {
                measure(&registry, mode, real_time, spin, seconds)?;
            }
        }
    }
    Ok(())
}

fn measure(
    registry: &Registry,
    mode: Mode,
    real_time: bool,
    spin: i64,
    seconds: f64,
) -> Result<(), RunError> {
    let path = std::env::temp_dir().join(format!("parallax-latency-{}.mcap", std::process::id()));
    let connection = ConnectionSpec { blocking: true, ..ConnectionSpec::new("sensor", "controller") };
    let graph = GraphSpec {
        name: "latency".into(),
        supervisor: "controller".into(),
        nodes: vec![
            NodeSpec::new("sensor", "sensor", 1000.0),
            NodeSpec::new("controller", "controller", 1000.0),
        ],
        connections: vec![connection],
        plant: None,
    };
    let options = RunOptions {
        duration: Some((seconds * 1e9) as i64),
        recording: Some(path.clone()),
        mode,
        real_time,
        spin,
        ..RunOptions::default()
    };
    let report = run(&graph, registry, options)?;
    let recording = Recording::read(&path)?;
    // What cannot be removed from a temporary folder is left to the system.
    let _ = std::fs::remove_file(&path);
    let steps = recording.node("controller").map_or(&[][..], |track| &track.steps);
    let stamps = steps.iter().flat_map(|step| &step.inputs).flat_map(|input| &input.consumed);
    let mut taken: Vec<i64> = stamps.map(|stamp| stamp.received - stamp.sent).collect();
    taken.sort_unstable();
    let at = |share: f64| {
        taken.get(((taken.len() as f64 - 1.0) * share) as usize).map_or(f64::NAN, |t| *t as f64 / 1e3)
    };
    let late = report.nodes[0].lateness;
    println!(
        "{:9}  {:9}  {:>4} us  {:7.1} / {:7.1} / {:8.1} us  {:5} / {:6} us  {:5.1} ms  {:4} KiB",
        format!("{mode:?}"),
        if real_time && report.warnings.iter().all(|warning| !warning.contains("like any program")) {
            "yes"
        } else {
            "no"
        },
        spin / 1000,
        at(0.5),
        at(0.99),
        at(1.0),
        late.p50 / 1000,
        late.p99 / 1000,
        report.startup as f64 / 1e6,
        report.shared_memory / 1024,
    );
    Ok(())
}
