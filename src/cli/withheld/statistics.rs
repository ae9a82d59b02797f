//! What the scores are made of: shares, quantiles and areas, each with a 95 % interval.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// A value, its 95 % interval, and how many cases it is made of. No cases, no value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Score {
    /// The value.
    pub(crate) value: Option<f64>,
    /// Lower end of the interval.
    pub(crate) low: Option<f64>,
    /// Upper end.
    pub(crate) high: Option<f64>,
    /// How many cases.
    pub(crate) count: usize,
}

/// How often a bootstrap draws.
const DRAWS: usize = 1000;

/// Share of `true`, with Wilson's interval (Wilson, J. Am. Stat. Assoc. 22, 1927).
pub(crate) fn share(hits: &[bool]) -> Score {
    let n = hits.len() as f64;
    if hits.is_empty() {
        return Score::default();
    }
    let p = hits.iter().filter(|hit| **hit).count() as f64 / n;
    let z = 1.959_964_f64;
    let scale = 1.0 / (1.0 + z * z / n);
    let middle = scale * (p + z * z / (2.0 * n));
    let half = scale * z * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
    Score {
        value: Some(p),
        low: Some((middle - half).max(0.0)),
        high: Some((middle + half).min(1.0)),
        count: hits.len(),
    }
}

/// Any statistic of cases, with a percentile bootstrap over them.
pub(crate) fn bootstrap<T: Copy>(cases: &[T], statistic: impl Fn(&[T]) -> Option<f64>) -> Score {
    let Some(value) = statistic(cases) else { return Score { count: cases.len(), ..Score::default() } };
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut drawn = Vec::with_capacity(cases.len());
    let mut values: Vec<f64> = (0..DRAWS)
        .filter_map(|_| {
            drawn.clear();
            drawn.extend((0..cases.len()).map(|_| cases[random.random_range(0..cases.len())]));
            statistic(&drawn)
        })
        .collect();
    values.sort_by(f64::total_cmp);
    Score {
        value: Some(value),
        low: quantile_of_sorted(&values, 0.025),
        high: quantile_of_sorted(&values, 0.975),
        count: cases.len(),
    }
}

/// The mean.
pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The quantile at `q`, linear between the two nearest values.
pub(crate) fn quantile(values: &[f64], q: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    quantile_of_sorted(&sorted, q)
}

fn quantile_of_sorted(sorted: &[f64], q: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let at = q * last as f64;
    let (below, part) = (at.floor() as usize, at.fract());
    let (low, high) = (sorted[below], sorted[(below + 1).min(last)]);
    Some(low + part * (high - low))
}

/// Expected calibration error over ten equal bins of confidence (Naeini et al., AAAI 2015).
pub(crate) fn calibration_error(cases: &[(f64, bool)]) -> Option<f64> {
    let mut bins = [(0.0, 0.0); 10];
    for (confidence, right) in cases {
        let bin = ((confidence * 10.0) as usize).min(9);
        bins[bin].0 += confidence;
        bins[bin].1 += f64::from(u8::from(*right));
    }
    let off: f64 = bins.iter().map(|(confidence, right)| (confidence - right).abs()).sum();
    (!cases.is_empty()).then(|| off / cases.len() as f64)
}

/// Area under the receiver's curve: how likely a case that is `true` scores above one that is not; half for a tie.
pub(crate) fn area(cases: &[(f64, bool)]) -> Option<f64> {
    let (yes, no): (Vec<_>, Vec<_>) = cases.iter().partition(|(_, positive)| *positive);
    if yes.is_empty() || no.is_empty() {
        return None;
    }
    let mut others: Vec<f64> = no.iter().map(|(score, _)| *score).collect();
    others.sort_by(f64::total_cmp);
    let above: f64 = yes
        .iter()
        .map(|(score, _)| {
            let (below, upto) = (
                others.partition_point(|other| other < score),
                others.partition_point(|other| other <= score),
            );
            0.5 * (below + upto) as f64
        })
        .sum();
    Some(above / (yes.len() * no.len()) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: Option<f64>, expected: f64) {
        let found = found.unwrap();
        assert!((found - expected).abs() < 1e-3, "{found} is not {expected}");
    }

    #[test]
    fn wilsons_interval_is_as_published() {
        // 8 of 10: Newcombe, Statistics in Medicine 17, 1998, by the formula for method 3.
        let hits: Vec<bool> = (0..10).map(|k| k < 8).collect();
        let score = share(&hits);
        near(score.value, 0.8);
        near(score.low, 0.490);
        near(score.high, 0.943);
        assert_eq!(share(&[]).value, None);
        near(share(&[true; 4]).high, 1.0);
    }

    #[test]
    fn quantiles_and_calibration_by_hand() {
        near(quantile(&[4.0, 1.0, 3.0, 2.0], 0.5), 2.5);
        near(quantile(&[0.0, 10.0], 0.1), 1.0);
        assert_eq!(quantile(&[], 0.5), None);
        // Two of confidence 0.95 and right once: off by 0.45. Two of 0.25 and never right: off by 0.25.
        near(calibration_error(&[(0.95, true), (0.95, false), (0.25, false), (0.25, false)]), 0.35);
        near(calibration_error(&[(1.0, true)]), 0.0);
    }

    #[test]
    fn areas_by_hand() {
        near(area(&[(2.0, true), (1.0, false)]), 1.0);
        near(area(&[(1.0, true), (1.0, false)]), 0.5);
        near(area(&[(1.0, true), (3.0, true), (2.0, false), (0.0, false)]), 0.75);
        assert_eq!(area(&[(1.0, true)]), None);
    }

    #[test]
    fn a_bootstrap_covers_its_value_and_repeats() {
        let cases: Vec<f64> = (0..101).map(f64::from).collect();
        let median = |values: &[f64]| quantile(values, 0.5);
        let score = bootstrap(&cases, median);
        near(score.value, 50.0);
        let (low, high) = (score.low.unwrap(), score.high.unwrap());
        assert!(low > 25.0 && low < 48.0 && high > 52.0 && high < 75.0, "{low} to {high}");
        assert_eq!(score, bootstrap(&cases, median));
    }
}
