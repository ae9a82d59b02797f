//! Whether a delay that is another one for every message has one hump or two, and where they lie.
//!
//! A reading says how likely each deviation δ of its delay from the mean is: to second order in δ, the residual at the mean less
//! what ŷ′ δ + ½ ŷ″ δ² explains is noise. One reading says little (a pixel of noise is a millisecond of a fast swing), all of them
//! together show the distribution that the delays are drawn from: the likelihood of a mixture of normal distributions is the
//! product over readings of the integral over δ, here a sum on a grid. Expectation and maximisation find it (A. P. Dempster,
//! N. M. Laird, D. B. Rubin, J. R. Stat. Soc. B 39, 1977). Two humps are told only where they make the readings so much
//! likelier that Schwarz's criterion (Annals of Statistics 6, 1978) pays for their three numbers.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Deviations that are looked at, …
const GRID: usize = 192;
/// … up to so many times the spread on either side.
const REACH: f64 = 4.5;
/// Most steps of a fit.
const STEPS: usize = 3000;
/// It has converged where a step makes the readings likelier by less, in units of the log likelihood.
const SETTLED: f64 = 1e-5;
/// Two humps are looked for from these shares of the later one.
const SHARES: [f64; 3] = [0.25, 0.5, 0.75];
/// A smaller share is no hump but a few readings that fit nothing.
const LEAST: f64 = 0.05;
/// How far apart humps begin, in spreads of the whole.
const APART: f64 = 1.5;

/// What one message says of its delay: per output the residual at the mean delay, the prediction's slope (1/s) and second
/// derivative (1/s²) by the delay, and the noise's standard deviation.
#[derive(Debug, Clone)]
pub(super) struct Reading(pub(super) Vec<[f64; 4]>);

impl Reading {
    /// The log likelihood of a deviation (s), up to a constant.
    fn log_likelihood(&self, deviation: f64) -> f64 {
        let of = |[residual, slope, bend, noise]: &[f64; 4]| {
            let left = residual - slope * deviation - 0.5 * bend * deviation * deviation;
            -0.5 * (left / noise).powi(2)
        };
        self.0.iter().map(of).sum()
    }
}

/// A normal distribution among those of a mixture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Component {
    pub(super) share: f64,
    /// From the mean delay on, s.
    pub(super) offset: f64,
    /// Standard deviation, s.
    pub(super) spread: f64,
}

/// Two humps, the earlier first.
#[derive(Debug, Clone)]
pub(super) struct Two {
    pub(super) humps: [Component; 2],
    /// Covariance of the later one's share, then of the offsets, then of the spreads.
    pub(super) covariance: DMatrix<f64>,
    /// By how much Schwarz's criterion prefers them to one, in units of −2 log likelihood.
    pub(super) evidence: f64,
}

/// The two humps of the delays that these readings had, whose standard deviation is `spread` (s); none where one says as much.
pub(super) fn two_humps(readings: &[Reading], spread: f64) -> Option<Two> {
    if readings.is_empty() || !(spread > 0.0 && spread.is_finite()) {
        return None;
    }
    let table = Table::new(readings, spread);
    let (_, one) = table.fit(vec![Component { share: 1.0, offset: 0.0, spread }]);
    let starts = SHARES.map(|share| {
        let apart = APART * spread;
        let own = (1.0 - share * (1.0 - share) * APART * APART).max(0.05).sqrt() * spread;
        vec![
            Component { share: 1.0 - share, offset: -share * apart, spread: own },
            Component { share, offset: (1.0 - share) * apart, spread: own },
        ]
    });
    let ends: Vec<(Vec<Component>, f64)> =
        starts.into_par_iter().map(|components| table.fit(components)).collect();
    let (mut found, two) = ends.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let evidence = 2.0 * (two - one) - 3.0 * (readings.len() as f64).ln();
    let substantial = found.iter().all(|component| component.share >= LEAST);
    if evidence.is_nan() || evidence <= 0.0 || !substantial {
        return None;
    }
    found.sort_by(|a, b| a.offset.total_cmp(&b.offset));
    let humps: [Component; 2] = found.try_into().ok()?;
    // One that is only wider than the other is its tail, as it shows where predictions lack something.
    if humps[1].offset - humps[0].offset < humps[0].spread.max(humps[1].spread) {
        return None;
    }
    let covariance = table.information(&humps).try_inverse()?;
    let told = covariance.diagonal().iter().all(|variance| variance.is_finite() && *variance >= 0.0);
    told.then_some(Two { humps, covariance, evidence })
}

/// How likely each deviation is by each reading.
struct Table {
    deviations: Vec<f64>,
    /// `[reading][deviation]`, the largest of each reading 1.
    likelihoods: Vec<f64>,
    step: f64,
    /// What was taken off to make it so.
    constant: f64,
}

impl Table {
    fn new(readings: &[Reading], spread: f64) -> Self {
        let step = 2.0 * REACH * spread / (GRID - 1) as f64;
        let deviations: Vec<f64> = (0..GRID).map(|i| -REACH * spread + step * i as f64).collect();
        let (mut likelihoods, mut constant) = (Vec::with_capacity(readings.len() * GRID), 0.0);
        for reading in readings {
            let logs: Vec<f64> = deviations.iter().map(|d| reading.log_likelihood(*d)).collect();
            let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            constant += most;
            likelihoods.extend(logs.iter().map(|log| (log - most).exp()));
        }
        Self { deviations, likelihoods, step, constant }
    }

