//! Readings that rest at a limit of their sensor while the state is predicted within: they show that the state lies beyond, and not by
//! how much (a censored observation: Tobin 1958; as an update of a filter: Allik, Miller, Piovoso & Zurakowski 2016, "The Tobit Kalman
//! filter").
//!
//! Taken as exact readings, they would pin a state down that is hardly known, a stretch that begins behind a limit at the limit.

use std::f64::consts::TAU;

use parallax_runtime::delay::special::normal_cdf;

use crate::simulator::Gradient;

/// A reading that has the same effect on mean and variance of the state as the knowledge that a quantity x ~ N(m, P) lies beyond a limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Beyond {
    /// The reading less m.
    pub(super) innovation: f64,
    /// The variance of its noise.
    pub(super) noise: f64,
    /// −2 log of the probability of it, less that at the limit itself.
    pub(super) cost: f64,
}

/// Standard deviations from where on the asymptotic series is closer than the difference of nearly equal numbers.
const FAR: f64 = 30.0;

impl Beyond {
    /// Of a quantity of variance P = `variance` that is predicted `short` > 0 of the limit; nothing where a reading with noise of
    /// variance `noise` rather is of what lies just within the limit.
    ///
    /// With α = `short`/√P and λ = φ(α)/Φ(−α), a Gaussian cut off below its limit has mean m + λ√P and variance P (1 − δ),
    /// δ = λ (λ − α) (Johnson, Kotz & Balakrishnan, "Continuous Univariate Distributions", volume 1, section 13.10). The derivatives of
    /// −log Φ(−α) by m are those of half the square of the innovation that is given here.
    pub(super) fn of(short: f64, variance: f64, noise: f64) -> Option<Beyond> {
        let std = variance.sqrt();
        let alpha = short / std;
        let (lambda, kept, log) = if alpha < FAR {
            let tail = normal_cdf(-alpha);
            let lambda = (-0.5 * alpha * alpha).exp() / (TAU.sqrt() * tail);
            (lambda, 1.0 - lambda * (lambda - alpha), tail.ln())
        } else {
            let inverse = 1.0 / (alpha * alpha);
            let lambda = alpha * (1.0 + inverse * (1.0 - inverse * (2.0 - 10.0 * inverse)));
            let kept = inverse * (1.0 - inverse * (6.0 - 50.0 * inverse));
            (lambda, kept, -0.5 * alpha * alpha - (TAU.sqrt() * lambda).ln())
        };
        let found = Beyond {
            innovation: std * lambda / (1.0 - kept),
            noise: variance * kept / (1.0 - kept),
            cost: -2.0 * (log + std::f64::consts::LN_2),
        };
        // Beyond the limit against within it: Φ(−α) N(reading; limit, noise), or N(reading; m, P + noise).
        (variance > noise * lambda * lambda && found.noise.is_finite()).then_some(found)
    }

    /// The same of a quantity of which nothing is known yet: the mean goes to the limit and no further. A variance that only says so
    /// would throw it far beyond, where the linearised model leads astray.
    pub(super) fn at_the_limit(self, short: f64, variance: f64) -> Beyond {
        Beyond { innovation: short * (variance + self.noise) / variance, ..self }
    }
}

/// Share of the variance at the start of a stretch from which a prediction is hardly known better than there.
pub(super) const UNKNOWN: f64 = 0.25;

/// The variance of a prediction on one lane, by the covariances of the states that it depends on.
pub(super) fn variance_of(
    states: &[usize],
    row: &Gradient,
    lane: usize,
    covariance: impl Fn(usize, usize) -> f64,
) -> f64 {
    let all = states.iter().flat_map(|i| states.iter().map(move |j| (*i, *j)));
    all.map(|(i, j)| row.by[i][lane] * row.by[j][lane] * covariance(i, j)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean and variance of a standard Gaussian above `alpha`, by sums.
    fn cut(alpha: f64) -> (f64, f64) {
        let (mut weight, mut first, mut second) = (0.0, 0.0, 0.0);
        let step = 1e-5;
        for k in 0..1_200_000 {
            let x = alpha + (f64::from(k) + 0.5) * step;
            let density = (-0.5 * (x * x - alpha * alpha)).exp();
            weight += density;
            first += density * x;
            second += density * x * x;
        }
        let mean = first / weight;
        (mean, second / weight - mean * mean)
    }

    #[test]
    fn a_state_behind_a_limit_is_known_as_a_gaussian_cut_off_there() {
        for alpha in [0.01, 0.5, 2.0, 5.0, 20.0, 29.9, 30.1] {
            let (mean, variance) = cut(alpha);
            let std: f64 = 0.3;
            let beyond = Beyond::of(alpha * std, std * std, 1e-9).unwrap();
            let gain = std * std / (std * std + beyond.noise);
            let (found, left) = (gain * beyond.innovation / std, 1.0 - gain);
            assert!((found - mean).abs() < 1e-4 * mean, "{alpha}: {found} {mean}");
            assert!((left - variance).abs() < 1e-3 * variance, "{alpha}: {left} {variance}");
        }
    }

    #[test]
    fn its_innovation_is_the_slope_of_its_cost() {
        for alpha in [0.1, 1.0, 6.0, 29.0, 35.0] {
            let (std, step): (f64, f64) = (0.3, 1e-5);
            let at = |alpha: f64| Beyond::of(alpha * std, std * std, 1e-9).unwrap();
            let slope = (at(alpha + step).cost - at(alpha - step).cost) / (2.0 * step * std);
            let half = at(alpha).innovation / (std * std + at(alpha).noise);
            assert!((slope - 2.0 * half).abs() < 1e-5 * slope, "{alpha}: {slope} {half}");
        }
    }

    #[test]
    fn a_state_of_which_nothing_is_known_goes_to_the_limit() {
        let (short, variance) = (0.2, 9.0);
        let beyond = Beyond::of(short, variance, 1e-6).unwrap();
        let there = beyond.at_the_limit(short, variance);
        let gain = variance / (variance + there.noise);
        assert!((gain * there.innovation - short).abs() < 1e-12, "{there:?}");
        assert!(gain * beyond.innovation > 10.0 * short, "{beyond:?}");
    }

    #[test]
    fn a_state_that_is_known_as_well_as_a_reading_is_read() {
        assert_eq!(Beyond::of(0.01, 1e-6, 1e-6), None);
        assert!(Beyond::of(0.01, 1.0, 1e-6).is_some());
    }
}
