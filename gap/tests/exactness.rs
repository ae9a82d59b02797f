//! Derivatives, the order of events and what a reading sees: what the fits rely on.

use crate::rotor;
use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::equations::EquationsSimulator;
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::hypothesis::Slot;
use parallax_gap::shooting::{States, Window, shoot};
use parallax_gap::simulator::{Prediction, Run, Simulator, Transition, wrapped};
use parallax_model::effect::{Effect, PlaceKind};
use parallax_model::plant::Plant;
use parallax_model::system::System;

/// A pendulum with an effect of every kind that can act together, at delays between samples.
fn with_effects(experiment: &Experiment) -> (EquationsSimulator<'_>, Vec<f64>) {
    let equations = System::parse(SYSTEM, "pendulum.toml").expect("valid").equations().expect("complete");
    let at = [
        (Effect::Delay, PlaceKind::Input, 0, vec![0.0137]),
        (Effect::Lag, PlaceKind::Input, 0, vec![0.043]),
        (Effect::Offset, PlaceKind::Input, 0, vec![0.2]),
        (Effect::Saturation, PlaceKind::Input, 0, vec![-1.1, 1.3]),
        (Effect::Deadband, PlaceKind::Input, 0, vec![0.15]),
        (Effect::Viscous, PlaceKind::Joint, 0, vec![0.01]),
        (Effect::Coulomb, PlaceKind::Joint, 0, vec![0.02]),
        (Effect::AsymmetricFriction, PlaceKind::Joint, 0, vec![0.015, 0.01]),
        (Effect::Bias, PlaceKind::Output, 0, vec![0.05]),
        (Effect::Delay, PlaceKind::Output, 0, vec![0.0071]),
    ];
    let effects: Vec<_> = at.iter().map(|(effect, kind, index, _)| (*effect, *kind, *index)).collect();
    let (mut slots, mut theta) = (vec![Slot::Nominal(0), Slot::Nominal(1)], vec![0.0125, 0.12]);
    for (effect, (_, _, _, values)) in at.iter().enumerate() {
        for (parameter, value) in values.iter().enumerate() {
            slots.push(Slot::Effect { effect, parameter });
            theta.push(*value);
        }
    }
    let plant = Plant::new(equations, &effects, Vec::new(), vec![0.3]);
    (EquationsSimulator::new(plant, slots, experiment, 0.005), theta)
}

/// Predictions of readings from one state at the first event, with their derivatives by state and θ.
fn predictions(run: &mut dyn Run, state: &[f64], parameters: usize) -> (Vec<f64>, Vec<Vec<f64>>) {
    let n = state.len();
    let (mut x, mut rows, mut values) = (state.to_vec(), Vec::new(), Vec::new());
    let width = n + parameters;
    let mut by: Vec<Vec<f64>> =
        (0..n).map(|i| (0..width).map(|j| f64::from(u8::from(i == j))).collect()).collect();
    let (mut transition, mut prediction) = (Transition::default(), Prediction::default());
    for index in 0..run.events().len() {
        if run.events()[index].reading.is_some() {
            run.observe(index, &x, &mut prediction);
            values.push(prediction.value);
            rows.push(
                (0..width)
                    .map(|j| {
                        let through: f64 = (0..n).map(|i| prediction.by_state[i] * by[i][j]).sum();
                        through + if j < n { 0.0 } else { prediction.by_parameter[j - n] }
                    })
                    .collect(),
            );
        }
        if index + 1 < run.events().len() {
            run.advance(index, &mut x, &mut transition);
            by = (0..n)
                .map(|i| {
                    (0..width)
                        .map(|j| {
                            let through: f64 =
                                (0..n).map(|k| transition.by_state[i * n + k] * by[k][j]).sum();
                            through
                                + if j < n { 0.0 } else { transition.by_parameter[i * parameters + j - n] }
                        })
                        .collect()
                })
                .collect();
        }
    }
    (values, rows)
}

#[test]
fn derivatives_agree_with_central_differences() {
    let experiment = record(Hidden::default(), 3, 0.5);
    let (simulator, theta) = with_effects(&experiment);
    let state = [0.1, 0.4];
    let p = simulator.parameters();
    let (_, rows) = predictions(&mut *simulator.run(&theta), &state, p);
    for j in 0..2 + p {
        let shifted = |sign: f64| {
            let (mut x, mut t) = (state, theta.clone());
            let h = if j < 2 { 1e-6 } else { 1e-6 * theta[j - 2].abs() };
            if j < 2 {
                x[j] += sign * h
            } else {
                t[j - 2] += sign * h
            }
            (predictions(&mut *simulator.run(&t), &x, p).0, h)
        };
        let ((above, h), (below, _)) = (shifted(1.0), shifted(-1.0));
        let largest = rows.iter().map(|r| r[j].abs()).fold(1e-6, f64::max);
        for (k, row) in rows.iter().enumerate() {
            let difference = (above[k] - below[k]) / (2.0 * h);
            assert!(
                (row[j] - difference).abs() < 1e-4 * largest,
                "reading {k}, variable {j}: {} against {difference}",
                row[j]
            );
        }
    }
}

