//! Why an effect on how readings scatter is not the answer: what the readings show of it.

use parallax_model::effect::{Effect, PlaceKind};

use super::{Explanation, Fate};
use crate::answers::as_fitted;
use crate::hypothesis::EffectAt;
use crate::library;
use crate::options::Options;
use crate::readings::ReadingEffect;
use crate::report::Which;
use crate::setup::Setup;

/// Explains every effect on how readings scatter that the user asked about and that is not among the explanations so far (`known`), in the
/// order of the library. `readings` are those that were found, `causes` those of them that are named, `winner` is the leading answer.
pub(crate) fn of_readings(
    setup: &Setup,
    options: &Options,
    known: &[Explanation],
    (readings, causes): (&[ReadingEffect], &[ReadingEffect]),
    winner: Option<&Which>,
) -> Vec<Explanation> {
    let asked = |at: &EffectAt| options.explain.iter().any(|pattern| pattern.fits(at));
    let all = library::statistical(setup).into_iter().filter(asked);
    let new = all.filter(|at| !known.iter().any(|explanation| explanation.effect == at.label()));
    let winner = winner.map_or_else(String::new, |which| {
        let labels: Vec<String> = which.effects.iter().map(|effect| effect.label()).collect();
        if labels.is_empty() { "no gap".into() } else { labels.join(" + ") }
    });
    new.map(|at| {
        let of = |all: &[ReadingEffect]| all.iter().find(|r| as_fitted(r).label() == at.label()).cloned();
        let (named, found) = (of(causes), of(readings));
        let fate = match (&named, &found) {
            (Some(_), _) => Fate::Leads,
            (None, Some(found)) if found.significant => Fate::NotShown { reason: LEFT_BY_OTHERS.into() },
            (None, Some(_)) => Fate::NotShown { reason: TOO_LITTLE.into() },
            (None, None) => Fate::NotShown { reason: not_looked_for(setup, options, &at).into() },
        };
        let found = named.or(found);
        Explanation {
            effect: at.label(),
            fate,
            winner: winner.clone(),
            evidence: None,
            against_no_effect: found.as_ref().map(|found| -0.5 * found.evidence),
            error: None,
            winner_error: None,
            parameters: found.map(|found| found.parameters).unwrap_or_default(),
            worse: Vec::new(),
        }
    })
    .collect()
}

const LEFT_BY_OTHERS: &str =
    "what the readings show of it is what another cause leaves, or too little of the gap";
const TOO_LITTLE: &str = "the readings show no more of it than chance may, or less than they scatter anyway";

/// Why nothing was found of an effect.
fn not_looked_for(setup: &Setup, options: &Options, at: &EffectAt) -> &'static str {
    let system = setup.equations.system();
    if system.effects.iter().any(|e| e.name == at.effect.name() && e.place == at.place.to_string()) {
        return "the system states it";
    }
    if !options.allows(at) {
        return "it was left out on request";
    }
    let declares_noise = || {
        let output = system.outputs.iter().find(|output| output.name == at.place.key);
        output.is_some_and(|output| output.noise.is_some())
    };
    match (at.place.kind, at.effect) {
        (PlaceKind::Input, _) => "its commands hardly change, or change nothing that is read",
        (_, Effect::Quantization) => "its readings lie on no lattice",
        (_, Effect::Stuck) => "none of its readings repeats the one before while it moves",
        (_, Effect::Outliers) => "none of its readings lies far from its neighbours",
        (_, Effect::Drops) => "none of its readings is missing on an even grid of stamps",
        (_, Effect::Noise) if !declares_noise() => "the system declares no `noise` to hold it against",
        (_, Effect::Noise) => "its readings move more from one to the next than they scatter",
        _ => "it has too few readings",
    }
}
