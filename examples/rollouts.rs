//! Rollouts of one compiled graph in thousands of environments, on the lanes and cores of this machine.
//!
//! A graph of models is scheduled many times, delays drawn anew; the schedules become one table; and 4,096 pendulums, each
//! with a mass of its own, are swung up and balanced along them by the same agent. How many end upright?
//!
//! `cargo run --release --example rollouts`

use std::error::Error;
use std::time::Instant;

use parallax::nodes::{pendulum, registry};
use parallax::runtime::time::SECOND;
use parallax::sim::batch::{Batch, Precision};
use parallax::sim::compiled::{CompileOptions, compile};
use parallax::sim::generate_many;

const ENVIRONMENTS: usize = 4096;

fn main() -> Result<(), Box<dyn Error>> {
    let mut spec = pendulum::simulated();
    if let Some(agent) = spec.node_mut("agent") {
        agent.parameters.insert("balance_only".into(), true.into());
        agent.parameters.insert("excitation".into(), 0.5.into());
    }
    let graph = spec.validate(&registry())?;

    let episodes = generate_many(&graph, 0, 10 * SECOND, 32)?;
    let compiled = compile(&graph, &episodes, &CompileOptions::default())?;
    println!(
        "{} episodes of {} steps of the agent: {} slots, {:.1} % of them filled",
        compiled.episodes,
        compiled.steps,
        compiled.slots.len(),
        100.0 * compiled.efficiency()
    );

    // Masses from half to one and a half times what the agent believes.
    let batch = Batch::new(&graph, &compiled, 1)?;
    let masses: Vec<f64> =
        (0..ENVIRONMENTS).map(|index| 0.0509 * (0.5 + index as f64 / ENVIRONMENTS as f64)).collect();
    let mut environments = batch.environments(ENVIRONMENTS);
    environments.set_param("world", "pendulum.mass", &masses)?;

    let began = Instant::now();
    let rollout = batch.rollout(&environments, Precision::DoubleLanes, &["encoder"])?;
    let seconds = began.elapsed().as_secs_f64();
    let steps = (ENVIRONMENTS * compiled.steps) as f64;
    println!(
        "{ENVIRONMENTS} environments: {seconds:.2} s, {:.0} M steps of the agent a second",
        steps / seconds * 1e-6
    );

    // Upright: within 0.3 rad of the top in the last second. Steps that nobody consumed did not run: they are no number.
    let seen = &rollout.outputs[0];
    let upright = |environment: usize| {
        let last = (seen.steps - 100..seen.steps).map(|step| seen.message(environment, step)[0]);
        last.filter(|angle| !angle.is_nan()).all(|angle| angle.abs() < 0.3)
    };
    for tenth in 0..10 {
        let range = tenth * ENVIRONMENTS / 10..(tenth + 1) * ENVIRONMENTS / 10;
        let count = range.clone().filter(|&environment| upright(environment)).count();
        let (low, high) = (1e3 * masses[range.start], 1e3 * masses[range.end - 1]);
        println!("{low:3.0} to {high:3.0} g: {:3.0} % upright", 100.0 * count as f64 / range.len() as f64);
    }
    Ok(())
}
