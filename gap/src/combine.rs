//! Several effects at once: from the best single ones forward (`grow`), with others in the place of some (`exchange`), and back (`shorten`)
//! where one of them is not needed.

mod exchange;
mod grow;
mod promise;
mod shorten;
mod waves;

use std::cell::OnceCell;

use parallax_model::effect::{Effect, PlaceKind};
use rayon::prelude::*;

use crate::hypothesis::{EffectAt, Hypothesis};
use crate::judge::{EVEN, Judge, WORTH};
use crate::library;
use crate::search::{Fit, INEXACT, fit_hypothesis, fit_part};
use crate::setup::Setup;
use crate::stop::SEVERAL;
use grow::{Beginnings, Grown};
pub use promise::{by_promise, most_of};
use promise::{leaves_nothing, most_left};

/// Single effects from which combinations begin in any case.
const BASES: usize = 2;

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

/// What combinations are made of.
struct Combine<'a> {
    setup: &'a Setup,
    null: &'a Fit,
    /// Single effects in their best forms, the best first, and all of their forms.
    fits: &'a [Fit],
    forms: &'a [EffectAt],
    /// What may be added.
    pool: Vec<Candidate<'a>>,
    /// Another one from where several effects reach the noise and no single one does.
    judge: Judge,
}

/// Combinations that are worth their further effects; `fits` are single effects in their best forms, the best first,
/// `forms` are all of them, and `tried` all that were tried alone. Single effects that were fitted better from where they are
/// in a combination are among what it gives.
#[must_use]
pub fn combinations(
    setup: &Setup,
    null: &Fit,
    fits: &[Fit],
    (forms, tried): (&[EffectAt], &[EffectAt]),
    judge: &Judge,
) -> Vec<Fit> {
    let mut combine = Combine::new(setup, null, fits, (forms, tried), judge);
    let Beginnings { first, further } = combine.beginnings();
    let mut found: Vec<Fit> = Vec::new();
    for (k, base) in first.iter().chain(&further).enumerate() {
        let in_any_case = k < first.len();
        // Where nothing reaches the noise, there is always more, and no end.
        if !in_any_case && (!combine.judge.is_exact() || combine.is_settled(&found)) {
            break;
        }
        if setup.stop.leaves_out(|| SEVERAL.into()) {
            break;
        }
        let Grown { fit: mut base, again, rejected } = combine.grown((*base).clone());
        found.extend(again);
        // Two effects that are not worth it in the forms that explain most alone may be so in others.
        let apart = rejected.filter(|_| in_any_case && base.hypothesis.effects.len() < 2);
        let other = match &apart {
            Some(pair) => combine.exchanged(pair).filter(|other| combine.judge.is_worth(other, &base)),
            None => combine.exchanged(&base),
        };
        if let Some(other) = other {
            base = combine.grown(other).fit;
        }
        if setup.stop.asked() {
            return found;
        }
        let finished = combine.finished(base, &found);
        found.extend(finished);
    }
    found
}

/// What comes of a hypothesis of several effects that was found otherwise: with more of them, and without those that are not needed;
/// nothing where one of `fits`, or of what was `found` before, explains as much. The other arguments are those of [`combinations`].
#[must_use]
pub fn beside(
    setup: &Setup,
    null: &Fit,
    (fits, found): (&[Fit], &[Fit]),
    (forms, tried): (&[EffectAt], &[EffectAt]),
    joint: Fit,
) -> Vec<Fit> {
    let judge = Judge::new(null, fits.iter().chain(found).chain([&joint]));
    let mut combine = Combine::new(setup, null, fits, (forms, tried), &judge);
    let grown = combine.grown(joint).fit;
    combine.finished(grown, found)
}

/// The stops on the other side of a joint than those that explain most alone: either may be there.
fn other_sides<'a>(pool: &[Candidate<'a>], forms: &'a [EffectAt]) -> Vec<Candidate<'a>> {
    let is_stop = |at: &&EffectAt| matches!(at.effect, Effect::EndStop | Effect::EndStopLower);
    let others = forms.iter().filter(is_stop).filter_map(|at| {
        let known = pool.iter().find(|own| own.at.place == at.place && is_stop(&own.at) && own.at != at)?;
        Some(Candidate { at, alone: known.alone, helps: false })
    });
    others.collect()
}

/// The limits of commands that alone would hold them still, which nothing does: beside another effect they may be where they are.
fn limits_of_commands<'a>(
    pool: &[Candidate<'a>],
    tried: &'a [EffectAt],
    null: &'a Fit,
) -> Vec<Candidate<'a>> {
    let is_limit = |at: &&EffectAt| at.effect == Effect::Saturation && at.place.kind == PlaceKind::Input;
    let is_known = |at: &EffectAt| pool.iter().any(|own| own.at.label() == at.label());
    let others = tried.iter().filter(|at| is_limit(at) && !is_known(at));
    others.map(|at| Candidate { at, alone: null, helps: false }).collect()
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

