//! Dry friction as dry as it is.
//!
//! A search smooths the direction of a joint's motion around rest, within a speed that its integration steps stand. What a joint that
//! hardly moves lacks of its friction is made up for by more friction elsewhere, one or two hundredths of it. So what is to be reported
//! is fitted in ever finer steps, each from where the one before ended (a continuation: Allgower & Georg 1990), and is as fine as the data
//! like it best: what creeps stays smooth.

use super::{Fit, fit_part};
use crate::hypothesis::Hypothesis;
use crate::library;
use crate::setup::Setup;

/// How often steps are halved, at most: an eighth of them costs eight times as much, and leaves an eighth of what is made up for.
pub(crate) const HALVINGS: u32 = 3;

/// The same hypothesis in those of finer steps in which it explains most, if it has dry friction and explains more there.
pub(crate) fn sharpened(setup: &Setup, null: &Fit, fit: &Fit) -> Option<Fit> {
    if !fit.hypothesis.is_dry() {
        return None;
    }
    let cost = |fit: &Fit| fit.innovation.evidence_cost;
    let (mut from, mut best) = (fit.clone(), None);
    for halvings in fit.hypothesis.halvings + 1..=HALVINGS {
        if setup.stop.asked() {
            break;
        }
        let finer = fit_part(setup, null, Hypothesis { halvings, ..from.hypothesis.clone() }, &from);
        if cost(&finer) < cost(best.as_ref().unwrap_or(fit)) && library::is_possible(setup, &finer) {
            let mut better = finer.clone();
            better.widen_by_change(&from);
            best = Some(better);
        }
        from = finer;
    }
    if let Some(best) = &mut best {
        best.hold_to_predictions(setup);
    }
    best
}
