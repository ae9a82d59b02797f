//! From a standard normal number to a delay: the quantile of a distribution at the number's probability, prepared so
//! that a draw neither allocates nor searches long.

use super::Delay;
use super::distribution::{logarithm, shape_and_scale};
use super::special::{gamma_cdf, gamma_density, normal_cdf, normal_density};

/// Numbers beyond this many standard deviations count as this many: one draw in 10^15.
const END: f64 = 8.0;
/// Knots of a table from `-END` to `END`.
const KNOTS: usize = 513;
/// Delays are kept in whole nanoseconds: a tenth of one is exact enough.
const TOLERANCE: f64 = 1e-10;

/// A delay as a function of a standard normal number. It never falls.
#[derive(Debug, Clone)]
pub(super) enum Marginal {
    /// A constant, or a distribution that a correlation cannot change.
    Constant(f64),
    Normal {
        mean: f64,
        std: f64,
    },
    LogNormal {
        mean: f64,
        std: f64,
    },
    Uniform {
        low: f64,
        span: f64,
    },
    /// Sorted and clipped.
    Empirical(Box<[f64]>),
    Mixture(Mixture),
    /// Values and slopes at evenly spaced knots, joined by cubics.
    Smooth(Box<[(f64, f64)]>),
}

impl Marginal {
    pub(super) fn new(delay: &Delay) -> Self {
        match delay {
            Delay::Normal { mean, std } => Self::Normal { mean: *mean, std: *std },
            Delay::LogNormal { mean, std } if *std > 0.0 => {
                let (mean, std) = logarithm(*mean, *std);
                Self::LogNormal { mean, std }
            }
            Delay::Gamma { mean, std } if *std > 0.0 => Self::gamma(*mean, *std),
            Delay::Uniform { low, high } => Self::Uniform { low: *low, span: high - low },
            Delay::Empirical { samples } if !samples.is_empty() => {
                let mut sorted: Vec<f64> = samples.iter().map(|sample| sample.max(0.0)).collect();
                sorted.sort_by(f64::total_cmp);
                Self::Empirical(sorted.into())
            }
            Delay::Mixture { weights, means, stds } => Self::Mixture(Mixture::new(weights, means, stds)),
            Delay::Correlated { of, .. } => Self::new(of),
            _ => Self::Constant(delay.expected()),
        }
    }

    /// The delay at the standard normal number `z`, s.
    #[inline]
    pub(super) fn at(&self, z: f64) -> f64 {
        let z = z.clamp(-END, END);
        match self {
            Self::Constant(seconds) => *seconds,
            Self::Normal { mean, std } => (mean + std * z).max(0.0),
            Self::LogNormal { mean, std } => (mean + std * z).exp(),
            Self::Uniform { low, span } => low + span * normal_cdf(z),
            Self::Empirical(sorted) => {
                let place = (normal_cdf(z) * sorted.len() as f64) as usize;
                sorted[place.min(sorted.len() - 1)]
            }
            Self::Mixture(mixture) => mixture.at(z).max(0.0),
            Self::Smooth(knots) => {
                let (index, part, step) = cell(z);
                let ((y0, d0), (y1, d1)) = (knots[index], knots[index + 1]);
                // The cubic through both ends with the slopes there.
                let (t, t2, t3) = (part, part * part, part * part * part);
                let y = y0 * (1.0 - 3.0 * t2 + 2.0 * t3)
                    + y1 * (3.0 * t2 - 2.0 * t3)
                    + step * (d0 * (t - 2.0 * t2 + t3) + d1 * (t3 - t2));
                y.clamp(y0, y1)
            }
        }
    }

    /// The quantile at a probability in (0, 1), s.
    pub(super) fn at_probability(&self, p: f64) -> f64 {
        self.at(super::special::normal_quantile(p))
    }

    fn gamma(mean: f64, std: f64) -> Self {
        let (shape, scale) = shape_and_scale(mean, std);
        let mut low = 0.0;
        let mut knots = Vec::with_capacity(KNOTS);
        for index in 0..KNOTS {
            let z = knot(index);
            let p = normal_cdf(z);
            // An upper end that surely lies above: the cube of Wilson and Hilferty's normal, doubled until it does.
            let cube = 1.0 - 1.0 / (9.0 * shape) + z / (3.0 * shape.sqrt());
            let mut high = (shape * cube.max(0.0).powi(3)).max(low).max(1e-300);
            while gamma_cdf(shape, high) < p && high < 1e300 {
                high *= 2.0;
            }
            let x = solve(low, high, 1e-14 * shape.max(high), |x| {
                (gamma_cdf(shape, x) - p, gamma_density(shape, x))
            });
            let density = gamma_density(shape, x);
            let slope = if density.is_finite() && density > 0.0 { normal_density(z) / density } else { 0.0 };
            knots.push((x * scale, slope * scale));
            low = x;
        }
        Self::Smooth(limited(knots).into())
    }
}

