//! How long an estimator's step takes: an update and three predictions of the pendulum, and whole steps of its node.

use std::hint::black_box;
use std::time::Instant;

use parallax_model::filter::{Constants, Process, Scaling, Unscented};
use parallax_model::program::Workspace;
use parallax_model::tree::Tree;
use parallax_nodes::models::pendulum::Params;
use parallax_nodes::pendulum::ukf::Pendulum;
use parallax_nodes::{pendulum, registry};
use parallax_runtime::node::{Consumed, InputWindow, Step};

const STEPS: usize = 200_000;
const BATCH: usize = 20;

fn report(name: &str, mut taken: Vec<f64>) {
    taken.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| taken[((taken.len() - 1) as f64 * share) as usize] * 1e6;
    println!("{name:<44} {:>8.2} us {:>8.2} us {:>8.2} us", at(0.5), at(0.05), at(0.99));
}

/// A prediction to the picture, its update, and three predictions ahead, each one step of the integrator: algorithm 1 of the
/// paper's appendix B.
fn filter(predictions: usize) -> Result<Vec<f64>, Box<dyn std::error::Error>> {
    let filter = Unscented::new(Pendulum, Scaling::default(), vec![1], vec![Some(std::f64::consts::TAU)])?;
    let mut prepared = vec![0.0; Pendulum.prepared()];
    Pendulum.prepare(&Params { friction: 0.0, ..Params::default() }.to_vec(), &mut prepared);
    let (mut values, mut workspace) = (vec![0.0; filter.room()], Workspace::new());
    let mut room = filter.lend(&mut values, &mut workspace);
    let constants = Constants { params: &prepared, noise: &[1.5e-3], disturbance: &[2.0] };
    let mut belief = [3.0, 0.5, 0.1, 0.0, 1.0];
    let mut taken = Vec::with_capacity(STEPS / BATCH);
    let dt = 0.01;
    for batch in 0..STEPS / BATCH {
        let start = Instant::now();
        for step in 0..BATCH {
            let time = dt * (batch * BATCH + step) as f64;
            let voltage = [if step % 2 == 0 { 1.0 } else { -1.0 }];
            filter.predict(&constants, &mut belief, &voltage, [time, dt], &mut room);
            let reading = [belief[0] + 1e-4];
            filter.update(&constants, &mut belief, black_box(&reading), (&voltage, time), &mut room);
            let mut ahead = belief;
            for _ in 0..predictions {
                filter.predict(&constants, &mut ahead, &voltage, [time, dt], &mut room);
            }
            black_box(ahead);
        }
        taken.push(start.elapsed().as_secs_f64() / BATCH as f64);
    }
    Ok(taken)
}

/// Whole steps of a node: windows of one picture and sixteen commands, 30 ms ahead.
fn node(kind: &str, parameters: serde_json::Value) -> Result<Vec<f64>, Box<dyn std::error::Error>> {
    let mut spec = pendulum::graph();
    let estimator = spec.node_mut("estimator").ok_or("the graph has an estimator")?;
    estimator.kind = kind.into();
    estimator.parameters = serde_json::from_value(parameters)?;
    let graph = spec.validate(&registry())?;
    let index = graph.index("estimator").ok_or("the graph has an estimator")?;
    let mut node = graph.build(index, 1)?;
    let mut output = vec![0.0; graph.nodes()[index].kind.output().leaves.len()];
    let mut taken = Vec::with_capacity(STEPS / BATCH);
    let (mut camera, mut motor) = (InputWindow::new("camera", 2, 1), InputWindow::new("motor", 1, 16));
    for tick in 0..STEPS as u64 / 10 {
        let now = (tick as i64 + 20) * 10_000_000;
        camera.clear(0);
        let seen = now - 10_000_000;
        camera.push(Consumed { seq: Some(tick), sent: seen, received: now }, &[3.1, seen as f64 * 1e-9]);
        motor.clear(0);
        for back in (1..=16u64).rev() {
            let sent = now - 10_000_000 * back as i64;
            motor.push(Consumed { seq: Some(tick + 16 - back), sent, received: sent }, &[0.5]);
        }
        let inputs = [camera.clone(), motor.clone()];
        let step = Step::new(tick, now, now, &inputs);
        let start = Instant::now();
        node.step_into(&step, black_box(&mut output))?;
        taken.push(start.elapsed().as_secs_f64());
    }
    Ok(taken)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("{:<44} {:>11} {:>11} {:>11}", "pendulum", "p50", "p5", "p99");
    report("filter: prediction and update", filter(0)?);
    report("filter: the same and 3 predictions", filter(3)?);
    report("node pendulum/estimator (extended)", node("pendulum/estimator", serde_json::json!({}))?);
    report("node pendulum/ukf", node("pendulum/ukf", serde_json::json!({ "ahead": 0.02 }))?);
    let system = serde_json::json!({
        "initial": { "q": 3.1, "v": 0.0 }, "std": { "q": 2.0, "v": 5.0 }, "disturbance": { "v": 2.0 }, "ahead": 0.02,
        "sends": { "message": "pendulum/Estimate", "leaves": ["angle", "speed", "stamp"], "values": ["q", "v", "stamp"] },
    });
    report("node estimator, of a system.toml", node("estimator", system)?);
    Ok(())
}
