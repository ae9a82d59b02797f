//! The answers of a report as one list: the named ones, "no gap" and "none of these", by probability.

use super::format;
use super::{FittedEffect, Report, Which};

/// What is said when no named effect belongs to the cause.
const NONE_OF_THESE: &str = "none of these";
/// What is said of an answer without effects.
const NO_GAP: &str = "no gap";

/// One answer as it is shown.
pub(super) struct Answer<'a> {
    /// Its effects; empty for "no gap" and "none of these".
    pub(super) effects: &'a [FittedEffect],
    /// Name of an answer without effects.
    pub(super) word: &'static str,
    /// What this data cannot tell apart from it, itself left out.
    pub(super) alike: Vec<&'a str>,
    /// Its probability.
    pub(super) probability: f64,
}

impl Answer<'_> {
    /// `delay@input:goal + coulomb@joint:axis`, or `no gap`.
    pub(super) fn name(&self) -> String {
        self.names().join(" + ")
    }

    /// The same, each effect by itself.
    pub(super) fn names(&self) -> Vec<String> {
        if self.effects.is_empty() {
            return vec![self.word.to_owned()];
        }
        self.effects.iter().map(FittedEffect::label).collect()
    }

    /// The fitted parameters of all effects: `delay 0.041 ± 0.001 s, …`.
    pub(super) fn parameters(&self) -> Vec<String> {
        self.effects
            .iter()
            .flat_map(|effect| &effect.parameters)
            .map(|(name, value)| format!("{name} {}", format::uncertain(value)))
            .collect()
    }
}

fn answer(which: &Which) -> Answer<'_> {
    let own: Vec<String> = which.effects.iter().map(FittedEffect::label).collect();
    let whole = own.join(" + ");
    let word = if which.class.iter().any(|name| name == NONE_OF_THESE) { NONE_OF_THESE } else { NO_GAP };
    let alike = which.class.iter().map(String::as_str).filter(|other| {
        let itself = *other == whole || own.iter().any(|name| name == other);
        !itself && (!own.is_empty() || *other != word)
    });
    Answer { effects: &which.effects, word, alike: alike.collect(), probability: which.probability }
}

/// All answers, the most probable first.
pub(super) fn answers(report: &Report) -> Vec<Answer<'_>> {
    let mut answers: Vec<Answer<'_>> = report.which.iter().map(answer).collect();
    let listed = answers.iter().any(|answer| answer.effects.is_empty() && answer.word == NONE_OF_THESE);
    if !listed && report.unexplained.probability.is_finite() {
        let probability = report.unexplained.probability;
        answers.push(Answer { effects: &[], word: NONE_OF_THESE, alike: Vec::new(), probability });
    }
    answers.sort_by(|a, b| order(b.probability).total_cmp(&order(a.probability)));
    answers
}

/// Unknown probabilities go last.
fn order(probability: f64) -> f64 {
    if probability.is_nan() { f64::NEG_INFINITY } else { probability }
}
