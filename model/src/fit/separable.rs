//! Least squares in which some parameters enter linearly: they are solved for, never searched.
//!
//! For `y ≈ Φ(θ) c` the best coefficients at any `θ` are those of a linear least-squares problem, and what is left to
//! minimise is the part of `y` that `Φ(θ)` does not span: variable projection (G. H. Golub and V. Pereyra, *The
//! Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose Variables Separate*, SIAM J. Numer. Anal.
//! 10, 1973). Its Gauss–Newton step, without the term that L. Kaufman (BIT 15, 1975) leaves out, is that of the whole
//! problem with the coefficients eliminated ([`eliminate`]).

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::Local;

/// Normal equations of `y ≈ Φ c`, summed sample by sample.
#[derive(Debug, Clone, PartialEq)]
pub struct Sums {
    /// ΦᵀΦ, row by row.
    pub gram: Vec<f64>,
    /// Φᵀy.
    pub right: Vec<f64>,
    /// yᵀy.
    pub square: f64,
}

/// A singular value below this share of the largest counts as zero, whatever the sums are known to.
const RANK: f64 = 1e-12;

/// How many times the rounding of a number that of a sum is taken to be: of some hundreds to thousands that round to either side.
const ROUNDED: f64 = 8.0;

impl Sums {
    /// Of nothing yet, for `coefficients` of them.
    #[must_use]
    pub fn new(coefficients: usize) -> Self {
        Self { gram: vec![0.0; coefficients * coefficients], right: vec![0.0; coefficients], square: 0.0 }
    }

    /// Adds a sample: a row of Φ and what it should give.
    pub fn add(&mut self, row: &[f64], y: f64) {
        for (i, a) in row.iter().enumerate() {
            for (j, b) in row.iter().enumerate() {
                self.gram[i * row.len() + j] += a * b;
            }
            self.right[i] += a * y;
        }
        self.square += y * y;
    }

    /// The best coefficients, the smallest of them where several are equally good, and the sum of squares left over, which is no
    /// less than what rounding may have taken from it. `epsilon` is that of the numbers in which the sums were formed. Not a number
    /// where the sums are not finite.
    #[must_use]
    pub fn solve(&self, epsilon: f64) -> (Vec<f64>, f64) {
        let k = self.right.len();
        if k == 0 {
            return (Vec::new(), self.square);
        }
        let gram = DMatrix::from_row_slice(k, k, &self.gram);
        let right = DVector::from_row_slice(&self.right);
        if gram.iter().chain(right.iter()).any(|value| !value.is_finite()) {
            return (vec![f64::NAN; k], f64::NAN);
        }
        // Columns in units of their length, so that what is negligible does not depend on units.
        let scale = DVector::from_fn(k, |i, _| {
            let length = gram[(i, i)].sqrt();
            if length > 0.0 { 1.0 / length } else { 0.0 }
        });
        let scaled = DMatrix::from_fn(k, k, |i, j| gram[(i, j)] * scale[i] * scale[j]);
        let target = right.component_mul(&scale);
        let rank = RANK.max(ROUNDED * epsilon);
        let coefficients = match well_conditioned(&scaled, (1e3 * RANK).max(10.0 * rank)) {
            Some(factor) => factor.solve(&target),
            None => {
                let SymmetricEigen { eigenvectors, eigenvalues } = scaled.symmetric_eigen();
                let largest = eigenvalues.max();
                let mut along = eigenvectors.transpose() * target;
                for (value, eigen) in along.iter_mut().zip(eigenvalues.iter()) {
                    *value = if *eigen > rank * largest { *value / eigen } else { 0.0 };
                }
                eigenvectors * along
            }
        };
        let coefficients = coefficients.component_mul(&scale);
        let explained =
            2.0 * coefficients.dot(&right) - (coefficients.transpose() * &gram * &coefficients)[0];
        // Large coefficients of columns that nearly depend on each other cancel: of a difference of large sums little is known.
        let sizes = coefficients.abs();
        let size = self.square + 2.0 * sizes.dot(&right.abs()) + (sizes.transpose() * gram.abs() * &sizes)[0];
        let left = (self.square - explained).max(ROUNDED * epsilon * size);
        (coefficients.iter().copied().collect(), left)
    }
}

/// A Cholesky factor, unless a pivot squared says that columns nearly depend on each other.
fn well_conditioned(
    matrix: &DMatrix<f64>,
    least_square: f64,
) -> Option<nalgebra::Cholesky<f64, nalgebra::Dyn>> {
    let factor = matrix.clone().cholesky()?;
    let least = factor.l_dirty().diagonal().min();
    (least * least > least_square).then_some(factor)
}

/// Eliminates the last `linear` parameters of a Gauss–Newton model: the Schur complement. Where they are at their best, it
/// is the model of the loss that variable projection leaves.
#[must_use]
pub fn eliminate(local: &Local, linear: usize) -> Local {
    let all = local.gradient.len();
    let kept = all - linear;
    if linear == 0 {
        return local.clone();
    }
    let information = DMatrix::from_row_slice(all, all, &local.information);
    let gradient = DVector::from_row_slice(&local.gradient);
    let inner = information.view((kept, kept), (linear, linear)).clone_owned();
    let cross = information.view((0, kept), (kept, linear)).clone_owned();
    let inverse = pseudo_inverse(&inner);
    let through = &cross * inverse;
    let information = information.view((0, 0), (kept, kept)) - &through * cross.transpose();
    let gradient = gradient.rows(0, kept) - through * gradient.rows(kept, linear);
    Local {
        cost: local.cost,
        information: (0..kept * kept).map(|at| information[(at / kept, at % kept)]).collect(),
        gradient: gradient.iter().copied().collect(),
    }
}

/// The Moore–Penrose inverse of a symmetric matrix, in units of its diagonal.
#[must_use]
pub fn pseudo_inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let k = matrix.nrows();
    let scale = DVector::from_fn(k, |i, _| {
        let size = matrix[(i, i)].sqrt();
        if size > 0.0 { 1.0 / size } else { 0.0 }
    });
    let scaled = DMatrix::from_fn(k, k, |i, j| matrix[(i, j)] * scale[i] * scale[j]);
    let SymmetricEigen { eigenvectors, eigenvalues } = scaled.symmetric_eigen();
    let largest = eigenvalues.max().max(0.0);
    let inverse = eigenvalues.map(|value| if value > RANK * largest { 1.0 / value } else { 0.0 });
    let whole = &eigenvectors * DMatrix::from_diagonal(&inverse) * eigenvectors.transpose();
    DMatrix::from_fn(k, k, |i, j| whole[(i, j)] * scale[i] * scale[j])
}
