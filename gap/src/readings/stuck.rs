//! Readings that repeat the one before, beyond what steps and standstill explain.

use std::f64::consts::SQRT_2;

use parallax_runtime::delay::special::normal_cdf;

use super::lattice::{Lattice, SHOW_A_LATTICE};
use super::local::Local;
use super::peak::{Peak, peak};
use crate::simulator::wrapped;

/// Probability that two readings with noise and no steps are equal by chance.
const BY_CHANCE: f64 = 1e-6;

/// Repeats of one output.
#[derive(Clone, Debug)]
pub(super) struct Repeats {
    /// Per reading: whether it repeats the one before, and how probable that was without the effect.
    pub(super) repeats: Vec<(bool, f64)>,
}

/// Looks at every reading after the first. At the ends of the log, readings that repeat up to one of the `rests` which were left out are
/// those of a machine that stands.
pub(super) fn repeats(
    local: &Local,
    rests: &[(f64, f64)],
    wrap: Option<f64>,
    lattice: Option<Lattice>,
) -> Repeats {
    let (value, n) = (&local.value, local.value.len());
    let largest = value.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let step = lattice.map_or_else(|| at_most(value, 1e-12 * largest), |l| l.step);
    // Rounding is part of what neighbours show of the noise.
    let noise = (local.robust().powi(2) - step * step / 12.0).max(0.0).sqrt();
    let same = |k: usize| (value[k] - value[k - 1]).abs() <= 1e-12 * largest;
    let mut out = vec![(false, 0.0); n];
    let mut k = 1;
    while k < n {
        if !same(k) {
            k += 1;
            continue;
        }
        let first = k - 1;
        while k < n && same(k) {
            k += 1;
        }
        // Motion over the run, from the reading before it to the one after it; at the ends of the log that of as many readings
        // beside it.
        let length = k - first;
        let motion =
            |from: usize, to: usize| wrapped(value[to] - value[from], wrap).abs() / (to - from) as f64;
        let rests_before = || rests.first().is_some_and(|(_, to)| *to <= local.stamp[0]);
        let rests_after = || rests.last().is_some_and(|(from, _)| *from > local.stamp[n - 1]);
        let chord = match (first.checked_sub(1), k < n) {
            (Some(_), false) if rests_after() => 0.0,
            (None, true) if rests_before() => 0.0,
            (Some(before), true) => motion(before, k),
            (Some(_), false) => motion(first.saturating_sub(length), first),
            (None, true) => motion(k - 1, (k - 1 + length).min(n - 1)),
            (None, false) => 0.0,
        };
        let still = chord <= 1e-9 * largest;
        let probability = if still {
            1.0
        } else if step > 0.0 {
            in_one_step(chord, SQRT_2 * noise, step)
        } else {
            BY_CHANCE
        };
        for entry in &mut out[first + 1..k] {
            *entry = (true, probability.clamp(BY_CHANCE, 1.0));
        }
    }
    Repeats { repeats: out }
}

/// The longest step of which readings can be that hardly ever change, those of a machine that rests: too few changes show a lattice,
/// and none rules it out. 0 where there are enough.
fn at_most(value: &[f64], rounding: f64) -> f64 {
    let changes = value.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|change| *change > rounding);
    let (count, least) = changes.fold((0, f64::INFINITY), |(count, least), c| (count + 1, c.min(least)));
    if count < SHOW_A_LATTICE && least.is_finite() { least } else { 0.0 }
}

/// Probability that two readings round to one step while the quantity moves by `motion` and noise of `std` is added.
fn in_one_step(motion: f64, std: f64, step: f64) -> f64 {
    // Averaged over where in the step the first reading lies: E max(0, 1 − |motion + noise|/step).
    let points = 21;
    let (mut sum, mut weights) = (0.0, 0.0);
    for k in 0..points {
        let z = -3.0 + 6.0 * f64::from(k) / f64::from(points - 1);
        let weight = normal_cdf(z + 0.15) - normal_cdf(z - 0.15);
        sum += weight * (1.0 - (motion + z * std).abs() / step).max(0.0);
        weights += weight;
    }
    sum / weights
}

