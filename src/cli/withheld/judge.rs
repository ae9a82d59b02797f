//! One diagnosis beside its answer: what of it is right.

use std::collections::BTreeSet;

use parallax_model::effect::Effect;

use super::case::{CaseResult, Finding, NamedAnswer};
use super::family::family;
use super::seal::Sealed;

/// What "no effect" is called in the confusion table.
pub(crate) const NO_GAP: &str = "no gap";
/// What "no named effect" is called there.
pub(crate) const UNEXPLAINED: &str = "unexplained";
/// What a diagnosis that failed is called there.
pub(crate) const FAILED: &str = "failed";

/// A result with its answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Case<'a> {
    /// What is true.
    pub(crate) truth: &'a Sealed,
    /// What was said.
    pub(crate) result: &'a CaseResult,
}

/// One entry of the ranking that a diagnosis amounts to.
#[derive(Clone, Copy, Debug)]
enum Entry<'a> {
    Named(&'a NamedAnswer),
    NoGap,
    Unexplained,
}

/// The effect's name in `name@place`.
fn effect_of(label: &str) -> &str {
    label.split_once('@').map_or(label, |(name, _)| name)
}

/// The place in `name@place`.
fn place_of(label: &str) -> &str {
    label.split_once('@').map_or("", |(_, place)| place)
}

