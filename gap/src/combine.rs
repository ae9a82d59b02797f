//! Several effects at once: from the best single ones forward, and back where one of them is not needed.

use std::cell::OnceCell;

use nalgebra::{DMatrix, DVector};
use parallax_model::effect::Effect;
use rayon::prelude::*;

use crate::hypothesis::{EffectAt, Hypothesis, Slot};
use crate::judge::{DECISIVE, EVEN, Judge, WORTH};
use crate::library;
use crate::search::{Fit, INEXACT, Width, fit_all, fit_hypothesis, fit_part};
use crate::setup::Setup;
use crate::signature::{self, Nuisance};
use crate::stop::SEVERAL;

/// Single effects from which combinations begin in any case.
const BASES: usize = 2;

/// Single effects of which those that promise most are beginnings as well, and how many.
const PROMISING: usize = 6;
const PROMISED: usize = 1;

/// Difference of −2 log evidence up to which another single effect is a beginning as well.
const RIVAL: f64 = 50.0;

/// Effects that are fitted beside a base, the highest in a score test.
const ADDED: usize = 8;

/// Most effects at once.
const MOST: usize = 4;

/// Standard deviations from their nulls beyond which an effect is not tried to be left out.
const CERTAIN: f64 = 20.0;

/// Most that any effect may promise, in a score test, beside a combination with which nothing is left: the largest of
/// some hundred tests by chance.
const NOTHING: f64 = 20.0;

/// Difference of −2 log evidence up to which two effects alone are one and the same.
const TWIN: f64 = 0.01;

/// An effect that may be added, with its fit alone.
#[derive(Clone, Copy)]
struct Candidate<'a> {
    at: &'a EffectAt,
    alone: &'a Fit,
    /// Whether it explains something alone: then where it does so is a start of its own.
    helps: bool,
}

/// Combinations that are worth their further effects; `fits` are single effects in their best forms, the best first, and
/// `forms` are all of them. Single effects that were fitted better from where they are in a combination are among what it
/// gives.
#[must_use]
pub fn combinations<'a>(
    setup: &Setup,
    null: &Fit,
    fits: &'a [Fit],
    forms: &[EffectAt],
    judge: &Judge,
) -> Vec<Fit> {
    let helps = |alone: &Fit| judge.cost(alone) < judge.cost(null) - WORTH;
    let candidate = |alone: &'a Fit| {
        Some(Candidate { at: alone.hypothesis.effects.first()?, alone, helps: helps(alone) })
    };
    let pool: Vec<Candidate<'_>> = fits.iter().filter_map(candidate).collect();
    let mut found: Vec<Fit> = Vec::new();
    let (first, further) = beginnings(setup, null, fits, &pool, judge);
    let judge = &mut judge.clone();
    for (k, base) in first.iter().chain(&further).enumerate() {
        // Where nothing reaches the noise, there is always more, and no end.
        if k == first.len() && (!judge.is_exact() || is_settled(setup, fits, &found, &pool, judge)) {
            break;
        }
        if setup.stop.leaves_out(|| SEVERAL.into()) {
            break;
        }
        let Grown { fit: mut base, again, rejected } =
            grown(setup, null, (*base).clone(), fits, &pool, judge);
        found.extend(again);
        // Two effects that are not worth it in the forms that explain most alone may be so in others.
        let apart = |_: &&Fit| k < first.len() && base.hypothesis.effects.len() < 2;
        let from = rejected.as_ref().filter(apart).unwrap_or(&base);
        let other = exchanged(setup, null, from, fits, (&pool, forms), judge);
        if let Some(other) = other.filter(|other| std::ptr::eq(from, &base) || judge.is_worth(other, &base)) {
            base = grown(setup, null, other, fits, &pool, judge).fit;
        }
        if setup.stop.asked() {
            return found;
        }
        if base.hypothesis.effects.len() < 2 {
            continue;
        }
        let base = simplify(setup, null, prune(setup, null, base, fits, &pool, judge), &pool, judge);
        let known = |other: &Fit| same(&other.hypothesis.effects, &base.hypothesis.effects);
        if base.hypothesis.effects.len() < 2
            || found.iter().any(known)
            || explained_by_one(setup, &base, fits, &pool, judge)
        {
            continue;
        }
        let singles = restarted(setup, null, &base, fits, judge);
        if !explained_by_one(setup, &base, &singles, &pool, judge) {
            let others = twins(setup, null, &base, fits, judge);
            found.push(base);
            found.extend(others);
        }
        found.extend(singles);
    }
    found
}

