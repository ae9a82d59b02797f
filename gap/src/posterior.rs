//! The weights of the answers: evidence, tempered, gathered into classes that the data cannot tell apart.

mod answer;
mod classes;
mod doubt;
mod gathered;
mod refined;
mod times;

use nalgebra::DVector;

use crate::fit::TEMPERATURE;
use crate::judge::{self, DECISIVE, EVEN, Judge, WORTH};
use crate::options::Options;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;
use crate::signature::{self, Nuisance, SAME};
use crate::stop::UNKNOWN;
use crate::unknown;
pub use answer::Answer;
use classes::{beyond_its_range, gives_way, lead_with_the_simplest};
pub(crate) use doubt::Left;
pub use gathered::Gathered;
use rayon::prelude::*;

/// Prior probability that there is no gap, and that no named effect describes it; effects share the rest equally.
const PRIOR_NO_GAP: f64 = 0.3;
const PRIOR_UNKNOWN: f64 = 0.1;

/// Prior probability that a cause has a further effect beside it, shared by all that it might be. Small, because where there is one its
/// evidence leaves no doubt: on development data, with ten times this prior, none of 162 pairs that were right had an answer with fewer
/// effects of a hundredth of their probability. Where an effect was named beside the one that was the cause alone, this one often had.
const PRIOR_FURTHER: f64 = 0.03;

/// Cosine of two signatures from which they are of one and the same change of the model: of a pendulum's motor constant and its
/// inverse inertia they differ in the sixth digit.
const IDENTICAL: f64 = 1.0 - 1e-7;

/// Share of what a form may be off by that an effect must explain beside commands that acted otherwise: when each did is known
/// better than the form of what moves the machine.
const BESIDE_ACTED: f64 = 0.1;

/// Answers whose estimates are held to predictions of what was fitted.
const HELD: usize = 4;

/// All answers, by probability.
#[derive(Clone, Debug)]
pub struct Posterior {
    /// Classes of single effects.
    pub answers: Vec<Answer>,
    /// Answers that led and were left out.
    pub refuted: Vec<Answer>,
    /// Probability that there is no gap.
    pub no_gap: f64,
    /// Probability that no named effect belongs to the cause.
    pub unexplained: f64,
    /// Natural logarithm of the evidence for any gap against none, the alternatives weighed by their priors.
    pub log_evidence: f64,
    log_no_gap: f64,
    /// Of a residual alone.
    log_alone: f64,
    residual_alone: Option<Fit>,
    /// Other unknown causes, each with its weight, the likeliest last.
    further_alone: Vec<(f64, Fit)>,
    residual_on_leader: Option<Fit>,
    judge: Judge,
}

impl Posterior {
    /// The fit of the leading answer; the null fit where there is none.
    #[must_use]
    pub fn leader<'a>(&'a self, null: &'a Fit) -> &'a Fit {
        self.answers.first().map_or(null, |a| &a.fit)
    }

    /// −2 log evidence of a fit, up to a constant that is the same for all.
    #[must_use]
    pub fn cost(&self, fit: &Fit) -> f64 {
        self.judge.cost(fit)
    }

    /// Takes probability from the named answers for what the leader leaves on held-out time, which no evidence was taken from. What is
    /// named stays named: a machine is never quite as in the library.
    pub(crate) fn doubt(&mut self, left: Left) {
        let Some(first) = self.answers.first().map(|a| a.probability) else { return };
        let named: f64 = self.answers.iter().map(|a| a.probability).sum();
        self.leave_to_unknown(1.0 - left.doubted(first, named, self.unexplained));
    }

    /// The fits of other answers that follow the windows no worse than the leading one.
    pub fn no_worse_by_windows(&self) -> impl Iterator<Item = &Fit> {
        let most = self.answers.first().map_or(0.0, |answer| answer.fit.shooting_error);
        self.answers.iter().skip(1).map(|answer| &answer.fit).filter(move |fit| fit.shooting_error <= most)
    }