/// Limits the slopes so that no cubic overshoots (Fritsch and Carlson 1980).
fn limited(mut knots: Vec<(f64, f64)>) -> Vec<(f64, f64)> {
    let step = 2.0 * END / (KNOTS - 1) as f64;
    for index in 0..knots.len() {
        let rise = |a: usize, b: usize| (knots[b].0 - knots[a].0) / step;
        let before = if index > 0 { rise(index - 1, index) } else { f64::INFINITY };
        let after = if index + 1 < knots.len() { rise(index, index + 1) } else { f64::INFINITY };
        knots[index].1 = knots[index].1.clamp(0.0, 3.0 * before.min(after));
    }
    knots
}

fn knot(index: usize) -> f64 {
    -END + 2.0 * END * index as f64 / (KNOTS - 1) as f64
}

/// The cell of a table in which `z` lies, how far into it, and how wide it is.
#[inline]
fn cell(z: f64) -> (usize, f64, f64) {
    let step = 2.0 * END / (KNOTS - 1) as f64;
    let place = (z + END) / step;
    let index = (place as usize).min(KNOTS - 2);
    (index, (place - index as f64).clamp(0.0, 1.0), step)
}

/// A mixture of normal distributions before clipping, with its quantiles at the knots.
#[derive(Debug, Clone)]
pub(super) struct Mixture {
    /// Weight, mean, standard deviation; the weights sum to 1.
    parts: Box<[(f64, f64, f64)]>,
    knots: Box<[f64]>,
}

impl Mixture {
    fn new(weights: &[f64], means: &[f64], stds: &[f64]) -> Self {
        let sum: f64 = weights.iter().sum();
        let parts: Vec<(f64, f64, f64)> = weights
            .iter()
            .zip(means)
            .zip(stds)
            .filter(|((weight, _), _)| **weight > 0.0)
            .map(|((weight, mean), std)| (weight / sum, *mean, *std))
            .collect();
        let mut mixture = Self { parts: parts.into(), knots: Box::default() };
        // The quantile lies between the components' own.
        let ends = |z: f64| {
            let own = mixture.parts.iter().map(|(_, mean, std)| mean + std * z);
            own.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
        };
        let knots = (0..KNOTS).map(|index| {
            let z = knot(index);
            let (low, high) = ends(z);
            mixture.quantile(z, low, high)
        });
        let knots: Box<[f64]> = knots.collect();
        mixture.knots = knots;
        mixture
    }

    /// Probability below `x` (in the lower half) or above it (in the upper half), less that of `z`; and the density. Both
    /// grow with `x`. The smaller tail keeps the digits.
    #[inline]
    fn excess(&self, z: f64, x: f64) -> (f64, f64) {
        let side = if z <= 0.0 { 1.0 } else { -1.0 };
        let (mut tail, mut density) = (0.0, 0.0);
        for &(weight, mean, std) in &self.parts {
            if std > 0.0 {
                let u = (x - mean) / std;
                tail += weight * normal_cdf(side * u);
                density += weight * normal_density(u) / std;
            } else if if z <= 0.0 { x >= mean } else { x < mean } {
                tail += weight;
            }
        }
        (side * (tail - normal_cdf(side * z)), density)
    }

    fn quantile(&self, z: f64, low: f64, high: f64) -> f64 {
        solve(low, high, TOLERANCE, |x| self.excess(z, x))
    }

    #[inline]
    fn at(&self, z: f64) -> f64 {
        let (index, ..) = cell(z);
        self.quantile(z, self.knots[index], self.knots[index + 1])
    }
}

/// The place between `low` and `high` where a function that does not fall changes its sign, by Newton's method kept
/// within a shrinking bracket. `function` gives the value and the slope.
#[inline]
fn solve(mut low: f64, mut high: f64, tolerance: f64, function: impl Fn(f64) -> (f64, f64)) -> f64 {
    let mut x = 0.5 * (low + high);
    for _ in 0..200 {
        if high - low <= tolerance {
            break;
        }
        let (value, slope) = function(x);
        if value < 0.0 {
            low = x;
        } else {
            high = x;
        }
        let newton = x - value / slope;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - x).abs() <= 0.5 * tolerance && newton == next {
            return next;
        }
        x = next;
    }
    // Of a step the upper end is the quantile.
    if high - low <= tolerance { high } else { x }
}