/// An effect alone, from where it is beside another one (`beside`), where it is fitted better so: on its own way there it stuck
/// (`known`), and the other one would pay for the rest of the way.
fn again(setup: &Setup, null: &Fit, known: &Fit, beside: &Fit, judge: &Judge) -> Option<Fit> {
    let single = fit_part(setup, null, library::hypothesis(setup, &known.hypothesis.effects), beside);
    let better = judge.cost(&single) < judge.cost(known) - EVEN;
    (better && library::is_possible(setup, &single)).then_some(single)
}

/// The forms that have fewer parameters than those that explain most, fitted again from there, as long as one of theirs is to
/// spare: one that does no more than a simpler form need not have found more than that one would.
pub fn forms_to_spare(setup: &Setup, null: &Fit, fits: &[Fit], judge: &Judge) -> Vec<(usize, Fit)> {
    let of_leaders = fits.iter().take(BASES).filter(|leader| leader.has_spare(0));
    let simpler = of_leaders.flat_map(|leader| {
        let (label, size) = (leader.hypothesis.label(), leader.hypothesis.fitted.len());
        let has_less = move |fit: &Fit| fit.hypothesis.label() == label && fit.hypothesis.fitted.len() < size;
        fits.iter().enumerate().filter(move |(_, fit)| has_less(fit)).map(move |(k, fit)| (k, fit, leader))
    });
    let simpler: Vec<(usize, &Fit, &Fit)> = simpler.filter(|_| !setup.stop.asked()).collect();
    simpler
        .into_par_iter()
        .filter_map(|(k, fit, leader)| Some((k, again(setup, null, fit, leader, judge)?)))
        .collect()
}

/// Each effect of a pair [`again`].
fn restarted(setup: &Setup, null: &Fit, fit: &Fit, fits: &[Fit], judge: &Judge) -> Vec<Fit> {
    if fit.hypothesis.effects.len() != 2 || setup.stop.leaves_out(|| SEVERAL.into()) {
        return Vec::new();
    }
    let own = fit.hypothesis.effects.par_iter();
    let known = own.filter_map(|at| fits.iter().find(|f| f.hypothesis.effects == [at.clone()]));
    known.filter_map(|known| again(setup, null, known, fit, judge)).collect()
}

/// What a fit grew to.
struct Grown {
    /// With further effects, one by one, as long as they are worth it.
    fit: Fit,
    /// The single one that it began with, where that is fitted better [`again`].
    again: Option<Fit>,
    /// The best with one effect more, which was not worth it.
    rejected: Option<Fit>,
}

