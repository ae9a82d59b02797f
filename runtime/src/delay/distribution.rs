//! What plots, tests of fits and correlated draws ask of a delay: distribution function, quantiles, density.

use super::Delay;
use super::special::{gamma_cdf, gamma_density, normal_cdf, normal_density};

impl Delay {
    /// Probability of at most `x` seconds, after clipping at zero. `None` for a delay that follows from an output, and
    /// where [`problem`](Self::problem) finds one.
    ///
    /// ```
    /// use parallax_runtime::delay::Delay;
    /// let delay = Delay::Normal { mean: 0.0, std: 0.01 };
    /// assert_eq!((delay.cdf(-0.01), delay.cdf(0.0)), (Some(0.0), Some(0.5)));
    /// ```
    pub fn cdf(&self, x: f64) -> Option<f64> {
        if self.problem().is_some() {
            return None;
        }
        if x < 0.0 {
            return self.leaf().is_none().then_some(0.0);
        }
        let normal = |mean: f64, std: f64| {
            if std > 0.0 { normal_cdf((x - mean) / std) } else { step(x >= mean) }
        };
        Some(match self {
            Self::Constant { seconds } => step(x >= *seconds),
            Self::Normal { mean, std } => normal(*mean, *std),
            Self::Mixture { weights, means, stds } => {
                let parts = weights.iter().zip(means).zip(stds);
                parts.map(|((weight, mean), std)| weight * normal(*mean, *std)).sum::<f64>()
                    / weights.iter().sum::<f64>()
            }
            Self::LogNormal { mean, std } | Self::Gamma { mean, std } if *std == 0.0 => step(x >= *mean),
            Self::LogNormal { mean, std } => {
                let (mean, std) = logarithm(*mean, *std);
                if x > 0.0 { normal_cdf((x.ln() - mean) / std) } else { 0.0 }
            }
            Self::Gamma { mean, std } => {
                let (shape, scale) = shape_and_scale(*mean, *std);
                gamma_cdf(shape, x / scale)
            }
            Self::Uniform { low, high } if low == high => step(x >= *low),
            Self::Uniform { low, high } => ((x - low) / (high - low)).clamp(0.0, 1.0),
            Self::Empirical { samples } => {
                samples.iter().filter(|sample| **sample <= x).count() as f64 / samples.len() as f64
            }
            Self::Correlated { of, .. } => return of.cdf(x),
            Self::Output { .. } => return None,
        })
    }

    /// The shortest delay, s, that is not exceeded with probability `p`. `None` where [`cdf`](Self::cdf) has none, and
    /// for a `p` outside [0, 1]; infinite at 1 where nothing bounds the delay.
    ///
    /// ```
    /// use parallax_runtime::delay::Delay;
    /// let delay = Delay::Uniform { low: 0.01, high: 0.03 };
    /// assert_eq!(delay.quantile(0.25), Some(0.015));
    /// ```
    pub fn quantile(&self, p: f64) -> Option<f64> {
        if !(0.0..=1.0).contains(&p) || self.problem().is_some() || self.leaf().is_some() {
            return None;
        }
        let (low, high) = self.bounds();
        if p == 0.0 {
            return Some(low);
        }
        Some(match self {
            Self::Uniform { low, high } => low + p * (high - low),
            Self::Empirical { samples } => {
                let mut sorted: Vec<f64> = samples.iter().map(|sample| sample.max(0.0)).collect();
                sorted.sort_by(f64::total_cmp);
                sorted[((p * sorted.len() as f64).ceil() as usize).clamp(1, sorted.len()) - 1]
            }
            Self::Correlated { of, .. } => return of.quantile(p),
            _ if p == 1.0 || low == high => high,
            _ => super::marginal::Marginal::new(self).at_probability(p),
        })
    }

    /// Density at `x` seconds, per second, without the part that clipping gathers at zero. `None` where there is none:
    /// for what is constant, observed, or follows from an output.
    pub fn density(&self, x: f64) -> Option<f64> {
        if self.problem().is_some() {
            return None;
        }
        let inside = step(x >= 0.0);
        let normal = |mean: f64, std: f64| normal_density((x - mean) / std) / std;
        match self {
            Self::Normal { mean, std } if *std > 0.0 => Some(inside * normal(*mean, *std)),
            Self::Mixture { weights, means, stds } => {
                let parts = weights.iter().zip(means).zip(stds).filter(|(_, std)| **std > 0.0);
                let sum: f64 = parts.map(|((weight, mean), std)| weight * normal(*mean, *std)).sum();
                Some(inside * sum / weights.iter().sum::<f64>())
            }
            Self::LogNormal { mean, std } if *std > 0.0 => {
                let (mean, std) = logarithm(*mean, *std);
                Some(if x > 0.0 { normal_density((x.ln() - mean) / std) / (std * x) } else { 0.0 })
            }
            Self::Gamma { mean, std } if *std > 0.0 => {
                let (shape, scale) = shape_and_scale(*mean, *std);
                Some(if x > 0.0 { gamma_density(shape, x / scale) / scale } else { 0.0 })
            }
            Self::Uniform { low, high } if low < high => {
                Some(step((*low..=*high).contains(&x)) / (high - low))
            }
            Self::Correlated { of, .. } => of.density(x),
            _ => None,
        }
    }
}

fn step(reached: bool) -> f64 {
    if reached { 1.0 } else { 0.0 }
}

/// Mean and standard deviation of the logarithm of a log-normal variable, from its own.
pub(super) fn logarithm(mean: f64, std: f64) -> (f64, f64) {
    let variance = (1.0 + (std / mean).powi(2)).ln();
    (mean.ln() - 0.5 * variance, variance.sqrt())
}

/// Shape and scale of a gamma variable, from its mean and standard deviation.
pub(super) fn shape_and_scale(mean: f64, std: f64) -> (f64, f64) {
    ((mean / std).powi(2), std * (std / mean))
}
