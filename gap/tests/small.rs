//! A cause that moves readings by less than their noise: within a window too short to show it, over minutes all the same.

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_model::system::System;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

const SYSTEM: &str = r#"
format = 1
name = "sledge"

[parameters]
m = { value = 1.0, unit = "kg", calibrate = [0.5, 2.0] }

[inputs]
F = { signal = "force" }

[state]
x = { derivative = "v", initial = "position" }
v = { derivative = "F/m" }

[outputs]
position = { value = "x", unit = "m" }

[joints]
slide = { position = "x", velocity = "v", inertia = "m", drive = "F" }
"#;

/// A minute of a mass that is pushed to and fro at 50 Hz, read to 5 mm, in a medium that takes so much of its momentum in each second.
fn record(drag: f64, seed: u64) -> Experiment {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (period, steps) = (0.02, 200);
    let step = period / f64::from(steps);
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut x, mut v) = (0.0, 0.0);
    for k in 0..3000 {
        let t = f64::from(k) * period;
        let wave = |frequency: f64, phase: f64| (std::f64::consts::TAU * frequency * t + phase).sin();
        // Pushed back to where it began, as a position controller does.
        let force = 0.12 * wave(0.07, 0.4) + 0.2 * wave(0.19, 1.0) + 0.2 * wave(0.43, 2.0) - 0.15 * x;
        held.times.push(t);
        held.values.push(force);
        let noise: f64 = StandardNormal.sample(&mut random);
        samples.push(Sample { stamp: t, output: 0, value: x + 0.005 * noise });
        for _ in 0..steps {
            v += step * (force - drag * v);
            x += step * v;
        }
    }
    Experiment {
        inputs: vec![held],
        input_units: vec!["N".into()],
        samples,
        wraps: vec![None],
        ..Experiment::default()
    }
}

#[test]
fn what_no_window_shows_is_named_by_the_innovations() {
    for (drag, named) in [(0.003, true), (0.0, false)] {
        let equations = System::parse(SYSTEM, "sledge.toml").expect("valid").equations().expect("complete");
        let found =
            diagnose_experiment(equations, record(drag, 8), "sledge", &Options::default(), &|_, _| ());
        let report = found.expect("diagnosed").report;
        assert_eq!(report.gap.detected, named, "{}", report.summary);
        let first = &report.which[0];
        if named {
            assert!(first.class.iter().any(|name| name == "viscous@joint:slide"), "{}", report.summary);
            assert!(first.probability > 0.8, "{}", report.summary);
            // Without it, predictions over the horizon are off by hardly more than the noise.
            assert!(report.how_far.refitted < 1.5, "{}", report.how_far.refitted);
        }
    }
}