/// A fit with further effects.
fn grown(
    setup: &Setup,
    null: &Fit,
    mut base: Fit,
    fits: &[Fit],
    pool: &[Candidate<'_>],
    judge: &mut Judge,
) -> Grown {
    let (mut refitted, mut rejected) = (None, None);
    while base.hypothesis.effects.len() < MOST && !setup.stop.leaves_out(|| SEVERAL.into()) {
        let Some(next) = extend(setup, null, &base, fits, pool, judge) else { break };
        if base.hypothesis.effects.len() == 1 && refitted.is_none() {
            refitted = again(setup, null, &base, &next, judge);
            if let Some(single) = &refitted {
                base = single.clone();
                continue;
            }
        }
        let complete = || leaves_nothing(setup, &next, pool);
        if !judge.is_worth_or(&next, &base, complete) || !judge.is_worth(&next, null) {
            rejected = Some(next);
            break;
        }
        base = next;
    }
    Grown { fit: base, again: refitted, rejected }
}

/// Where the noise is not reached: the best combination with another effect, or another form, in the place of one of
/// them. Each was chosen before what came later was known.
fn exchanged(
    setup: &Setup,
    null: &Fit,
    fit: &Fit,
    fits: &[Fit],
    (pool, forms): (&[Candidate<'_>], &[EffectAt]),
    judge: &mut Judge,
) -> Option<Fit> {
    let effects = &fit.hypothesis.effects;
    if effects.len() < 2 || fit.shooting_error <= INEXACT {
        return None;
    }
    let mut others: Vec<Fit> = Vec::new();
    for (left_out, own) in effects.iter().enumerate() {
        if setup.stop.leaves_out(|| SEVERAL.into()) {
            return None;
        }
        let rest = without(setup, null, fit, left_out, fits);
        let others_of = forms.iter().filter(|at| at.label() == own.label() && *at != own);
        let with = |form: &EffectAt| {
            let effects = rest.hypothesis.effects.iter().chain([form]).cloned().collect::<Vec<_>>();
            library::hypothesis(setup, &effects)
        };
        others.extend(fit_all(setup, &rest, others_of.map(with).collect(), Width::FURTHER, &|_| ()));
        // The last one was chosen beside all others.
        if left_out + 1 < effects.len() {
            others.extend(extend(setup, null, &rest, fits, pool, judge));
        }
    }
    let best = others.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)))?;
    (judge.cost(&best) < judge.cost(fit) - WORTH).then_some(best)
}

/// A combination without one of its effects.
fn without(setup: &Setup, null: &Fit, fit: &Fit, left_out: usize, fits: &[Fit]) -> Fit {
    let mut rest = fit.hypothesis.effects.clone();
    rest.remove(left_out);
    match fits.iter().find(|f| same(&f.hypothesis.effects, &rest)) {
        Some(known) => known.clone(),
        // From where they are beside it; another start may have missed them.
        None => fit_part(setup, null, library::hypothesis(setup, &rest), fit),
    }
}

/// Whether a single effect with which the noise is reached explains as much as several do, whichever they began with: then
/// these only share out what the one does.
fn explained_by_one(setup: &Setup, fit: &Fit, fits: &[Fit], pool: &[Candidate<'_>], judge: &Judge) -> bool {
    let complete = OnceCell::new();
    let complete = || *complete.get_or_init(|| leaves_nothing(setup, fit, pool));
    let mut exact = fits.iter().filter(|single| single.shooting_error <= INEXACT);
    exact.any(|single| !judge.is_worth_or(fit, single, complete))
}

/// Where combinations begin: at the best single effects, and at those further ones with which a second effect promises
/// more than with the best. Of two causes neither need be what explains most alone.
fn beginnings<'a>(
    setup: &Setup,
    null: &Fit,
    fits: &'a [Fit],
    pool: &[Candidate<'_>],
    judge: &Judge,
) -> (Vec<&'a Fit>, Vec<&'a Fit>) {
    // Where nothing reaches the noise, two effects may do together what neither promises alone.
    let helps = |fit: &Fit| {
        judge.is_worth(fit, null) || (!judge.is_exact() && judge.cost(fit) < judge.cost(null) - EVEN)
    };
    let near = |fit: &Fit| judge.cost(fit) < judge.cost(&fits[0]) + RIVAL;
    let mut chosen: Vec<&Fit> = fits.iter().take(BASES).filter(|fit| helps(fit) && near(fit)).collect();
    let Some(first) = chosen.first() else { return (chosen, Vec::new()) };
    let promise = |base: &Fit| {
        let nuisance = Nuisance::new(base);
        let best = pool.par_iter().filter(|other| !base.hypothesis.effects.contains(other.at));
        let most = best.map(|other| score(setup, base, &nuisance, other.at)).reduce(|| 0.0, f64::max);
        let (all, count) = (nuisance.innovations.norm_squared(), nuisance.innovations.len() as f64);
        // What the likelihood gains once the noise is that of the rest.
        base.innovation.evidence_cost + count * (1.0 - most / all).max(1e-6).ln()
    };
    let mut rivals: Vec<(f64, &Fit)> = Vec::new();
    for (k, fit) in fits.iter().enumerate().take(PROMISING).skip(chosen.len()) {
        let twin = fits[..k].iter().any(|other| (judge.cost(other) - judge.cost(fit)).abs() < TWIN);
        if !twin && helps(fit) && !setup.stop.asked() {
            rivals.push((promise(fit), fit));
        }
    }
    let least = promise(first) - WORTH;
    rivals.sort_by(|a, b| a.0.total_cmp(&b.0));
    let promised = rivals.iter().filter(|(promise, _)| *promise < least).take(PROMISED).count();
    let mut rivals: Vec<&Fit> = rivals.into_iter().map(|(_, fit)| fit).collect();
    let further = rivals.split_off(promised);
    chosen.extend(rivals);
    (chosen, further)
}

/// Whether one of these leaves nothing material, or nothing at all to any other effect.
fn is_settled(setup: &Setup, fits: &[Fit], found: &[Fit], pool: &[Candidate<'_>], judge: &Judge) -> bool {
    let best = fits.iter().chain(found).min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)));
    best.is_some_and(|best| {
        !judge.is_material_from(best.shooting_error, 1.0)
            || (best.shooting_error <= INEXACT && leaves_nothing(setup, best, pool))
    })
}

