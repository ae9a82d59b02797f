//! Properties of the parts that a diagnosis rests on, and logs that are odd but possible.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::equations::EquationsSimulator;
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::hypothesis::{EffectAt, Slot};
use parallax_gap::innovation::walk;
use parallax_gap::library;
use parallax_gap::quantify::{Block, Row, closed};
use parallax_gap::setup::Setup;
use parallax_gap::shooting::{States, Window, lateness, locate, shoot};
use parallax_gap::signature::orthonormal;
use parallax_gap::simulator::Simulator;
use parallax_model::effect::{Effect, Place, PlaceKind};
use parallax_model::plant::Plant;
use parallax_model::system::{Equations, System};
use proptest::prelude::*;

fn equations() -> Equations {
    System::parse(crate::support::SYSTEM, "system.toml").unwrap().equations().unwrap()
}

fn row(squares: f64) -> Row {
    Row { blocks: vec![Block { squares, count: 1 }; 4], readings: Vec::new() }
}

/// Two sensors of a mass on a spring, read at the same times and pushed now and then.
fn two_sensors() -> Setup {
    let text = r#"
format = 1
name = "mass"
[inputs]
u = { signal = "u" }
[state]
q = { derivative = "v", initial = "near" }
v = { derivative = "u - 4*q - 6*v" }
[outputs]
near = { value = "q", unit = "m" }
far = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "1", drive = "u" }
"#;
    let equations = System::parse(text, "mass.toml").unwrap().equations().unwrap();
    let push = |k: u32| f64::from(u8::from(k.is_multiple_of(3)));
    let input =
        Held { times: (0..40).map(|k| 0.3 * f64::from(k)).collect(), values: (0..40).map(push).collect() };
    let (mut q, mut v, mut samples) = (0.0_f64, 0.0_f64, Vec::new());
    for k in 0..12_000_u32 {
        let t = 1e-3 * f64::from(k);
        if k.is_multiple_of(10) {
            let jitter = 1e-3 * (7.0 * f64::from(k)).sin();
            samples.extend([0, 1].map(|output| Sample { stamp: t, output, value: q + jitter }));
        }
        v += 1e-3 * (push(k / 300) - 4.0 * q - 6.0 * v);
        q += 1e-3 * v;
    }
    let experiment = Experiment {
        inputs: vec![input],
        input_units: vec![String::new()],
        samples,
        wraps: vec![None, None],
        ..Experiment::default()
    };
    Setup::new(equations, experiment, None)
}

/// Three sensors of a level that decays.
fn decay() -> Setup {
    let text = r#"
format = 1
name = "tank"
[inputs]
u = { signal = "u" }
[state]
x = { derivative = "u - 6*x" }
[outputs]
one = { value = "x", unit = "m" }
other = { value = "x", unit = "m" }
late = { value = "x", unit = "m" }
"#;
    let equations = System::parse(text, "tank.toml").unwrap().equations().unwrap();
    let sample = |k: u32| {
        let stamp = 0.01 * f64::from(k);
        [0, 1, 2].map(|output| Sample { stamp, output, value: (3.0 * stamp).sin() })
    };
    let experiment = Experiment {
        inputs: vec![Held { times: vec![0.0], values: vec![0.0] }],
        input_units: vec![String::new()],
        samples: (0..1200).flat_map(sample).collect(),
        wraps: vec![None; 3],
        ..Experiment::default()
    };
    Setup::new(equations, experiment, None)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Hypotheses are compared reading by reading: a delay under trial must neither lose nor repeat one, nor change
    /// which stands where.
    #[test]
    fn a_late_sensor_keeps_the_readings_in_their_places(delay in 0.0..0.15_f64) {
        let setup = two_sensors();
        let place = Place::new(PlaceKind::Output, "far");
        let late = library::hypothesis(&setup, &[EffectAt { effect: Effect::Delay, place }]);
        let simulator = library::simulator(&setup, &late, Vec::new());
        let at = |delay: f64| walk(&simulator, &setup.train, &setup.noise, &setup.noise.initial, &[delay]);
        let (plain, moved) = (at(0.0), at(delay));
        let key = |pass: &parallax_gap::filter::Pass| -> Vec<(u64, usize)> {
            pass.stamp.iter().map(|s| s.to_bits()).zip(pass.output.iter().copied()).collect()
        };
        prop_assert_eq!(key(&plain), key(&moved));
        let once: std::collections::BTreeSet<_> = key(&plain).into_iter().collect();
        prop_assert_eq!(once.len(), plain.readings());
    }

    /// Nor may it know more where a stretch or a window begins: what happened before is no part of it.
    #[test]
    fn a_late_sensor_knows_no_more_where_a_stretch_begins(delay in 0.0..0.15_f64) {
        let setup = two_sensors();
        let place = Place::new(PlaceKind::Output, "far");
        let late = library::hypothesis(&setup, &[EffectAt { effect: Effect::Delay, place }]);
        let simulator = library::simulator(&setup, &late, Vec::new());
        let known = |delay: f64| -> f64 {
            let pass = walk(&simulator, &setup.train, &setup.noise, &setup.noise.initial, &[delay]);
            pass.variance.iter().map(|v| v.ln()).sum()
        };
        let stretches = setup.train.len() as f64;
        prop_assert!((known(0.0) - known(delay)).abs() < 3.0 * stretches, "{} {}", known(0.0), known(delay));
    }

    /// What a window tells of its state is told of the state where most sensors begin, wherever one that is late does.
    #[test]
    fn a_late_sensor_moves_no_window(delay in 0.0..0.1_f64) {
        let setup = decay();
        let place = Place::new(PlaceKind::Output, "late");
        let late = library::hypothesis(&setup, &[EffectAt { effect: Effect::Delay, place }]);
        let simulator = library::simulator(&setup, &late, Vec::new());
        let window = Window::new(2.0, 2.5, vec![1.0], vec![1e6]);
        let (_, residuals, _) = shoot(&simulator, &[delay], &mut [window], &[1.0; 3], States::Settled);
        // Readings every 10 ms of what decays with a rate of 6/s.
        let told = |late: f64| (0..50).map(|k| (-2.0 * 6.0 * (0.01 * f64::from(k) - late)).exp()).sum::<f64>();
        let volume = ((2.0 * told(0.0) + told(delay)) * 1e12).ln();
        prop_assert!((residuals.volume - volume).abs() < 1e-3, "{} {volume}", residuals.volume);
    }
}

