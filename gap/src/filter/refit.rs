//! Which noise makes a walk's innovations likeliest, on logarithms of variances: from a noise that is about right by Fisher scoring,
//! from anywhere by coordinate searches.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::{Local, bounded_step};

use super::{Noise, Pass};

/// The first step of a search, and the one at which it ends.
const STEPS: (f64, f64) = (1.5, 0.08);

/// A gain in −2 log likelihood that is not worth a step, and most steps.
const PROMISE: f64 = 0.05;
const ROUNDS: usize = 20;

/// How far one step of Fisher scoring goes, at most: derivatives tell little of what is a hundred times larger.
const FURTHEST: f64 = 3.0;

/// How much larger or smaller than its natural size, in units of the others', a state's process noise is taken to be.
const WIDEST: f64 = 30.0;

/// Ends where no step of any coordinate lowers the cost. `shift` takes a step along a coordinate, as far as bounds let it.
fn descend<T: Clone + PartialEq>(
    start: &T,
    coordinates: usize,
    shift: impl Fn(&mut T, usize, f64),
    cost_at: impl Fn(&T) -> f64,
) -> T {
    let (mut best, mut cost) = (start.clone(), cost_at(start));
    let mut step = STEPS.0;
    while step > STEPS.1 {
        let mut improved = false;
        for coordinate in 0..coordinates {
            for direction in [-1.0, 1.0] {
                let mut trial = best.clone();
                shift(&mut trial, coordinate, direction * step);
                if trial == best {
                    continue;
                }
                let trial_cost = cost_at(&trial);
                if trial_cost < cost {
                    (best, cost, improved) = (trial, trial_cost, true);
                    break;
                }
            }
        }
        if !improved {
            step /= 2.0;
        }
    }
    best
}

/// A step in a noise: coordinate 0 is the process noise, the others are the outputs' variances.
fn step_noise(noise: &mut Noise, coordinate: usize, step: f64, limits: &[(f64, f64)], process_floor: f64) {
    match coordinate.checked_sub(1) {
        None => noise.log_process = (noise.log_process + step).max(process_floor),
        Some(output) => {
            let (low, high) = limits[output];
            let value = &mut noise.log_output[output];
            *value = (*value + step).clamp(low, high);
        }
    }
}

impl Pass {
    /// The noise near this one that makes the innovations likeliest around this walk, as [`Pass::refit_noise`] has it; this one if
    /// none promises more. `excess` is each output's [`Pass::excess`] where this noise was the likeliest, if that is known: where they
    /// have hardly changed, the outputs' noise stays as long as the process noise does, which is far less work.
    #[must_use]
    pub fn mend_noise(
        &self,
        scale: &[f64],
        noise: &Noise,
        limits: &[(f64, f64)],
        process_floor: f64,
        excess: &[(f64, usize)],
    ) -> Noise {
        let process = scale.iter().any(|s| *s > 0.0).then_some(None);
        let free = (0..limits.len()).filter(|k| limits[*k].0 < limits[*k].1);
        let own = self.excess(limits.len());
        // What a scale of the innovations promises that differs from 1 by so much.
        let changed = free.clone().any(|k| {
            let known = excess.get(k).map_or(f64::INFINITY, |known| known.0);
            (own[k].0 - known).powi(2) > 2.0 * PROMISE * own[k].1.max(1) as f64
        });
        let mut near = noise.clone();
        if !changed {
            near = self.mend(scale, noise, process.as_slice(), limits, process_floor);
            if near == *noise {
                return near;
            }
        }
        let all: Vec<Option<usize>> = process.into_iter().chain(free.map(Some)).collect();
        self.mend(scale, &near, &all, limits, process_floor)
    }

    /// Σ (e²/s − 1) of the readings of each output that the likelihood is of, and their number: a noise under which innovations are
    /// as large as predicted leaves none.
    #[must_use]
    pub fn excess(&self, outputs: usize) -> Vec<(f64, usize)> {
        let mut excess = vec![(0.0, 0); outputs];
        let all = self.innovation.iter().zip(&self.variance).zip(&self.output).zip(&self.weighs);
        for (((e, s), output), _) in all.filter(|(_, weighs)| **weighs) {
            excess[*output].0 += e * e / s - 1.0;
            excess[*output].1 += 1;
        }
        excess
    }

