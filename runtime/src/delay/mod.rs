//! How long a step or a message takes: a distribution, never negative.
//!
//! [`Delay`] is what a graph says, [`DelaySampler`] draws from it. What falls below zero counts as zero, so that a
//! Gaussian fitted to small delays stays a Gaussian (van der Heijden et al., "REX", section 3.3).

mod distribution;
mod from_output;
mod marginal;
mod sampler;
pub mod special;

use serde::{Deserialize, Serialize};

pub use from_output::DelayOfOutput;
pub use sampler::DelaySampler;

use crate::time::{Nanos, from_seconds};

/// A distribution of durations in seconds. What falls below zero counts as zero.
///
/// ```
/// use parallax_runtime::delay::Delay;
/// let delay: Delay = toml::from_str("distribution = 'normal'\nmean = 0.01\nstd = 0.002").unwrap();
/// assert_eq!(delay, Delay::Normal { mean: 0.01, std: 0.002 });
/// assert!((delay.expected() - 0.01).abs() < 1e-6);
///
/// // A camera that needs one or two periods of its shutter, and tends to stay at either.
/// let camera: Delay = toml::from_str(
///     "distribution = 'correlated'\n\
///      correlation = 0.7\n\
///      of = { distribution = 'mixture', weights = [0.7, 0.3], means = [0.010, 0.022], stds = [0.001, 0.002] }",
/// ).unwrap();
/// assert!((camera.expected() - 0.0136).abs() < 1e-9);
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "distribution", rename_all = "snake_case", deny_unknown_fields)]
pub enum Delay {
    /// Always the same.
    Constant {
        /// The duration, s.
        seconds: f64,
    },
    /// A normal distribution, clipped at zero.
    Normal {
        /// Mean before clipping, s.
        mean: f64,
        /// Standard deviation before clipping, s.
        std: f64,
    },
    /// A mixture of normal distributions, clipped at zero. The three lists are of one length, one entry a component.
    Mixture {
        /// Shares of the components; only their proportions count.
        weights: Vec<f64>,
        /// Means before clipping, s.
        means: Vec<f64>,
        /// Standard deviations before clipping, s; 0 for a component that is always the same.
        stds: Vec<f64>,
    },
    /// A log-normal distribution, given by its own mean and standard deviation (not those of its logarithm).
    LogNormal {
        /// Mean, s.
        mean: f64,
        /// Standard deviation, s.
        std: f64,
    },
    /// A gamma distribution, given by its mean and standard deviation: shape `(mean / std)²`, scale `std² / mean`.
    Gamma {
        /// Mean, s.
        mean: f64,
        /// Standard deviation, s.
        std: f64,
    },
    /// Evenly between two bounds.
    Uniform {
        /// Shortest, s.
        low: f64,
        /// Longest, s.
        high: f64,
    },
    /// One of the durations that were observed, each as likely as the others.
    Empirical {
        /// What was observed, s.
        samples: Vec<f64>,
    },
    /// Successive delays that resemble each other, while each by itself is distributed as `of`.
    ///
    /// A Gaussian copula of a first-order autoregression: `z_k = r z_(k-1) + sqrt(1 - r²) e_k` with standard normal
    /// `e_k`, and the delay is the quantile of `of` at the standard normal distribution of `z_k`. `r` is therefore
    /// the correlation of successive delays on the scale on which they are normal; of normal delays it is their
    /// correlation itself.
    Correlated {
        /// `r`, above −1 and below 1.
        correlation: f64,
        /// The distribution of a single delay: any but `correlated` and `output`.
        of: Box<Delay>,
    },
    /// What a step found decides how long it took: `offset + scale × leaf`, kept within bounds, where `leaf` is one of
    /// the step's own output. Only a node's computation can be so: an object detector that needs a millisecond for
    /// each object that it sees, or a node whose model says itself how long it computes. A graph under the simulated
    /// clock follows it, and so does a compiled graph that is told to decide at run time.
    Output {
        /// The leaf of the node's output.
        leaf: String,
        /// Delay where the leaf is zero, s.
        #[serde(default)]
        offset: f64,
        /// Delay for each unit of the leaf, s.
        #[serde(default = "one")]
        scale: f64,
        /// Shortest, s.
        min: f64,
        /// Longest, s; also the delay of a leaf that is not a number.
        max: f64,
        /// What the schedule is to expect, s; it sets the phases of receivers. Absent: the middle of the bounds.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        expected: Option<f64>,
    },
}

fn one() -> f64 {
    1.0
}

impl Default for Delay {
    fn default() -> Self {
        Self::ZERO
    }
}

impl Delay {
    /// No delay at all.
    pub const ZERO: Self = Self::Constant { seconds: 0.0 };