    /// Leaves out the leading answer, with which predictions of held-out time are worse than without, or far worse than with
    /// another one: whatever the evidence says of how the data differ from the model, the model with it is no nearer to the
    /// machine.
    pub fn refute(&mut self, setup: &Setup, null: &Fit) {
        if self.answers.is_empty() {
            return;
        }
        self.refuted.push(self.answers.remove(0));
        self.residual_on_leader = None;
        let Some(leader) = self.answers.first_mut() else {
            self.settle(None, null);
            return;
        };
        let member = (0..leader.logs.len()).max_by(|a, b| leader.logs[*a].total_cmp(&leader.logs[*b]));
        let member = member.unwrap_or(0);
        let best = member.checked_sub(1).map_or(&leader.fit, |other| &leader.alike[other]).clone();
        // What is hardly likelier by itself than that there is no gap has no part in what a residual beside it explains.
        let helps = leader.logs[member] - self.log_no_gap > 0.5 * WORTH / TEMPERATURE;
        let together = helps.then(|| residual_on(setup, null, &best, &self.judge, &|| ())).flatten();
        if let Some(together) = together {
            let gain = 0.5 * (self.judge.cost(&best) - self.judge.cost(&together)) / TEMPERATURE;
            leader.logs[member] += (gain + PRIOR_UNKNOWN.ln()).max(0.0);
            self.residual_on_leader = Some(together).filter(|_| gain > 0.0);
        }
        let log = leader.logs[member];
        self.settle(Some((&best, log)), null);
    }

    /// Leaves out all named answers, where predictions without them are as good as the readings let them be; an unknown
    /// cause has its prior then.
    pub fn name_none(&mut self, null: &Fit) {
        self.refuted.append(&mut self.answers);
        self.residual_on_leader = None;
        self.log_alone = self.log_alone.min(self.log_no_gap + PRIOR_UNKNOWN.ln());
        self.settle(None, null);
    }

    /// Leaves all but this share of what all else has to an unknown cause: something is known to be there that is no effect.
    pub fn know_unknown(&mut self, but: f64) {
        self.unexplained += (1.0 - but) * self.no_gap;
        self.no_gap *= but;
        self.leave_to_unknown(but);
    }

    /// Leaves all but this share of what the named answers have to an unknown cause.
    fn leave_to_unknown(&mut self, but: f64) {
        let named: f64 = self.answers.iter().map(|a| a.probability).sum();
        for answer in &mut self.answers {
            answer.probability *= but;
            answer.members.iter_mut().for_each(|(_, probability, _)| *probability *= but);
        }
        self.unexplained += (1.0 - but) * named;
    }

    /// Takes from the unknown cause what predictions of held-out time deny it: all but its prior where it `spoils` them, and what makes it
    /// more likely than the leading answer, `beyond` which it explains this many times what a form may be off by, where it is held to
    /// that. Gives whether another unknown cause is likelier than what is left of this one, and stands in its place.
    pub fn deny_unknown(&mut self, spoils: bool, beyond: Option<f64>, null: &Fit) -> bool {
        let beyond = beyond.filter(|beyond| *beyond < 1.0);
        if !spoils && beyond.is_none() {
            return false;
        }
        let mut log = self.log_alone;
        if spoils {
            log = log.min(self.log_no_gap + PRIOR_UNKNOWN.ln());
        }
        if let (Some(beyond), Some(leader)) = (beyond, self.answers.first()) {
            let most = leader.logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            log = log.min(most + beyond.max(1e-6).ln());
        }
        if let Some((other, fit)) = self.further_alone.pop_if(|(other, _)| *other > log) {
            (self.log_alone, self.residual_alone) = (other, Some(fit));
            self.settle_on_best(null);
            return true;
        }
        self.log_alone = log;
        self.settle(None, null);
        false
    }

    /// Has the estimates of the answers that may be named, and of the unknown cause, be those that predict best what was fitted.
    pub fn hold_to_predictions(&mut self, setup: &Setup) {
        let leading = self.answers.iter_mut().take(HELD).map(|answer| &mut answer.fit);
        let residuals = self.residual_alone.iter_mut().chain(self.residual_on_leader.iter_mut());
        let residuals = residuals.chain(self.further_alone.iter_mut().map(|(_, fit)| fit));
        leading.chain(residuals).for_each(|fit| fit.hold_to_predictions(setup));
    }

