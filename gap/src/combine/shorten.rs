//! Combinations with less: without an effect that is not needed, or with a simpler one in its place.

use parallax_model::effect::Effect;
use rayon::prelude::*;

use super::promise::most_left;
use super::{Combine, is_worth, same};
use crate::library;
use crate::search::{Fit, fit_hypothesis, fit_part};
use crate::stop::SEVERAL;

/// Standard deviations from their nulls beyond which an effect is not tried to be left out.
const CERTAIN: f64 = 20.0;

impl Combine<'_> {
    /// A combination without one of its effects.
    pub(super) fn without(&self, fit: &Fit, left_out: usize) -> Fit {
        let mut rest = fit.hypothesis.effects.clone();
        rest.remove(left_out);
        match self.fits.iter().find(|f| same(&f.hypothesis.effects, &rest)) {
            Some(known) => known.clone(),
            // From where they are beside it; another start may have missed them.
            None => fit_part(self.setup, self.null, library::hypothesis(self.setup, &rest), fit),
        }
    }

    /// With no effect that is not needed, each in its simplest form: what made up for a form that was off is not needed beside the
    /// right one.
    pub(super) fn shortened(&self, fit: Fit) -> Fit {
        let fit = self.pruned(fit);
        let before = fit.hypothesis.effects.clone();
        let fit = self.simplified(fit);
        if same(&before, &fit.hypothesis.effects) { fit } else { self.pruned(fit) }
    }

    /// Leaves out each effect without which the evidence loses less than [`WORTH`](crate::judge::WORTH), the least needed first.
    fn pruned(&self, mut fit: Fit) -> Fit {
        let judge = &self.judge;
        while fit.hypothesis.effects.len() > 1 && !self.setup.stop.leaves_out(|| SEVERAL.into()) {
            let doubtful: Vec<usize> =
                (0..fit.hypothesis.effects.len()).filter(|k| !is_certain(&fit, *k)).collect();
            let shorter: Vec<Fit> =
                doubtful.into_par_iter().map(|left_out| self.without(&fit, left_out)).collect();
            let best = shorter.into_iter().min_by(|a, b| judge.cost(a).total_cmp(&judge.cost(b)));
            let left = || most_left(self.setup, &fit, &self.pool);
            match best.filter(|best| !is_worth(self.setup, self.null, judge, (&fit, best), left)) {
                Some(simpler) => fit = simpler,
                None => break,
            }
        }
        fit
    }

    /// Puts a simpler effect in the place of one that contains it, where that one is not worth it, or hardly and what the simpler
    /// one leaves out is not told from nothing.
    fn simplified(&self, mut fit: Fit) -> Fit {
        let (setup, judge) = (self.setup, &self.judge);
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
                let other = fit_hypothesis(setup, self.null, library::hypothesis(setup, &effects));
                let left = || most_left(setup, &fit, &self.pool);
                let worth = is_worth(setup, self.null, judge, (&fit, &other), left);
                if !worth || judge.is_spare(&fit, k, &other) {
                    fit = other;
                    break;
                }
            }
        }
        fit
    }
}

/// Whether every parameter of an effect is far from its null: a frequency may be where there is no amplitude, and a parameter of the
/// model that is free of its range may have come back into it.
fn is_certain(fit: &Fit, effect: usize) -> bool {
    if fit.hypothesis.effects[effect].effect == Effect::Parameter {
        return false;
    }
    let (fitted, std) = (&fit.hypothesis.fitted, fit.innovation.minimum.std());
    let away = |k: usize| (fit.theta()[k] - fitted[k].null).abs() / std[k];
    fit.hypothesis.of_effect(effect).all(|k| away(k) > CERTAIN)
}
