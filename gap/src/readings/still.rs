//! Events that come where a joint hardly moves: there a machine that sticks differs from its model, and nothing that befalls
//! messages knows where the machine is.

use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::rank_among;

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
    fit.joints(setup).iter().any(|joint| {
        let speeds: Vec<f64> = joint.iter().map(|values| values.velocity.abs()).collect();
        is_slower(&speeds, &events, &all)
    })
}

/// Whether the speeds at `events` are so much less than those at `all` that it is no chance.
fn is_slower(speeds: &[f64], events: &[usize], all: &[usize]) -> bool {
    if events.len() < FEWEST {
        return false;
    }
    let mut sorted: Vec<f64> = all.iter().map(|k| speeds[*k]).collect();
    sorted.sort_by(f64::total_cmp);
    let rank = |k: &usize| rank_among(&sorted, speeds[*k]) / sorted.len() as f64;
    let count = events.len() as f64;
    events.iter().map(rank).sum::<f64>() / count < 0.5 - SLOW / (12.0 * count).sqrt()
}

#[cfg(test)]
mod tests {
    use rand::seq::IteratorRandom;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const ALL: usize = 400;

    fn speeds(random: &mut ChaCha8Rng) -> Vec<f64> {
        (0..ALL).map(|_| random.random::<f64>()).collect()
    }

    #[test]
    fn events_where_a_joint_is_slow_are_told_from_those_by_chance() {
        let mut random = ChaCha8Rng::seed_from_u64(11);
        let all: Vec<usize> = (0..ALL).collect();
        let (mut taken, mut missed) = (0, 0);
        for _ in 0..200 {
            let speeds = speeds(&mut random);
            let by_chance = all.iter().copied().sample(&mut random, 12);
            taken += usize::from(is_slower(&speeds, &by_chance, &all));
            let slow = all.iter().copied().filter(|k| speeds[*k] < 0.25).sample(&mut random, 12);
            missed += usize::from(!is_slower(&speeds, &slow, &all));
        }
        // 2.5 standard deviations on one side are six of a thousand.
        assert!(taken <= 5, "{taken} of 200 by chance");
        assert_eq!(missed, 0, "of 200 in the slowest quarter");
    }

    #[test]
    fn a_joint_that_always_stands_tells_nothing() {
        let all: Vec<usize> = (0..ALL).collect();
        let events: Vec<usize> = (0..ALL).step_by(20).collect();
        assert!(!is_slower(&[0.0; ALL], &events, &all));
    }

    #[test]
    fn two_events_tell_nothing() {
        let speeds: Vec<f64> = (0..ALL).map(|k| k as f64).collect();
        let all: Vec<usize> = (0..ALL).collect();
        assert!(!is_slower(&speeds, &[0, 1], &all));
        assert!(is_slower(&speeds, &[0, 1, 2], &all));
    }
}
