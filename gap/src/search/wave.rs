//! Where the fit of a wave starts: its amplitude and phase, once its length is known.
//!
//! Amplitude and phase are one vector, by which the response is linear. A fit that starts at another vector than the one that is there
//! takes what the length is off by for the wrong wave: with a tenth of the amplitude ten times too much, with the opposite phase in
//! the wrong direction.

use nalgebra::{Matrix2, Vector2};
use parallax_model::effect::Effect;

use super::Fit;
use crate::hypothesis::{Fitted, Hypothesis};
use crate::setup::Setup;
use crate::signature::{self, Nuisance};

/// Turns each start of the last effect, if that is a wave, to the amplitude and phase that the innovations of the fit without it show of a
/// wave of that length: their regression on the two derivatives (variable projection: Golub & Pereyra 1973).
pub(super) fn turned(setup: &Setup, base: &Fit, hypothesis: &Hypothesis, starts: &mut [Vec<f64>]) {
    let Some(last) = hypothesis.effects.len().checked_sub(1) else { return };
    if !matches!(hypothesis.effects[last].effect, Effect::Cogging | Effect::PeriodicDisturbance) {
        return;
    }
    let at = |name: &str| hypothesis.of_effect(last).find(|k| hypothesis.fitted[*k].name == name);
    let (Some(amplitude), Some(phase)) = (at("amplitude"), at("phase")) else { return };
    // Among the derivatives by what the hypothesis has beyond the base, in its order.
    let of = |k: usize| hypothesis.of_effect(last).position(|own| own == k);
    let (Some(first), Some(second)) = (of(amplitude), of(phase)) else { return };
    let nuisance = Nuisance::new(base);
    for (k, start) in starts.iter_mut().enumerate() {
        let columns = nuisance.project_columns(&signature::columns_of(setup, base, hypothesis, k));
        if columns.ncols() != hypothesis.of_effect(last).count() {
            continue;
        }
        let by = |column: usize, fitted: &Fitted| columns.column(column) / fitted.scale;
        let sine = by(first, &hypothesis.fitted[amplitude]);
        // The derivative by the phase is the amplitude times that.
        let cosine = by(second, &hypothesis.fitted[phase]) / start[amplitude];
        let information =
            Matrix2::new(sine.dot(&sine), sine.dot(&cosine), cosine.dot(&sine), cosine.dot(&cosine));
        // An innovation is what was read less what was predicted.
        let side = -Vector2::new(sine.dot(&nuisance.innovations), cosine.dot(&nuisance.innovations));
        let Some(found) = information.cholesky().map(|c| c.solve(&side)) else { continue };
        let (size, turn) = (found.norm(), found.y.atan2(found.x));
        if size > 0.0 && turn.is_finite() {
            start[amplitude] = size.min(hypothesis.fitted[amplitude].high);
            start[phase] += turn;
        }
    }
}