/// The combination with one of its effects in the place of which stands another that alone fits exactly as well: one
/// sensor's delay and the command's.
fn twins(setup: &Setup, null: &Fit, fit: &Fit, fits: &[Fit], judge: &Judge) -> Vec<Fit> {
    let effects = &fit.hypothesis.effects;
    let alone =
        |at: &EffectAt| fits.iter().find(|f| f.hypothesis.effects == [at.clone()]).map(|f| judge.cost(f));
    let mut found = Vec::new();
    for (k, at) in effects.iter().enumerate() {
        let Some(own) = alone(at) else { continue };
        for twin in fits.iter().filter_map(|f| f.hypothesis.effects.first()) {
            let even = alone(twin).is_some_and(|cost| (cost - own).abs() < TWIN);
            if !even || effects.contains(twin) || setup.stop.leaves_out(|| SEVERAL.into()) {
                continue;
            }
            let mut with = effects.clone();
            with[k] = twin.clone();
            found.push(fit_hypothesis(setup, null, library::hypothesis(setup, &with)));
        }
    }
    found
}

/// The best fit with one effect more, if any effect promises something.
fn extend(
    setup: &Setup,
    null: &Fit,
    base: &Fit,
    singles: &[Fit],
    pool: &[Candidate<'_>],
    judge: &mut Judge,
) -> Option<Fit> {
    // What repeats shows best beside what the base explains.
    let setup = &setup.with_lines_of(&base.innovation.pass);
    let nuisance = Nuisance::new(base);
    let others: Vec<&Candidate<'_>> = pool
        .iter()
        .filter(|other| !base.hypothesis.effects.iter().any(|own| overlap(own, other.at)))
        .collect();
    let mut scores: Vec<(f64, &EffectAt, Hypothesis)> = others
        .into_par_iter()
        .map(|other| {
            let mut effects = base.hypothesis.effects.clone();
            effects.push(other.at.clone());
            let mut hypothesis = library::hypothesis(setup, &effects);
            let mut most = score(setup, base, &nuisance, other.at);
            if other.helps {
                let start = hypothesis.starts_at(&other.alone.hypothesis, other.alone.estimate());
                let columns = signature::columns_of(setup, base, &hypothesis, start);
                most = most.max(score_of(&nuisance, &columns));
            }
            (most, other.at, hypothesis)
        })
        .collect();
    scores.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(b.1)));
    // Where the noise is not reached, the innovations are ruled by what all lack: there the windows decide.
    let open = base.shooting_error > INEXACT;
    let promising = scores.into_iter().filter(|(score, ..)| open || *score > WORTH).take(ADDED);
    let hypotheses: Vec<_> = promising.map(|(_, _, hypothesis)| hypothesis).collect();
    if hypotheses.is_empty() {
        return None;
    }
    let fits = fit_all(setup, base, hypotheses, Width::FURTHER, &|_| ());
    if !judge.is_exact() && fits.iter().any(|fit| fit.shooting_error <= INEXACT) {
        // Of what several reach the noise with no single one could judge.
        *judge = Judge::new(null, singles.iter().chain(&fits));
    }
    let chosen = simplest(&fits, |fit| judge.cost(fit))?;
    if base.shooting_error <= INEXACT {
        // With a model that is right the innovations say most: windows take a late sensor for another start.
        let small: Vec<Fit> = fits.iter().filter(|fit| judge.gains(fit, base)).cloned().collect();
        let complete = simplest(&small, |fit| fit.innovation.evidence_cost).filter(|fit| {
            same(&fit.hypothesis.effects, &chosen.hypothesis.effects) || leaves_nothing(setup, fit, pool)
        });
        return complete.or(Some(chosen));
    }
    Some(chosen)
}

