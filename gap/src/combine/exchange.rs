//! Combinations with another: another effect, or another form, in the place of one of them.

use rayon::prelude::*;

use super::{Combine, one_more};
use crate::hypothesis::EffectAt;
use crate::library;
use crate::search::{Fit, INEXACT, Width, fit_all, fit_part};
use crate::stop::SEVERAL;

impl Combine<'_> {
    /// Where the noise is not reached: the best combination with another effect, or another form, in the place of one of
    /// them. Each was chosen before what came later was known.
    pub(super) fn exchanged(&mut self, fit: &Fit) -> Option<Fit> {
        let (setup, effects) = (self.setup, &fit.hypothesis.effects);
        if effects.len() < 2 || fit.shooting_error <= INEXACT {
            return None;
        }
        let mut others: Vec<Fit> = Vec::new();
        for (left_out, own) in effects.iter().enumerate() {
            if setup.stop.leaves_out(|| SEVERAL.into()) {
                return None;
            }
            let rest = self.without(fit, left_out);
            others.extend(self.in_other_forms(&rest, own));
            // The last one was chosen beside all others.
            if left_out + 1 < effects.len() {
                others.extend(self.extended(&rest));
            }
        }
        let judge = &self.judge;
        let best = judge.best(others.iter())?;
        judge.is_better(best, fit).then(|| best.clone())
    }

    /// The combination with each effect in the form that explains most beside the others, from where it is.
    pub(super) fn reformed(&self, mut fit: Fit) -> Fit {
        let setup = self.setup;
        for k in 0..fit.hypothesis.effects.len() {
            let own = fit.hypothesis.effects[k].clone();
            let forms: Vec<&EffectAt> = self.other_forms(&own).collect();
            if forms.is_empty() || setup.stop.leaves_out(|| SEVERAL.into()) {
                continue;
            }
            let others = forms.into_par_iter().map(|form| {
                let mut effects = fit.hypothesis.effects.clone();
                effects[k] = form.clone();
                fit_part(setup, self.null, library::hypothesis(setup, &effects), &fit)
            });
            let others: Vec<Fit> = others.filter(|other| library::is_possible(setup, other)).collect();
            if let Some(best) = self.judge.best(others.iter()).filter(|best| self.judge.is_better(best, &fit))
            {
                fit = best.clone();
            }
        }
        fit
    }

    /// A combination with one effect more, which is `own` in each of its other forms.
    fn in_other_forms(&self, rest: &Fit, own: &EffectAt) -> Vec<Fit> {
        let forms = self.other_forms(own).map(|form| one_more(self.setup, rest, form)).collect();
        fit_all(self.setup, rest, forms, Width::FURTHER, &|_| ())
    }
}
