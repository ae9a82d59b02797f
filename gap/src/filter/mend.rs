//! Which noise makes a walk's innovations likeliest, from one that is about right: Fisher scoring on logarithms of variances.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::{Local, bounded_step};

use super::{Noise, Pass};

/// A gain in −2 log likelihood that is not worth a step, and most steps.
const PROMISE: f64 = 0.05;
const ROUNDS: usize = 20;

/// How far one step of Fisher scoring goes, at most: derivatives tell little of what is a hundred times larger.
const FURTHEST: f64 = 3.0;

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
}