    /// Always `seconds`.
    pub fn constant(seconds: f64) -> Self {
        Self::Constant { seconds }
    }

    /// What is wrong with the numbers, if anything: the reason as a sentence without a subject.
    pub fn problem(&self) -> Option<&'static str> {
        let valid = |value: f64| value.is_finite() && value >= 0.0;
        match self {
            Self::Constant { seconds } if !valid(*seconds) => {
                Some("has to be a number of seconds, at least 0")
            }
            Self::Normal { mean, std } if !mean.is_finite() || !valid(*std) => {
                Some("needs a finite mean and a standard deviation of at least 0")
            }
            Self::Mixture { weights, means, stds }
                if weights.is_empty() || weights.len() != means.len() || weights.len() != stds.len() =>
            {
                Some("needs as many weights as means and standard deviations, and at least one")
            }
            Self::Mixture { weights, .. }
                if !weights.iter().all(|w| valid(*w))
                    || !(f64::MIN_POSITIVE..=f64::MAX).contains(&weights.iter().sum()) =>
            {
                Some("needs weights of at least 0 with a positive, finite sum")
            }
            Self::Mixture { means, stds, .. }
                if !means.iter().all(|mean| mean.is_finite()) || !stds.iter().all(|std| valid(*std)) =>
            {
                Some("needs finite means and standard deviations of at least 0")
            }
            Self::LogNormal { mean, std } | Self::Gamma { mean, std }
                if !valid(*mean) || *mean == 0.0 || !valid(*std) =>
            {
                Some("needs a positive mean and a standard deviation of at least 0")
            }
            Self::Uniform { low, high } if !valid(*low) || !valid(*high) || low > high => {
                Some("needs 0 <= low <= high")
            }
            Self::Empirical { samples } if samples.is_empty() => Some("needs at least one sample"),
            Self::Empirical { samples } if !samples.iter().all(|s| s.is_finite()) => {
                Some("needs samples that are finite numbers of seconds")
            }
            Self::Correlated { correlation, .. } if !(*correlation > -1.0 && *correlation < 1.0) => {
                Some("needs a correlation above -1 and below 1")
            }
            Self::Correlated { of, .. } => match **of {
                Self::Correlated { .. } => Some("is correlated twice; say it once"),
                Self::Output { .. } => Some(
                    "follows from the output and so cannot be correlated; correlate the output's leaf instead",
                ),
                ref of => of.problem(),
            },
            Self::Output { offset, scale, .. } if !offset.is_finite() || !scale.is_finite() => {
                Some("needs a finite offset and scale")
            }
            Self::Output { min, max, .. } if !valid(*min) || !valid(*max) || min > max => {
                Some("needs bounds 0 <= min <= max")
            }
            Self::Output { min, max, expected: Some(expected), .. } if !(min..=max).contains(&expected) => {
                Some("needs an expected delay within min and max")
            }
            _ => None,
        }
    }

    /// The mean in seconds, after clipping at zero; of a delay that follows from an output, what is stated as expected.
    pub fn expected(&self) -> f64 {
        match self {
            Self::Constant { seconds } => seconds.max(0.0),
            Self::Normal { mean, std } => clipped_mean(*mean, *std),
            Self::Mixture { weights, means, stds } => {
                let sum: f64 = weights.iter().sum();
                let parts = weights.iter().zip(means).zip(stds);
                parts.map(|((weight, mean), std)| weight * clipped_mean(*mean, *std)).sum::<f64>() / sum
            }
            Self::LogNormal { mean, .. } | Self::Gamma { mean, .. } => *mean,
            Self::Uniform { low, high } => 0.5 * (low + high),
            Self::Empirical { samples } => {
                samples.iter().map(|s| s.max(0.0)).sum::<f64>() / samples.len().max(1) as f64
            }
            Self::Correlated { of, .. } => of.expected(),
            Self::Output { min, max, expected, .. } => expected.unwrap_or(0.5 * (min + max)),
        }
    }

    /// The mean in nanoseconds.
    pub fn expected_nanos(&self) -> Nanos {
        from_seconds(self.expected())
    }

    /// The shortest and the longest delay, s; the longest is infinite where nothing bounds it.
    ///
    /// ```
    /// use parallax_runtime::delay::Delay;
    /// assert_eq!(Delay::Uniform { low: 0.001, high: 0.003 }.bounds(), (0.001, 0.003));
    /// assert_eq!(Delay::Normal { mean: 0.01, std: 0.001 }.bounds(), (0.0, f64::INFINITY));
    /// ```
    pub fn bounds(&self) -> (f64, f64) {
        match self {
            Self::Constant { seconds } => (seconds.max(0.0), seconds.max(0.0)),
            Self::Normal { mean, std } if *std == 0.0 => (mean.max(0.0), mean.max(0.0)),
            Self::LogNormal { mean, std } | Self::Gamma { mean, std } if *std == 0.0 => (*mean, *mean),
            Self::Mixture { weights, means, stds }
                if weights.iter().zip(stds).all(|(weight, std)| *weight == 0.0 || *std == 0.0) =>
            {
                let used = weights.iter().zip(means).filter(|(weight, _)| **weight > 0.0);
                span(used.map(|(_, mean)| *mean))
            }
            Self::Normal { .. } | Self::Mixture { .. } | Self::LogNormal { .. } | Self::Gamma { .. } => {
                (0.0, f64::INFINITY)
            }
            Self::Uniform { low, high } => (*low, *high),
            Self::Empirical { samples } => span(samples.iter().copied()),
            Self::Correlated { of, .. } => of.bounds(),
            Self::Output { min, max, .. } => (*min, *max),
        }
    }

    /// The leaf of the step's output that it follows from, if it does.
    pub fn leaf(&self) -> Option<&str> {
        match self {
            Self::Output { leaf, .. } => Some(leaf),
            _ => None,
        }
    }

    /// The rule by which it follows from an output with these leaves; none where it does not, or where the leaf is not
    /// there.
    pub fn of_output(&self, leaves: &[String]) -> Option<DelayOfOutput> {
        let Self::Output { leaf, offset, scale, min, max, .. } = self else { return None };
        let leaf = leaves.iter().position(|name| name == leaf)?;
        Some(DelayOfOutput { leaf, offset: *offset, scale: *scale, min: *min, max: *max })
    }

    /// The distribution ready for drawing. `leaves` names the leaves of the output that a step's delay may follow from;
    /// none for a connection.
    pub fn sampler(&self, leaves: &[String]) -> DelaySampler {
        DelaySampler::new(self, leaves)
    }
}