impl Repeats {
    /// Log likelihood of a rate over the readings in `range`, less that of no effect.
    pub(super) fn gain(&self, rate: f64, range: std::ops::Range<usize>) -> f64 {
        self.repeats[range]
            .iter()
            .map(|(repeated, p)| if *repeated { (rate / p + 1.0 - rate).ln() } else { (1.0 - rate).ln() })
            .sum()
    }

    /// The rate's posterior.
    pub(super) fn rate(&self, range: std::ops::Range<usize>) -> Peak {
        peak(1e-4, 0.95, |rate| self.gain(rate, range.clone()))
    }

    /// By how much less is known of the rate where a sensor sticks for several readings at a time: the ratio of its standard deviation to
    /// that of readings each of which repeats the one before by itself. Of runs at random times the variance of their sum is the sum of
    /// their squares.
    pub(super) fn spread(&self, rate: f64, range: std::ops::Range<usize>) -> f64 {
        let stuck = self.stuck(rate);
        let runs = stuck[range].chunk_by(|a, b| a == b).filter(|run| run[0]).map(|run| run.len() as f64);
        let (sum, squares) =
            runs.fold((0.0, 0.0), |(sum, squares), length| (sum + length, squares + length * length));
        let by_themselves = sum * (1.0 + rate) / (1.0 - rate);
        if squares > by_themselves { (squares / by_themselves).sqrt() } else { 1.0 }
    }

    /// Readings that are stuck rather than equal by chance, at this rate.
    pub(super) fn stuck(&self, rate: f64) -> Vec<bool> {
        self.repeats.iter().map(|(repeated, p)| *repeated && *p < 0.2 * rate).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stuck(values: Vec<f64>) -> usize {
        let stamps = (0..values.len()).map(|k| 0.01 * k as f64).collect();
        let repeats = repeats(&Local::new(stamps, values, None), &[], None, None);
        repeats.stuck(0.95).iter().filter(|stuck| **stuck).count()
    }

    #[test]
    fn a_machine_that_rests_is_not_stuck() {
        // An encoder that stands between two of its steps, and then on one of them.
        let resting = |k: usize| if k < 60 || k == 63 { -0.0116 } else { -0.01 };
        assert_eq!(stuck((0..200).map(resting).collect()), 0);
    }

    #[test]
    fn less_is_known_of_the_rate_of_a_sensor_that_sticks_for_a_while() {
        // One of ten readings is old: one by one, and five at a time.
        let of = |old: fn(usize) -> usize| {
            let values = (0..1000).map(|k| (0.05 * old(k) as f64).sin()).collect();
            let stamps = (0..1000).map(|k| 0.01 * f64::from(k)).collect();
            let repeats = repeats(&Local::new(stamps, values, None), &[], None, None);
            let count = repeats.stuck(0.1).iter().filter(|stuck| **stuck).count();
            (count, repeats.spread(0.1, 1..1000))
        };
        let (count, alone) = of(|k| if k % 10 == 7 { k - 1 } else { k });
        assert_eq!((count, alone), (100, 1.0));
        let (count, five) = of(|k| if k % 50 > 44 { k - k % 50 + 44 } else { k });
        assert_eq!(count, 100);
        assert!((five - (5.0 * 0.9 / 1.1_f64).sqrt()).abs() < 1e-9, "{five}");
    }

    #[test]
    fn a_sensor_that_repeats_itself_in_motion_is() {
        let moving = |k: usize| (0.05 * k as f64).sin();
        let repeating = |k: usize| moving(if k % 50 == 7 { k - 1 } else { k });
        assert_eq!(stuck((0..200).map(repeating).collect()), 4);
        assert_eq!(stuck((0..200).map(moving).collect()), 0);
    }
}
