//! How far a fit may go: a limit that nothing reached is out of the way, a phase turns as often as it has to, and a stop is as hard
//! as it is.

use crate::axis::labelled;
use parallax_gap::experiment::{Held, Sample};
use parallax_gap::report::Report;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviation of what the sensor adds (m).
const NOISE: f64 = 0.0005;

/// A mass that starts at `start` (m) and is pushed for 20 s by what `force` makes of its position and the push; steps of 0.1 ms.
fn diagnosed(start: f64, push: impl Fn(f64) -> f64, force: impl Fn(f64, f64) -> f64) -> Report {
    const PERIOD: f64 = 0.02;
    const STEPS: u32 = 200;
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let (mut held, mut samples) = (Held::default(), Vec::new());
    let (mut q, mut v) = (start, 0.0);
    for k in 0..1000 {
        let stamp = PERIOD * f64::from(k);
        let noise: f64 = StandardNormal.sample(&mut random);
        samples.push(Sample { stamp, output: 0, value: q + NOISE * noise });
        held.times.push(stamp);
        held.values.push(push(stamp));
        let step = PERIOD / f64::from(STEPS);
        for _ in 0..STEPS {
            q += 0.5 * step * v;
            v += step * (force(q, push(stamp)) - 2.8 * v);
            q += 0.5 * step * v;
        }
    }
    crate::axis::diagnosed(NOISE, held, samples)
}

fn shaken(t: f64) -> f64 {
    1.2 * (1.9 * t).sin() + 0.9 * (5.3 * t + 1.0).sin() + 0.6 * (11.0 * t).cos()
}

#[test]
fn a_limit_that_nothing_reached_does_not_clip_what_comes_later() {
    // Only at the end, where nothing is fitted, the push goes further down.
    let push = |t: f64| shaken(t).max(if t < 15.0 { -1.0 } else { -1.2 });
    let report = diagnosed(0.0, push, |_, u| u.min(1.1));
    let best = &report.which[0];
    assert_eq!(labelled(best), "saturation@input:u", "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.95, "{}", report.summary);
    let high = best.effects[0].parameters["high"].value;
    assert!((high - 1.1).abs() < 0.02, "{high}");
    let lowest = (0..1000).map(|k| push(0.02 * f64::from(k))).fold(0.0, f64::min);
    let low = best.effects[0].parameters["low"].value;
    assert!(low < 0.999 * lowest, "{low} clips a push of {lowest}");
}

#[test]
fn a_wave_far_from_zero_is_followed_round() {
    let report = diagnosed(40.0, |t| 3.0 * shaken(t), |q, u| u + 0.6 * (7.3 * q + 1.0).sin());
    let best = &report.which[0];
    assert_eq!(labelled(best), "cogging@joint:axis", "{}", report.summary);
    let [length, height] = ["wavenumber", "amplitude"].map(|name| best.effects[0].parameters[name].value);
    assert!((length - 7.3).abs() < 0.05 && (height - 0.6).abs() < 0.03, "{length}, {height}");
}

#[test]
fn a_stop_is_as_hard_as_it_is() {
    // Eighty times what the push would bend over the way.
    let report = diagnosed(0.0, shaken, |q, u| u - 4000.0 * (q - 0.12).max(0.0));
    let best = &report.which[0];
    assert_eq!(labelled(best), "end_stop@joint:axis", "{}", report.summary);
    let [limit, stiffness] = ["limit", "stiffness"].map(|name| best.effects[0].parameters[name].value);
    assert!((limit - 0.12).abs() < 0.002 && (stiffness / 4000.0 - 1.0).abs() < 0.2, "{limit}, {stiffness}");
}
