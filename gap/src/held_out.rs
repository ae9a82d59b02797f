//! Which part of a log is held out: one that shows nothing that the rest does not show as well.
//!
//! A stop that is hit once, or a gust, may lie wholly in the part on which nothing is fitted. Nothing could then be learned
//! of it, and the diagnosis would answer "no gap" beside an error that says otherwise.

use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::search::{Fit, INEXACT};
use crate::setup::{HELD_OUT, Setup};

/// Mean square of an output's innovations on held-out time, against that on the rest, beyond which the parts are not alike: where
/// the rest shows a gap to learn from, and where it is predicted to the noise. On 70 development cases the largest was 1.25 where
/// nothing had happened in one part alone.
const UNLIKE: (f64, f64) = (2.0, 1.4);

/// So many readings of an output at least tell its mean square.
const LEAST_READINGS: usize = 50;

/// Another choice of the part to hold out, where the one in use holds what surprises a model most in some output: the one of the
/// others whose parts are most alike among those that leave the surprise to be learned from. Of the nominal model, or of one with the
/// effects that were found on the rest: what it lacks may have been hidden by them.
#[must_use]
pub(crate) fn fairer(setup: &Setup, fit: &Fit) -> Option<usize> {
    let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
    let outputs = setup.output_noise.len();
    let surprise = |segments: &[Segment]| -> Vec<f64> {
        let pass = walk_plain(&simulator, segments, &setup.noise, &fit.innovation.noise, fit.theta());
        let mut sums = vec![(0.0, 0); outputs];
        for (output, error) in pass.output.iter().zip(pass.whitened()) {
            sums[*output].0 += error * error;
            sums[*output].1 += 1;
        }
        let mean = |(sum, count): (f64, usize)| if count < LEAST_READINGS { 1.0 } else { sum / count as f64 };
        sums.into_iter().map(mean).collect()
    };
    let ratios = |setup: &Setup| -> Vec<f64> {
        let (test, train) = (surprise(&setup.test), surprise(&setup.train));
        test.iter().zip(train).map(|(test, train)| test / train).collect()
    };
    let most = if fit.shooting_error > INEXACT { UNLIKE.0 } else { UNLIKE.1 };
    let is_alike = |ratios: &[f64]| ratios.iter().all(|ratio| *ratio <= most);
    let now = ratios(setup);
    if is_alike(&now) || now.iter().any(|ratio| ratio.is_nan()) {
        return None;
    }
    let others = (0..HELD_OUT).filter_map(|which| {
        let mut other = setup.clone();
        other.hold_out(which);
        if other.train.is_empty() || other.test.is_empty() {
            return None;
        }
        let found = ratios(&other);
        let unlike = found.iter().map(|ratio| ratio.ln().abs()).fold(0.0, f64::max);
        is_alike(&found).then_some((which, unlike))
    });
    others.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(which, _)| which)
}
