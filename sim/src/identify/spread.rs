//! How sure the estimates are.
//!
//! The information says how sure, if predictions lack nothing but noise that is another one for every reading. Where they lack
//! something else, as a search does that ends at a local minimum near the noise, or a simulator that rounds times, what they lack
//! is alike for a while, and every part of a recording pulls the estimates somewhere else. How far they scatter when each part
//! is left out in turn is the jackknife's estimate of their covariance (B. Efron, *The Jackknife, the Bootstrap and Other
//! Resampling Plans*, SIAM 1982, with parts of the time in the place of readings: H. R. Künsch, Annals of Statistics 17, 1989),
//! here by one Gauss–Newton step for each part. In every direction the larger of the two counts.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// How sure the coordinates are, which stand in widths of their bounds.
pub(super) struct Spread {
    /// Their covariance; directions without any information are as wide as [`OPEN`].
    pub(super) covariance: DMatrix<f64>,
}

/// What a part of the recordings adds to the information and to the gradient.
pub(super) struct Part {
    pub(super) information: DMatrix<f64>,
    pub(super) gradient: DVector<f64>,
}

/// What the data say nothing of has this standard deviation, in widths of the bounds.
const OPEN: f64 = 1e3;
/// What has a larger one is not determined: it could be anywhere between its bounds.
const LOOSE: f64 = 1.0;
/// Share of the information in a direction that is left without a part, at least.
const LEAST: f64 = 1e-2;
/// So few parts say nothing of how much they differ.
const FEW: usize = 8;

impl Spread {
    /// Of this information.
    pub(super) fn new(information: &DMatrix<f64>) -> Self {
        let (vectors, variances) = directions(information);
        Self { covariance: &vectors * DMatrix::from_diagonal(&variances) * vectors.transpose() }
    }

    /// Of this information, and of how much the parts whose sum it is differ. `inflation` is that of the noise in
    /// `information`, which the parts do not have.
    pub(super) fn of_parts(information: &DMatrix<f64>, inflation: f64, parts: &[Part]) -> Self {
        if parts.len() < FEW {
            return Self::new(information);
        }
        let (vectors, variances) = directions(information);
        let root = variances.map(f64::sqrt);
        // Turns coordinates in which the information's covariance is one into ours.
        let colour = &vectors * DMatrix::from_diagonal(&root);
        let n = information.nrows();
        let total = parts.iter().fold(DVector::zeros(n), |sum: DVector<f64>, part| sum + &part.gradient);
        let moves: Vec<DVector<f64>> = parts
            .iter()
            .map(|part| {
                let rest =
                    DMatrix::identity(n, n) * inflation - colour.transpose() * &part.information * &colour;
                // At the minimum what the others pull is what this one does, the other way; priors pull as before.
                let pull = colour.transpose() * (&part.gradient - &total / parts.len() as f64);
                // What a part alone tells is not known without it: it moves no further than this.
                let SymmetricEigen { eigenvectors, eigenvalues } = rest.symmetric_eigen();
                let along = eigenvectors.transpose() * pull;
                let moved = along.zip_map(&eigenvalues, |by, left| by / left.max(LEAST * inflation));
                eigenvectors * moved
            })
            .filter(|by| by.iter().all(|value| value.is_finite()))
            .collect();
        let count = moves.len() as f64;
        if moves.len() < FEW {
            return Self::new(information);
        }
        let mean = moves.iter().fold(DVector::zeros(n), |sum: DVector<f64>, by| sum + by) / count;
        let mut scatter = DMatrix::zeros(n, n);
        for by in &moves {
            let off = by - &mean;
            scatter += &off * off.transpose();
        }
        scatter *= (count - 1.0) / count;
        let SymmetricEigen { eigenvectors, eigenvalues } = scatter.symmetric_eigen();
        let larger = &colour * eigenvectors;
        let eigenvalues = eigenvalues.map(|value| value.max(1.0));
        Self { covariance: &larger * DMatrix::from_diagonal(&eigenvalues) * larger.transpose() }
    }