    /// The likeliest noise whose variances differ from those of this one only where they are `moving`.
    fn mend(
        &self,
        scale: &[f64],
        noise: &Noise,
        moving: &[Option<usize>],
        limits: &[(f64, f64)],
        process_floor: f64,
    ) -> Noise {
        let low: Vec<f64> = moving.iter().map(|of| of.map_or(process_floor, |k| limits[k].0)).collect();
        let high: Vec<f64> = moving.iter().map(|of| of.map_or(f64::INFINITY, |k| limits[k].1)).collect();
        let mut at: Vec<f64> =
            moving.iter().map(|of| of.map_or(noise.log_process, |k| noise.log_output[k])).collect();
        let there = |at: &[f64]| {
            let mut there = noise.clone();
            for (of, value) in moving.iter().zip(at) {
                match of {
                    None => there.log_process = *value,
                    Some(k) => there.log_output[*k] = *value,
                }
            }
            there
        };
        let ones = vec![1.0; moving.len()];
        let step = |at: &[f64], local: &Local, damping: f64| {
            let information = DMatrix::from_row_slice(at.len(), at.len(), &local.information);
            let gradient = DVector::from_row_slice(&local.gradient);
            bounded_step([&low, &high, &ones], at, &information, &gradient, damping)
        };
        let mut local = self.slope(scale, &there(&at), moving);
        let mut damping = 1e-3;
        for _ in 0..ROUNDS {
            let Some(step) = step(&at, &local, damping).filter(|_| local.is_finite()) else { break };
            let trial: Vec<f64> = (0..at.len())
                .map(|k| (at[k] + step[k].clamp(-FURTHEST, FURTHEST)).clamp(low[k], high[k]))
                .collect();
            let promised: f64 = (0..at.len()).map(|k| (at[k] - trial[k]) * local.gradient[k]).sum();
            if promised < PROMISE {
                break;
            }
            let other = self.slope(scale, &there(&trial), moving);
            if other.is_finite() && other.cost < local.cost {
                (at, local) = (trial, other);
                damping = (damping * 0.2).max(1e-9);
            } else {
                damping *= 10.0;
            }
        }
        there(&at)
    }

    /// The noise that makes the innovations likeliest around this walk.
    ///
    /// `limits` bound each output's log variance, equal ones fix it; `process_floor` bounds the process noise.
    #[must_use]
    pub fn refit_noise(
        &self,
        scale: &[f64],
        noise: &Noise,
        limits: &[(f64, f64)],
        process_floor: f64,
    ) -> Noise {
        let process = scale.iter().any(|s| *s > 0.0);
        let shift = |noise: &mut Noise, coordinate: usize, step: f64| {
            if coordinate > 0 || process {
                step_noise(noise, coordinate, step, limits, process_floor);
            }
        };
        descend(noise, 1 + limits.len(), shift, |noise| self.cost_at(scale, noise))
    }

    /// The sizes of the states' process noise that make the innovations likeliest around this walk, together with the noise;
    /// from the states' natural sizes `scale`, zero for a state that only integrates another one.
    ///
    /// What a model lacks need not be in proportion to how fast its states change: the inflow of a tank may be wrong, and
    /// what flows on from it known.
    #[must_use]
    pub fn refit_scale(
        &self,
        scale: &[f64],
        noise: &Noise,
        limits: &[(f64, f64)],
        process_floor: f64,
    ) -> Vec<f64> {
        let noisy: Vec<usize> = (0..scale.len()).filter(|state| scale[*state] > 0.0).collect();
        // Logarithms of the states' variances in units of the natural ones.
        let scaled = |logs: &[f64]| -> Vec<f64> {
            let mut scaled = scale.to_vec();
            noisy.iter().zip(logs).for_each(|(state, log)| scaled[*state] *= (0.5 * log).exp());
            scaled
        };
        let widest = 2.0 * WIDEST.ln();
        let shift = |(noise, logs): &mut (Noise, Vec<f64>), coordinate: usize, step: f64| match coordinate
            .checked_sub(noisy.len())
        {
            None => logs[coordinate] = (logs[coordinate] + step).clamp(-widest, widest),
            Some(of_noise) => step_noise(noise, of_noise, step, limits, process_floor),
        };
        let start = (noise.clone(), vec![0.0; noisy.len()]);
        let count = noisy.len() + 1 + limits.len();
        let (_, logs) = descend(&start, count, shift, |(noise, logs)| self.cost_at(&scaled(logs), noise));
        scaled(&logs)
    }
}
