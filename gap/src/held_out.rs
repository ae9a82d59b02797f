//! Which part of a log is held out: one that shows nothing that the rest does not show as well.
//!
//! A stop that is hit once, or a gust, may lie wholly in the part on which nothing is fitted. Nothing could then be learned
//! of it, and the diagnosis would answer "no gap" beside an error that says otherwise.

use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::search::Fit;
use crate::setup::{HELD_OUT, Setup};

/// Mean square of the innovations on held-out time, against that on the rest, beyond which the parts are not alike.
const UNLIKE: f64 = 2.0;

/// Another choice of the part to hold out, where the one in use holds what surprises the nominal model most: the one of
/// the others whose parts are most alike among those that leave the surprise to be learned from.
#[must_use]
pub(crate) fn fairer(setup: &Setup, null: &Fit) -> Option<usize> {
    let simulator = library::simulator(setup, &null.hypothesis, Vec::new());
    let ratio = |setup: &Setup| {
        let surprise = |segments: &[Segment]| {
            let pass = walk_plain(&simulator, segments, &setup.noise, &null.innovation.noise, null.theta());
            let whitened = pass.whitened();
            whitened.iter().map(|e| e * e).sum::<f64>() / whitened.len().max(1) as f64
        };
        surprise(&setup.test) / surprise(&setup.train)
    };
    if ratio(setup).is_nan() || ratio(setup) <= UNLIKE {
        return None;
    }
    let others = (0..HELD_OUT).filter_map(|which| {
        let mut other = setup.clone();
        other.hold_out(which);
        let found = if other.train.is_empty() || other.test.is_empty() { f64::NAN } else { ratio(&other) };
        (found <= UNLIKE).then(|| (which, found.ln().abs()))
    });
    others.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(which, _)| which)
}
