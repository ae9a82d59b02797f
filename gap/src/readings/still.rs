//! Events that come where a joint hardly moves: there a machine that sticks differs from its model, and nothing that befalls
//! messages knows where the machine is.

use crate::search::Fit;
use crate::setup::Setup;

/// Events from which their place tells anything.
const FEWEST: usize = 3;

/// Standard deviations by which the mean rank of the speeds must be less than that of any speeds.
const SLOW: f64 = 2.5;

/// Whether what befell some messages, at these stamps (s), came where one of the joints is slower than chance has it: each speed's
/// rank among those at `all` messages is even between nothing and one, and their mean is about a half.
pub(super) fn come_at_rest(setup: &Setup, fit: &Fit, events: &[f64], all: &[f64]) -> bool {
    let pass = &fit.innovation.pass;
    let at = |message: &f64| {
        let after = pass.stamp.partition_point(|stamp| stamp < message);
        let near = [after.checked_sub(1), Some(after)].into_iter().flatten();
        let distance = |k: &usize| (pass.stamp.get(*k).copied().unwrap_or(f64::INFINITY) - message).abs();
        near.min_by(|a, b| distance(a).total_cmp(&distance(b))).filter(|k| distance(k) <= setup.period)
    };
    // Among the readings that are fitted.
    let [events, all] = [events, all].map(|messages| messages.iter().filter_map(at).collect::<Vec<usize>>());
    if events.len() < FEWEST {
        return false;
    }
    let count = events.len() as f64;
    let least = 0.5 - SLOW / (12.0 * count).sqrt();
    fit.joints(setup).iter().any(|joint| {
        let speeds: Vec<f64> = joint.iter().map(|values| values.velocity.abs()).collect();
        let mut sorted: Vec<f64> = all.iter().map(|k| speeds[*k]).collect();
        sorted.sort_by(f64::total_cmp);
        let rank = |k: &usize| {
            let below =
                |most: bool| sorted.partition_point(|s| *s < speeds[*k] || (most && *s == speeds[*k]));
            0.5 * (below(false) + below(true)) as f64 / sorted.len() as f64
        };
        events.iter().map(rank).sum::<f64>() / count < least
    })
}
