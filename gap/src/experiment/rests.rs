//! Long rests: time in which no command changes and no reading moves by more than its resolution.
//!
//! A machine that stands says once where it stands; what it says again, reading by reading for as long as somebody waited, is no evidence,
//! and would outweigh the motion that a diagnosis is about.

use super::Experiment;
use crate::noise::resolution;

/// Horizons that are kept of a rest after the motion has ended, and before the next begins.
const KEPT: (f64, f64) = (4.0, 2.0);

/// Horizons of a rest that are worth leaving out: over less, states are carried on.
const WORTH: f64 = 4.0;

/// Difference of times that is none (s).
const ROUNDING: f64 = 1e-9;

impl Experiment {
    /// Leaves out the readings within long rests of a machine that moves at other times, and notes from when to when. A recording in
    /// which nothing ever moves stays as it is.
    pub fn leave_out_rests(&mut self, horizon: f64) {
        let rests = self.long_rests(horizon);
        let left_out = |stamp: f64| rests.iter().any(|(from, to)| (*from..*to).contains(&stamp));
        self.samples.retain(|sample| !left_out(sample.stamp));
        self.rests = rests;
    }

    /// How long the rests are that were left out (s), if any were.
    #[must_use]
    pub fn left_out(&self) -> Option<f64> {
        self.rests.iter().map(|(from, to)| to - from).reduce(|sum, more| sum + more)
    }

    /// What is left between two times of the rests that were left out (s).
    #[must_use]
    pub fn moving(&self, from: f64, to: f64) -> f64 {
        let within = |(a, b): &(f64, f64)| (b.min(to) - a.max(from)).max(0.0);
        to - from - self.rests.iter().map(within).sum::<f64>()
    }

    /// When so much has passed since `from` but for the rests that were left out (s): where a rest begins just then, its end.
    #[must_use]
    pub fn after(&self, from: f64, passed: f64) -> f64 {
        self.passed(from, passed, ROUNDING)
    }

    /// The same; where a rest begins just then, its beginning.
    #[must_use]
    pub fn until(&self, from: f64, passed: f64) -> f64 {
        self.passed(from, passed, -ROUNDING)
    }

    /// When so much has passed since `from`, with the rests that begin by `late` (s) after that.
    fn passed(&self, from: f64, passed: f64, late: f64) -> f64 {
        let mut at = from + passed;
        for (begin, end) in self.rests.iter().filter(|(_, end)| *end > from) {
            if *begin > at + late {
                break;
            }
            at += end - begin.max(from);
        }
        at
    }

    /// From when to when the machine rests, without what is kept of it; none where it always rests.
    fn long_rests(&self, horizon: f64) -> Vec<(f64, f64)> {
        let rests = self.rests_longer_than((KEPT.0 + KEPT.1 + WORTH) * horizon);
        let spans = self.spans();
        let total = |all: &[(f64, f64)]| all.iter().map(|(from, to)| to - from).sum::<f64>();
        if total(&spans) - total(&rests) < WORTH * horizon {
            return Vec::new();
        }
        let starts = |from: f64| spans.iter().any(|(first, _)| from <= *first);
        let ends = |to: f64| spans.iter().any(|(_, last)| to >= *last);
        // From reading to reading.
        let next = |time: f64| {
            let next = self.samples.partition_point(|sample| sample.stamp < time);
            self.samples.get(next).map_or(time, |sample| sample.stamp)
        };
        rests
            .into_iter()
            // Before the first motion there is none that ends, and after the last one none that begins.
            .map(|(from, to)| {
                let from = if starts(from) { from } else { next(from + KEPT.0 * horizon) };
                (from, if ends(to) { to + ROUNDING } else { next(to - KEPT.1 * horizon) })
            })
            .collect()
    }

    /// First and last stamps of the rests within one recording that are longer than this (s).
    fn rests_longer_than(&self, least: f64) -> Vec<(f64, f64)> {
        let steps: Vec<f64> =
            (0..self.wraps.len()).map(|output| resolution(&self.output(output).1)).collect();
        let mut rests = Vec::new();
        for (begin, end) in self.spans() {
            let first = self.samples.partition_point(|sample| sample.stamp < begin);
            let last = self.samples.partition_point(|sample| sample.stamp <= end);
            // Least and largest reading of each output since the rest began.
            let mut seen: Vec<Option<(f64, f64)>> = vec![None; steps.len()];
            let mut from = begin;
            let mut to = begin;
            for sample in &self.samples[first..last] {
                let (low, high) = seen[sample.output].unwrap_or((sample.value, sample.value));
                let (low, high) = (low.min(sample.value), high.max(sample.value));
                let moves = high - low > 1.5 * steps[sample.output] || self.is_commanded(to, sample.stamp);
                if moves {
                    if to - from > least {
                        rests.push((from, to));
                    }
                    from = sample.stamp;
                    seen.fill(None);
                    seen[sample.output] = Some((sample.value, sample.value));
                } else {
                    seen[sample.output] = Some((low, high));
                }
                to = sample.stamp;
            }
            if to - from > least {
                rests.push((from, to));
            }
        }
        rests
    }

