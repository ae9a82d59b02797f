//! The answers as the report states them: effects with their parameters, classes with their probabilities, places.

use std::collections::{BTreeMap, BTreeSet};

use parallax_model::effect::{Effect, Place, PlaceKind};
use parallax_model::system::EffectEntry;

use crate::hypothesis::{Hypothesis, Slot};
use crate::library;
use crate::posterior;
use crate::readings::ReadingEffect;
use crate::report::{FittedEffect, Value, Where, Which};
use crate::search::{Fit, RESTS};
use crate::setup::Setup;

/// The effects of a fit, with their parameters.
pub(crate) fn fitted_effects(setup: &Setup, fit: &Fit) -> Vec<FittedEffect> {
    let (theta, std) = (fit.estimate(), fit.std());
    fit.hypothesis
        .effects
        .iter()
        .enumerate()
        .map(|(e, at)| {
            let fitted = fit.hypothesis.fitted.iter().enumerate();
            let own: Vec<usize> = fitted
                .filter(|(_, f)| match f.slot {
                    Slot::Effect { effect, .. } => effect == e,
                    Slot::Nominal(index) => match library::owner(setup.equations.system(), index) {
                        Some(own) => own.effect == at.effect,
                        None => {
                            at.effect == Effect::Parameter
                                && library::place_index(setup, &at.place) == Some(index)
                        }
                    },
                    Slot::Weight(_) => false,
                })
                .map(|(k, _)| k)
                .collect();
            let values: Vec<f64> = own.iter().map(|&k| theta[k]).collect();
            let values = at.effect.canonical(&values);
            let parameters = own
                .iter()
                .zip(values)
                .map(|(&k, value)| {
                    let f = &fit.hypothesis.fitted[k];
                    // A limit at the end of what the log holds was never reached: it is there or beyond.
                    let limit = matches!(f.name.as_str(), "high" | "low" | "limit" | "lower_limit");
                    let near = RESTS * (f.high - f.low);
                    let unreached = limit && (theta[k] - f.null).abs() <= near;
                    let std = if unreached { f64::INFINITY } else { std[k] };
                    (f.name.clone(), Value { value, std, unit: f.unit.clone() })
                })
                .collect();
            FittedEffect { name: at.effect.name().into(), place: at.place.to_string(), parameters }
        })
        .collect()
}

/// Delay, in standard deviations of the jitter, up to which it is the jitter's mean: of times that are late and never
/// early 1 (exponential) to 1.7 (uniform), with room for error.
const MEAN_OF_JITTER: f64 = 3.0;

/// Whether an effect on times may be how late those are on average that scatter by `spread` (s).
pub(crate) fn is_mean_of(setup: &Setup, effect: &FittedEffect, spread: f64) -> bool {
    let (from, to) = setup.experiment.span();
    let late = |name: &str, share: f64| {
        let value = effect.parameters.get(name).map(|value| value.value * share);
        value.is_some_and(|late| (0.0..MEAN_OF_JITTER * spread).contains(&late))
    };
    match Effect::from_name(&effect.name) {
        Some(Effect::Delay) => late("delay", 1.0),
        // Of second order, what is slow is late by 2 ζ T: the group delay of 1 / (T² s² + 2 ζ T s + 1) at rest.
        Some(Effect::Lag | Effect::SensorLag) => {
            late("time_constant", effect.parameters.get("damping").map_or(1.0, |damping| 2.0 * damping.value))
        }
        // What has parted at the end is twice the mean.
        Some(Effect::ClockSkew) => late("skew", 0.5 * (to - from)),
        _ => false,
    }
}

/// Whether an effect is a lag, which is late by its time constant.
fn is_sluggish(effect: &FittedEffect) -> bool {
    matches!(Effect::from_name(&effect.name), Some(Effect::Lag | Effect::SensorLag))
}

/// The name of an effect of an answer where times scatter, if it acts at one of these places or the data do not tell that it acts
/// elsewhere: what is late anywhere shows everywhere behind it.
fn late_there(answer: &Which, effect: usize, places: &[&str]) -> Option<String> {
    let own = &answer.effects[effect];
    let others: BTreeSet<String> =
        answer.effects.iter().enumerate().filter(|(k, _)| *k != effect).map(|(_, e)| e.label()).collect();
    let mut names = places.iter().map(|place| (place, format!("{}@{place}", own.name)));
    let found = names.find(|(place, there)| {
        let is_in = |name: &String| {
            let parts: BTreeSet<String> = name.split(" + ").map(str::to_owned).collect();
            // What is late there is named beside it where it is one of the others.
            let adds = parts.contains(there) && !others.contains(there);
            adds && parts.len() == others.len() + 1 && others.is_subset(&parts)
        };
        **place == own.place || answer.class.iter().any(is_in)
    });
    found.map(|(_, there)| there)
}

