//! How long a step or a message takes: a distribution, never negative.

use rand_distr::{Distribution, LogNormal, Normal};
use serde::{Deserialize, Serialize};

use crate::time::{Nanos, from_seconds};

/// A distribution of durations in seconds. What falls below zero counts as zero.
///
/// ```
/// use parallax_runtime::delay::Delay;
/// let delay: Delay = toml::from_str("distribution = 'normal'\nmean = 0.01\nstd = 0.002").unwrap();
/// assert_eq!(delay, Delay::Normal { mean: 0.01, std: 0.002 });
/// assert!((delay.expected() - 0.01).abs() < 1e-6);
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
    /// A log-normal distribution, given by its own mean and standard deviation (not those of its logarithm).
    LogNormal {
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
            Self::LogNormal { mean, std } if !valid(*mean) || *mean == 0.0 || !valid(*std) => {
                Some("needs a positive mean and a standard deviation of at least 0")
            }
            Self::Uniform { low, high } if !valid(*low) || !valid(*high) || low > high => {
                Some("needs 0 <= low <= high")
            }
            Self::Empirical { samples } if samples.is_empty() => Some("needs at least one sample"),
            Self::Empirical { samples } if !samples.iter().all(|s| s.is_finite()) => {
                Some("needs samples that are finite numbers of seconds")
            }
            _ => None,
        }
    }

    /// The mean in seconds, after clipping at zero.
    pub fn expected(&self) -> f64 {
        match self {
            Self::Constant { seconds } => seconds.max(0.0),
            Self::Normal { mean, std } if *std > 0.0 => {
                // E[max(X, 0)] = m P(m/s) + s p(m/s), with the standard normal's distribution P and density p.
                let z = mean / std;
                let density = (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt();
                let distribution = 0.5 * libm::erfc(-z / std::f64::consts::SQRT_2);
                mean * distribution + std * density
            }
            Self::Normal { mean, .. } => mean.max(0.0),
            Self::LogNormal { mean, .. } => *mean,
            Self::Uniform { low, high } => 0.5 * (low + high),
            Self::Empirical { samples } => {
                samples.iter().map(|s| s.max(0.0)).sum::<f64>() / samples.len().max(1) as f64
            }
        }
    }

    /// The mean in nanoseconds.
    pub fn expected_nanos(&self) -> Nanos {
        from_seconds(self.expected())
    }

    /// The distribution ready for drawing.
    pub fn sampler(&self) -> DelaySampler {
        let kind = match self {
            Self::Constant { seconds } => Kind::Constant(from_seconds(seconds.max(0.0))),
            Self::Normal { mean, std } => match Normal::new(*mean, *std) {
                Ok(normal) => Kind::Normal(normal),
                Err(_) => Kind::Constant(self.expected_nanos()),
            },
            Self::LogNormal { mean, std } => {
                // The logarithm's parameters from the mean and standard deviation of the delay itself.
                let variance = (1.0 + (std / mean).powi(2)).ln();
                match LogNormal::new(mean.ln() - 0.5 * variance, variance.sqrt()) {
                    Ok(log_normal) => Kind::LogNormal(log_normal),
                    Err(_) => Kind::Constant(self.expected_nanos()),
                }
            }
            Self::Uniform { low, high } => Kind::Uniform { low: *low, span: high - low },
            Self::Empirical { samples } if samples.is_empty() => Kind::Constant(0),
            Self::Empirical { samples } => {
                Kind::Empirical(samples.iter().map(|s| from_seconds(s.max(0.0))).collect())
            }
        };
        DelaySampler { kind }
    }
}

/// A [`Delay`] prepared for drawing many durations.
#[derive(Debug, Clone)]
pub struct DelaySampler {
    kind: Kind,
}

#[derive(Debug, Clone)]
enum Kind {
    Constant(Nanos),
    Normal(Normal<f64>),
    LogNormal(LogNormal<f64>),
    Uniform { low: f64, span: f64 },
    Empirical(Box<[Nanos]>),
}

impl DelaySampler {
    /// Draws one duration, at least 0. A constant draws no random number.
    #[inline]
    pub fn sample(&self, random: &mut impl rand::Rng) -> Nanos {
        match &self.kind {
            Kind::Constant(nanos) => *nanos,
            Kind::Normal(normal) => from_seconds(normal.sample(random).max(0.0)),
            Kind::LogNormal(log_normal) => from_seconds(log_normal.sample(random).max(0.0)),
            Kind::Uniform { low, span } => from_seconds(low + span * unit(random)),
            Kind::Empirical(samples) => {
                // Multiply and shift: at most 2^-32 from uniform for any list that fits in memory.
                let index = (u128::from(random.next_u64()) * samples.len() as u128) >> 64;
                samples[index as usize]
            }
        }
    }
}

/// A number in [0, 1) from the upper 53 bits.
fn unit(random: &mut impl rand::Rng) -> f64 {
    (random.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    fn mean_of(delay: &Delay) -> f64 {
        let mut random = stream(3, Purpose::Communication, "a->b");
        let sampler = delay.sampler();
        let count = 40_000;
        let sum: f64 = (0..count).map(|_| sampler.sample(&mut random) as f64 * 1e-9).sum();
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
