//! Combinations with more: where they begin, and one effect after the other as long as each is worth it.

use rayon::prelude::*;

use super::promise::{leaves_nothing, most_left, score, score_of};
use super::{BASES, Candidate, Combine, TWIN, is_worth, one_more, overlap, same};
use crate::hypothesis::Hypothesis;
use crate::judge::{DECISIVE, EVEN, Judge, WORTH};
use crate::library;
use crate::search::{Fit, INEXACT, Width, fit_all};
use crate::signature::{self, Nuisance};
use crate::stop::SEVERAL;

/// Single effects of which those that promise most are beginnings as well, and how many.
const PROMISING: usize = 6;
const PROMISED: usize = 1;

/// Difference of −2 log evidence up to which another single effect is a beginning as well.
const RIVAL: f64 = 50.0;

/// Effects that are fitted beside a base, the highest in a score test.
const ADDED: usize = 8;

/// The same of those that explain most alone, at other places than the base's, where the base does not reach the noise: a score test
/// of innovations is ruled there by what all lack.
const ALONE: usize = 3;

/// Most effects at once.
const MOST: usize = 4;

/// What a fit grew to.
pub(super) struct Grown {
    /// With further effects, one by one, as long as they are worth it.
    pub(super) fit: Fit,
    /// The single one that it began with, where that is fitted better [again](Combine::again).
    pub(super) again: Option<Fit>,
    /// The best with one effect more, which was not worth it.
    pub(super) rejected: Option<Fit>,
}

/// Where combinations begin.
pub(super) struct Beginnings<'a> {
    /// At these in any case: the best single effects, and those with which a second effect promises more than with the best. Of
    /// two causes neither need be what explains most alone.
    pub(super) first: Vec<&'a Fit>,
    /// At these where something is left, those first with which a second effect promises most.
    pub(super) further: Vec<&'a Fit>,
}

