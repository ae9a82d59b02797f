//! Whether successive delays resemble each other.

use parallax_runtime::delay::special::normal_quantile;
use parallax_runtime::time::Nanos;
use serde::Serialize;

/// The correlation of a delay with the one before it, on the scale on which delays are normal.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Correlation {
    /// The estimate, −1 to 1; 0 where there are too few pairs.
    pub value: f64,
    /// Pairs of successive delays, outliers aside.
    pub pairs: usize,
    /// Whether it is part of the fit: beyond 3.3 standard errors `1 / sqrt(pairs)` (one chance in a thousand) and large
    /// enough to matter, 0.05.
    pub significant: bool,
}

/// Standard errors that chance does not reach.
const SIGNIFICANT: f64 = 3.3;
/// Correlations below this change no schedule.
const RELEVANT: f64 = 0.05;

/// Estimates the correlation that a Gaussian copula needs: of the normal scores of the ranks (van der Waerden), ties at
/// their mean rank, over the pairs of which both are kept.
pub(super) fn correlation(delays: &[Nanos], successive: &[bool], kept: &[bool]) -> Correlation {
    let mut order: Vec<usize> = (0..delays.len()).filter(|&index| kept[index]).collect();
    order.sort_by_key(|&index| (delays[index], index));
    let count = order.len() as f64;
    let mut scores = vec![0.0; delays.len()];
    let mut start = 0;
    while start < order.len() {
        let delay = delays[order[start]];
        let end = start + order[start..].partition_point(|&index| delays[index] == delay);
        let score = normal_quantile(0.5 * (start + end) as f64 / count);
        for &index in &order[start..end] {
            scores[index] = score;
        }
        start = end;
    }
    let variance = order.iter().map(|&index| scores[index].powi(2)).sum::<f64>() / count.max(1.0);
    let pairs = (1..delays.len()).filter(|&index| successive[index] && kept[index] && kept[index - 1]);
    let (mut sum, mut pairs_count) = (0.0, 0);
    for index in pairs {
        sum += scores[index] * scores[index - 1];
        pairs_count += 1;
    }
    if pairs_count < 20 || variance < 1e-12 {
        return Correlation { pairs: pairs_count, ..Correlation::default() };
    }
    let value = (sum / pairs_count as f64 / variance).clamp(-0.999, 0.999);
    let significant = value.abs() * (pairs_count as f64).sqrt() > SIGNIFICANT && value.abs() >= RELEVANT;
    Correlation { value, pairs: pairs_count, significant }
}
