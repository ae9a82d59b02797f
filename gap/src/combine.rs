//! Several effects at once: from the best single ones forward, and back where one of them is not needed.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::hypothesis::{EffectAt, Slot};
use crate::judge::{EVEN, Judge, WORTH};
use crate::library;
use crate::search::{Fit, Width, fit_all, fit_hypothesis};
use crate::setup::Setup;
use crate::signature::{self, Nuisance};
use crate::stop::SEVERAL;

/// Single effects from which combinations begin.
const BASES: usize = 2;

/// Difference of −2 log evidence up to which another single effect is a beginning as well.
const RIVAL: f64 = 50.0;

/// Effects that are fitted beside a base, the highest in a score test.
const ADDED: usize = 8;

/// Most effects at once.
const MOST: usize = 4;

/// Squared distance from its null beyond which an effect is not tried to be left out.
const CERTAIN: f64 = 400.0;

/// Difference of −2 log evidence up to which two effects alone are one and the same.
const TWIN: f64 = 0.01;

/// Combinations that are worth their further effects; `fits` are single effects, the best first.
#[must_use]
pub fn combinations(setup: &Setup, null: &Fit, fits: &[Fit], judge: &Judge) -> Vec<Fit> {
    let pool: Vec<EffectAt> = fits.iter().filter_map(|f| f.hypothesis.effects.first().cloned()).collect();
    let mut found: Vec<Fit> = Vec::new();
    for base in fits
        .iter()
        .take(BASES)
        .filter(|base| judge.is_worth(base, null) && judge.cost(base) < judge.cost(&fits[0]) + RIVAL)
    {
        if setup.stop.leaves_out(|| SEVERAL.into()) {
            break;
        }
        let mut base = base.clone();
        while base.hypothesis.effects.len() < MOST {
            let Some(next) = extend(setup, &base, &pool, judge) else { break };
            if !judge.is_worth(&next, &base) {
                break;
            }
            if setup.stop.leaves_out(|| SEVERAL.into()) {
                return found;
            }
            base = next;
        }
        if base.hypothesis.effects.len() < 2 {
            continue;
        }
        let base = simplify(setup, null, prune(setup, null, base, fits, judge), judge);
        let known = |other: &Fit| same(&other.hypothesis.effects, &base.hypothesis.effects);
        if base.hypothesis.effects.len() > 1 && !found.iter().any(known) {
            let others = twins(setup, null, &base, fits, judge);
            found.push(base);
            found.extend(others);
        }
    }
    found
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
fn extend(setup: &Setup, base: &Fit, pool: &[EffectAt], judge: &Judge) -> Option<Fit> {
    let nuisance = Nuisance::new(base);
    let others: Vec<&EffectAt> = pool.iter().filter(|at| !base.hypothesis.effects.contains(at)).collect();
    let mut scores: Vec<(f64, &EffectAt)> =
        others.into_par_iter().map(|at| (score(setup, base, &nuisance, at), at)).collect();
    scores.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(b.1)));
    let hypotheses: Vec<_> = scores
        .iter()
        .filter(|(score, _)| *score > WORTH)
        .take(ADDED)
        .map(|(_, at)| {
            let mut effects = base.hypothesis.effects.clone();
            effects.push((*at).clone());
            library::hypothesis(setup, &effects)
        })
        .collect();
    if hypotheses.is_empty() {
        return None;
    }
    let fits = fit_all(setup, base, hypotheses, Width::FURTHER, &|_| ());
    let least = fits.iter().map(|fit| judge.cost(fit)).fold(f64::INFINITY, f64::min);
    // Of those that the evidence does not tell apart, the simplest; of these the first in the library's order where it is
    // truly even.
    let even: Vec<Fit> = fits.into_iter().filter(|fit| judge.cost(fit) < least + WORTH).collect();
    let size = |fit: &Fit| fit.hypothesis.fitted.len();
    let smallest = even.iter().map(size).min()?;
    let simplest: Vec<Fit> = even.into_iter().filter(|fit| size(fit) == smallest).collect();
    let least = simplest.iter().map(|fit| judge.cost(fit)).fold(f64::INFINITY, f64::min);
    let best = simplest.into_iter().filter(|fit| judge.cost(fit) < least + EVEN);
    best.min_by(|a, b| a.hypothesis.effects.cmp(&b.hypothesis.effects))
}

/// How much of the base's squared innovations an effect's signature takes, at most: a score test.
fn score(setup: &Setup, base: &Fit, nuisance: &Nuisance, at: &EffectAt) -> f64 {
    let columns = nuisance.project_columns(&signature::columns(setup, base, at));
    let basis = signature::orthonormal(&columns);
    let along: DVector<f64> = basis.transpose() * &nuisance.innovations;
    let score = along.norm_squared();
    if score.is_finite() { score } else { 0.0 }
}

/// Leaves out each effect without which the evidence loses less than [`WORTH`], the least needed first.
fn prune(setup: &Setup, null: &Fit, mut fit: Fit, fits: &[Fit], judge: &Judge) -> Fit {
    while fit.hypothesis.effects.len() > 1 && !setup.stop.leaves_out(|| SEVERAL.into()) {
        let effects = fit.hypothesis.effects.clone();
        let doubtful: Vec<usize> =
            (0..effects.len()).filter(|k| distance(&fit, *k).is_none_or(|d| d < CERTAIN)).collect();
        let without = doubtful.into_par_iter().map(|left_out| {
            let mut rest = effects.clone();
            rest.remove(left_out);
            match fits.iter().find(|f| same(&f.hypothesis.effects, &rest)) {
                Some(known) => known.clone(),
                None => fit_hypothesis(setup, null, library::hypothesis(setup, &rest)),
            }
        });
        let without: Vec<Fit> = without.collect();
        let best = without.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)));
        match best.filter(|best| !judge.is_worth(&fit, best)) {
            Some(simpler) => fit = simpler,
            None => break,
        }
    }
    fit
}

/// Puts a simpler effect in the place of one that contains it, where that costs less than [`WORTH`].
fn simplify(setup: &Setup, null: &Fit, mut fit: Fit, judge: &Judge) -> Fit {
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
            if !judge.is_worth(&fit, &other) {
                fit = other;
                break;
            }
        }
    }
    fit
}

/// Squared distance of an effect's parameters from their nulls in units of their covariance (Wald's statistic).
fn distance(fit: &Fit, effect: usize) -> Option<f64> {
    let fitted = fit.hypothesis.fitted.iter().enumerate();
    let own: Vec<usize> = fitted
        .filter(|(_, f)| matches!(f.slot, Slot::Effect { effect: of, .. } if of == effect))
        .map(|(j, _)| j)
        .collect();
    if own.is_empty() {
        return None;
    }
    let covariance = fit.innovation.minimum.covariance()?;
    let part = DMatrix::from_fn(own.len(), own.len(), |i, j| covariance[(own[i], own[j])]);
    let away = DVector::from_fn(own.len(), |i, _| fit.theta()[own[i]] - fit.hypothesis.fitted[own[i]].null);
    let distance = away.dot(&part.cholesky()?.solve(&away));
    distance.is_finite().then_some(distance)
}

/// Whether two lists hold the same effects.
fn same(a: &[EffectAt], b: &[EffectAt]) -> bool {
    a.len() == b.len() && a.iter().all(|at| b.contains(at))
}
