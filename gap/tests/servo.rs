//! A position servo under commands in steps, logged at 50 Hz: corners in its motion, a dead time of several periods, and a speed
//! that its motor cannot exceed. Integrated here by steps of its own.

use std::collections::VecDeque;

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What is believed of it: it follows at once, as fast as it likes.
const SYSTEM: &str = r#"
format = 1
name = "servo"

[parameters]
stiffness = { value = 400.0, unit = "1/s^2", calibrate = [20.0, 20000.0] }
damping = { value = 30.0, unit = "1/s", calibrate = [1.0, 1000.0] }

[inputs]
u = { signal = "goal" }

[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "stiffness*(u - q) - damping*v", initial = 0.0 }

[outputs]
position = { value = "q", unit = "rad" }

[joints]
servo = { position = "q", velocity = "v", inertia = "1", drive = "stiffness*(u - q)" }
"#;

const PERIOD: f64 = 0.02;
const SAMPLES: usize = 1000;
const NOISE: f64 = 0.0007;

/// v̇ = 310 (u − q) − 26 v, the command `dead_time` (s) late, the speed at most `fastest` (rad/s).
fn record(seed: u64, dead_time: f64, fastest: f64) -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    const STEPS: usize = 200;
    let step = PERIOD / STEPS as f64;
    let mut underway: VecDeque<f64> = vec![0.0; (dead_time / step).round() as usize].into();
    let (mut q, mut v, mut goal) = (0.0_f64, 0.0_f64, 0.0);
    let (mut stamps, mut goals, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..SAMPLES {
        if random.random_bool(0.06) {
            goal = random.random_range(-0.6..0.6);
        }
        stamps.push((k as f64 * PERIOD * 1e9).round() as i64);
        goals.push(goal);
        let noise: f64 = StandardNormal.sample(&mut random);
        readings.push(q + NOISE * noise);
        for _ in 0..STEPS {
            underway.push_back(goal);
            let acting = underway.pop_front().unwrap_or(goal);
            v = (v + step * (310.0 * (acting - q) - 26.0 * v)).clamp(-fastest, fastest);
            q += step * v;
        }
    }
    let signals = vec![
        Signal::new("goal", Role::Command, "rad", stamps.clone(), goals),
        Signal::new("position", Role::Measurement, "rad", stamps, readings),
    ];
    Log { title: "servo".into(), signals, ..Log::default() }
}

fn diagnosed(log: &Log) -> Report {
    let system = System::parse(SYSTEM, "servo.toml").expect("the system is valid");
    diagnose(&system, log, &Options::default(), &|_, _| ()).expect("it can be diagnosed").report
}

/// The corners of the motion, far beyond the noise and rare, are no outliers: a model that knows of the dead time predicts them.
#[test]
fn a_dead_time_of_several_periods_is_alone() {
    let report = diagnosed(&record(1, 0.07, f64::INFINITY));
    let [effect] = &report.which[0].effects[..] else { panic!("{}", report.summary) };
    assert_eq!(effect.name, "delay", "{}", report.summary);
    assert!((effect.parameters["delay"].value - 0.07).abs() < 0.001, "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.99, "{}", report.summary);
}

/// The nominal servo is nearly twice as fast, and so are the speeds that it believes of the log. (Where within a step of the
/// integration the limit is met is not resolved, for which commands that come late by chance may be named beside it.)
#[test]
fn a_speed_that_cannot_be_exceeded_is_found() {
    let report = diagnosed(&record(2, 0.0, 1.2));
    let effect = &report.which[0].effects[0];
    assert_eq!(
        (effect.name.as_str(), effect.place.as_str()),
        ("saturation", "state:v"),
        "{}",
        report.summary
    );
    for (name, truth) in [("high", 1.2), ("low", -1.2)] {
        assert!((effect.parameters[name].value - truth).abs() < 0.05, "{}", report.summary);
    }
    assert!(report.how_far.closed_by_effect.value > 0.97, "{}", report.summary);
}
