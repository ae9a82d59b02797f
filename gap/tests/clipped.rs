//! A sensor that is at its limit for long: what happens behind it is followed, and what acts beside it is found.

use crate::axis::labelled;
use parallax_gap::experiment::{Held, Sample};
use parallax_gap::report::Report;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviation of what the sensor adds (m).
const NOISE: f64 = 0.0001;

/// Readings and commands per second.
const RATE: f64 = 100.0;

/// A mass that a controller takes from place to place for 20 s, by a sensor that reads no further than `limit` (m); what acts of a
/// push is what `acts` makes of it. Steps of 0.1 ms.
fn diagnosed(limit: f64, acts: impl Fn(f64) -> f64) -> Report {
    const STEPS: u32 = 100;
    // Those at its limit are overshot.
    let places = [0.048, -0.05, 0.04, 0.049, 0.02, -0.1, 0.045, -0.03, 0.048, 0.0, -0.08, 0.04, 0.049, -0.06];
    let mut random = ChaCha8Rng::seed_from_u64(23);
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut q, mut v, mut seen, mut speed) = (0.0_f64, 0.0_f64, 0.0, 0.0);
    for k in 0..2000_u32 {
        let stamp = f64::from(k) / RATE;
        let noise: f64 = StandardNormal.sample(&mut random);
        let read = q.min(limit) + NOISE * noise;
        samples.push(Sample { stamp, output: 0, value: read });
        speed += 0.2 * ((read - seen) * RATE - speed);
        seen = read;
        let goal = places[(k / 140) as usize % places.len()];
        let push = (40.0 * (goal - read) - 3.0 * speed).clamp(-3.0, 3.0);
        held.times.push(stamp);
        held.values.push(push);
        let step = 1.0 / RATE / f64::from(STEPS);
        for _ in 0..STEPS {
            q += 0.5 * step * v;
            v += step * (acts(push) - 2.8 * v);
            q += 0.5 * step * v;
        }
    }
    crate::axis::diagnosed(NOISE, held, samples)
}

#[test]
fn a_deadband_behind_a_sensor_at_its_limit_is_found() {
    let report = diagnosed(0.05, |push| push.signum() * (push.abs() - 0.15).max(0.0));
    let best = &report.which[0];
    assert_eq!(labelled(best), "deadband@input:u + sensor_saturation@output:position", "{}", report.summary);
    assert!(best.probability > 0.9, "{}", report.summary);
    let of = |effect: &str, name: &str| {
        best.effects.iter().find(|e| e.name == effect).expect("named").parameters[name].clone()
    };
    let (width, high) = (of("deadband", "width"), of("sensor_saturation", "high"));
    assert!((width.value - 0.15).abs() < 0.02, "{width:?}");
    assert!((high.value - 0.05).abs() < 0.001, "{high:?}");
    let left = report.how_far.with_effect;
    assert!(left < 2.0, "{left}: {}", report.summary);
}
