//! Classes of answers that the data cannot tell apart: who gives way to whom, and who is named.

use parallax_model::effect::PlaceKind;

use crate::judge::{EVEN, Judge};
use crate::search::Fit;
use crate::setup::Setup;

/// Difference of −2 log evidence up to which the simpler of two effects with one signature is named.
const EQUAL: f64 = 10.0;

/// Whether one has what the other has but for an effect that contains a simpler one at the same place, and either has a
/// parameter to spare there or explains no more of the gap than the simpler one's form may be off by.
pub(super) fn gives_way(fit: &Fit, to: &Fit, judge: &Judge) -> bool {
    let beyond = |all: &Fit, other: &Fit| -> Vec<usize> {
        let known = &other.hypothesis.effects;
        (0..all.hypothesis.effects.len()).filter(|&k| !known.contains(&all.hypothesis.effects[k])).collect()
    };
    let ([own], [other]) = (&beyond(fit, to)[..], &beyond(to, fit)[..]) else { return false };
    let (at, simpler) = (&fit.hypothesis.effects[*own], &to.hypothesis.effects[*other]);
    at.place == simpler.place
        && at.effect.simpler().contains(&simpler.effect)
        && (!judge.is_material(fit, to) || judge.is_spare(fit, *own, to))
}

/// Whether it takes a calibrated parameter beyond the range that the system's file gives it.
pub(super) fn beyond_its_range(setup: &Setup, fit: &Fit) -> bool {
    let calibrated = |name: &str| {
        let mut parameters = setup.equations.system().parameters.iter();
        parameters.any(|p| p.name == name && p.calibrate.is_some())
    };
    fit.hypothesis.effects.iter().any(|at| at.place.kind == PlaceKind::Parameter && calibrated(&at.place.key))
}

/// Puts the member to be named first: the simplest of those that the evidence does not tell apart from the best. One
/// with fewer parameters may be a little worse, and where nothing reaches the noise by what the best one's form is off;
/// of equally simple ones the first in the library's order, which puts commands before readings, only where the evidence
/// is truly even. What contradicts the system's file (`contradicts`), by itself or in a parameter's place, comes after all
/// that does not.
pub(super) fn lead_with_the_simplest(
    class: &mut [usize],
    fits: &[Fit],
    judge: &Judge,
    contradicts: &dyn Fn(usize) -> bool,
) {
    let cost = |k: usize| judge.cost(&fits[k]);
    let least = |all: &mut dyn Iterator<Item = usize>| all.min_by(|a, b| cost(*a).total_cmp(&cost(*b)));
    let Some(first) = least(&mut class.iter().copied()) else { return };
    let honest = least(&mut class.iter().copied().filter(|&k| !contradicts(k)))
        .filter(|&k| cost(k) - cost(first) < EQUAL);
    let best = honest.unwrap_or(first);
    let size = |k: usize| fits[k].hypothesis.fitted.len();
    let spare = (0..fits[best].hypothesis.effects.len()).any(|k| fits[best].has_spare(k));
    let eligible = |k: usize| {
        if honest.is_some() && contradicts(k) {
            return false;
        }
        let worse = cost(k) - cost(best);
        let form = !judge.is_exact() && judge.beyond_form(&fits[best], &fits[k]) < 1.0;
        let gives_way = spare || form || gives_way(&fits[best], &fits[k], judge);
        worse < EVEN || (size(k) < size(best) && (worse < EQUAL || gives_way))
    };
    let eligible: Vec<usize> = class.iter().copied().filter(|&k| eligible(k)).collect();
    let smallest = eligible.iter().map(|&k| size(k)).min().unwrap_or_default();
    let simplest = eligible.into_iter().filter(|&k| size(k) == smallest);
    let least = simplest.clone().map(cost).fold(f64::INFINITY, f64::min);
    let named = simplest
        .filter(|&k| cost(k) < least + EVEN)
        .min_by_key(|&k| fits[k].hypothesis.effects.clone())
        .and_then(|named| class.iter().position(|&k| k == named));
    if let Some(named) = named {
        class[..=named].rotate_right(1);
    }
}
