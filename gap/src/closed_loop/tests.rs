//! The simulated machine against the diagnosis's own simulator, which knows all commands beforehand.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use parallax_model::plant::Plant;
use parallax_model::system::System;

use super::world::{Machine, Sensor, World};
use crate::equations::EquationsSimulator;
use crate::experiment::{Experiment, Held, Sample};
use crate::simulator::{Prediction, Simulator, Transition};

const SYSTEM: &str = r#"
format = 1
name = "carriage"
[parameters]
m = { value = 2.0, unit = "kg" }
b = { value = 1.5, unit = "N s/m" }
[inputs]
u = { signal = "force" }
[state]
q = { derivative = "v" }
v = { derivative = "(u - b*v)/m" }
[outputs]
position = { value = "q", unit = "m", noise = 1e-12 }
felt = { value = "u", unit = "N", noise = 1e-12 }
[joints]
rail = { position = "q", velocity = "v", inertia = "m", drive = "u" }
"#;

/// Commands every 10 ms, readings every 7 ms.
fn recorded() -> Experiment {
    let times: Vec<f64> = (0..400).map(|k| f64::from(k) * 0.01).collect();
    let values = times.iter().map(|t| 3.0 * (2.0 * t).sin() + 2.0 * (9.0 * t).sin()).collect();
    let samples = (0..560)
        .flat_map(|k| [0, 1].map(|output| Sample { stamp: f64::from(k) * 0.007 + 1e-4, output, value: 0.0 }));
    Experiment {
        inputs: vec![Held { times, values }],
        samples: samples.collect(),
        wraps: vec![None, None],
        ..Experiment::default()
    }
}

#[test]
fn effects_act_one_command_at_a_time_as_they_do_along_a_recording() {
    let effects = [
        ("delay", "input:u", "delay = 0.033"),
        ("delay", "output:position", "delay = 0.025"),
        ("lag", "input:u", "time_constant = 0.05"),
        ("lag", "input:u", "time_constant = 0.05, damping = 0.6"),
        ("gain", "input:u", "gain = 1.2"),
        ("rate_limit", "input:u", "rate = 20.0"),
        ("backlash", "input:u", "gap = 1.0"),
        ("saturation", "input:u", "low = -2.0, high = 2.5"),
        ("viscous", "joint:rail", "coefficient = 2.0"),
        ("coulomb", "joint:rail", "force = 1.0"),
        ("sensor_lag", "output:position", "time_constant = 0.04"),
        ("bias", "output:position", "bias = 0.1"),
        ("drift", "output:position", "rate = 0.1"),
        ("flexibility", "joint:rail", "stiffness = 40.0, damping = 1.0, ratio = 0.5"),
    ];
    let experiment = recorded();
    let nominal = predicted(&experiment, "");
    for (name, place, parameters) in effects {
        let effect =
            format!("[[effect]]\nname = \"{name}\"\nplace = \"{place}\"\nparameters = {{ {parameters} }}\n");
        let expected = predicted(&experiment, &effect);
        let moved = expected.iter().zip(&nominal).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(moved > 0.01, "{name}: the effect does nothing in this experiment");
        let machine = machine(&experiment, &effect);
        let begin = experiment.samples[0].stamp;
        let mut start = vec![0.1, -0.2];
        start.resize(machine_states(&effect), 0.0);
        let (start, _) = simulator(&experiment, &effect).start(&start[..2], &[1.0; 2], begin);
        let mut world = World::new(&machine, &experiment, begin, start, 1);
        let commands = &experiment.inputs[0];
        let mut sent = commands.times.partition_point(|t| *t < begin);
        for (k, sample) in experiment.samples.iter().enumerate() {
            while sent < commands.times.len() && commands.times[sent] <= sample.stamp {
                world.command(0, commands.times[sent], commands.values[sent]);
                sent += 1;
            }
            let read = world.read(sample.output, sample.stamp).unwrap();
            // A late reading of a command is defined between samples there, and by what acts here.
            let late = name == "delay" && sample.output == 1;
            // Late readings of the first instants show what was before the machine began to move.
            let settled = sample.stamp > 0.1 || !place.starts_with("output");
            if !late && settled {
                let away = (read - expected[k]).abs();
                // Along a recording a reading shows the mean of a smoothed command over a piece, here its value.
                let near = if sample.output == 0 { 2e-4 } else { 0.05 };
                assert!(away < near, "{name} {place} at {} s: {read} for {}", sample.stamp, expected[k]);
            }
        }
    }
}

fn plant(effect: &str) -> Plant {
    let equations = System::parse(&format!("{SYSTEM}{effect}"), "s.toml").unwrap().equations().unwrap();
    Plant::new(equations, &[], Vec::new(), vec![0.01])
}

fn machine_states(effect: &str) -> usize {
    plant(effect).states()
}

const STEP: f64 = 1e-3;

fn machine(experiment: &Experiment, effect: &str) -> Arc<Machine> {
    let sensors = (0..2).map(|output| Sensor::of(experiment, output, 0.0)).collect();
    Arc::new(Machine::new(plant(effect), STEP, experiment, sensors))
}

fn simulator<'a>(experiment: &'a Experiment, effect: &str) -> EquationsSimulator<'a> {
    EquationsSimulator::new(plant(effect), Vec::new(), experiment, STEP)
}

/// What the simulator that knows the whole recording predicts for each of its samples.
fn predicted(experiment: &Experiment, effect: &str) -> Vec<f64> {
    let simulator = simulator(experiment, effect);
    let mut run = simulator.run(&[]);
    let first = experiment.samples[0];
    let readings = |index: usize, run: &dyn crate::simulator::Run| run.events()[index].reading;
    // The state is that at the first stamp, also where the readings then show an earlier time.
    let begin = run.events().iter().position(|e| e.time >= first.stamp - 1e-12).unwrap();
    let (mut x, _) = simulator.start(&[0.1, -0.2], &[1.0; 2], first.stamp);
    let (mut transition, mut prediction) = (Transition::default(), Prediction::default());
    let mut found = vec![f64::NAN; experiment.samples.len()];
    let count = run.events().len();
    for index in begin..count {
        if let Some(reading) = readings(index, &*run) {
            run.observe(index, &x, &mut prediction);
            let at = experiment.samples.iter();
            let at = at.zip(0..).find(|(s, _)| s.stamp == reading.stamp && s.output == reading.output);
            found[at.unwrap().1] = prediction.value;
        }
        if index + 1 < count {
            run.advance(index, &mut x, &mut transition);
        }
    }
    // Readings before the machine began to move show where it began.
    for (value, sample) in found.iter_mut().zip(&experiment.samples).filter(|(value, _)| value.is_nan()) {
        *value = if sample.output == 0 { 0.1 } else { experiment.inputs[0].at(sample.stamp) };
    }
    found
}
