//! Commands that are late where they are large are told from commands that are late, and from commands that are late by chance: the
//! first is no effect of the library, and said to be there.

use std::collections::VecDeque;

use crate::axis::labelled;
use parallax_gap::experiment::{Held, Sample};
use parallax_gap::report::Report;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviation of what the sensor adds (m).
const NOISE: f64 = 0.0005;

/// A mass that is pushed for 20 s by commands that each act after a time of their own (s), of what they are and of a draw; in the
/// order in which they were sent; what is asked for changes every 0.1 s. Steps of 0.2 ms.
fn diagnosed(mut late: impl FnMut(f64, f64) -> f64) -> Report {
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
        samples.push(Sample { stamp, output: 0, value: q + NOISE * draw() });
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
    crate::axis::diagnosed(NOISE, held, samples)
}

#[test]
fn what_befalls_large_commands_is_outside_the_library() {
    let report = diagnosed(|push, _| if push.abs() > 1.1 { 0.06 } else { 0.0 });
    assert!(report.unexplained.probability > 0.9, "{}", report.summary);
    let hint = report.unexplained.hint.as_deref().expect("it is known to be there");
    let numbers: Vec<f64> = hint.split([' ', ',']).filter_map(|word| word.parse().ok()).collect();
    let near = numbers.iter().zip([0.06, -1.1, 1.1]).all(|(found, truth)| (found / truth - 1.0).abs() < 0.05);
    assert!(numbers.len() == 3 && near, "{hint}");
    assert!(report.summary.contains(hint), "{}", report.summary);
}

#[test]
fn what_befalls_all_is_an_effect() {
    let report = diagnosed(|_, _| 0.06);
    assert_eq!(labelled(&report.which[0]), "delay@input:u", "{}", report.summary);
    assert!(report.which[0].probability > 0.9 && report.unexplained.hint.is_none(), "{}", report.summary);
}

#[test]
fn chance_is_an_effect_as_well() {
    let report = diagnosed(|_, draw| 0.02 * draw.abs());
    assert_eq!(labelled(&report.which[0]), "jitter@input:u", "{}", report.summary);
    assert!(report.which[0].probability > 0.9 && report.unexplained.hint.is_none(), "{}", report.summary);
}