impl<'a> Case<'a> {
    fn finding(&self) -> Option<&'a Finding> {
        self.result.found.as_ref()
    }

    /// The true effects, `name@place`.
    pub(crate) fn true_labels(&self) -> Vec<String> {
        let effects = self.truth.answer.effects.iter();
        effects.map(|effect| format!("{}@{}", effect.name, effect.place)).collect()
    }

    /// What the data cannot tell apart from the truth, the truth included unless it was left out of the library.
    pub(crate) fn class(&self) -> BTreeSet<String> {
        let mut class: BTreeSet<String> = self.truth.answer.class.iter().cloned().collect();
        for label in self.true_labels() {
            if self.truth.left_out {
                class.retain(|member| effect_of(member) != effect_of(&label));
            } else {
                class.insert(label);
            }
        }
        class
    }

    /// Whether a gap was detected.
    pub(crate) fn detected(&self) -> bool {
        self.finding().is_some_and(|found| found.detected)
    }

    /// Answers by probability. "No gap" leads where none was detected.
    fn ranking(&self) -> Vec<(Entry<'a>, f64)> {
        let Some(found) = self.finding() else { return Vec::new() };
        let mut entries: Vec<(Entry<'a>, f64)> =
            found.answers.iter().map(|answer| (Entry::Named(answer), answer.probability)).collect();
        entries.push((Entry::Unexplained, found.unexplained));
        entries.push((Entry::NoGap, found.no_gap));
        entries.sort_by(|a, b| b.1.total_cmp(&a.1));
        if !found.detected {
            // A stable sort: the others keep their order.
            entries.sort_by_key(|(entry, _)| !matches!(entry, Entry::NoGap));
        }
        entries
    }

    /// Whether an answer is the one true effect, or one that the data cannot tell apart from it.
    fn is_right(&self, answer: &NamedAnswer) -> bool {
        matches!(answer.effects.as_slice(), [one] if self.class().contains(&one.label))
    }

    /// Whether one of the first `count` answers is right. A case outside the library has no right answer by name.
    pub(crate) fn right_within(&self, count: usize) -> bool {
        let ranking = self.ranking();
        ranking
            .iter()
            .take(count)
            .any(|(entry, _)| matches!(entry, Entry::Named(answer) if self.is_right(answer)))
    }

    /// The leading answer, where it is a named one.
    pub(crate) fn leader(&self) -> Option<&'a NamedAnswer> {
        match self.ranking().first() {
            Some((Entry::Named(answer), _)) => Some(answer),
            _ => None,
        }
    }

    /// Whether the leading answer is the true effect itself.
    pub(crate) fn raw(&self) -> bool {
        let truth = self.true_labels();
        self.leader().is_some_and(|answer| {
            answer.effects.len() == 1 && truth.len() == 1 && answer.effects[0].label == truth[0]
        })
    }

    /// Whether the leading answer is that none of the effects is it, or one that takes the left-out effect's place.
    pub(crate) fn none_or_alike(&self) -> bool {
        matches!(self.ranking().first(), Some((Entry::Unexplained, _))) || self.right_within(1)
    }

    /// Whether a gap was found and the most probable place is the true one, or one of its class.
    pub(crate) fn place(&self) -> bool {
        let Some(place) = self.finding().filter(|f| f.detected).and_then(|f| f.place.as_deref()) else {
            return false;
        };
        self.class().iter().any(|label| place_of(label) == place)
    }

    /// Probability of the leading answer, and whether it is right. None where the diagnosis failed.
    pub(crate) fn confidence(&self) -> Option<(f64, bool)> {
        let (_, probability) = *self.ranking().first()?;
        Some((probability.clamp(0.0, 1.0), self.right_within(1)))
    }

    /// Probability given to the truth and its class; none at all where the diagnosis failed.
    pub(crate) fn probability_of_truth(&self) -> f64 {
        let right = self.ranking().into_iter().filter_map(|(entry, probability)| match entry {
            Entry::Named(answer) if self.is_right(answer) => Some(probability),
            _ => None,
        });
        right.sum::<f64>().min(1.0)
    }

    /// Brier's score over all answers: 0 is perfect, 2 the worst (Monthly Weather Review 78, 1950).
    pub(crate) fn brier(&self) -> f64 {
        let wrong = self.ranking().into_iter().filter_map(|(entry, probability)| match entry {
            Entry::Named(answer) if self.is_right(answer) => None,
            _ => Some(probability * probability),
        });
        (1.0 - self.probability_of_truth()).powi(2) + wrong.sum::<f64>()
    }

    /// Whether the leading answer is of the true family, or right.
    pub(crate) fn family(&self) -> bool {
        let truth: BTreeSet<&str> =
            self.truth.answer.effects.iter().filter_map(|e| family(&e.name)).collect();
        let in_class = self.right_within(1);
        in_class
            || self.leader().is_some_and(|answer| {
                let said = answer.effects.iter().map(|e| family(effect_of(&e.label)));
                !answer.effects.is_empty()
                    && said.into_iter().all(|family| family.is_some_and(|f| truth.contains(f)))
            })
    }

    /// How many effects the leading answer names, how many of them are true, and how many there are. An effect of the
    /// class stands for the true one.
    pub(crate) fn matched(&self) -> (usize, usize, usize) {
        let mut open = self.true_labels();
        let count = open.len();
        let class = self.class();
        let said: Vec<&str> =
            self.leader().map_or_else(Vec::new, |a| a.effects.iter().map(|e| e.label.as_str()).collect());
        let mut others = Vec::new();
        for label in &said {
            match open.iter().position(|truth| truth == label) {
                Some(at) => drop(open.remove(at)),
                None => others.push(*label),
            }
        }
        let alike = others.iter().filter(|label| class.contains(**label)).count().min(open.len());
        (said.len(), said.len() - others.len() + alike, count)
    }

    /// Errors of the true effect's parameters where it leads: relative error, and whether the 95 % interval covers.
    pub(crate) fn parameters(&self) -> Vec<(f64, Option<bool>)> {
        if !self.raw() {
            return Vec::new();
        }
        let (Some(answer), Some(truth)) = (self.leader(), self.truth.answer.effects.first()) else {
            return Vec::new();
        };
        let mut out = Vec::new();
        for (name, value) in &truth.parameters {
            let Some((found, std)) = answer.effects.first().and_then(|e| e.parameters.get(name)) else {
                continue;
            };
            // A phase comes round again; its size is half a turn, not its value.
            let half = std::f64::consts::PI;
            let (off, size) = if name == "phase" {
                ((found - value + half).rem_euclid(2.0 * half) - half, half)
            } else {
                (found - value, value.abs())
            };
            if size > 0.0 {
                out.push((off.abs() / size, std.map(|std| off.abs() <= 1.959_964 * std)));
            }
        }
        out
    }

    /// Probability that no named effect is the cause, and the share of the gap that is left. A diagnosis that failed says
    /// neither.
    pub(crate) fn unexplained(&self) -> (f64, f64) {
        self.finding().map_or((0.0, 0.0), |found| (found.unexplained, found.unexplained_share))
    }

    /// Whether adding the true effect can lower the error of a prediction: noise and its like cannot.
    pub(crate) fn can_lower(&self) -> bool {
        let effects = &self.truth.answer.effects;
        !effects.is_empty()
            && effects.iter().all(|e| Effect::from_name(&e.name).is_some_and(|effect| !effect.statistical()))
    }

    /// What an experiment made of the answer's class, where the truth is one effect of the library: whether the truth was
    /// in the class, and whether it is what is left.
    pub(crate) fn separation(&self) -> Option<(bool, bool)> {
        let separation = self.result.separation.as_ref()?;
        match self.true_labels().as_slice() {
            [truth] if !self.truth.left_out => Some((separation.held(truth), separation.right(truth))),
            _ => None,
        }
    }

    /// Whether the diagnosis failed.
    pub(crate) fn failed(&self) -> bool {
        self.result.found.is_none()
    }

    /// What the leading answer is called in the confusion table: effects without their places.
    pub(crate) fn said(&self) -> String {
        match self.ranking().first() {
            None => FAILED.into(),
            Some((Entry::NoGap, _)) => NO_GAP.into(),
            Some((Entry::Unexplained, _)) => UNEXPLAINED.into(),
            Some((Entry::Named(answer), _)) => {
                let names: Vec<&str> = answer.effects.iter().map(|e| effect_of(&e.label)).collect();
                names.join(" + ")
            }
        }
    }
}
