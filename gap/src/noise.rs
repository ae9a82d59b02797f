//! The noise of a sensor, estimated without a model.

use crate::simulator::wrapped;
use crate::statistics::median;

/// Standard deviation of the noise of evenly spaced readings, from their third differences.
///
/// A third difference takes any local quadratic away, and white noise of variance σ² leaves 20 σ². The median of
/// the magnitudes is robust to jumps. Readings on a grid have at least the deviation of rounding, step/√12.
#[must_use]
pub fn model_free(values: &[f64], period: Option<f64>) -> f64 {
    let values = unwrapped(values, period);
    let mut thirds: Vec<f64> =
        values.windows(4).map(|w| (w[3] - 3.0 * w[2] + 3.0 * w[1] - w[0]).abs()).collect();
    let deviation = 1.4826 * median(&mut thirds) / 20.0_f64.sqrt();
    let largest = values.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    deviation.max(resolution(&values) / 12.0_f64.sqrt()).max(1e-9 * largest).max(1e-12)
}

/// The step between neighbouring values of a quantised reading: the smallest difference that is no rounding error,
/// and zero unless values repeat, as those of a grid do.
#[must_use]
pub fn resolution(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let largest = sorted.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let mut steps: Vec<f64> = Vec::new();
    let mut repeats = 0;
    for pair in sorted.windows(2) {
        let step = pair[1] - pair[0];
        if step <= 1e-9 * largest {
            repeats += 1;
        } else {
            steps.push(step);
        }
    }
    if repeats * 5 < sorted.len() || steps.is_empty() {
        0.0
    } else {
        steps.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

/// An angle followed across its wraps.
#[must_use]
pub fn unwrapped(values: &[f64], period: Option<f64>) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::with_capacity(values.len());
    for value in values {
        let next = match out.last() {
            Some(last) => last + wrapped(value - last, period),
            None => *value,
        };
        out.push(next);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_of_a_grid_is_its_rounding() {
        let values: Vec<f64> =
            (0..2000).map(|k| ((f64::from(k) * 0.001).sin() * 100.0).round() / 100.0).collect();
        assert!((resolution(&values) - 0.01).abs() < 1e-6);
        let estimate = model_free(&values, None);
        assert!((0.002..0.004).contains(&estimate), "{estimate}");
    }

    #[test]
    fn angles_are_followed_across_wraps() {
        let turns: Vec<f64> = (0..100).map(|k| f64::from(k) * 0.2).collect();
        let tau = std::f64::consts::TAU;
        let folded: Vec<f64> = turns.iter().map(|a| wrapped(*a, Some(tau))).collect();
        for (a, b) in unwrapped(&folded, Some(tau)).iter().zip(&turns) {
            assert!((a - b).abs() < 1e-9);
        }
    }
}