    /// Weighs the answers as what there is beside a cause that was found apart from them, one that leaves predictions as they are.
    pub fn stand_beside_another(&mut self, null: &Fit) {
        let further = (PRIOR_FURTHER / (1.0 - PRIOR_NO_GAP)).ln();
        self.log_no_gap += ((1.0 - PRIOR_FURTHER) / PRIOR_NO_GAP).ln();
        self.log_alone += further;
        self.further_alone.iter_mut().for_each(|(log, _)| *log += further);
        self.answers.iter_mut().flat_map(|answer| &mut answer.logs).for_each(|log| *log += further);
        self.settle_on_best(null);
    }

    /// Takes back what answers and a residual alone speak for where it is no more than the form may be off by of what lowered the
    /// null model's mean squared error from `before`: commands that acted otherwise than they were recorded.
    pub fn forgive(&mut self, null: &Fit, before: f64) {
        let beyond = |fit: &Fit| judge::share_of_form(null.shooting_error - fit.shooting_error, before - 1.0);
        let each = self.log_no_gap - (self.answers.len().max(1) as f64).ln();
        for answer in &mut self.answers {
            let beyond = beyond(&answer.fit) / BESIDE_ACTED;
            if beyond < 1.0 {
                answer.logs.iter_mut().for_each(|log| *log = log.min(each + beyond.max(1e-6).ln()));
            }
        }
        if let Some(beyond) = self.residual_alone.as_ref().map(beyond).filter(|beyond| *beyond < 1.0) {
            self.log_alone = self.log_alone.min(self.log_no_gap + beyond.max(1e-6).ln());
        }
        self.settle_on_best(null);
    }

    fn settle_on_best(&mut self, null: &Fit) {
        let log = |answer: &Answer| answer.logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let best = self.answers.iter().max_by(|a, b| log(a).total_cmp(&log(b)));
        let best = best.map(|answer| (answer.fit.clone(), log(answer)));
        self.settle(best.as_ref().map(|(fit, log)| (fit, *log)), null);
    }

    /// The weight of an unknown cause that would have `log_alone`, beside the best fit with its weight.
    fn beside(&self, best: Option<(&Fit, f64)>, alone: &Fit, log_alone: f64, null: &Fit) -> f64 {
        let Some((best, log)) = best else { return log_alone };
        // What a residual explains beyond a named cause is evidence against it only if it is material: no effect has
        // exactly the form that the library gives it. A cause that is no likelier than none is no measure. That friction changes
        // in time is no matter of its form.
        let beyond = self.judge.beyond_form(alone, best);
        let is_form = beyond < 1.0 && !unknown::friction::changes(alone);
        if is_form && log > self.log_no_gap && self.judge.cost(best) < self.judge.cost(null) {
            log_alone.min(log + beyond.max(1e-6).ln())
        } else {
            log_alone
        }
    }

    /// Of all unknown causes the likeliest beside the best fit stands alone.
    fn lead_with_the_likeliest(&mut self, best: Option<(&Fit, f64)>, null: &Fit) {
        let mut all = std::mem::take(&mut self.further_alone);
        all.extend(self.residual_alone.take().map(|alone| (self.log_alone, alone)));
        let weight = |(log, fit): &(f64, Fit)| self.beside(best, fit, *log, null);
        all.sort_by(|a, b| weight(a).total_cmp(&weight(b)));
        if let Some((log, alone)) = all.pop() {
            (self.log_alone, self.residual_alone) = (log, Some(alone));
        }
        self.further_alone = all;
    }