/// What readings show, as an effect of an answer.
pub(crate) fn as_fitted(r: &ReadingEffect) -> FittedEffect {
    FittedEffect { name: r.name.clone(), place: r.place.clone(), parameters: r.parameters.clone() }
}

/// All answers by probability. Effects on how readings scatter that count as causes are part of each.
pub(crate) fn which(
    setup: &Setup,
    posterior: &posterior::Posterior,
    readings: &[ReadingEffect],
) -> Vec<Which> {
    let known = |way: &ReadingEffect| readings.iter().any(|r| r.place == way.place);
    let mut out: Vec<Which> = Vec::new();
    for answer in &posterior.answers {
        let ways = answer.ways().filter(|(way, _)| !known(way)).map(|(way, probability)| {
            let effect = as_fitted(way);
            Which { class: vec![effect.label()], effects: vec![effect], probability }
        });
        let ways: Vec<Which> = ways.collect();
        out.push(Which {
            effects: fitted_effects(setup, &answer.fit),
            class: answer.class.clone(),
            probability: answer.probability - ways.iter().map(|way| way.probability).sum::<f64>(),
        });
        out.extend(ways);
    }
    out.push(Which { effects: Vec::new(), class: Vec::new(), probability: posterior.no_gap });
    // Readings and commands that come late by chance come late on average: a delay of that size is no cause of its own.
    let scattered = || readings.iter().filter(|r| r.name == Effect::Jitter.name());
    let spread_of = |r: &ReadingEffect| r.parameters.get("spread").map(|spread| spread.value);
    let spread = scattered().filter_map(spread_of).fold(0.0, f64::max);
    let scatters = |e: &FittedEffect| scattered().any(|r| r.place == e.place);
    // Commands that scatter do so in all readings; readings of one sensor tell nothing of what another one shows.
    let only_sensor = setup.equations.system().outputs.len() == 1;
    let spread_seen = |answer: &Which| {
        let there = |r: &&ReadingEffect| {
            let place = format!("@{}", r.place);
            let is_place = |name: &String| name.ends_with(&place);
            only_sensor || !r.place.starts_with("output:") || answer.class.iter().any(is_place)
        };
        scattered().filter(there).filter_map(spread_of).fold(0.0, f64::max)
    };
    let (average, rest): (Vec<Which>, Vec<Which>) =
        out.into_iter().partition(|answer| match &answer.effects[..] {
            [only] if only.name == Effect::Delay.name() => {
                // What acts ahead of its stamp by more is no mean of lateness.
                let most = MEAN_OF_JITTER * spread_seen(answer);
                only.parameters.values().all(|delay| delay.value.abs() < most)
            }
            // What is late anywhere shows everywhere behind it, and times that scatter blur how.
            [only] => (scatters(only) || is_sluggish(only)) && is_mean_of(setup, only, spread_seen(answer)),
            _ => false,
        });
    let mut out = rest;
    let places: Vec<&str> = scattered().map(|r| r.place.as_str()).collect();
    for answer in out.iter_mut().filter(|answer| answer.effects.len() > 1) {
        let mut means = answer.effects.iter().enumerate().filter(|(_, e)| is_mean_of(setup, e, spread));
        let mean = means.find_map(|(k, _)| Some((k, late_there(answer, k, &places)?)));
        let Some((mean, there)) = mean else { continue };
        let own = answer.effects.remove(mean).label();
        let mut known = BTreeSet::new();
        let class = std::mem::take(&mut answer.class).into_iter().map(|name| {
            let others: Vec<&str> = name.split(" + ").filter(|part| *part != own && *part != there).collect();
            others.join(" + ")
        });
        answer.class = class.filter(|name| known.insert(name.clone())).collect();
    }
    if let Some(none) = out.iter_mut().find(|answer| answer.effects.is_empty()) {
        none.probability += average.iter().map(|answer| answer.probability).sum::<f64>();
    }
    let mut out = merged(out);
    let labels: Vec<String> = readings.iter().map(|r| format!("{}@{}", r.name, r.place)).collect();
    for answer in &mut out {
        if labels.is_empty() {
            break;
        }
        for name in &mut answer.class {
            *name = format!("{name} + {}", labels.join(" + "));
        }
        if answer.class.is_empty() {
            answer.class.push(labels.join(" + "));
        }
        answer.effects.extend(readings.iter().map(as_fitted));
    }
    out.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    out
}

/// One answer of those that name the same effects, the likeliest: without what others stand for the mean of, some are one.
fn merged(all: Vec<Which>) -> Vec<Which> {
    let names = |which: &Which| which.effects.iter().map(FittedEffect::label).collect::<BTreeSet<String>>();
    let mut out: Vec<Which> = Vec::new();
    for which in all {
        match out.iter_mut().find(|known| names(known) == names(&which)) {
            Some(known) => {
                known.probability += which.probability;
                let new =
                    which.class.into_iter().filter(|name| !known.class.contains(name)).collect::<Vec<_>>();
                known.class.extend(new);
            }
            None => out.push(which),
        }
    }
    out
}

