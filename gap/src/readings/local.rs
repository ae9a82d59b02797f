//! What a reading differs by from the polynomial through its neighbours: noise, without a model.

use crate::simulator::wrapped;
use crate::statistics::median;

/// A window longer than this many of the usual ones is a gap: nothing is interpolated across it.
const GAP: f64 = 3.0;

/// Readings of one output, and what each differs by from its neighbours.
#[derive(Clone, Debug)]
pub(super) struct Local {
    /// Stamps (s).
    pub(super) stamp: Vec<f64>,
    /// Readings.
    pub(super) value: Vec<f64>,
    wrap: Option<f64>,
    /// Neighbours on each side.
    reach: usize,
    longest: f64,
}

impl Local {
    /// With two or three neighbours on each side: as many as leave the least of the motion.
    pub(super) fn new(stamp: Vec<f64>, value: Vec<f64>, wrap: Option<f64>) -> Self {
        let period = median(&mut stamp.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>());
        let with = |reach: usize| Local {
            stamp: stamp.clone(),
            value: value.clone(),
            wrap,
            reach,
            longest: GAP * 2.0 * reach as f64 * period,
        };
        let (near, far) = (with(2), with(3));
        if far.robust() < 0.8 * near.robust() { far } else { near }
    }

    /// The residual of reading `k` in units of one reading's error: what it differs by from the interpolation, over
    /// √(1 + Σ weights²). The second value is the factor that was divided by.
    pub(super) fn residual(&self, k: usize) -> Option<(f64, f64)> {
        let (first, last) = (k.checked_sub(self.reach)?, k + self.reach);
        if last >= self.stamp.len() {
            return None;
        }
        self.from(k, &(first..=last).filter(|j| *j != k).collect::<Vec<usize>>())
    }

    /// The same from the nearest neighbours that do not count as `marked`.
    pub(super) fn residual_without(&self, k: usize, marked: &[bool]) -> Option<(f64, f64)> {
        let free = |j: &usize| !marked[*j];
        let before: Vec<usize> = (0..k).rev().filter(free).take(self.reach).collect();
        let after: Vec<usize> = (k + 1..self.stamp.len()).filter(free).take(self.reach).collect();
        if before.len().min(after.len()) < self.reach {
            return None;
        }
        self.from(k, &before.into_iter().rev().chain(after).collect::<Vec<usize>>())
    }

    /// The residual of reading `k` from the polynomial through these others, in the order of their stamps.
    fn from(&self, k: usize, others: &[usize]) -> Option<(f64, f64)> {
        let span = self.stamp[*others.last()?] - self.stamp[*others.first()?];
        if span > self.longest {
            return None;
        }
        let (mut sum, mut squares) = (0.0, 1.0);
        for &j in others {
            let weight: f64 = others
                .iter()
                .filter(|i| **i != j)
                .map(|&i| (self.stamp[k] - self.stamp[i]) / (self.stamp[j] - self.stamp[i]))
                .product();
            // Angles are followed from the reading itself.
            sum += weight * wrapped(self.value[j] - self.value[k], self.wrap);
            squares += weight * weight;
        }
        Some((-sum / squares.sqrt(), squares.sqrt()))
    }

    /// All residuals; nothing at the ends and beside gaps.
    pub(super) fn residuals(&self) -> Vec<Option<f64>> {
        (0..self.stamp.len()).map(|k| self.residual(k).map(|r| r.0)).collect()
    }

    /// Standard deviation of the noise from the median of the magnitudes.
    pub(super) fn robust(&self) -> f64 {
        let mut sizes: Vec<f64> = self.residuals().into_iter().flatten().map(f64::abs).collect();
        1.4826 * median(&mut sizes)
    }

    /// How many independent readings one residual is worth where the noise is white, and the correlation of
    /// successive residuals there.
    pub(super) fn independence(&self) -> (f64, f64) {
        let weights: &[f64] = if self.reach == 2 {
            &[1.0 / 6.0, -4.0 / 6.0, 1.0, -4.0 / 6.0, 1.0 / 6.0]
        } else {
            &[-0.05, 0.3, -0.75, 1.0, -0.75, 0.3, -0.05]
        };
        let product =
            |lag: usize| -> f64 { weights.iter().zip(&weights[lag..]).map(|(a, b)| a * b).sum::<f64>() };
        let correlations = (1..weights.len()).map(|lag| product(lag) / product(0));
        let sum: f64 = 1.0 + 2.0 * correlations.map(|c| c * c).sum::<f64>();
        (1.0 / sum, product(1) / product(0))
    }

    /// Whether the residuals are coloured as white noise colours them: what moves smoothly leaves another colour.
    pub(super) fn is_noise(&self) -> bool {
        let residuals = self.residuals();
        let (mut across, mut along) = (0.0, 0.0);
        for pair in residuals.windows(2) {
            if let [Some(a), Some(b)] = pair {
                across += a * b;
                along += 0.5 * (a * a + b * b);
            }
        }
        along > 0.0 && across / along < 0.6 * self.independence().1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn noise_is_told_from_motion() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let stamp: Vec<f64> = (0..4000).map(|k| 0.01 * f64::from(k)).collect();
        let moved: Vec<f64> = stamp.iter().map(|t| (2.0 * t).sin()).collect();
        let noisy: Vec<f64> = moved
            .iter()
            .map(|v| {
                let z: f64 = StandardNormal.sample(&mut random);
                v + 0.003 * z
            })
            .collect();
        let local = Local::new(stamp.clone(), noisy, None);
        assert!((local.robust() / 0.003 - 1.0).abs() < 0.08, "{}", local.robust());
        assert!(local.is_noise());
        let fast: Vec<f64> = stamp.iter().map(|t| (40.0 * t).sin()).collect();
        assert!(!Local::new(stamp, fast, None).is_noise());
    }
}