    /// Probabilities from the weights; `best` is the best fit with its weight. Gives the weight of all that is a gap.
    fn settle(&mut self, best: Option<(&Fit, f64)>, null: &Fit) -> f64 {
        let alone = self.residual_alone.as_ref();
        let log_unknown =
            alone.map_or(self.log_alone, |alone| self.beside(best, alone, self.log_alone, null));
        let logs = || self.answers.iter().flat_map(|answer| &answer.logs).chain([&log_unknown]);
        let largest = logs().copied().fold(self.log_no_gap, f64::max);
        let of_a_gap: f64 = logs().map(|log| (log - largest).exp()).sum();
        let total = of_a_gap + (self.log_no_gap - largest).exp();
        let share = |log: f64| (log - largest).exp() / total;
        let first = self.answers.iter().map(|answer| answer.logs.iter().map(|log| share(*log)).sum::<f64>());
        let slip = doubt::slip(first.fold(0.0, f64::max), share(log_unknown), share(self.log_no_gap));
        let probability = |log: f64| (1.0 - slip) * share(log);
        (self.no_gap, self.unexplained) = (probability(self.log_no_gap), slip + probability(log_unknown));
        for answer in &mut self.answers {
            answer.probability = answer.logs.iter().map(|log| probability(*log)).sum();
            // The leader was chosen among those that are as good as the best, so that it is as likely.
            let best = answer.logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let weight =
                |(k, log): (usize, &f64)| if k == 0 || *log >= best { 1.0 } else { (log - best).exp() };
            let weights: Vec<f64> = answer.logs.iter().enumerate().map(weight).collect();
            let all: f64 = weights.iter().sum();
            for ((_, of_member, _), weight) in answer.members.iter_mut().zip(weights) {
                *of_member = answer.probability * weight / all;
            }
        }
        self.answers.sort_by(|a, b| b.likeliest().total_cmp(&a.likeliest()));
        largest + of_a_gap.ln()
    }

    /// Whether the leading answer is more likely than that there is no gap.
    #[must_use]
    pub fn leads_the_null(&self) -> bool {
        self.answers.first().is_some_and(|answer| answer.probability > self.no_gap)
    }

    /// Whether the leading answer is more likely than that none of them is right.
    #[must_use]
    pub fn names(&self) -> bool {
        self.answers.first().is_some_and(|answer| answer.likeliest() > self.unexplained)
    }

    /// The best residual: on top of the leading answer, or alone.
    #[must_use]
    pub fn residual(&self, on_leader: bool) -> Option<&Fit> {
        if on_leader { self.residual_on_leader.as_ref() } else { self.residual_alone.as_ref() }
    }
}

