//! Which noise makes a walk's innovations likeliest: searches by parabolas along one logarithm of a variance after the other.

use super::{Noise, Pass};

/// The first step of a search along a coordinate, the shortest and the longest.
const STEPS: (f64, f64, f64) = (0.6, 0.2, 6.0);

/// How near to the lowest point of a coordinate is near enough.
const NEAR: f64 = 0.05;

/// What a step lowers a cost by at least, as a step of the parameters does.
const GAIN: f64 = 1e-2;

/// Most rounds through the coordinates.
const ROUNDS: usize = 60;

/// How far coordinates move, all together, until those that rest are asked again.
const AGAIN: f64 = 1.0;

/// How much larger or smaller than its natural size, in units of the others', a state's process noise is taken to be.
const WIDEST: f64 = 30.0;

/// Ends where no coordinate lowers the cost any further. `shift` takes a step along a coordinate, as far as bounds let it.
fn descend<T: Clone + PartialEq>(
    start: &T,
    coordinates: usize,
    shift: impl Fn(&mut T, usize, f64),
    cost_at: impl Fn(&T) -> f64,
) -> T {
    let (mut best, mut cost) = (start.clone(), cost_at(start));
    let mut steps = vec![STEPS.0; coordinates];
    // Most stay where they are: one that does rests while the others go on.
    let mut rests = vec![false; coordinates];
    let mut moved = 0.0;
    for _ in 0..ROUNDS {
        for (coordinate, (step, rests)) in steps.iter_mut().zip(&mut rests).enumerate() {
            if *rests {
                continue;
            }
            let at = |far: f64| {
                let mut there = best.clone();
                shift(&mut there, coordinate, far);
                let cost = if there == best { f64::NAN } else { cost_at(&there) };
                (far, there, if cost.is_nan() { f64::INFINITY } else { cost })
            };
            let (down, up) = (at(-*step), at(*step));
            let curvature = down.2 + up.2 - 2.0 * cost;
            // The lowest point of the parabola through all three.
            let lowest = (0.5 * *step * (down.2 - up.2) / curvature).clamp(-3.0 * *step, 3.0 * *step);
            let mut tries = vec![down, up];
            if curvature > 0.0 && curvature.is_finite() && lowest.abs() > NEAR {
                tries.push(at(lowest));
            }
            let found = tries.into_iter().min_by(|a, b| a.2.total_cmp(&b.2)).filter(|t| t.2 < cost - GAIN);
            let far = found.as_ref().map_or(0.0, |(far, ..)| far.abs());
            *rests = far < STEPS.1;
            *step = (2.0 * far).clamp(STEPS.1, STEPS.2);
            moved += far;
            if let Some((_, there, lower)) = found {
                (best, cost) = (there, lower);
            }
        }
        if rests.iter().all(|rests| *rests) {
            if moved < AGAIN {
                break;
            }
            rests.fill(false);
            moved = 0.0;
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