proptest! {
    #[test]
    fn bases_are_orthonormal(values in prop::collection::vec(-1e3..1e3_f64, 60)) {
        let columns = nalgebra::DMatrix::from_row_slice(20, 3, &values);
        let basis = orthonormal(&columns);
        let product = basis.transpose() * &basis;
        prop_assert!((product - nalgebra::DMatrix::identity(basis.ncols(), basis.ncols())).norm() < 1e-9);
    }

    #[test]
    fn shares_are_bounded_and_a_failed_prediction_closes_nothing(before in 1.0..1e6_f64, after in 0.0..1e9_f64) {
        let share = closed(&row(before), &row(after), 1);
        prop_assert!(share.low <= share.value && share.value <= share.high);
        prop_assert!((-10.0..=1.0).contains(&share.value));
        prop_assert!(closed(&row(before), &row(f64::NAN), 1).value < 0.0);
    }

    #[test]
    fn averaging_keeps_a_commands_integral_and_its_last_value(values in prop::collection::vec(-5.0..5.0_f64, 20..200)) {
        let times: Vec<f64> = (0..values.len()).map(|k| k as f64 * 1e-3).collect();
        let held = Held { times, values };
        let averaged = held.averaged(0.01);
        let end = *held.times.last().unwrap();
        let integral = |h: &Held| -> f64 {
            let until = h.times.iter().skip(1).copied().chain([end]);
            h.times.iter().zip(&h.values).zip(until).map(|((t, v), u)| v * (u - t)).sum()
        };
        prop_assert!((integral(&held) - integral(&averaged)).abs() < 1e-9);
        prop_assert_eq!(averaged.at(end + 1.0), held.at(end + 1.0));
    }

    #[test]
    fn a_late_sensor_loses_no_reading(delay in 0.0..30.0_f64) {
        let samples: Vec<Sample> =
            (0..100).map(|k| Sample { stamp: f64::from(k), output: 0, value: 0.0 }).collect();
        let held = Held { times: vec![0.0, 50.0], values: vec![0.0, 1.0] };
        let experiment = Experiment { inputs: vec![held], samples, wraps: vec![None], ..Experiment::default() };
        let plant = Plant::new(equations(), &[(Effect::Delay, PlaceKind::Output, 0)], Vec::new(), vec![1.0]);
        let simulator =
            EquationsSimulator::new(plant, vec![Slot::Effect { effect: 0, parameter: 0 }], &experiment, 1.0);
        let run = simulator.run(&[delay]);
        let events = run.events();
        let (first, end) = locate(events, lateness(events), 20.0, 40.0).unwrap();
        let found = events[first..end].iter().filter_map(|e| e.reading).filter(|r| r.stamp >= 20.0 && r.stamp < 40.0);
        prop_assert_eq!(found.count(), 20);
    }
}

/// Diagnoses a changed recording: it may be refused with a reason, and must not panic.
fn survives(change: impl Fn(&mut Experiment)) {
    let mut experiment = crate::support::record(crate::support::Hidden::default(), 5, 4.0);
    change(&mut experiment);
    match diagnose_experiment(equations(), experiment, "odd", &Options::default(), &|_, _| ()) {
        Ok(found) => assert!(found.report.gap.p_value.is_finite()),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

#[test]
fn an_output_that_never_changes() {
    survives(|e| e.samples.iter_mut().for_each(|s| s.value = 0.3));
}

#[test]
fn a_command_that_never_changes() {
    survives(|e| e.inputs[0].values.iter_mut().for_each(|v| *v = 0.0));
}

#[test]
fn a_coarse_sensor() {
    survives(|e| e.samples.iter_mut().for_each(|s| s.value = (s.value * 10.0).round() / 10.0));
}

#[test]
fn a_sensor_of_noise() {
    survives(|e| {
        for (k, s) in e.samples.iter_mut().enumerate() {
            s.value = ((k * 7919) % 1000) as f64 / 200.0 - 2.5;
        }
    });
}

#[test]
fn samples_that_are_missing() {
    survives(|e| e.samples.retain(|s| !(1.0..2.2).contains(&s.stamp)));
}
