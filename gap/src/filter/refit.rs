//! Which noise makes a walk's innovations likeliest, from anywhere: coordinate searches on logarithms of variances.

use super::{Noise, Pass};

/// The first step of a search, and the one at which it ends.
const STEPS: (f64, f64) = (1.5, 0.08);

/// How much larger or smaller than its natural size, in units of the others', a state's process noise is taken to be.
const WIDEST: f64 = 30.0;

/// Ends where no step of any coordinate lowers the cost. `shift` takes a step along a coordinate, as far as bounds let it. Where there
/// are threads both directions are tried at once; the first that is lower is taken either way.
fn descend<T: Clone + PartialEq + Send + Sync>(
    start: &T,
    coordinates: usize,
    shift: impl Fn(&mut T, usize, f64) + Sync,
    cost_at: impl Fn(&T) -> f64 + Sync,
) -> T {
    let (mut best, mut cost) = (start.clone(), cost_at(start));
    let mut step = STEPS.0;
    while step > STEPS.1 {
        let mut improved = false;
        for coordinate in 0..coordinates {
            let towards = |direction: f64| {
                let mut trial = best.clone();
                shift(&mut trial, coordinate, direction * step);
                let trial_cost = if trial == best { f64::INFINITY } else { cost_at(&trial) };
                (trial_cost < cost).then_some((trial, trial_cost))
            };
            let found = if rayon::current_num_threads() > 1 {
                let (down, up) = rayon::join(|| towards(-1.0), || towards(1.0));
                down.or(up)
            } else {
                towards(-1.0).or_else(|| towards(1.0))
            };
            if let Some(found) = found {
                (best, cost) = found;
                improved = true;
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
