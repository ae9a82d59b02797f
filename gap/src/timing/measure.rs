//! An estimate with its interval, against what was declared.

use parallax_runtime::delay::Delay;
use serde::{Deserialize, Serialize};

use crate::statistics::standard_deviation;

/// Standard deviations of the interval: 99.9 %, because many places are measured at once.
const WIDE: f64 = 3.3;

/// Batches whose means give the error of a mean of samples that may resemble their neighbours.
const BATCHES: usize = 20;

/// An estimate, its 99.9 % interval, and what was declared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measure {
    /// The estimate.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// What was declared, if anything.
    pub declared: Option<f64>,
    /// Whether the interval leaves the declared value out, by an amount that matters.
    pub significant: bool,
}

impl Measure {
    fn new(value: f64, error: f64) -> Self {
        Measure { value, low: value - error, high: value + error, declared: None, significant: false }
    }

    /// The mean of samples in order; `hidden` is the share of samples that were not seen.
    pub(super) fn mean(samples: &[f64], hidden: f64) -> Self {
        let mean = samples.iter().sum::<f64>() / samples.len().max(1) as f64;
        Self::new(mean, WIDE * error_of_mean(samples) + hidden * standard_deviation(samples))
    }

    /// The standard deviation of samples in order.
    pub(super) fn deviation(samples: &[f64], hidden: f64) -> Self {
        let mean = samples.iter().sum::<f64>() / samples.len().max(1) as f64;
        let squares: Vec<f64> = samples.iter().map(|s| (s - mean).powi(2)).collect();
        let std = standard_deviation(samples);
        // The error of a root is that of the square over twice the root.
        let error = if std > 0.0 { error_of_mean(&squares) / (2.0 * std) } else { 0.0 };
        Self::new(std, WIDE * error + hidden * std)
    }

    /// A share of `of`, with Wilson's interval, against a declared one.
    pub(super) fn share(count: usize, of: usize, declared: f64) -> Self {
        if of == 0 {
            return Measure { value: 0.0, low: 0.0, high: 1.0, declared: Some(declared), significant: false };
        }
        let (n, p, z) = (of as f64, count as f64 / of as f64, WIDE);
        let middle = (p + z * z / (2.0 * n)) / (1.0 + z * z / n);
        let half = z / (1.0 + z * z / n) * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
        let (low, high) = (if count == 0 { 0.0 } else { (middle - half).max(0.0) }, (middle + half).min(1.0));
        let apart = low > declared || high < declared;
        Measure {
            value: p,
            low,
            high,
            declared: Some(declared),
            significant: apart && count != 0 && count > 2,
        }
    }

    /// The same against what was declared; a difference up to `matters` counts for nothing.
    pub(super) fn against(mut self, declared: Option<f64>, matters: f64) -> Self {
        self.declared = declared;
        self.significant = declared.is_some_and(|declared| {
            (declared < self.low || declared > self.high) && (declared - self.value).abs() > matters
        });
        self
    }

    /// The standard deviation that its interval stands for.
    #[must_use]
    pub fn std(&self) -> f64 {
        0.5 * (self.high - self.low) / WIDE
    }
}

/// Standard deviation of the mean, from the means of batches.
fn error_of_mean(samples: &[f64]) -> f64 {
    let batches = BATCHES.min(samples.len());
    if batches < 2 {
        return f64::INFINITY;
    }
    let means: Vec<f64> = (0..batches)
        .map(|b| {
            let batch = &samples[b * samples.len() / batches..(b + 1) * samples.len() / batches];
            batch.iter().sum::<f64>() / batch.len() as f64
        })
        .collect();
    let spread = standard_deviation(&means) * (batches as f64 / (batches - 1) as f64).sqrt();
    spread / (batches as f64).sqrt()
}

/// Mean and standard deviation of a declared delay (s), clipped at zero; none for one that follows from an output.
pub(super) fn moments(delay: &Delay) -> Option<(f64, f64)> {
    let points = 4000;
    let at = |k: usize| delay.quantile((k as f64 + 0.5) / points as f64);
    let all: Vec<f64> = (0..points).map(at).collect::<Option<_>>()?;
    Some((all.iter().sum::<f64>() / points as f64, standard_deviation(&all)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_the_distribution() {
        let (mean, std) = moments(&Delay::Normal { mean: 0.02, std: 0.003 }).expect("it has quantiles");
        assert!((mean - 0.02).abs() < 1e-6 && (std - 0.003).abs() < 1e-5, "{mean} {std}");
    }

    #[test]
    fn shares_have_intervals_that_hold_them() {
        let none = Measure::share(0, 1000, 0.0);
        assert!(none.low == 0.0 && none.high < 0.02 && !none.significant);
        let some = Measure::share(30, 1000, 0.0);
        assert!(some.low > 0.01 && some.high < 0.06 && some.significant);
    }
}
