//! One answer of several.

use super::times::Times;
use crate::hypothesis::EffectAt;
use crate::search::Fit;

/// One answer: a leading effect and those that cannot be told from it.
#[derive(Clone, Debug)]
pub struct Answer {
    /// The leader's fit.
    pub fit: Fit,
    /// The fits of the class' other members, in its order.
    pub alike: Vec<Fit>,
    /// Labels of the class, the leader first.
    pub class: Vec<String>,
    /// Effects of each member of the class, with its probability and the share of the training gap that it closes.
    pub members: Vec<(Vec<EffectAt>, f64, f64)>,
    /// Probability of the class.
    pub probability: f64,
    /// Natural logarithms of prior times tempered evidence, in the order of the class.
    pub(super) logs: Vec<f64>,
    /// What else its commands may be, where it is a delay of theirs and that was weighed.
    pub(super) times: Option<Times>,
}

impl Answer {
    /// Puts another fit in its place, of the same weight, which is all of its class.
    pub(super) fn exchange(&mut self, null: &Fit, fit: Fit) {
        self.members = vec![(fit.hypothesis.effects.clone(), self.probability, closed(null, &fit))];
        let most = self.logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.logs = vec![most + self.logs.iter().map(|log| (log - most).exp()).sum::<f64>().ln()];
        self.class = vec![fit.hypothesis.label()];
        (self.fit, self.alike, self.times) = (fit, Vec::new(), None);
    }
}

/// Share of the training gap that a fit closes.
pub(super) fn closed(null: &Fit, fit: &Fit) -> f64 {
    let (gap, floor) = (null.shooting_error, 1.0);
    ((gap - fit.shooting_error) / (gap - floor).max(1e-9)).clamp(0.0, 1.0)
}
