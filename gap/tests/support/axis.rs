//! A mass on a rail that is driven along it, diagnosed.

use std::collections::VecDeque;

use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::experiment::{Experiment, Held, Sample};
use parallax_gap::report::{Report, Which};
use parallax_model::system::System;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::rail;

const JOINT: &str = r#"
[joints]
axis = { position = "q", velocity = "v", inertia = "1", drive = "u", load = "-d*v" }
"#;

/// What the diagnosis says, and why of all effects on the pushes, of readings of its position, whose noise has this standard deviation (m), under these pushes.
pub(crate) fn diagnosed(noise: f64, pushes: Held, samples: Vec<Sample>) -> Report {
    let experiment = Experiment {
        inputs: vec![pushes],
        input_units: vec![String::new()],
        samples,
        wraps: vec![None],
        ..Experiment::default()
    };
    let text = format!("{}{JOINT}", rail::SLIDE).replace("noise = 0.0005", &format!("noise = {noise}"));
    let equations = System::parse(&text, "rail.toml").expect("valid").equations().expect("complete");
    let options = Options { explain: vec!["input:u".parse().expect("a place")], ..Options::default() };
    diagnose_experiment(equations, experiment, "log", &options, &|_, _| {})
        .expect("it can be diagnosed")
        .report
}

/// A mass that is pushed for 20 s by commands that each act after a time of their own (s), of what they are and of a draw; in the
/// order in which they were sent; what is asked for changes every 0.1 s. Steps of 0.2 ms. Its position is read with this noise (m).
pub(crate) fn pushed(noise: f64, mut late: impl FnMut(f64, f64) -> f64) -> Report {
    const PERIOD: f64 = 0.02;
    const STEPS: u32 = 100;
    const HELD: u32 = 5;
    let mut random = ChaCha8Rng::seed_from_u64(23);
    let mut draw = move || -> f64 { StandardNormal.sample(&mut random) };
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut q, mut v, mut acting, mut last) = (0.0, 0.0, 0.0, 0.0_f64);
    let mut queue: VecDeque<(f64, f64)> = VecDeque::new();
    let mut push = 0.0;
    for k in 0..1000 {
        let stamp = PERIOD * f64::from(k);
        samples.push(Sample { stamp, output: 0, value: q + noise * draw() });
        if k % HELD == 0 {
            push = 1.2 * draw();
        }
        held.times.push(stamp);
        held.values.push(push);
        last = last.max(stamp + late(push, draw()));
        queue.push_back((last, push));
        let step = PERIOD / f64::from(STEPS);
        for i in 0..STEPS {
            while queue.front().is_some_and(|(at, _)| *at <= stamp + step * f64::from(i) + 1e-9) {
                acting = queue.pop_front().expect("it is there").1;
            }
            q += 0.5 * step * v;
            v += step * (acting - 2.8 * v);
            q += 0.5 * step * v;
        }
    }
    diagnosed(noise, held, samples)
}

/// A mass that is pushed anew every half second for 20 s, beside a force of this size that repeats 0.9 times a second; some pushes, by
/// their number, never arrive. Its position is read with this noise (m), a seventh more than is declared: no model leaves less.
pub(crate) fn pushed_and_shaken(noise: f64, force: f64, lost: &[usize]) -> Report {
    const STEP: f64 = 2e-4;
    let mut random = ChaCha8Rng::seed_from_u64(29);
    let mut draw = move || -> f64 { StandardNormal.sample(&mut random) };
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut q, mut v, mut acting) = (0.0, 0.0, 0.0);
    for k in 0..100_000_usize {
        let time = STEP * k as f64;
        if k.is_multiple_of(2500) {
            let push = 1.5 * draw();
            held.push(time, push);
            if !lost.contains(&(k / 2500)) {
                acting = push;
            }
        }
        if k.is_multiple_of(50) {
            samples.push(Sample { stamp: time, output: 0, value: q + noise * draw() });
        }
        let shaken = force * (std::f64::consts::TAU * 0.9 * time).sin();
        q += 0.5 * STEP * v;
        v += STEP * (acting + shaken - 2.8 * v);
        q += 0.5 * STEP * v;
    }
    diagnosed(noise / 1.14, held, samples)
}

/// The effects of an answer, in the order of their names.
pub(crate) fn labelled(answer: &Which) -> String {
    let mut effects: Vec<String> = answer.effects.iter().map(|e| e.label()).collect();
    effects.sort();
    effects.join(" + ")
}
