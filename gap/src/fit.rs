//! Damped Gauss–Newton over a hypothesis' parameters, within bounds and under priors.
//!
//! Both losses use it: the innovation likelihood ([`crate::innovation`]) and short windows ([`crate::shooting`]).
//! Steps are taken in units of each parameter's scale.

use nalgebra::{DMatrix, DVector};
pub use parallax_model::fit::Local;
use parallax_runtime::delay::special::normal_cdf;

use crate::hypothesis::Fitted;
use crate::ridge::Ridge;

/// Where a minimisation ended.
#[derive(Clone, Debug)]
pub struct Minimum {
    /// The parameters θ.
    pub theta: Vec<f64>,
    /// The loss there, with the priors' −2 log densities.
    pub cost: f64,
    /// Half the Hessian with the priors' precision, in units of θ.
    pub information: DMatrix<f64>,
    /// The precision of the flat priors: where the data say nothing, the posterior is no wider than they are.
    flat: Vec<f64>,
}

/// Temperature of the posterior, of its probabilities and its intervals: readings are less independent than a likelihood
/// believes, and no model is as exact.
pub(crate) const TEMPERATURE: f64 = 2.0;

/// A gain in the loss that is not worth another step.
const PROMISE: f64 = 1e-2;

/// The priors' −2 log density at θ.
#[must_use]
pub fn prior_cost(fitted: &[Fitted], theta: &[f64]) -> f64 {
    fitted.iter().zip(theta).map(|(f, v)| f.prior.cost(*v)).sum()
}

/// Minimises `loss` plus the priors from `start`.
///
/// `loss` is asked at points within the bounds; `accepted` is told of each accepted point, so that it can re-estimate
/// what it holds fixed during a step (the noise) and gives back the loss under the new estimate.
pub fn minimise<L>(fitted: &[Fitted], start: &[f64], iterations: usize, mut loss: L) -> Minimum
where
    L: FnMut(&[f64], bool) -> Local,
{
    let p = fitted.len();
    let clamp = |theta: &mut [f64]| {
        for (v, f) in theta.iter_mut().zip(fitted) {
            *v = v.clamp(f.low, f.high);
        }
    };
    let ridges = Ridge::of(fitted);
    let mut theta = start.to_vec();
    clamp(&mut theta);
    let mut local = loss(&theta, true);
    let mut cost = local.cost + prior_cost(fitted, &theta);
    let mut damping = 1e-3;
    for _ in 0..iterations {
        if p == 0 {
            break;
        }
        let (mut hessian, mut gradient) = with_priors(fitted, &theta, &local);
        for ridge in &ridges {
            ridge.straighten(&theta, &mut hessian, &mut gradient);
        }
        // What the quadratic model promises: the gradient is half that of the cost.
        let promised = bounded_step(fitted, &theta, &hessian, &gradient, 0.0)
            .map(|step| -step.iter().zip(gradient.iter()).map(|(d, g)| d * g).sum::<f64>());
        if promised.is_some_and(|gain| gain < PROMISE) {
            break;
        }
        let mut accepted = false;
        for _ in 0..8 {
            let Some(step) = bounded_step(fitted, &theta, &hessian, &gradient, damping) else {
                damping *= 10.0;
                continue;
            };
            let mut trial: Vec<f64> = theta.iter().zip(&step).map(|(v, d)| v + d).collect();
            ridges.iter().for_each(|ridge| ridge.bend(&theta, &mut trial));
            clamp(&mut trial);
            let trial_local = loss(&trial, false);
            let trial_cost = trial_local.cost + prior_cost(fitted, &trial);
            if trial_cost.is_finite() && trial_cost < cost {
                let gain = cost - trial_cost;
                theta = trial;
                local = loss(&theta, true);
                let refreshed = local.cost + prior_cost(fitted, &theta);
                let moved = gain + (trial_cost - refreshed).max(0.0);
                cost = refreshed;
                damping = (damping * 0.2).max(1e-9);
                accepted = moved > PROMISE;
                break;
            }
            damping *= 6.0;
        }
        if !accepted {
            break;
        }
    }
    let (hessian, _) = with_priors(fitted, &theta, &local);
    let flat = fitted.iter().map(|f| f.prior.flat_precision()).collect();
    Minimum { theta, cost, information: hessian, flat }
}

