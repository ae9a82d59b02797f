//! Waves of which one is a multiple of the other: a single cause that is no sine.

use parallax_model::effect::Effect;

use crate::search::Fit;

/// The highest multiple: what is less of a wave than its ninth harmonic shows nowhere.
const HIGHEST: f64 = 9.0;

/// Standard deviations by which the ratio of two frequencies may differ from a whole number, and the share of it by which two that differ by
/// chance do not.
const AWAY: f64 = 3.0;
const NEAR: f64 = 0.002;

/// Whether two of a fit's effects are periodic forces of which one repeats a whole number of times within the other. Forces that have
/// nothing to do with each other hardly do; one that is no sine has such harmonics, and shows them wherever it moves the machine.
pub(super) fn are_one(fit: &Fit) -> bool {
    let std = fit.innovation.minimum.std();
    let frequency = |effect: usize| {
        let mut own = fit.hypothesis.of_effect(effect);
        let at = own.find(|k| fit.hypothesis.fitted[*k].name == "frequency")?;
        Some((fit.theta()[at], std[at]))
    };
    let effects = fit.hypothesis.effects.iter().enumerate();
    let waves: Vec<(f64, f64)> = effects
        .filter(|(_, at)| at.effect == Effect::PeriodicDisturbance)
        .filter_map(|(k, _)| frequency(k))
        .collect();
    let pairs = |k: usize| waves[k + 1..].iter().map(move |other| (k, *other));
    (0..waves.len()).flat_map(pairs).any(|(k, other)| is_multiple(waves[k], other))
}

/// Whether one of two frequencies (Hz), each with its standard deviation, is twice the other, or more times.
fn is_multiple(a: (f64, f64), b: (f64, f64)) -> bool {
    let (slow, fast) = if a.0 < b.0 { (a, b) } else { (b, a) };
    let ratio = fast.0 / slow.0;
    let times = ratio.round();
    let std = ratio * ((fast.1 / fast.0).powi(2) + (slow.1 / slow.0).powi(2)).sqrt();
    (2.0..=HIGHEST).contains(&times) && (ratio - times).abs() < (AWAY * std).min(NEAR * times)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_third_harmonic_is_of_its_wave_and_a_neighbour_is_not() {
        let slow = (1.60165, 2e-5);
        assert!(is_multiple(slow, (4.8050, 9e-4)) && is_multiple((4.8050, 9e-4), slow));
        assert!(!is_multiple(slow, (4.79, 9e-4)), "a dozen deviations away");
        assert!(!is_multiple(slow, (4.7, 0.2)), "an uncertain one may be anywhere");
        assert!(!is_multiple(slow, (1.60170, 2e-5)), "one frequency at two places");
        assert!(!is_multiple(slow, (1.60165 * 12.0, 1e-3)), "too high to show");
        assert!(!is_multiple((0.0, 1e-3), slow) && !is_multiple((f64::NAN, 1.0), slow));
    }
}