    /// The standard deviation of a coordinate, in widths of its bounds.
    pub(super) fn std(&self, index: usize) -> f64 {
        self.covariance[(index, index)].max(0.0).sqrt()
    }

    /// Whether the data determine a coordinate by itself.
    pub(super) fn determines(&self, index: usize) -> bool {
        self.std(index) < LOOSE
    }
}

/// The directions of an information matrix, and the variance along each.
fn directions(information: &DMatrix<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let SymmetricEigen { eigenvectors, eigenvalues } = information.clone().symmetric_eigen();
    let variances = eigenvalues.map(|value| 1.0 / (value.max(0.0) + OPEN.powi(-2)));
    (eigenvectors, variances)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// A constant and a slope over time fitted to noise that stays for `alike` readings, in 40 parts: the standard deviation
    /// that is stated of both, over that at which they scatter.
    fn stated_over_true(alike: usize) -> [f64; 2] {
        const READINGS: usize = 1200;
        const TRIES: usize = 60;
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let (mut stated, mut true_squares) = ([0.0; 2], [0.0; 2]);
        for _ in 0..TRIES {
            let mut noise = Vec::new();
            while noise.len() < READINGS {
                let value: f64 = StandardNormal.sample(&mut random);
                noise.extend(std::iter::repeat_n(value, alike));
            }
            let row = |k: usize| DVector::from_vec(vec![1.0, k as f64 / READINGS as f64 - 0.5]);
            let of = |range: std::ops::Range<usize>, by: &DVector<f64>| {
                let mut part = Part { information: DMatrix::zeros(2, 2), gradient: DVector::zeros(2) };
                for k in range {
                    let row = row(k);
                    part.information += &row * row.transpose();
                    part.gradient -= &row * (noise[k] - row.dot(by));
                }
                part
            };
            let start = of(0..READINGS, &DVector::zeros(2));
            let Some(factor) = start.information.cholesky() else { panic!("two rows differ") };
            let found = -factor.solve(&start.gradient);
            let parts: Vec<Part> =
                (0..40).map(|k| of(k * READINGS / 40..(k + 1) * READINGS / 40, &found)).collect();
            let whole = of(0..READINGS, &found);
            let spread = Spread::of_parts(&whole.information, 1.0, &parts);
            for i in 0..2 {
                stated[i] += spread.covariance[(i, i)] / TRIES as f64;
                true_squares[i] += found[i] * found[i] / TRIES as f64;
            }
        }
        [0, 1].map(|i| (stated[i] / true_squares[i]).sqrt())
    }

    #[test]
    fn noise_that_stays_widens_what_is_stated() {
        // Independent noise: nearly what the information says.
        for ratio in stated_over_true(1) {
            assert!((0.9..1.4).contains(&ratio), "{ratio}");
        }
        // The information alone would state a fourth of what is true.
        for ratio in stated_over_true(16) {
            assert!((0.7..1.4).contains(&ratio), "{ratio}");
        }
    }

    #[test]
    fn what_no_part_tells_stays_open() {
        let part = |sign: f64| Part {
            information: DMatrix::from_row_slice(2, 2, &[1e4, 0.0, 0.0, 0.0]),
            gradient: DVector::from_vec(vec![300.0 * sign, 0.0]),
        };
        let parts: Vec<Part> = (0..20).map(|k| part(if k % 2 == 0 { 1.0 } else { -1.0 })).collect();
        let spread = Spread::of_parts(&DMatrix::from_row_slice(2, 2, &[2e5, 0.0, 0.0, 0.0]), 1.0, &parts);
        assert!(spread.determines(0) && !spread.determines(1));
        // Each part pulls three times as far as its noise: the information says √(1/2e5).
        assert!((spread.std(0) / (3.0 / 2e5_f64.sqrt()) - 1.0).abs() < 0.1, "{}", spread.std(0));
    }
}
