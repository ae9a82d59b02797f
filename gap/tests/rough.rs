//! A machine of which no simulator knows everything: its torques ripple, so that nothing reaches the noise of its fine sensors, and dry friction
//! in both joints and an encoder's zero are behind most of the gap. Its integrator shares nothing with the library.

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_model::system::System;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What a simulator without friction believes of it.
const SYSTEM: &str = include_str!("../../examples/systems/double-pendulum.toml");

/// Dry friction in both joints (N m), and where the second encoder was zeroed (rad).
const FRICTION: [f64; 2] = [0.16, 0.14];
const ZERO: f64 = -0.08;

fn record() -> Experiment {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let (period, h, end) = (0.005, 1e-4, 8.0);
    let count = (end / period) as usize;
    let stamp: Vec<f64> = (0..count).map(|k| k as f64 * period).collect();
    let command = |k: usize, t: f64| {
        let wave = |f: f64, phase: f64| (std::f64::consts::TAU * f * t + phase).sin();
        if k == 0 {
            0.35 * wave(0.9, 0.0) + 0.3 * wave(1.7, 1.0)
        } else {
            0.3 * wave(1.3, 0.5) + 0.35 * wave(2.1, 2.0)
        }
    };
    let values = |k: usize| stamp.iter().map(|t| command(k, *t)).collect::<Vec<f64>>();
    let held = [0, 1].map(|k| Held { times: stamp.clone(), values: values(k) });
    let (mut q, mut v, mut ripple) = ([0.1, -0.2_f64], [0.0_f64; 2], [0.0_f64; 2]);
    let mut samples = Vec::new();
    for step in 0..count * 50 {
        let t = step as f64 * h;
        if step % 50 == 0 {
            // Both angles, then both speeds.
            let read = [(q[0], 1.5e-4), (q[1] + ZERO, 1.5e-4), (v[0], 0.08), (v[1], 0.08)];
            for (output, (value, std)) in read.into_iter().enumerate() {
                let noise: f64 = (0..12).map(|_| random.random_range(-0.5..0.5)).sum();
                samples.push(Sample { stamp: t, output, value: value + std * noise });
            }
        }
        let (s, c) = q[1].sin_cos();
        let (cross, own) = (0.3 * 0.105, 0.025);
        let (m11, m12) = (0.055 + own + 0.0567 + 2.0 * cross * c, own + cross * c);
        let load2 = -9.81 * 0.105 * (q[0] + q[1]).sin();
        let load = [-9.81 * 0.356 * q[0].sin() + load2, load2];
        let turning = [cross * s * (2.0 * v[0] * v[1] + v[1] * v[1]), -cross * s * v[0] * v[0]];
        let mut force = [0.0; 2];
        for k in 0..2 {
            ripple[k] +=
                -ripple[k] * h / 0.02 + 0.04 * (2.0 * h / 0.02_f64).sqrt() * random.random_range(-1.7..1.7);
            force[k] = held[k].values[step / 50] + ripple[k] + load[k] + turning[k];
        }
        // Each joint's friction takes at most what stops it, beside that of the other: by turns.
        let det = m11 * own - m12 * m12;
        let free = [
            v[0] + h * (own * force[0] - m12 * force[1]) / det,
            v[1] + h * (m11 * force[1] - m12 * force[0]) / det,
        ];
        let (mut dry, inverse) = ([0.0_f64; 2], [[own / det, -m12 / det], [-m12 / det, m11 / det]]);
        for _ in 0..20 {
            for k in 0..2 {
                let speed = free[k] + h * inverse[k][1 - k] * dry[1 - k];
                dry[k] = (-speed / (h * inverse[k][k])).clamp(-FRICTION[k], FRICTION[k]);
            }
        }
        for k in 0..2 {
            v[k] = free[k] + h * (inverse[k][0] * dry[0] + inverse[k][1] * dry[1]);
            q[k] += h * v[k];
        }
    }
    Experiment {
        inputs: held.to_vec(),
        input_units: vec!["N m".into(); 2],
        samples,
        wraps: vec![None; 4],
        ..Experiment::default()
    }
}

/// The zero and the heavy joint's friction close little beside that of the elbow, less than the form of its friction may be off by. But with all
/// three what is left is as good as random.
#[test]
fn small_causes_elsewhere_are_named_where_what_is_left_is_random() {
    let equations =
        System::parse(SYSTEM, "double-pendulum.toml").expect("valid").equations().expect("complete");
    let only = ["joint:shoulder", "joint:elbow", "bias"].map(|text| text.parse().expect("a selection"));
    let options = Options { only: only.to_vec(), ..Options::default() };
    let found = diagnose_experiment(equations, record(), "double pendulum", &options, &|_, _| ());
    let report = found.expect("it can be diagnosed").report;
    let effects = &report.which[0].effects;
    let labels: Vec<String> = effects.iter().map(|effect| effect.label()).collect();
    let causes = ["coulomb@joint:elbow", "bias@output:pos_meas2", "coulomb@joint:shoulder"];
    assert_eq!(labels, causes, "{}", report.summary);
    let value = |k: usize, name: &str| effects[k].parameters[name].value;
    assert!((value(0, "force") - FRICTION[1]).abs() < 0.02, "{}", report.summary);
    assert!((value(2, "force") - FRICTION[0]).abs() < 0.06, "{}", report.summary);
    assert!((value(1, "bias") - ZERO).abs() < 0.02, "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.95, "{}", report.summary);
    // What adds nothing to predictions of fresh motion is not named where nothing reaches the noise.
    let split = &report.how_far.split;
    assert!(split.len() == causes.len() && split.iter().all(|part| part.share > 0.0), "{split:?}");
}
