//! Readings in steps: the lattice on which all values lie.

use crate::statistics::quantile;

/// Distance from the lattice within which a difference counts as on it, in steps.
const TOLERANCE: f64 = 0.05;

/// Share of differences that must lie on the lattice.
const ON_IT: f64 = 0.97;

/// Changes of a reading that show a lattice, at least.
pub(super) const SHOW_A_LATTICE: usize = 20;

/// A lattice of values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// The step between neighbouring values.
    pub step: f64,
    /// How well it is known.
    pub std: f64,
    /// Differences of successive readings that lie on it, and all that are not zero.
    pub on: usize,
    /// Differences of successive readings that are not zero.
    pub of: usize,
}

impl Lattice {
    /// −2 log likelihood that so many differences lie on the lattice by chance.
    #[must_use]
    pub fn chance(&self) -> f64 {
        // Twice the tolerance of all values lie near a lattice by chance.
        2.0 * self.on as f64 * (2.0 * TOLERANCE).ln()
    }
}

/// The lattice of a series, if its values lie on one: the greatest common divisor of its differences, up to rounding.
///
/// Differences of successive readings are small multiples of the step, so that an error of the first guess does not add
/// up.
#[must_use]
pub fn lattice(values: &[f64]) -> Option<Lattice> {
    let largest = values.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let rounding = 1e-9 * largest;
    let differences: Vec<f64> =
        values.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|d| *d > rounding).collect();
    if differences.len() < SHOW_A_LATTICE {
        return None;
    }
    let smallest = differences.iter().copied().fold(f64::INFINITY, f64::min);
    let low = quantile(&mut differences.clone(), 0.03);
    // A rare value off the lattice spoils the smallest difference, fast motion skips single steps.
    [low, smallest, 0.5 * low, low / 3.0].into_iter().filter_map(|first| fitted(&differences, first)).next()
}

fn fitted(differences: &[f64], first: f64) -> Option<Lattice> {
    let mut step = first;
    let near = |step: f64, d: f64| ((d / step) - (d / step).round()).abs() < TOLERANCE && d > 0.5 * step;
    // From the small multiples, which know the step without counting wrong, to the large ones, which know it well.
    for reach in [3.0, 10.0, 50.0, 500.0] {
        let (mut sum, mut count) = (0.0, 0.0);
        for d in differences.iter().filter(|d| **d < reach * step && near(step, **d)) {
            sum += d;
            count += (d / step).round();
        }
        if count > 0.0 {
            step = sum / count;
        }
    }
    let on: Vec<f64> = differences.iter().copied().filter(|d| near(step, *d)).collect();
    if (on.len() as f64) < ON_IT * differences.len() as f64 {
        return None;
    }
    let counts: f64 = on.iter().map(|d| (d / step).round().powi(2)).sum();
    let error = on.iter().map(|d| (d - step * (d / step).round()).powi(2)).sum::<f64>() / on.len() as f64;
    Some(Lattice { step, std: (error / counts).sqrt(), on: on.len(), of: differences.len() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_an_encoder_are_found_through_rounded_text() {
        let step = std::f64::consts::TAU / 4096.0;
        let values: Vec<f64> = (0..3000)
            .map(|k| 1.3 * (0.011 * f64::from(k)).sin())
            .map(|v| ((v / step).round() * step * 1e6).round() / 1e6)
            .collect();
        let found = lattice(&values).expect("the values lie on a lattice");
        assert!((found.step / step - 1.0).abs() < 1e-5, "{found:?}");
        assert!(found.chance() < -1000.0);
    }

    #[test]
    fn smooth_values_have_none() {
        let values: Vec<f64> = (0..3000).map(|k| 1.3 * (0.011 * f64::from(k)).sin()).collect();
        assert_eq!(lattice(&values), None);
    }
}
