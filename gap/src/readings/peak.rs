//! The evidence of one positive parameter, by quadrature.

/// What the data say of a parameter whose logarithm is believed to lie evenly between two bounds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Peak {
    /// Posterior mean.
    pub(super) value: f64,
    /// Posterior standard deviation.
    pub(super) std: f64,
    /// Log of the likelihood averaged over the prior.
    pub(super) log_evidence: f64,
}

/// Points of the search, and of the quadrature around its peak.
const POINTS: usize = 61;

/// Fall of the log likelihood beyond which nothing counts.
const FAR: f64 = 14.0;

/// Integrates a likelihood over its parameter between `low` and `high`, both above zero.
pub(super) fn peak(low: f64, high: f64, log_likelihood: impl Fn(f64) -> f64) -> Peak {
    let (from, to) = (low.ln(), high.ln());
    let at = |x: f64| {
        let value = log_likelihood(x.exp());
        if value.is_nan() { f64::NEG_INFINITY } else { value }
    };
    let best_of = |from: f64, to: f64| {
        let step = (to - from) / (POINTS - 1) as f64;
        let points = (0..POINTS).map(|k| from + k as f64 * step).map(|x| (x, at(x)));
        (points.max_by(|a, b| a.1.total_cmp(&b.1)).map_or(from, |best| best.0), step)
    };
    // Each round looks closer around the best point of the one before.
    let (mut x, mut step) = best_of(from, to);
    for _ in 0..3 {
        (x, step) = best_of((x - 2.0 * step).max(from), (x + 2.0 * step).min(to));
    }
    let top = at(x);
    let edge = |bound: f64| {
        if at(bound) > top - FAR {
            return bound;
        }
        let (mut inside, mut outside) = (x, bound);
        for _ in 0..40 {
            let middle = 0.5 * (inside + outside);
            if at(middle) > top - FAR { inside = middle } else { outside = middle }
        }
        outside
    };
    let (left, right) = (edge(from), edge(to));
    let step = ((right - left) / (POINTS - 1) as f64).max(1e-12);
    let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
    for k in 0..POINTS {
        let x = left + k as f64 * step;
        let weight = (at(x) - top).exp();
        sum += weight;
        first += weight * x.exp();
        second += weight * (2.0 * x).exp();
    }
    let value = first / sum;
    let std = (second / sum - value * value).max(0.0).sqrt();
    Peak { value, std, log_evidence: top + (sum * step / (to - from)).ln() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_normal_peak_has_its_mean_and_width() {
        let found = peak(1e-3, 1e3, |x| -0.5 * ((x - 2.0) / 0.02).powi(2));
        assert!((found.value - 2.0).abs() < 1e-3, "{found:?}");
        assert!((found.std - 0.02).abs() < 2e-4, "{found:?}");
        // The mean likelihood over a prior that is flat in the logarithm: the peak's area over the prior's width.
        let area = (std::f64::consts::TAU.sqrt() * 0.02 / 2.0) / 1e6_f64.ln();
        assert!((found.log_evidence - area.ln()).abs() < 1e-3, "{found:?}");
    }
}
