//! Innovations whose variance grows with a size that differs from reading to reading: how likely they are at a scale and a floor, and which
//! floor is the likeliest.

use std::ops::Range;

use super::LogDensity;
use super::peak::peak;
use crate::statistics::root_mean_square;

/// Correlation of successive innovations up to which they count as free of a wrong mean.
const WHITE: f64 = 0.25;

/// Stretches of a log, and the share of what speaks for times of readings that scatter beyond which one of them speaks for something
/// else: the blow of a wall, which no model knows, comes while the machine is fast, and once.
const STRETCHES: usize = 40;
const MOST_OF_ONE: f64 = 0.8;

/// Most steps of the search for the floor of innovations, and the last one's relative size in its square.
const FLOOR_STEPS: usize = 20;
const FLOOR_ERROR: f64 = 1e-4;

/// Whitened innovations, and the standard deviation that one unit of an effect adds to each.
pub(super) struct Sensitivity {
    /// Innovations divided by their predicted standard deviation.
    pub(super) innovations: Vec<f64>,
    /// What one unit adds to each, in the same units.
    pub(super) size: Vec<f64>,
}

impl Sensitivity {
    /// These, where there are enough and all are numbers.
    pub(super) fn usable(self) -> Option<Self> {
        let finite = self.innovations.iter().chain(&self.size).all(|v| v.is_finite());
        (self.innovations.len() > 50 && finite && root_mean_square(&self.size) > 0.0).then_some(self)
    }

    /// Whether innovations that follow each other do not resemble each other, as those of a wrong mean do.
    pub(super) fn is_white(&self) -> bool {
        let (mut across, mut along) = (0.0, 0.0);
        for pair in self.innovations.windows(2) {
            across += pair[0] * pair[1];
            along += pair[0] * pair[0];
        }
        // Errors of single readings may leave innovations of alternating sign behind, a wrong mean does not.
        along > 0.0 && across < WHITE * along
    }

    /// Log likelihood of innovations of variance `floor`² + (scale × size)².
    pub(super) fn log(&self, scale: f64, floor: f64) -> f64 {
        self.log_of(0..self.innovations.len(), scale, floor)
    }

    /// The same of some of the readings.
    fn log_of(&self, readings: Range<usize>, scale: f64, floor: f64) -> f64 {
        let (innovations, size) = (&self.innovations[readings.clone()], &self.size[readings]);
        let (mut quadratic, mut logarithms) = (0.0, 0.0);
        // One logarithm for a few readings, whose variances are within a factor of 1e30 of one.
        for (innovations, sizes) in innovations.chunks(8).zip(size.chunks(8)) {
            let mut product = 1.0_f64;
            for (e, h) in innovations.iter().zip(sizes) {
                let variance = floor * floor + (scale * h).powi(2);
                quadratic += e * e / variance;
                product *= variance;
            }
            logarithms += product.ln();
        }
        -0.5 * (quadratic + logarithms)
    }

    /// Whether a scatter of this scale gains most of its log likelihood in one stretch.
    pub(super) fn is_of_one_stretch(&self, scale: f64) -> bool {
        let (plain, floor) = (self.floor(0.0), self.floor(scale));
        let count = self.innovations.len();
        let stretches = (0..STRETCHES).map(|k| count * k / STRETCHES..count * (k + 1) / STRETCHES);
        let gain = |readings: Range<usize>| {
            self.log_of(readings.clone(), scale, floor) - self.log_of(readings, 0.0, plain)
        };
        let gains: Vec<f64> = stretches.map(gain).collect();
        gains.iter().copied().fold(0.0, f64::max) > MOST_OF_ONE * gains.iter().sum::<f64>()
    }

    /// Log evidence for innovations that grow with the size.
    pub(super) fn by_size(&self) -> f64 {
        let floor = self.floor(0.0);
        let (natural, plain) = (floor / root_mean_square(&self.size), self.log(0.0, floor));
        let gain = |scale: f64| self.log(scale, self.floor(scale)) - plain;
        peak(1e-2 * natural, 1e2 * natural, gain).log_evidence
    }

    /// The floor that makes it largest between a tenth and 1.1 times the innovations' size: Fisher's scoring on the logarithm of its
    /// square, halving the range where that leaves it.
    pub(super) fn floor(&self, scale: f64) -> f64 {
        let size = root_mean_square(&self.innovations).max(1e-12);
        if scale == 0.0 {
            return size;
        }
        let added = (scale * root_mean_square(&self.size)).powi(2);
        let (mut low, mut high) = (2.0 * (0.1 * size).ln(), 2.0 * (1.1 * size).ln());
        let mut at = (size * size - added).max(1e-300).ln().clamp(low, high);
        for _ in 0..FLOOR_STEPS {
            let square = at.exp();
            let (mut slope, mut curvature) = (0.0, 0.0);
            for (e, h) in self.innovations.iter().zip(&self.size) {
                let share = 1.0 / (square + (scale * h).powi(2));
                slope += share - e * e * share * share;
                curvature += share * share;
            }
            if slope > 0.0 {
                high = at
            } else {
                low = at
            }
            let next = at - slope / (square * curvature);
            let next = if next > low && next < high { next } else { 0.5 * (low + high) };
            let moved = (next - at).abs();
            at = next;
            if moved < FLOOR_ERROR {
                break;
            }
        }
        (0.5 * at).exp()
    }
}

/// Mean log predictive density of held-out readings without and with a scatter of this scale.
pub(super) fn densities(train: &Sensitivity, test: &Sensitivity, scale: f64) -> LogDensity {
    let count = test.innovations.len() as f64;
    let constant = 0.5 * std::f64::consts::TAU.ln();
    let without = test.log(0.0, train.floor(0.0)) / count - constant;
    let with = test.log(scale, train.floor(scale)) / count - constant;
    LogDensity { without, with, best: with.max(without) }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn no_floor_is_likelier_than_the_one_that_is_found() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let size: Vec<f64> = (0..500).map(|_| normal().exp()).collect();
        let innovations = size.iter().map(|h| 0.8 * normal() + 0.5 * h * normal()).collect();
        let found = Sensitivity { innovations, size };
        let usual = root_mean_square(&found.innovations);
        for scale in [0.0, 0.05, 0.5, 5.0] {
            let at = found.log(scale, found.floor(scale));
            let grid = (0..=200).map(|k| usual * 0.1 * 11.0_f64.powf(f64::from(k) / 200.0));
            let best = grid.map(|floor| found.log(scale, floor)).fold(f64::NEG_INFINITY, f64::max);
            assert!(at > best - 1e-3, "{at} at {scale}, and {best}");
        }
        // What the other part of the innovations leaves is found again.
        assert!((found.floor(0.5) / 0.8 - 1.0).abs() < 0.1, "{}", found.floor(0.5));
    }
}