/// E[max(X, 0)] of a normal X.
fn clipped_mean(mean: f64, std: f64) -> f64 {
    if std <= 0.0 {
        return mean.max(0.0);
    }
    // E[max(X, 0)] = m P(m/s) + s p(m/s), with the standard normal's distribution P and density p.
    let z = mean / std;
    let density = (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt();
    let distribution = 0.5 * libm::erfc(-z / std::f64::consts::SQRT_2);
    mean * distribution + std * density
}

/// The smallest and the largest of some delays, clipped at zero.
fn span(delays: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = delays
        .map(|delay| delay.max(0.0))
        .fold((f64::INFINITY, 0.0_f64), |(low, high), delay| (low.min(delay), high.max(delay)));
    (low.min(high), high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    fn mean_of(delay: &Delay) -> f64 {
        let mut random = stream(3, Purpose::Communication, "a->b");
        let mut sampler = delay.sampler(&[]);
        let count = 40_000;
        let sum: f64 = (0..count).map(|_| sampler.sample(&mut random, &[]) as f64 * 1e-9).sum();
        sum / f64::from(count)
    }

    #[test]
    fn the_mean_of_many_draws_is_the_expected_delay() {
        let delays = [
            Delay::constant(0.02),
            Delay::Normal { mean: 0.01, std: 0.002 },
            // Half of the mass is clipped here: the plain mean would be wrong.
            Delay::Normal { mean: 0.0, std: 0.01 },
            Delay::LogNormal { mean: 0.01, std: 0.01 },
            Delay::Uniform { low: 0.01, high: 0.03 },
            Delay::Empirical { samples: vec![0.01, 0.02, 0.06] },
            Delay::Gamma { mean: 0.01, std: 0.004 },
            Delay::Mixture { weights: vec![3.0, 1.0], means: vec![0.0, 0.03], stds: vec![0.01, 0.0] },
        ];
        for delay in delays {
            let (mean, expected) = (mean_of(&delay), delay.expected());
            assert!((mean - expected).abs() < 0.02 * expected, "{delay:?}: drew {mean}, expected {expected}");
        }
    }

    #[test]
    fn impossible_numbers_are_named() {
        assert!(Delay::constant(-1.0).problem().is_some());
        assert!(Delay::Uniform { low: 0.2, high: 0.1 }.problem().is_some());
        assert!(Delay::Empirical { samples: vec![] }.problem().is_some());
        assert!(Delay::Normal { mean: f64::NAN, std: 0.1 }.problem().is_some());
        assert!(Delay::LogNormal { mean: 0.0, std: 0.1 }.problem().is_some());
        assert!(Delay::Normal { mean: 0.01, std: 0.1 }.problem().is_none());
    }
}