/// Weighs what was gathered, no gap and the unknowns; `done` is told of each unknown that was fitted, four at most.
#[must_use]
pub fn weigh(
    setup: &Setup,
    null: &Fit,
    nuisance: &Nuisance,
    gathered: Gathered,
    options: &Options,
    done: &(dyn Fn(&str) + Sync),
) -> Posterior {
    let Gathered { fits, forms, count, .. } = gathered;
    let judge = Judge::new(null, &fits);
    let weight = |fit: &Fit| {
        let effects = &fit.hypothesis.effects;
        let further = (PRIOR_FURTHER / count as f64).powi(effects.len() as i32 - 1);
        effects.iter().map(|at| options.weight(at)).product::<f64>() * further
    };
    let each = (1.0 - PRIOR_NO_GAP - PRIOR_UNKNOWN) / fits.iter().map(weight).sum::<f64>().max(1e-300);

    // The unknowns stand alone and on top of the leading effect: if the effect adds nothing to them, it is no cause.
    let alone = residual_on(setup, null, null, &judge, &|| done("unknown cause"));
    // So does friction of an unknown kind, in the place of the dry friction that explains most; where something else reaches the noise,
    // none is asked for.
    let asked =
        fits.first().is_some_and(|best| best.shooting_error > INEXACT || unknown::friction::is_part_of(best));
    let helps = |fit: &&Fit| asked && judge.cost(fit) < judge.cost(null) - EVEN;
    let dry = fits.iter().filter(|fit| unknown::friction::is_dry(fit)).find(helps);
    let frictions = dry.map_or_else(Vec::new, |fit| unknown::friction::in_place_of(setup, fit));
    let unknowns = alone.into_iter().chain(frictions);
    let beside = || done("unknown beside the leading cause");
    let together = fits.first().and_then(|best| residual_on(setup, null, best, &judge, &beside));

    let log_weight =
        |fit: &Fit, prior: f64| -0.5 * (judge.cost(fit) - judge.cost(null)) / TEMPERATURE + prior.ln();
    let mut logs: Vec<f64> =
        fits.iter().zip(&forms).map(|(f, forms)| log_weight(f, each * weight(f) / forms)).collect();
    // What a residual adds to the leader counts for the leader.
    if let (Some(first), Some(together)) = (logs.first_mut(), &together) {
        *first = first.max(log_weight(together, each * weight(&fits[0]) * PRIOR_UNKNOWN));
    }
    // A residual that the evidence does not ask for would only fit noise.
    let together = together.filter(|t| fits.first().is_some_and(|best| judge.cost(t) < judge.cost(best)));
    let signatures: Vec<DVector<f64>> =
        fits.par_iter().map(|f| nuisance.project(&signature::of_fit(setup, null, f))).collect();
    let beyond: Vec<usize> = (0..fits.len()).filter(|&k| beyond_its_range(setup, &fits[k])).collect();
    // By itself, or as an effect that does the same to every reading, as a gain does in place of a motor's constant.
    let contradicts = |k: usize| {
        beyond.iter().any(|&b| k == b || signature::cosine(&signatures[b], &signatures[k]) > IDENTICAL)
    };
    let mut taken = vec![false; fits.len()];
    let mut answers = Vec::new();
    for first in 0..fits.len() {
        if taken[first] {
            continue;
        }
        let near = |k: usize| judge.cost(&fits[k]) - judge.cost(&fits[first]) < DECISIVE;
        let mut class: Vec<usize> = (first..fits.len())
            .filter(|&k| {
                let alike = || near(k) && signature::cosine(&signatures[first], &signatures[k]) > SAME;
                let effects = |k: usize| fits[k].hypothesis.effects.len();
                // What contains another is that one where it has something to spare, however little their signatures at
                // standstill have in common.
                !taken[k]
                    && effects(k) == effects(first)
                    && (k == first || gives_way(&fits[first], &fits[k], &judge) || alike())
            })
            .collect();
        // And so is whatever else contains one of these and is no better.
        let more: Vec<usize> = (first..fits.len())
            .filter(|k| !taken[*k] && !class.contains(k) && near(*k))
            .filter(|k| class.iter().any(|c| gives_way(&fits[*k], &fits[*c], &judge)))
            .collect();
        class.extend(more);
        for &k in &class {
            taken[k] = true;
        }
        lead_with_the_simplest(&mut class, &fits, &judge, &contradicts);
        let members =
            class.iter().map(|&k| (fits[k].hypothesis.effects.clone(), 0.0, answer::closed(null, &fits[k])));
        answers.push(Answer {
            fit: fits[class[0]].clone(),
            alike: class[1..].iter().map(|&k| fits[k].clone()).collect(),
            class: class.iter().map(|&k| fits[k].hypothesis.label()).collect(),
            members: members.collect(),
            probability: 0.0,
            logs: class.iter().map(|&k| logs[k]).collect(),
            times: None,
        });
    }
    let mut posterior = Posterior {
        answers,
        refuted: Vec::new(),
        no_gap: 0.0,
        unexplained: 0.0,
        log_evidence: 0.0,
        log_no_gap: PRIOR_NO_GAP.ln(),
        log_alone: f64::NEG_INFINITY,
        further_alone: unknowns.map(|fit| (log_weight(&fit, PRIOR_UNKNOWN), fit)).collect(),
        residual_alone: None,
        residual_on_leader: together,
        judge,
    };
    let best = fits.first().zip(logs.first().copied());
    posterior.lead_with_the_likeliest(best, null);
    let of_a_gap = posterior.settle(best, null);
    posterior.log_evidence = of_a_gap - (1.0 - PRIOR_NO_GAP).ln();
    posterior
}

/// The likeliest residual on top of the effects of `base`; `done` is called after each kind of them.
fn residual_on(
    setup: &Setup,
    null: &Fit,
    base: &Fit,
    judge: &Judge,
    done: &(dyn Fn() + Sync),
) -> Option<Fit> {
    let fits: Vec<Fit> = unknown::kinds(setup)
        .into_par_iter()
        .filter(|_| !setup.stop.leaves_out(|| UNKNOWN.into()))
        .map(|kind| {
            let fit = unknown::fit_unknown(setup, null, base, unknown::choose(setup, null, base, kind));
            done();
            fit
        })
        .collect();
    fits.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)))
}
