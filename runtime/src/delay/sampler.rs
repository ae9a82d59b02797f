//! Draws delays.

use rand_distr::{Distribution, Gamma, LogNormal, Normal, StandardNormal};

use super::distribution::{logarithm, shape_and_scale};
use super::marginal::Marginal;
use super::{Delay, DelayOfOutput};
use crate::time::{Nanos, from_seconds};

/// A [`Delay`] prepared for drawing many durations. Drawing does not allocate. It remembers the last draw where
/// successive delays are correlated, so one sampler belongs to one node or connection of one run.
#[derive(Debug, Clone)]
pub struct DelaySampler {
    kind: Kind,
}

#[derive(Debug, Clone)]
enum Kind {
    Constant(Nanos),
    Normal(Normal<f64>),
    LogNormal(LogNormal<f64>),
    Gamma(Gamma<f64>),
    Uniform {
        low: f64,
        span: f64,
    },
    Empirical(Box<[Nanos]>),
    /// Cumulative weight, mean and standard deviation of each component; the last weight is 1.
    Mixture(Box<[(f64, f64, f64)]>),
    Correlated {
        correlation: f64,
        innovation: f64,
        /// The last standard normal number, once there was one.
        last: Option<f64>,
        marginal: Marginal,
    },
    Output(DelayOfOutput),
}

impl DelaySampler {
    pub(super) fn new(delay: &Delay, leaves: &[String]) -> Self {
        let constant = || Kind::Constant(delay.expected_nanos());
        let kind = match delay {
            Delay::Constant { seconds } => Kind::Constant(from_seconds(seconds.max(0.0))),
            Delay::Normal { mean, std } => Normal::new(*mean, *std).map_or_else(|_| constant(), Kind::Normal),
            Delay::Mixture { weights, means, stds } => {
                let sum: f64 = weights.iter().sum();
                let mut cumulative = 0.0;
                let parts = weights.iter().zip(means).zip(stds).map(|((weight, mean), std)| {
                    cumulative += weight / sum;
                    (cumulative, *mean, *std)
                });
                Kind::Mixture(parts.collect())
            }
            Delay::LogNormal { mean, std } => {
                let (mean, std) = logarithm(*mean, *std);
                LogNormal::new(mean, std).map_or_else(|_| constant(), Kind::LogNormal)
            }
            Delay::Gamma { mean, std } => {
                let (shape, scale) = shape_and_scale(*mean, *std);
                Gamma::new(shape, scale).map_or_else(|_| constant(), Kind::Gamma)
            }
            Delay::Uniform { low, high } => Kind::Uniform { low: *low, span: high - low },
            Delay::Empirical { samples } if samples.is_empty() => Kind::Constant(0),
            Delay::Empirical { samples } => {
                Kind::Empirical(samples.iter().map(|s| from_seconds(s.max(0.0))).collect())
            }
            Delay::Correlated { correlation, of } => match Marginal::new(of) {
                Marginal::Constant(seconds) => Kind::Constant(from_seconds(seconds)),
                marginal => Kind::Correlated {
                    correlation: *correlation,
                    innovation: (1.0 - correlation * correlation).max(0.0).sqrt(),
                    last: None,
                    marginal,
                },
            },
            // A validated graph has the leaf.
            Delay::Output { .. } => delay.of_output(leaves).map_or_else(constant, Kind::Output),
        };
        Self { kind }
    }

    /// Draws one duration, at least 0. `output` holds the leaves of the step's output, from which its delay may follow;
    /// it is empty for a connection. A constant, and what follows from the output, draws no random number.
    ///
    /// # Panics
    ///
    /// When the delay follows from a leaf that `output` lacks.
    #[inline]
    pub fn sample(&mut self, random: &mut impl rand::Rng, output: &[f64]) -> Nanos {
        match &mut self.kind {
            Kind::Constant(nanos) => *nanos,
            Kind::Normal(normal) => from_seconds(normal.sample(random).max(0.0)),
            Kind::LogNormal(log_normal) => from_seconds(log_normal.sample(random).max(0.0)),
            Kind::Gamma(gamma) => from_seconds(gamma.sample(random).max(0.0)),
            Kind::Uniform { low, span } => from_seconds(*low + *span * unit(random)),
            Kind::Empirical(samples) => {
                // Multiply and shift: at most 2^-32 from uniform for any list that fits in memory.
                let index = (u128::from(random.next_u64()) * samples.len() as u128) >> 64;
                samples[index as usize]
            }
            Kind::Mixture(parts) => {
                let u = unit(random);
                let (_, mean, std) =
                    parts.iter().find(|(end, ..)| u < *end).or(parts.last()).copied().unwrap_or_default();
                let z: f64 = StandardNormal.sample(random);
                from_seconds((mean + std * z).max(0.0))
            }
            Kind::Correlated { correlation, innovation, last, marginal } => {
                let fresh: f64 = StandardNormal.sample(random);
                let z = last.map_or(fresh, |last| *correlation * last + *innovation * fresh);
                *last = Some(z);
                from_seconds(marginal.at(z))
            }
            Kind::Output(rule) => rule.nanos(output[rule.leaf]),
        }
    }
}

/// A number in [0, 1) from the upper 53 bits.
fn unit(random: &mut impl rand::Rng) -> f64 {
    (random.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}