/// Of fits that neither the cost nor the innovations tell apart from the best, the simplest; of these the first in the library's
/// order where it is truly even.
fn simplest(fits: &[Fit], cost: impl Fn(&Fit) -> f64) -> Option<Fit> {
    let best = fits.iter().min_by(|a, b| cost(a).total_cmp(&cost(b)))?;
    let follows = |fit: &Fit| fit.innovation.evidence_cost < best.innovation.evidence_cost + DECISIVE;
    let even: Vec<&Fit> = fits.iter().filter(|fit| cost(fit) < cost(best) + WORTH && follows(fit)).collect();
    let size = |fit: &Fit| fit.hypothesis.fitted.len();
    let smallest = even.iter().map(|fit| size(fit)).min()?;
    let simplest: Vec<&Fit> = even.into_iter().filter(|fit| size(fit) == smallest).collect();
    let least = simplest.iter().map(|fit| cost(fit)).fold(f64::INFINITY, f64::min);
    let best = simplest.into_iter().filter(|fit| cost(fit) < least + EVEN);
    best.min_by(|a, b| a.hypothesis.effects.cmp(&b.hypothesis.effects)).cloned()
}

/// Whether no effect of the library promises anything beside a fit.
fn leaves_nothing(setup: &Setup, fit: &Fit, pool: &[Candidate<'_>]) -> bool {
    let setup = &setup.with_lines_of(&fit.innovation.pass);
    let nuisance = Nuisance::new(fit);
    let others =
        pool.par_iter().filter(|other| !fit.hypothesis.effects.iter().any(|own| overlap(own, other.at)));
    others.map(|other| score(setup, fit, &nuisance, other.at)).reduce(|| 0.0, f64::max) < NOTHING
}

/// Effects, each with its [signature](signature::columns), by what a score test of the base's innovations promises of them, the
/// most promising first.
#[must_use]
pub fn by_promise(
    setup: &Setup,
    base: &Fit,
    nuisance: &Nuisance,
    effects: &[EffectAt],
    columns: &[DMatrix<f64>],
) -> Vec<EffectAt> {
    let mut scores: Vec<(f64, &EffectAt)> = effects
        .par_iter()
        .zip(columns)
        .map(|(at, columns)| (score_with(setup, base, nuisance, at, columns), at))
        .collect();
    // The sort is stable: of equal effects the library's order holds.
    scores.sort_by(|a, b| b.0.total_cmp(&a.0));
    scores.into_iter().map(|(_, at)| at.clone()).collect()
}

/// How much of the base's squared innovations an effect's signature takes, at most: a score test.
fn score(setup: &Setup, base: &Fit, nuisance: &Nuisance, at: &EffectAt) -> f64 {
    score_with(setup, base, nuisance, at, &signature::columns(setup, base, at))
}

/// The same where the signature at the first start is known.
fn score_with(setup: &Setup, base: &Fit, nuisance: &Nuisance, at: &EffectAt, first: &DMatrix<f64>) -> f64 {
    let further = signature::columns_at_further_starts(setup, base, at);
    further.iter().map(|columns| score_of(nuisance, columns)).fold(score_of(nuisance, first), f64::max)
}

fn score_of(nuisance: &Nuisance, columns: &DMatrix<f64>) -> f64 {
    let basis = signature::orthonormal(&nuisance.project_columns(columns));
    let along: DVector<f64> = basis.transpose() * &nuisance.innovations;
    Some(along.norm_squared()).filter(|score| score.is_finite()).unwrap_or(0.0)
}

/// Leaves out each effect without which the evidence loses less than [`WORTH`], the least needed first.
fn prune(
    setup: &Setup,
    null: &Fit,
    mut fit: Fit,
    fits: &[Fit],
    pool: &[Candidate<'_>],
    judge: &Judge,
) -> Fit {
    while fit.hypothesis.effects.len() > 1 && !setup.stop.leaves_out(|| SEVERAL.into()) {
        let doubtful: Vec<usize> =
            (0..fit.hypothesis.effects.len()).filter(|k| !is_certain(&fit, *k)).collect();
        let shorter: Vec<Fit> =
            doubtful.into_par_iter().map(|left_out| without(setup, null, &fit, left_out, fits)).collect();
        let best = shorter.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)));
        let complete = || leaves_nothing(setup, &fit, pool);
        match best.filter(|best| !judge.is_worth_or(&fit, best, complete)) {
            Some(simpler) => fit = simpler,
            None => break,
        }
    }
    fit
}