    /// Whether a command changes after `from` and up to `to` (s).
    fn is_commanded(&self, from: f64, to: f64) -> bool {
        self.inputs.iter().any(|held| {
            let after = held.times.partition_point(|time| *time <= from);
            let until = held.times.partition_point(|time| *time <= to);
            held.values[after.saturating_sub(1)..until].windows(2).any(|pair| pair[0] != pair[1])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{Held, Sample};

    const HORIZON: f64 = 0.25;

    /// A machine that moves for two seconds from each of these times on and rests otherwise, for 30 s at 100 Hz.
    fn moving_at(times: &[f64], resolution: f64) -> Experiment {
        let stamps: Vec<f64> = (0..3000).map(|k| f64::from(k) * 0.01).collect();
        let moves = |stamp: f64| times.iter().find(|from| (**from..**from + 2.0).contains(&stamp));
        let command = |stamp: &f64| moves(*stamp).map_or(0.0, |from| (3.0 * (stamp - from)).sin());
        let values: Vec<f64> = stamps.iter().map(command).collect();
        let reads =
            |value: f64| if resolution > 0.0 { (value / resolution).round() * resolution } else { value };
        let noise = |k: usize| if resolution > 0.0 { 0.0 } else { 1e-3 * (k as f64 * 2.7).sin() };
        let sample = |(k, stamp): (usize, &f64)| Sample {
            stamp: *stamp,
            output: 0,
            value: reads(values[k]) + noise(k),
        };
        Experiment {
            samples: stamps.iter().enumerate().map(sample).collect(),
            inputs: vec![Held { times: stamps.clone(), values }],
            wraps: vec![None],
            ..Experiment::default()
        }
    }

    #[test]
    fn of_a_rest_its_beginning_and_its_end_are_kept() {
        let mut experiment = moving_at(&[0.0, 14.0], 0.01);
        experiment.leave_out_rests(HORIZON);
        let [(a, b), (c, d)] = experiment.rests[..] else { panic!("{:?}", experiment.rests) };
        assert!((2.9..3.2).contains(&a) && (13.3..13.6).contains(&b), "{a} to {b}");
        assert!((16.9..17.2).contains(&c) && d > 29.9, "{c} to {d}");
        assert!((experiment.span().1 - 17.0).abs() < 0.2, "{:?}", experiment.span());
        assert!(experiment.samples.iter().all(|sample| !(a..b).contains(&sample.stamp)));
        // Of half a minute what moves, and what is kept.
        let moving = experiment.moving(0.0, 30.0);
        assert!((moving - 6.5).abs() < 0.5, "{moving}");
        let before = experiment.moving(0.0, c);
        assert!((experiment.until(0.0, before) - c).abs() < 1e-6);
        assert!((experiment.after(0.0, before) - d).abs() < 1e-6);
        assert!((experiment.after(1.0, 1.0) - 2.0).abs() < 1e-9);
        let middle = experiment.after(0.0, a + 0.1);
        assert!((middle - b - 0.1).abs() < 1e-9, "{middle}");
    }

    #[test]
    fn noise_and_commands_are_no_rest() {
        for mut experiment in [moving_at(&[0.0], 0.0), {
            let mut held = moving_at(&[0.0], 0.01);
            held.inputs[0].values.iter_mut().enumerate().for_each(|(k, value)| *value += k as f64 * 1e-6);
            held
        }] {
            let before = experiment.clone();
            experiment.leave_out_rests(HORIZON);
            assert_eq!(experiment, before);
        }
    }

    #[test]
    fn a_machine_that_never_moves_is_left_as_it_is() {
        let mut experiment = moving_at(&[], 0.01);
        let before = experiment.clone();
        experiment.leave_out_rests(HORIZON);
        assert_eq!(experiment, before);
    }
}