    /// How likely deviations are by a component, its share apart: their sum is one.
    fn density(&self, component: &Component) -> Vec<f64> {
        let of = |d: &f64| (-0.5 * ((d - component.offset) / component.spread).powi(2)).exp();
        let mut density: Vec<f64> = self.deviations.iter().map(of).collect();
        let sum: f64 = density.iter().sum();
        density.iter_mut().for_each(|value| *value /= sum.max(f64::MIN_POSITIVE));
        density
    }

    /// The likeliest mixture from these components on, with its log likelihood.
    fn fit(&self, mut components: Vec<Component>) -> (Vec<Component>, f64) {
        let count = (self.likelihoods.len() / GRID) as f64;
        let mut before = f64::NEG_INFINITY;
        for _ in 0..STEPS {
            let densities: Vec<Vec<f64>> = components.iter().map(|c| self.density(c)).collect();
            let mixture: Vec<f64> = (0..GRID)
                .map(|i| components.iter().zip(&densities).map(|(c, density)| c.share * density[i]).sum())
                .collect();
            let (mut now, mut ratio) = (self.constant, vec![0.0; GRID]);
            for reading in self.likelihoods.chunks_exact(GRID) {
                let likely: f64 = reading.iter().zip(&mixture).map(|(l, m)| l * m).sum();
                let likely = likely.max(f64::MIN_POSITIVE);
                now += likely.ln();
                ratio.iter_mut().zip(reading).for_each(|(sum, l)| *sum += l / likely);
            }
            if now - before < SETTLED {
                break;
            }
            before = now;
            for (component, density) in components.iter_mut().zip(&densities) {
                let weights: Vec<f64> =
                    density.iter().zip(&ratio).map(|(q, ratio)| component.share * q * ratio).collect();
                let total: f64 = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
                let mean = |of: &dyn Fn(f64) -> f64| {
                    weights.iter().zip(&self.deviations).map(|(w, d)| w * of(*d)).sum::<f64>() / total
                };
                let offset = mean(&|d| d);
                // On the grid nothing is narrower than a step.
                let spread = mean(&|d| (d - offset).powi(2)).sqrt().max(self.step);
                *component = Component { share: total / count, offset, spread };
            }
        }
        (components, before)
    }

    /// The information that the readings' scores hold of the later hump's share, the offsets, and the spreads.
    fn information(&self, humps: &[Component; 2]) -> DMatrix<f64> {
        let densities = [self.density(&humps[0]), self.density(&humps[1])];
        let mut information = DMatrix::zeros(5, 5);
        for reading in self.likelihoods.chunks_exact(GRID) {
            let mut sums = [[0.0; 3]; 2];
            for ((hump, density), sums) in humps.iter().zip(&densities).zip(&mut sums) {
                for ((l, q), d) in reading.iter().zip(density).zip(&self.deviations) {
                    let (likely, off) = (l * q, (d - hump.offset) / hump.spread);
                    sums[0] += likely;
                    sums[1] += likely * off / hump.spread;
                    sums[2] += likely * (off * off - 1.0) / hump.spread;
                }
            }
            let all = humps[0].share * sums[0][0] + humps[1].share * sums[1][0];
            let [a, b] = [0, 1].map(|k| humps[k].share / all.max(f64::MIN_POSITIVE));
            let of_share = (sums[1][0] - sums[0][0]) / all.max(f64::MIN_POSITIVE);
            let scores = [of_share, a * sums[0][1], b * sums[1][1], a * sums[0][2], b * sums[1][2]];
            let score = DVector::from_row_slice(&scores);
            information += &score * score.transpose();
        }
        information
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal, StandardUniform};

    /// Readings of a mark that swings, each late by a time of its own.
    fn readings(seed: u64, humps: &[(f64, f64, f64)], count: usize) -> Vec<Reading> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let reading = |k: usize| {
            let phase = 0.37 * k as f64;
            let (slope, bend) = (600.0 * phase.sin(), 3e3 * phase.cos());
            let mut left: f64 = StandardUniform.sample(&mut random);
            let hump = humps.iter().find(|(share, ..)| {
                left -= share;
                left < 0.0
            });
            let (_, offset, spread) = hump.unwrap_or(&humps[0]);
            let drawn: f64 = StandardNormal.sample(&mut random);
            let d = offset + spread * drawn;
            let noise: f64 = StandardNormal.sample(&mut random);
            Reading(vec![[slope * d + 0.5 * bend * d * d + noise, slope, bend, 1.0]])
        };
        (0..count).map(reading).collect()
    }

    #[test]
    fn two_humps_are_found_within_what_is_stated_of_them() {
        let truth = [(0.7, -2.4e-3, 1e-3), (0.3, 5.6e-3, 1.5e-3)];
        let mut within = 0;
        for seed in 0..10 {
            let found = two_humps(&readings(seed, &truth, 1200), 3.9e-3).expect("two humps");
            let [early, late] = found.humps;
            let off = [
                late.share - 0.3,
                early.offset + 2.4e-3,
                late.offset - 5.6e-3,
                early.spread - 1e-3,
                late.spread - 1.5e-3,
            ];
            for (k, off) in off.iter().enumerate() {
                within += usize::from(off.abs() < 2.0 * found.covariance[(k, k)].sqrt());
            }
            assert!(off[0].abs() < 0.1 && off[1].abs() < 1e-3 && off[2].abs() < 1e-3, "{found:?}");
        }
        assert!(within >= 42, "{within} of 50");
    }

    #[test]
    fn one_hump_is_not_taken_for_two() {
        for seed in 0..10 {
            assert!(two_humps(&readings(seed, &[(1.0, 0.0, 2e-3)], 1200), 2e-3).is_none(), "seed {seed}");
        }
        assert!(two_humps(&[], 1e-3).is_none());
    }
}
