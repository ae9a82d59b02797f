//! Leading answers, fitted again: as sharp as their friction is, with the mean of times that scatter, and without what predicts nothing.

use rayon::prelude::*;

use super::{Answer, HELD, Posterior, residual_on};
use crate::fit::TEMPERATURE;
use crate::hypothesis::EffectAt;
use crate::judge::DECISIVE;
use crate::library;
use crate::quantify::Row;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;

impl Posterior {
    /// Has the leading answer's dry friction as sharp as the data say it is. Gives whether that is sharper than it was. What the
    /// answers weigh stays as it was, where all of them were as smooth. What of several effects then changes nothing made up for what the
    /// smooth friction lacked, and is left out.
    pub(crate) fn sharpen(&mut self, setup: &Setup, null: &Fit) -> bool {
        let mut changed = false;
        while let Some(leader) = self.answers.first_mut() {
            let Some(sharper) = search::sharpened(setup, null, &leader.fit) else { break };
            changed = true;
            let count = sharper.hypothesis.effects.len();
            let Some(nothing) = (0..count).find(|k| count > 1 && sharper.is_nothing(*k)) else {
                leader.fit = sharper;
                break;
            };
            let part = fit_without(setup, null, &leader.fit, nothing);
            self.lead_with(null, part);
        }
        changed
    }

    /// Leaves out of several effects of the leading answer those that ended where they change nothing: what joined an effect whose own
    /// search had ended elsewhere has only begun that anew.
    pub(crate) fn leave_out_nothing(&mut self, setup: &Setup, null: &Fit) {
        while let Some(fit) = self.answers.first().map(|leader| &leader.fit) {
            let count = fit.hypothesis.effects.len();
            let nothing = (0..count).filter(|k| count > 1 && fit.is_nothing(*k) && !setup.stop.asked());
            // From the states that the model with all of them has: where a machine rings, the nominal model knows none.
            let parts = nothing.map(|k| fit_without(setup, fit, fit, k));
            let part = parts.min_by(|a, b| self.judge.cost(a).total_cmp(&self.judge.cost(b)));
            let no_worse = |part: &Fit| !self.judge.is_material(fit, part);
            let Some(part) = part.filter(no_worse) else { break };
            self.lead_with(null, part);
        }
    }

    /// Has the dry friction of the answers that may be named as sharp as the data say it is, and weighs them so: an unknown cause, which
    /// is not smoothed, outweighs what creeps where the machine stands.
    pub(crate) fn weigh_sharp(&mut self, setup: &Setup, null: &Fit) {
        let judge = &self.judge;
        self.answers.par_iter_mut().take(HELD).for_each(|answer| {
            let Some(sharper) = search::sharpened(setup, null, &answer.fit) else { return };
            let gain = 0.5 * (judge.cost(&answer.fit) - judge.cost(&sharper)) / TEMPERATURE;
            answer.fit = sharper;
            // The first of a class leads it by its form, and speaks for all of it.
            let most = answer.logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            answer.logs[0] = most + gain.max(0.0);
        });
        self.settle_on_best(null);
    }

    /// Puts a delay at the place of readings whose times scatter, where it is their mean, in the place of one of several effects of the
    /// leading answer, where the evidence does not tell the two apart decisively: what is late on average looks late in more than one way.
    /// Gives whether it did.
    pub(crate) fn takes_for_mean(&mut self, setup: &Setup, null: &Fit, delay: &EffectAt) -> bool {
        let Some(leader) = self.answers.first_mut() else { return false };
        let effects = &leader.fit.hypothesis.effects;
        if effects.len() < 2 || effects.contains(delay) {
            return false;
        }
        let with = |k: usize| {
            let mut effects = effects.clone();
            effects[k] = delay.clone();
            search::fit_part(setup, null, library::hypothesis(setup, &effects), &leader.fit)
        };
        let others: Vec<Fit> = (0..effects.len()).into_par_iter().map(with).collect();
        let judge = &self.judge;
        let best = others.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)));
        let late = |fit: &Fit| {
            let at = fit.hypothesis.effects.iter().position(|at| at == delay);
            at.is_some_and(|at| !fit.is_nothing(at))
        };
        let even = |fit: &Fit| judge.cost(fit) < judge.cost(&leader.fit) + DECISIVE;
        let Some(best) = best.filter(|fit| late(fit) && even(fit)) else { return false };
        leader.exchange(null, best);
        self.residual_on_leader = None;
        true
    }

    /// Leaves out of several effects of the leading answer those without which fresh motion is predicted no worse, where nothing reaches
    /// the noise: there whatever is flexible explains more of the time that it is fitted to. `row` predicts held-out time, `with` is what
    /// the leading answer predicts of it; gives what the answer then does.
    pub(crate) fn shorten(
        &mut self,
        setup: &Setup,
        null: &Fit,
        row: &(dyn Fn(&Fit) -> Row + Sync),
        mut with: Row,
    ) -> Row {
        let mut shorter = false;
        while let Some(leader) = self.answers.first() {
            let (fit, effects) = (&leader.fit, &leader.fit.hypothesis.effects);
            if fit.shooting_error <= INEXACT || effects.len() < 2 || setup.stop.asked() {
                break;
            }
            let without = |k: usize| {
                let mut part = fit_without(setup, null, fit, k);
                part.hold_to_predictions(setup);
                let row = row(&part);
                (part, row)
            };
            let parts: Vec<(Fit, Row)> = (0..effects.len()).into_par_iter().map(without).collect();
            let best = parts.into_iter().min_by(|a, b| a.1.mean_square().total_cmp(&b.1.mean_square()));
            let Some((part, row)) = best.filter(|(_, row)| row.mean_square() <= with.mean_square()) else {
                break;
            };
            with = row;
            self.lead_with(null, part);
            shorter = true;
        }
        // What a residual explains beside what is left is another matter than what it did beside all of them.
        if let Some(leader) = self.answers.first().filter(|_| shorter) {
            let residual = residual_on(setup, null, &leader.fit, &self.judge, &|| ());
            self.residual_on_leader =
                residual.filter(|fit| self.judge.cost(fit) < self.judge.cost(&leader.fit));
        }
        with
    }

    /// Puts a fit in the place of the leading answer's, and takes back what was known of it as another one.
    fn lead_with(&mut self, null: &Fit, fit: Fit) {
        let is_it = |answer: &Answer| answer.fit.hypothesis.effects == fit.hypothesis.effects;
        let known: f64 =
            self.answers.iter().filter(|answer| is_it(answer)).map(|answer| answer.probability).sum();
        self.answers.retain(|answer| !is_it(answer));
        if let Some(leader) = self.answers.first_mut() {
            leader.exchange(null, fit);
            leader.probability += known;
            leader.members.iter_mut().for_each(|(_, probability, _)| *probability += known);
        }
    }
}

/// The fit without one of its effects, from where the others are, and from the states and the noise of `base`.
fn fit_without(setup: &Setup, base: &Fit, fit: &Fit, effect: usize) -> Fit {
    let mut effects = fit.hypothesis.effects.clone();
    effects.remove(effect);
    search::fit_part(setup, base, library::hypothesis(setup, &effects), fit)
}
