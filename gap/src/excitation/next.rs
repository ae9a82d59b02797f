//! From a system, a recording and the effects in question to the next experiment.

use parallax_model::system::Equations;

use super::{Design, DesignError, Wishes, design};
use crate::diagnosis::{DiagnosisError, prepare};
use crate::experiment::Experiment;
use crate::hypothesis::EffectAt;
use crate::library;
use crate::options::Options;
use crate::readings::Raw;
use crate::search::{Fit, fit_hypothesis};
use crate::setup::{Setup, without_rests};
use parallax_model::system::Suggestion;

/// Why no experiment can be proposed.
#[derive(Debug, thiserror::Error)]
pub enum ProposeError {
    /// The recording cannot be diagnosed.
    #[error(transparent)]
    Diagnosis(#[from] DiagnosisError),
    /// No experiment can be designed.
    #[error(transparent)]
    Design(#[from] DesignError),
    /// An effect that the system does not have.
    #[error("this system has no effect `{effect}`{suggestion} (it has: {known})")]
    Effect {
        /// What was asked for.
        effect: String,
        /// What may have been meant.
        suggestion: Suggestion,
        /// All effects at all places.
        known: String,
    },
}

/// Fits the effects, each written `delay@input:u` or as a sum `delay@input:u + coulomb@joint:axis`, to the recording, and
/// designs the experiment that tells them apart. `title` is the recording's name in messages.
///
/// # Errors
///
/// [`ProposeError`] when the recording cannot be diagnosed, an effect is unknown, or nothing can be designed.
pub fn propose(
    equations: Equations,
    experiment: Experiment,
    title: &str,
    effects: &[String],
    options: &Options,
    wishes: &Wishes,
) -> Result<Design, ProposeError> {
    let experiment = without_rests(experiment, options.horizon);
    let raw = Raw::of(&equations, &experiment);
    let (setup, null) = prepare(equations, &experiment, &raw, title, options, None)?;
    let choices: Vec<Vec<Vec<EffectAt>>> =
        effects.iter().map(|label| named(&setup, label)).collect::<Result<_, _>>()?;
    let mut fits = Vec::new();
    for forms in choices {
        let fit = forms.into_iter().map(|at| fit_hypothesis(&setup, &null, library::hypothesis(&setup, &at)));
        // Of several forms of one effect the one that the log likes best.
        fits.extend(fit.min_by(|a, b| a.innovation.evidence_cost.total_cmp(&b.innovation.evidence_cost)));
    }
    let candidates: Vec<&Fit> = fits.iter().collect();
    Ok(design(&setup, &null, &candidates, wishes)?)
}

/// Every choice of forms that a label may mean.
fn named(setup: &Setup, label: &str) -> Result<Vec<Vec<EffectAt>>, ProposeError> {
    let (known, _) = library::candidates(setup);
    let mut choices: Vec<Vec<EffectAt>> = vec![Vec::new()];
    for part in label.split(" + ") {
        let forms: Vec<&EffectAt> = known.iter().filter(|at| at.label() == part).collect();
        if forms.is_empty() {
            let mut labels: Vec<String> = known.iter().map(EffectAt::label).collect();
            labels.dedup();
            return Err(ProposeError::Effect {
                effect: part.into(),
                suggestion: Suggestion::nearest(part, labels.iter().map(String::as_str)),
                known: labels.join(", "),
            });
        }
        choices = choices
            .iter()
            .flat_map(|begun| forms.iter().map(|form| [&begun[..], &[(*form).clone()]].concat()))
            .collect();
    }
    Ok(choices)
}