impl<'a> Combine<'a> {
    /// The single effects at which combinations begin.
    pub(super) fn beginnings(&self) -> Beginnings<'a> {
        let (setup, null, fits, judge) = (self.setup, self.null, self.fits, &self.judge);
        // Where nothing reaches the noise, two effects may do together what neither promises alone.
        let helps = |fit: &Fit| {
            judge.is_worth(fit, null) || (!judge.is_exact() && judge.cost(fit) < judge.cost(null) - EVEN)
        };
        let near = |fit: &Fit| judge.cost(fit) < judge.cost(&fits[0]) + RIVAL;
        let mut first: Vec<&Fit> = fits.iter().take(BASES).filter(|fit| helps(fit) && near(fit)).collect();
        if let (false, [_, second]) = (judge.is_exact(), &mut first[..]) {
            // Of those behind the best, where all lack something, windows that hardly differ say little.
            let others = fits.iter().skip(1).filter(|fit| helps(fit));
            *second = judge.best(others).unwrap_or(second);
        }
        let Some(best) = first.first() else { return Beginnings { first, further: Vec::new() } };
        let promise = |base: &Fit| {
            let nuisance = Nuisance::new(base);
            let others = self.pool.par_iter().filter(|other| !base.hypothesis.effects.contains(other.at));
            let most = others.map(|other| score(setup, base, &nuisance, other.at)).reduce(|| 0.0, f64::max);
            let (all, count) = (nuisance.innovations.norm_squared(), nuisance.innovations.len() as f64);
            // What the likelihood gains once the noise is that of the rest.
            base.innovation.evidence_cost + count * (1.0 - most / all).max(1e-6).ln()
        };
        let mut rivals: Vec<(f64, &Fit)> = Vec::new();
        for (k, fit) in fits.iter().enumerate().take(PROMISING) {
            let known = first.iter().any(|known| std::ptr::eq(*known, fit));
            let twin = fits[..k].iter().any(|other| (judge.cost(other) - judge.cost(fit)).abs() < TWIN);
            if !known && !twin && helps(fit) && !setup.stop.asked() {
                rivals.push((promise(fit), fit));
            }
        }
        let least = promise(best) - WORTH;
        rivals.sort_by(|a, b| a.0.total_cmp(&b.0));
        let promised = rivals.iter().filter(|(promise, _)| *promise < least).take(PROMISED).count();
        let mut rivals: Vec<&Fit> = rivals.into_iter().map(|(_, fit)| fit).collect();
        let further = rivals.split_off(promised);
        first.extend(rivals);
        Beginnings { first, further }
    }

    /// A fit with further effects, one by one. One that is not worth it may be with yet another one, where the two leave what is as good
    /// as random.
    pub(super) fn grown(&mut self, mut base: Fit) -> Grown {
        let (mut again, mut rejected) = (None, None);
        let mut sure = base.clone();
        while base.hypothesis.effects.len() < MOST && !self.setup.stop.leaves_out(|| SEVERAL.into()) {
            let Some(next) = self.extended(&base) else { break };
            if base.hypothesis.effects.len() == 1 && again.is_none() {
                again = self.again(&base, &next);
                if let Some(single) = &again {
                    base = single.clone();
                    sure = single.clone();
                    continue;
                }
            }
            let left = || most_left(self.setup, &next, &self.pool);
            let judge = &self.judge;
            if is_worth(self.setup, self.null, judge, (&next, &base), left)
                && judge.is_worth(&next, self.null)
            {
                (sure, rejected) = (next.clone(), None);
            } else {
                let is_sure = same(&base.hypothesis.effects, &sure.hypothesis.effects);
                if let Some(other) = is_sure.then(|| self.in_place_of_one(&next, &base)).flatten() {
                    (base, sure) = (other.clone(), other);
                    continue;
                }
                rejected = rejected.or_else(|| Some(next.clone()));
                if !judge.is_worth(&next, &base) || !judge.nearly_leaves_chance(&next, &base) {
                    break;
                }
            }
            base = next;
        }
        Grown { fit: sure, again, rejected }
    }

    /// A combination whose last effect is in the place of one of those of `base`, where that explains more: what is too small beside the
    /// others may be what one of them stands in for.
    fn in_place_of_one(&self, with: &Fit, base: &Fit) -> Option<Fit> {
        let count = base.hypothesis.effects.len();
        if count < 2 || self.judge.cost(with) >= self.judge.cost(base) - WORTH {
            return None;
        }
        let others: Vec<Fit> = (0..count).into_par_iter().map(|k| self.without(with, k)).collect();
        let best = self.judge.best(others.iter().filter(|other| library::is_possible(self.setup, other)))?;
        self.judge.is_better(best, base).then(|| best.clone())
    }

    /// The best fit with one effect more, if any effect promises something.
    pub(super) fn extended(&mut self, base: &Fit) -> Option<Fit> {
        // What repeats shows best beside what the base explains.
        let setup = &self.setup.with_lines_of(&base.innovation.pass);
        let nuisance = Nuisance::new(base);
        let others = self.pool.par_iter();
        let mut scores: Vec<(f64, &Candidate<'_>, Hypothesis)> = others
            .filter(|other| !base.hypothesis.effects.iter().any(|own| overlap(own, other.at)))
            .flat_map_iter(|other| {
                let with = |at| (score(setup, base, &nuisance, at), other, one_more(setup, base, at));
                let (mut most, _, mut hypothesis) = with(other.at);
                if other.helps {
                    let start = hypothesis.starts_at(&other.alone.hypothesis, other.alone.estimate());
                    let columns = signature::columns_of(setup, base, &hypothesis, start);
                    most = most.max(score_of(&nuisance, &columns));
                }
                // The form that explains most alone need not be the one beside another effect; one that has more parameters always
                // promises a little more.
                let mut forms: Vec<(f64, &Candidate<'_>, Hypothesis)> = self
                    .other_forms(other.at)
                    .map(with)
                    .filter(|(score, ..)| *score > most + WORTH)
                    .collect();
                forms.push((most, other, hypothesis));
                forms
            })
            .collect();
        scores.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.at.cmp(b.1.at)));
        // Where the noise is not reached, the innovations are ruled by what all lack: there the windows decide.
        let open = base.shooting_error > INEXACT;
        let mut left = scores.into_iter().filter(|(score, ..)| open || *score > WORTH);
        let mut hypotheses: Vec<Hypothesis> =
            left.by_ref().take(ADDED).map(|(.., hypothesis)| hypothesis).collect();
        if open {
            // And those that explain most alone, elsewhere.
            let is_elsewhere = |other: &Candidate<'_>| {
                other.helps && base.hypothesis.effects.iter().all(|own| own.place != other.at.place)
            };
            let mut alone: Vec<(f64, Hypothesis)> = left
                .filter(|(_, other, _)| is_elsewhere(other))
                .map(|(_, other, hypothesis)| (self.judge.cost(other.alone), hypothesis))
                .collect();
            alone.sort_by(|a, b| a.0.total_cmp(&b.0));
            hypotheses.extend(alone.into_iter().take(ALONE).map(|(_, hypothesis)| hypothesis));
        }
        if hypotheses.is_empty() {
            return None;
        }
        let fits = fit_all(setup, base, hypotheses, Width::FURTHER, &|_| ());
        if !self.judge.is_exact() && fits.iter().any(|fit| fit.shooting_error <= INEXACT) {
            // Several effects reach the noise: from here on both losses are likelihoods of the data.
            self.judge = Judge::new(self.null, self.fits.iter().chain(&fits));
        }
        let judge = &self.judge;
        let chosen = simplest(&fits, |fit| judge.cost_beyond(fit, base))?;
        if base.shooting_error <= INEXACT {
            // With a model that is right the innovations say most: windows take a late sensor for another start.
            let small: Vec<Fit> = fits.iter().filter(|fit| judge.gains(fit, base)).cloned().collect();
            let complete = simplest(&small, |fit| fit.innovation.evidence_cost).filter(|fit| {
                same(&fit.hypothesis.effects, &chosen.hypothesis.effects)
                    || leaves_nothing(setup, fit, &self.pool)
            });
            return complete.or(Some(chosen));
        }
        Some(chosen)
    }
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
