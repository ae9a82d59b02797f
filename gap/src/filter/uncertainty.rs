//! How well the state of an exact model is known along one walk, step by step.

use super::lanes::{Pattern, innovate, propagate, update};

/// The covariance of the state along a walk.
#[derive(Clone, Debug)]
pub struct Uncertainty {
    /// States × states.
    covariance: Vec<f64>,
    gain: Vec<f64>,
    scratch: Vec<f64>,
    all: Vec<usize>,
    whole: Pattern,
    quiet: Vec<f64>,
}

impl Uncertainty {
    /// Of states that are known to these standard deviations.
    #[must_use]
    pub fn new(std: &[f64]) -> Self {
        let n = std.len();
        let mut covariance = vec![0.0; n * n];
        for (i, std) in std.iter().enumerate() {
            covariance[i * n + i] = std * std;
        }
        let all: Vec<usize> = (0..n).collect();
        let whole = Pattern(vec![all.clone(); n]);
        let (zero, scratch) = (vec![0.0; n], vec![0.0; 2 * n * n]);
        Self { covariance, gain: zero.clone(), scratch, all, whole, quiet: zero }
    }

    /// A step by its transition, without process noise.
    pub fn advance(&mut self, by_state: &[f64]) {
        propagate(&self.whole, by_state, 0.0, &self.quiet, &mut self.covariance, &mut self.scratch);
    }

    /// A reading with gradient `h` and this `noise` (variance).
    pub fn read(&mut self, h: &[f64], noise: f64) {
        let variance = innovate(&self.all, h, noise, false, &self.covariance, &mut self.gain);
        update(self.all.len(), &self.gain, variance, false, &mut self.covariance);
    }

    /// The variance of a reading with gradient `h`, without its own noise: h P hᵀ.
    #[must_use]
    pub fn variance(&self, h: &[f64]) -> f64 {
        let rows = self.covariance.chunks(h.len().max(1)).zip(h);
        let along = rows.map(|(row, hi)| hi * row.iter().zip(h).map(|(p, hj)| p * hj).sum::<f64>());
        along.sum::<f64>().max(0.0)
    }
}