/// An effect alone, from where it is beside another one (`beside`), where it is fitted better so: on its own way there it stuck
/// (`known`), and the other one would pay for the rest of the way.
fn again(setup: &Setup, null: &Fit, known: &Fit, beside: &Fit, judge: &Judge) -> Option<Fit> {
    let single = fit_part(setup, null, library::hypothesis(setup, &known.hypothesis.effects), beside);
    let better = judge.cost(&single) < judge.cost(known) - EVEN;
    (better && library::is_possible(setup, &single)).then_some(single)
}

impl<'a> Combine<'a> {
    fn new(
        setup: &'a Setup,
        null: &'a Fit,
        fits: &'a [Fit],
        (forms, tried): (&'a [EffectAt], &'a [EffectAt]),
        judge: &Judge,
    ) -> Self {
        let helps = |alone: &Fit| judge.cost(alone) < judge.cost(null) - WORTH;
        let pool = fits.iter().filter_map(|alone| {
            Some(Candidate { at: alone.hypothesis.effects.first()?, alone, helps: helps(alone) })
        });
        let mut pool: Vec<Candidate<'_>> = pool.collect();
        pool.extend(other_sides(&pool, forms));
        pool.extend(limits_of_commands(&pool, tried, null));
        Combine { setup, null, fits, forms, pool, judge: *judge }
    }

    /// A combination without what it does not need, and those that are as good; nothing where one of what was `found` before explains as
    /// much. Single effects that are fitted better from where they are in it are among what it gives.
    fn finished(&self, base: Fit, found: &[Fit]) -> Vec<Fit> {
        if base.hypothesis.effects.len() < 2 {
            return Vec::new();
        }
        let base = self.shortened(self.reformed(base));
        let known = |other: &Fit| same(&other.hypothesis.effects, &base.hypothesis.effects);
        if base.hypothesis.effects.len() < 2
            || found.iter().any(known)
            || waves::are_one(&base)
            || self.explained_by_one(&base, self.fits.iter().chain(found))
        {
            return Vec::new();
        }
        let singles = self.restarted(&base);
        let mut out = Vec::new();
        if !self.explained_by_one(&base, singles.iter()) {
            let others = self.twins(&base);
            out.push(base);
            out.extend(others);
        }
        out.extend(singles);
        out
    }

    /// The other forms of an effect.
    fn other_forms<'b>(&'b self, own: &'b EffectAt) -> impl Iterator<Item = &'b EffectAt> {
        self.forms.iter().filter(move |at| at.label() == own.label() && *at != own)
    }

    /// An effect alone [`again`].
    fn again(&self, known: &Fit, beside: &Fit) -> Option<Fit> {
        again(self.setup, self.null, known, beside, &self.judge)
    }

    /// Each effect of a pair [`again`].
    fn restarted(&self, fit: &Fit) -> Vec<Fit> {
        if fit.hypothesis.effects.len() != 2 || self.setup.stop.leaves_out(|| SEVERAL.into()) {
            return Vec::new();
        }
        let own = fit.hypothesis.effects.par_iter();
        let known = own.filter_map(|at| self.fits.iter().find(|f| f.hypothesis.effects == [at.clone()]));
        known.filter_map(|known| self.again(known, fit)).collect()
    }