fn with_priors(fitted: &[Fitted], theta: &[f64], local: &Local) -> (DMatrix<f64>, DVector<f64>) {
    let p = fitted.len();
    let mut hessian = DMatrix::from_row_slice(p, p, &local.information);
    let mut gradient = DVector::from_row_slice(&local.gradient);
    for (i, f) in fitted.iter().enumerate() {
        let (mean, precision) = f.prior.quadratic(theta[i]);
        hessian[(i, i)] += precision;
        gradient[i] += precision * (theta[i] - mean);
    }
    (hessian, gradient)
}

/// A damped Newton step within the bounds of the fitted parameters.
fn bounded_step(
    fitted: &[Fitted],
    theta: &[f64],
    hessian: &DMatrix<f64>,
    gradient: &DVector<f64>,
    damping: f64,
) -> Option<Vec<f64>> {
    let each = |of: fn(&Fitted) -> f64| fitted.iter().map(of).collect::<Vec<f64>>();
    let (low, high, scale) = (each(|f| f.low), each(|f| f.high), each(|f| f.scale));
    parallax_model::fit::bounded_step([&low, &high, &scale], theta, hessian, gradient, damping)
}

impl Minimum {
    /// Standard deviations of θ by the curvature at the minimum.
    #[must_use]
    pub fn std(&self) -> Vec<f64> {
        let p = self.theta.len();
        self.covariance()
            .map_or_else(|| vec![f64::INFINITY; p], |c| (0..p).map(|i| c[(i, i)].max(0.0).sqrt()).collect())
    }

    /// Covariance of θ by the curvature at the minimum, if it is curved in every direction.
    #[must_use]
    pub fn covariance(&self) -> Option<DMatrix<f64>> {
        let mut information = self.information.clone();
        for (i, precision) in self.flat.iter().enumerate() {
            information[(i, i)] += precision;
        }
        information.cholesky().map(|c| c.inverse())
    }

    /// −2 log of the share of the posterior's bell that lies within the bounds, parameter by parameter: at a bound,
    /// half of it.
    fn cut_off(&self, fitted: &[Fitted]) -> f64 {
        let inside = fitted.iter().zip(&self.theta).zip(self.std()).map(|((f, value), std)| {
            if std.is_nan() || std <= 0.0 || std.is_infinite() {
                return 0.0;
            }
            let share = normal_cdf((f.high - value) / std) - normal_cdf((f.low - value) / std);
            -2.0 * share.clamp(0.05, 1.0).ln()
        });
        inside.sum()
    }

    /// Laplace's approximation of −2 log evidence: the minimum, and the volume around it.
    /// (MacKay, "Information Theory, Inference, and Learning Algorithms", chapter 27.)
    #[must_use]
    pub fn evidence_cost(&self, fitted: &[Fitted]) -> f64 {
        let p = fitted.len();
        let mut scaled = self.information.clone();
        let mut volume = 0.0;
        for (i, f) in fitted.iter().enumerate() {
            for j in 0..p {
                scaled[(i, j)] *= f.scale * fitted[j].scale;
            }
            volume += 2.0 * f.scale.ln();
        }
        // Where the data say nothing, the posterior is no wider than a flat prior.
        for (i, f) in fitted.iter().enumerate() {
            scaled[(i, i)] += f.prior.flat_precision() * f.scale * f.scale;
        }
        let log_determinant = match scaled.cholesky() {
            Some(c) => 2.0 * c.l().diagonal().iter().map(|d| d.ln()).sum::<f64>(),
            None => return f64::INFINITY,
        };
        self.cost + log_determinant - volume - p as f64 * (2.0 * std::f64::consts::PI).ln()
            + self.cut_off(fitted)
    }
}
