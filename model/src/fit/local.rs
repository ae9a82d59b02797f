//! A loss around one point, and damped steps from it.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// A loss around one point: its value and its Gauss–Newton model, all without the priors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Local {
    /// The loss: −2 log likelihood.
    pub cost: f64,
    /// Half its Hessian, JᵀJ of the whitened residuals by θ, p × p row by row.
    pub information: Vec<f64>,
    /// Half its gradient, Jᵀe.
    pub gradient: Vec<f64>,
}

impl Local {
    /// A loss of zero that depends on none of `parameters`.
    #[must_use]
    pub fn zero(parameters: usize) -> Self {
        Self { cost: 0.0, information: vec![0.0; parameters * parameters], gradient: vec![0.0; parameters] }
    }

    /// Whether everything is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.cost.is_finite() && self.information.iter().chain(&self.gradient).all(|value| value.is_finite())
    }
}

/// A damped Newton step (K. Levenberg 1944, D. W. Marquardt 1963) from `theta` in a box whose corners are `low` and
/// `high`: the Hessian's diagonal, in units of `scale`, grows by the factor `1 + damping`. Parameters are held where they
/// rest on a bound and the slope points outside. None where the damped Hessian is not positive definite.
#[must_use]
pub fn bounded_step(
    [low, high, scale]: [&[f64]; 3],
    theta: &[f64],
    hessian: &DMatrix<f64>,
    gradient: &DVector<f64>,
    damping: f64,
) -> Option<Vec<f64>> {
    let free: Vec<usize> = (0..theta.len())
        .filter(|&i| {
            !((theta[i] <= low[i] && gradient[i] > 0.0) || (theta[i] >= high[i] && gradient[i] < 0.0))
        })
        .collect();
    let mut matrix = DMatrix::zeros(free.len(), free.len());
    let mut right = DVector::zeros(free.len());
    for (a, &i) in free.iter().enumerate() {
        for (b, &j) in free.iter().enumerate() {
            matrix[(a, b)] = hessian[(i, j)] * scale[i] * scale[j];
        }
        right[a] = -gradient[i] * scale[i];
    }
    let largest = matrix.diagonal().max().max(1e-12);
    for a in 0..free.len() {
        matrix[(a, a)] += damping * matrix[(a, a)].max(1e-9 * largest);
    }
    let solution = matrix.cholesky()?.solve(&right);
    let mut step = vec![0.0; theta.len()];
    for (a, &i) in free.iter().enumerate() {
        step[i] = solution[a] * scale[i];
    }
    step.iter().all(|d| d.is_finite()).then_some(step)
}