#[test]
fn a_reading_sees_the_command_stamped_with_it() {
    let text = "format = 1\nname = \"wire\"\n[inputs]\nu = { signal = \"u\" }\n[outputs]\ny = { value = \"u\", unit = \"V\" }\n";
    let equations = System::parse(text, "wire.toml").expect("valid").equations().expect("complete");
    let experiment = Experiment {
        inputs: vec![Held { times: vec![0.0, 0.1, 0.2], values: vec![1.0, 2.0, 3.0] }],
        input_units: vec!["V".into()],
        samples: [0.05, 0.1, 0.15, 0.2].map(|stamp| Sample { stamp, output: 0, value: 0.0 }).to_vec(),
        wraps: vec![None],
        ..Experiment::default()
    };
    let plant = Plant::new(equations, &[], Vec::new(), Vec::new());
    let simulator = EquationsSimulator::new(plant, Vec::new(), &experiment, 0.01);
    let run = simulator.run(&[]);
    assert!(run.events().windows(2).all(|pair| pair[0].time <= pair[1].time));
    drop(run);
    let (values, _) = predictions(&mut *simulator.run(&[]), &[], 0);
    assert_eq!(values, [1.0, 2.0, 2.0, 3.0]);
}

#[test]
fn angles_differ_by_less_than_half_a_turn() {
    let tau = std::f64::consts::TAU;
    assert!((wrapped(3.1 - -3.1, Some(tau)) - (6.2 - tau)).abs() < 1e-12);
    assert_eq!(wrapped(6.2, None), 6.2);
}

#[test]
fn the_number_of_threads_does_not_change_the_report() {
    let report = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads start");
        pool.install(|| {
            let equations =
                System::parse(SYSTEM, "pendulum.toml").expect("valid").equations().expect("complete");
            let experiment = record(Hidden { lag: 0.06, ..Hidden::default() }, 5, 6.0);
            let found = diagnose_experiment(equations, experiment, "p", &Options::default(), &|_, _| ());
            serde_json::to_vec(&found.expect("it can be diagnosed").report).expect("it is data")
        })
    };
    assert_eq!(report(1), report(4));
}

/// Two commands that share their stamps: what changes when the second of them acts is felt at no delay as well, where both
/// act at one time.
#[test]
fn commands_of_one_stamp_part_in_the_derivatives() {
    const TWO: &str = r#"
format = 1
name = "two"
[inputs]
a = { signal = "a" }
b = { signal = "b" }
[state]
x = { derivative = "a - 0.5*x" }
y = { derivative = "b - 0.5*y" }
[outputs]
x = { value = "x" }
y = { value = "y" }
"#;
    let times: Vec<f64> = (0..40).map(|k| 0.02 * f64::from(k)).collect();
    let held = |shift: f64| Held {
        times: times.clone(),
        values: times.iter().map(|t| (9.0 * t + shift).sin()).collect(),
    };
    let mut samples = Vec::new();
    for (k, stamp) in times.iter().enumerate().skip(1) {
        samples.extend((0..2).map(|output| Sample { output, stamp: stamp + 0.004, value: 0.1 * k as f64 }));
    }
    let experiment = Experiment {
        inputs: vec![held(0.0), held(1.0)],
        input_units: vec![String::new(); 2],
        samples,
        wraps: vec![None, None],
        ..Experiment::default()
    };
    for (input, effect) in [(0, Effect::ClockSkew), (1, Effect::ClockSkew), (1, Effect::Delay)] {
        let readings = |theta: f64| {
            let equations = System::parse(TWO, "two.toml").expect("valid").equations().expect("complete");
            let plant = Plant::new(equations, &[(effect, PlaceKind::Input, input)], Vec::new(), Vec::new());
            let slots = vec![Slot::Effect { effect: 0, parameter: 0 }];
            let simulator = EquationsSimulator::new(plant, slots, &experiment, 0.005);
            predictions(&mut *simulator.run(&[theta]), &[0.2, -0.3], 1)
        };
        let (_, exact) = readings(0.0);
        let step = 1e-6;
        let ((ahead, _), (here, _)) = (readings(step), readings(0.0));
        let mut largest: f64 = 0.0;
        for ((ahead, here), row) in ahead.iter().zip(&here).zip(&exact) {
            let numeric = (ahead - here) / step;
            largest = largest.max(numeric.abs());
            assert!((numeric - row[2]).abs() < 1e-4, "{effect:?} of {input}: {numeric} against {}", row[2]);
        }
        assert!(largest > 0.05, "{effect:?} of {input} leaves a trace");
    }
}

/// What integrating a window's first state out costs is of what its sensors tell, and not of the units that they tell it in: otherwise
/// one that reads a tenth of what it should would be the likelier for every window.
#[test]
fn a_scale_does_not_change_what_windows_cost() {
    let experiment = rotor::experiment();
    let simulator =
        rotor::simulator(rotor::equations(), &[(Effect::Scale, PlaceKind::Output, 0)], &experiment);
    let volume = |scale: f64| {
        let mut windows = vec![Window::new(0.1, 0.3, vec![0.1, 0.4, 0.2], vec![1.0; 3])];
        shoot(&simulator, &[scale], &mut windows, &[1e-6, 1e-4], States::Kept).1.volume
    };
    let plain = volume(1.0);
    assert!(plain > 1.0);
    for scale in [0.95, 0.1, -0.2, -1.0, 3.0] {
        assert!((volume(scale) - plain).abs() < 1e-9, "{scale}: {} for {plain}", volume(scale));
    }
}
