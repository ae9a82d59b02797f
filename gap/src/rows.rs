//! The five rows of how far an answer goes, from the predictions that they are made of.

use crate::quantify::{self, Row};
use crate::report::{HowFar, Split};

/// Predictions of the same held-out readings by each model.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rows {
    /// As the system was given.
    pub(crate) nominal: Row,
    /// Its calibrated parameters refitted.
    pub(crate) refitted: Row,
    /// With the leading answer's effects.
    pub(crate) with_effect: Row,
    /// With a flexible residual on top.
    pub(crate) black_box: Row,
}

impl Rows {
    /// One after the other.
    pub(crate) fn joined<'a>(all: impl Iterator<Item = &'a Rows>) -> Rows {
        let mut joined = Rows::default();
        for rows in all {
            joined.nominal.extend(&rows.nominal);
            joined.refitted.extend(&rows.refitted);
            joined.with_effect.extend(&rows.with_effect);
            joined.black_box.extend(&rows.black_box);
        }
        joined
    }

    /// Root mean square errors over `horizon_s` (s), and what is closed of them; `seed` is that of the intervals.
    pub(crate) fn how_far(&self, horizon_s: f64, split: Vec<Split>, seed: u64) -> HowFar {
        let rms = |row: &Row| row.mean_square().sqrt();
        HowFar {
            horizon_s,
            nominal: rms(&self.nominal),
            refitted: rms(&self.refitted),
            with_effect: rms(&self.with_effect),
            black_box: rms(&self.black_box),
            noise_floor: 1.0,
            closed_total: quantify::closed(&self.nominal, &self.with_effect, seed),
            closed_by_effect: quantify::closed(&self.refitted, &self.with_effect, seed),
            split,
        }
    }

    /// Share of the refitted gap that the effects leave and the residual closes.
    pub(crate) fn left(&self) -> f64 {
        let gap = (self.refitted.mean_square() - 1.0).max(1e-12);
        let left = (self.with_effect.mean_square() - self.black_box.mean_square()).max(0.0);
        if left.is_finite() { (left / gap).min(1.0) } else { 0.0 }
    }
}
