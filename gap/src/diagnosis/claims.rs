//! What an unknown cause claims, held to fresh motion.
//!
//! On the time that it is fitted to, whatever is flexible follows what a named effect leaves. Where no model reaches the noise, as on
//! any real machine, its evidence says little else; predictions of held-out time say whether it is more than that.

use crate::judge;
use crate::posterior::Posterior;
use crate::quantify::{self, Row};
use crate::search::{Fit, INEXACT};

/// Share of the gap on held-out time, below zero, that an unknown cause must add to it with certainty to be refuted: its errors are
/// twice those without. One that nobody can predict, such as gusts, is no such cause: it is not there when the motion is fresh.
const ADDS: f64 = -3.0;

/// Share of the gap on held-out time that a named answer must close for an unknown cause to be held to it: one that predicts better,
/// and one that does not.
const LEAST_CLOSED: (f64, f64) = (0.3, 0.1);

/// Takes from the unknown cause that outweighs the leading answer what predictions of held-out time (`row`) deny it: all but its prior
/// where it spoils them and the answer does not; where it explains no more beyond the answer than the answer's form may be off by, all
/// that makes it more likely than that. An answer that is no likelier than that there is no gap denies nothing. Where
/// another kind of unknown cause is likelier than what is left of this one, it speaks.
pub(super) fn hold_unknown(
    answers: &mut Posterior,
    null: &Fit,
    row: &impl Fn(&Fit) -> Row,
    refitted: &Row,
    seed: u64,
) {
    loop {
        let (Some(alone), Some(leader)) = (answers.residual(false), answers.answers.first()) else { return };
        if alone.shooting_error <= INEXACT || answers.names() || !answers.leads_the_null() {
            return;
        }
        let exact = leader.fit.shooting_error <= INEXACT;
        let (alone, leader) = (row(alone), row(&leader.fit));
        let closed = |row: &Row| quantify::closed(refitted, row, seed);
        let by_leader = closed(&leader);
        let spoils = closed(&alone).high < ADDS && by_leader.value > 0.0;
        let gap = refitted.mean_square() - 1.0;
        let (alone, leader) = (alone.mean_square(), leader.mean_square());
        let least = if alone < leader { LEAST_CLOSED.0 } else { LEAST_CLOSED.1 };
        // What may close nothing is no measure.
        let is_held = !exact && by_leader.low > 0.0 && refitted.mean_square() - leader > least * gap;
        let beyond = is_held.then(|| judge::share_of_form(leader - alone, gap));
        if !answers.deny_unknown(spoils, beyond, null) {
            return;
        }
    }
}
