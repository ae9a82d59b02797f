//! A cause beside the first one, looked for as if the first were part of the system.
//!
//! What a second cause does may not show until the first is known: which frequency repeats in what is left, how far a joint went while
//! its sensor was at a limit, which states are pushed by what nobody knows. So the recording is looked at anew with the system as the
//! first answer corrects it, and what explains most there is fitted together with the first, to be weighed like any other answer.

use rayon::prelude::*;

use super::weigh::{Rounds, Searched};
use crate::answers::{corrected_effects, fitted_effects};
use crate::calibration;
use crate::combine;
use crate::experiment::Experiment;
use crate::hypothesis::EffectAt;
use crate::judge::Judge;
use crate::library;
use crate::readings::Raw;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;
use crate::stop::SEVERAL;

/// Variance ratio of the innovations up to which a fit that reaches the sensors' noise leaves nothing to look for.
const CHANCE: f64 = 2.0;

impl Rounds<'_> {
    /// The best fit with a further effect, and what any other effect promises beside the two; nothing where the best one leaves no more
    /// than noise, or nothing explains what it leaves. `progress` goes from 0 to 1.
    pub(super) fn beside(
        &self,
        setup: &Setup,
        best: &Fit,
        experiment: &Experiment,
        progress: &(dyn Fn(f64, &str) + Sync),
    ) -> Option<(Fit, f64)> {
        let is_noise = best.shooting_error <= INEXACT && best.variance_ratio <= CHANCE;
        if is_noise || setup.stop.leaves_out(|| SEVERAL.into()) {
            return None;
        }
        let effects = corrected_effects(setup, &best.hypothesis, &fitted_effects(setup, best));
        let values = calibration::values(setup, best);
        let system = setup.equations.system().with_corrections(&values, &effects);
        let mut experiment = experiment.clone();
        // Each recording has constants of its own; what was fitted is none of them.
        for (index, value) in values.iter().filter_map(|(name, value)| Some((system.parameter(name)?, value)))
        {
            let own = experiment.parts.iter_mut().filter_map(|part| part.parameters.get_mut(index));
            own.for_each(|own| *own = *value);
        }
        // A system that these values contradict, or a search that was stopped, shows nothing.
        let equations = system.equations().ok()?;
        let raw = Raw::of(&equations, &experiment);
        let told = |done: f64, _: &str| progress(done, "a cause beside the first");
        let again = Rounds { equations: equations.clone(), checked: false, ..*self };
        let Ok(searched) = again.search(equations, &raw, &experiment, Some(setup.held_out), &told) else {
            setup.stop.leaves_out(|| SEVERAL.into());
            return None;
        };
        let Searched { setup: mut seen, null: known, fits, promising, .. } = searched;
        let judge = Judge::new(&known, &fits);
        let own = &best.hypothesis.effects;
        let is_new = |fit: &&Fit| {
            !fit.hypothesis.effects.iter().any(|at| own.iter().any(|own| combine::overlap(own, at)))
        };
        let further = judge.best(fits.iter().filter(is_new).filter(|fit| judge.is_worth(fit, &known)))?;
        let left = combine::most_of(&seen, further, promising.par_iter());
        // Sizes, and bounds by them, are those that were seen beside the first cause; the nominal system is the one that was given.
        seen.equations = setup.equations.clone();
        let effects: Vec<EffectAt> = own.iter().chain(&further.hypothesis.effects).cloned().collect();
        let joint = search::fit_together(setup, library::hypothesis(&seen, &effects), best, further);
        library::is_possible(setup, &joint).then_some((joint, left))
    }
}