/// Puts a simpler effect in the place of one that contains it, where that one is not worth it, or hardly and what the simpler one
/// leaves out is not told from nothing.
fn simplify(setup: &Setup, null: &Fit, mut fit: Fit, pool: &[Candidate<'_>], judge: &Judge) -> Fit {
    for k in 0..fit.hypothesis.effects.len() {
        for simpler in fit.hypothesis.effects[k].effect.simpler() {
            if setup.stop.leaves_out(|| SEVERAL.into()) {
                return fit;
            }
            let mut effects = fit.hypothesis.effects.clone();
            effects[k].effect = *simpler;
            let repeated = effects.iter().enumerate().any(|(i, at)| effects[..i].contains(at));
            if repeated {
                continue;
            }
            let other = fit_hypothesis(setup, null, library::hypothesis(setup, &effects));
            let complete = || leaves_nothing(setup, &fit, pool);
            if !judge.is_worth_or(&fit, &other, complete) || judge.is_spare(&fit, k, &other) {
                fit = other;
                break;
            }
        }
    }
    fit
}

/// Whether every parameter of an effect is far from its null: a frequency may be where there is no amplitude, and a parameter of the
/// model that is free of its range may have come back into it.
fn is_certain(fit: &Fit, effect: usize) -> bool {
    if fit.hypothesis.effects[effect].effect == Effect::Parameter {
        return false;
    }
    let values = fit.theta().iter().zip(fit.innovation.minimum.std());
    let own = fit
        .hypothesis
        .fitted
        .iter()
        .zip(values)
        .filter(|(f, _)| matches!(f.slot, Slot::Effect { effect: of, .. } if of == effect));
    own.map(|(f, (value, std))| (value - f.null).abs() / std).all(|away| away > CERTAIN)
}

/// Whether two effects are one, or one contains the other at its place: they are alternatives, not companions.
fn overlap(a: &EffectAt, b: &EffectAt) -> bool {
    let contains =
        |a: &EffectAt, b: &EffectAt| a.effect == b.effect || a.effect.simpler().contains(&b.effect);
    a.place == b.place && (contains(a, b) || contains(b, a))
}

/// Whether two lists hold the same effects.
fn same(a: &[EffectAt], b: &[EffectAt]) -> bool {
    a.len() == b.len() && a.iter().all(|at| b.contains(at))
}