/// Difference in probability within which two places are as likely: below what a report shows of it.
const AS_LIKELY: f64 = 1e-3;

/// Places by the probability that something of the cause acts there, with what the best single effect there closes.
pub(crate) fn places(posterior: &posterior::Posterior, readings: &[ReadingEffect]) -> Vec<Where> {
    let mut by_place: BTreeMap<String, Where> = BTreeMap::new();
    for answer in &posterior.answers {
        for (effects, probability, share) in &answer.members {
            let places: BTreeSet<String> = effects.iter().map(|at| at.place.to_string()).collect();
            let alone = places.len() == 1;
            for place in places {
                let entry = by_place.entry(place).or_insert_with_key(|place| Where {
                    place: place.clone(),
                    share: 0.0,
                    probability: 0.0,
                });
                entry.share = entry.share.max(if alone { *share } else { 0.0 });
                entry.probability += probability;
            }
        }
    }
    for reading in readings {
        let entry = by_place.entry(reading.place.clone()).or_insert_with(|| Where {
            place: reading.place.clone(),
            share: 0.0,
            probability: 0.0,
        });
        entry.share = entry.share.max(reading.share.unwrap_or(0.0));
        entry.probability = 1.0;
    }
    let mut out: Vec<Where> = by_place.into_values().collect();
    out.sort_by(|a, b| b.probability.total_cmp(&a.probability).then(b.share.total_cmp(&a.share)));
    // Of places that are as likely, that of what is named comes first.
    let leader = posterior.answers.first().and_then(|answer| answer.members.first());
    let leads = |place: &Where| {
        leader.is_some_and(|(effects, ..)| effects.iter().any(|at| at.place.to_string() == place.place))
    };
    let most = out.first().map_or(0.0, |place| place.probability);
    let as_likely = out.iter().take_while(|place| most - place.probability < AS_LIKELY);
    if let Some(leading) = as_likely.into_iter().position(leads) {
        out[..=leading].rotate_right(1);
    }
    out
}

/// The speed within which dry friction was smoothed, in steps so many times finer than those of a search.
fn smoothing(setup: &Setup, effect: &FittedEffect, fineness: f64) -> Option<f64> {
    let place: Place = effect.place.parse().ok()?;
    let joint = setup.equations.system().joint(&place.key).filter(|_| place.kind == PlaceKind::Joint)?;
    let parameters: Vec<&str> = effect.parameters.keys().map(String::as_str).collect();
    let dry = Effect::with_parameters(&effect.name, &parameters).is_some_and(Effect::is_dry);
    dry.then(|| setup.joints[joint].smoothing / fineness)
}

/// What is added to a corrected system, of effects that were fitted under this hypothesis.
pub(crate) fn corrected_effects(
    setup: &Setup,
    hypothesis: &Hypothesis,
    effects: &[FittedEffect],
) -> Vec<EffectEntry> {
    effects
        .iter()
        // A parameter with another value is written as that value.
        .filter(|e| e.name != Effect::Parameter.name() && Effect::from_name(&e.name).is_some())
        .map(|e| EffectEntry {
            name: e.name.clone(),
            place: e.place.clone(),
            parameters: e.parameters.iter().map(|(name, v)| (name.clone(), v.value)).collect(),
            smoothing: smoothing(setup, e, hypothesis.fineness()),
            line: 0,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn effect(name: &str, place: &str) -> FittedEffect {
        FittedEffect { name: name.into(), place: place.into(), parameters: BTreeMap::new() }
    }

    fn tilted_and_late(class: &[&str]) -> Which {
        let effects = vec![effect("gravity_tilt", "joint:shaft"), effect("delay", "input:goal")];
        Which { effects, class: class.iter().map(|name| (*name).to_owned()).collect(), probability: 1.0 }
    }

    #[test]
    fn a_late_command_may_be_late_readings_where_the_data_do_not_tell_them_apart() {
        let alike = tilted_and_late(&["delay@output:position + gravity_tilt@joint:shaft"]);
        assert_eq!(late_there(&alike, 1, &["output:position"]).as_deref(), Some("delay@output:position"));
        // Of another reading the data say no such thing, nor where something else would have to be exchanged as well.
        assert_eq!(late_there(&alike, 1, &["output:current"]), None);
        for other in ["delay@output:position", "delay@output:position + wind@joint:shaft"] {
            assert_eq!(late_there(&tilted_and_late(&[other]), 1, &["output:position"]), None, "{other}");
        }
        assert_eq!(late_there(&alike, 1, &["input:goal"]).as_deref(), Some("delay@input:goal"));
    }
}