    /// Whether a single effect with which the noise is reached explains as much as several do, whichever they began with, or, where
    /// some hypothesis reaches it, one of them: then these only share out what the one does. One that is their sum need not,
    /// where it reaches the noise. Of the `others` only single effects count.
    fn explained_by_one<'f>(&self, fit: &Fit, others: impl Iterator<Item = &'f Fit>) -> bool {
        let left = OnceCell::new();
        let left = || *left.get_or_init(|| most_left(self.setup, fit, &self.pool));
        let own =
            |single: &Fit| single.hypothesis.effects.iter().all(|at| fit.hypothesis.effects.contains(at));
        let exact = |single: &Fit| single.shooting_error <= INEXACT;
        let singles = others.filter(|other| other.hypothesis.effects.len() == 1);
        let mut enough = singles.filter(|single| exact(single) || (self.judge.is_exact() && own(single)));
        enough.any(|single| {
            is_sum(&single.hypothesis.effects[0], &fit.hypothesis.effects) && exact(single)
                || !is_worth(self.setup, self.null, &self.judge, (fit, single), left)
        })
    }

    /// Whether the best so far leaves nothing material, or nothing at all to any other effect. One that needs a parameter to be at
    /// its bound may stand in for what is there.
    fn is_settled(&self, found: &[Fit]) -> bool {
        let all = self.fits.iter().chain(found);
        let best = all.min_by(|a, b| self.judge.cost(a).total_cmp(&self.judge.cost(b)));
        best.filter(|best| !best.is_at_bound()).is_some_and(|best| {
            !self.judge.is_material_from(best.shooting_error, 1.0)
                || (best.shooting_error <= INEXACT && leaves_nothing(self.setup, best, &self.pool))
        })
    }

    /// The combination with one of its effects in the place of which stands another that alone fits exactly as well: one
    /// sensor's delay and the command's.
    fn twins(&self, fit: &Fit) -> Vec<Fit> {
        let (setup, fits, effects) = (self.setup, self.fits, &fit.hypothesis.effects);
        let alone = |at: &EffectAt| {
            fits.iter().find(|f| f.hypothesis.effects == [at.clone()]).map(|f| self.judge.cost(f))
        };
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
                found.push(fit_hypothesis(setup, self.null, library::hypothesis(setup, &with)));
            }
        }
        found
    }
}

/// Whether `fit` is worth its effects over `base`, what is too small to be told from a form included; `left` is what any other effect
/// promises beside it.
pub(crate) fn is_worth(
    setup: &Setup,
    null: &Fit,
    judge: &Judge,
    (fit, base): (&Fit, &Fit),
    left: impl FnOnce() -> f64,
) -> bool {
    judge.is_worth_or(fit, base, left, || [null, base, fit].map(|fit| fit.error_ahead(setup, fit.theta())))
}

/// The hypothesis with one effect more than a fit has.
fn one_more(setup: &Setup, fit: &Fit, further: &EffectAt) -> Hypothesis {
    let effects: Vec<EffectAt> = fit.hypothesis.effects.iter().chain([further]).cloned().collect();
    library::hypothesis(setup, &effects)
}

/// Whether two effects are one, or one contains the other at its place: they are alternatives, not companions.
pub fn overlap(a: &EffectAt, b: &EffectAt) -> bool {
    let contains =
        |a: &EffectAt, b: &EffectAt| a.effect == b.effect || a.effect.simpler().contains(&b.effect);
    a.place == b.place && (contains(a, b) || contains(b, a))
}

/// Whether an effect is by its definition the sum of two: dry friction that differs by direction is a constant one and a constant
/// push. Smoothed they differ where the machine stands, by what neither is.
fn is_sum(of: &EffectAt, parts: &[EffectAt]) -> bool {
    let pushes = |at: &EffectAt| match at.effect {
        Effect::ConstantForce | Effect::Wind | Effect::GravityTilt => at.place == of.place,
        Effect::Offset | Effect::Bias => true,
        _ => false,
    };
    let rubs = |at: &EffectAt| at.effect.name() == Effect::Coulomb.name() && at.place == of.place;
    of.effect == Effect::AsymmetricFriction
        && parts.len() == 2
        && parts.iter().any(rubs)
        && parts.iter().any(pushes)
}

/// Whether two lists hold the same effects.
fn same(a: &[EffectAt], b: &[EffectAt]) -> bool {
    a.len() == b.len() && a.iter().all(|at| b.contains(at))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(effect: Effect, place: &str) -> EffectAt {
        EffectAt { effect, place: place.parse().expect("a place") }
    }

    #[test]
    fn friction_by_direction_is_a_constant_one_and_a_push() {
        let sum = at(Effect::AsymmetricFriction, "joint:a");
        let rubs = at(Effect::Coulomb, "joint:a");
        for push in [
            at(Effect::Offset, "input:u"),
            at(Effect::ConstantForce, "joint:a"),
            at(Effect::Bias, "output:y"),
        ] {
            assert!(is_sum(&sum, &[rubs.clone(), push.clone()]) && is_sum(&sum, &[push, rubs.clone()]));
        }
        let elsewhere = [at(Effect::Coulomb, "joint:b"), at(Effect::ConstantForce, "joint:b")];
        assert!(!is_sum(&sum, &elsewhere), "friction of another joint");
        assert!(
            !is_sum(&sum, &[rubs.clone(), at(Effect::ConstantForce, "joint:b")]),
            "a push on another joint"
        );
        assert!(!is_sum(&sum, &[rubs.clone(), at(Effect::Delay, "input:u")]));
        assert!(!is_sum(&rubs, &[sum.clone(), at(Effect::Offset, "input:u")]));
    }
}
