//! Events that come where a joint hardly moves: there a machine that sticks differs from its model, and nothing that befalls
//! messages knows where the machine is.

use crate::search::Fit;
use crate::setup::Setup;

/// Events from which their place tells anything.
const FEWEST: usize = 3;

/// Standard deviations by which the mean rank of the speeds of one joint must be less than that of any speeds.
const SLOW: f64 = 2.5;

/// Whether what befell some messages, at these stamps (s), came where one of the joints is slower than chance has it. `all` are the stamps
/// of those that it could have befallen, each with its weight: as often as it would show there. Each speed's rank among these is even
/// between nothing and one by chance, and their mean is about a half.
pub(super) fn come_at_rest(
    setup: &Setup,
    fit: &Fit,
    events: &[f64],
    all: impl Iterator<Item = (f64, f64)>,
) -> bool {
    let pass = &fit.innovation.pass;
    let at = |message: f64| {
        let after = pass.stamp.partition_point(|stamp| *stamp < message);
        let near = [after.checked_sub(1), Some(after)].into_iter().flatten();
        let distance = |k: &usize| (pass.stamp.get(*k).copied().unwrap_or(f64::INFINITY) - message).abs();
        near.min_by(|a, b| distance(a).total_cmp(&distance(b))).filter(|k| distance(k) <= setup.period)
    };
    // Among the readings that are fitted.
    let events: Vec<usize> = events.iter().filter_map(|stamp| at(*stamp)).collect();
    let all: Vec<(usize, f64)> =
        all.filter_map(|(stamp, weight)| at(stamp).map(|reading| (reading, weight))).collect();
    let joints = fit.joints(setup);
    joints.iter().any(|joint| {
        let speeds: Vec<f64> = joint.iter().map(|values| values.velocity.abs()).collect();
        is_slower(&speeds, &events, &all, joints.len())
    })
}

/// Whether the speeds at `events` are so much less than those at `all`, each of which counts by its weight, that it is no chance: not even
/// the least of so many `joints` by chance. A normal distribution's tail is about exp(−z²/2).
fn is_slower(speeds: &[f64], events: &[usize], all: &[(usize, f64)], joints: usize) -> bool {
    if events.len() < FEWEST {
        return false;
    }
    let mut sorted: Vec<(f64, f64)> = all.iter().map(|(k, weight)| (speeds[*k], *weight)).collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let weight = |of: &[(f64, f64)]| of.iter().map(|(_, weight)| weight).sum::<f64>();
    let total = weight(&sorted);
    // Equal speeds share their rank.
    let rank = |k: &usize| {
        let below = sorted.partition_point(|(speed, _)| *speed < speeds[*k]);
        let up_to = sorted.partition_point(|(speed, _)| *speed <= speeds[*k]);
        (weight(&sorted[..below]) + 0.5 * weight(&sorted[below..up_to])) / total
    };
    let count = events.len() as f64;
    let slow = (SLOW * SLOW + 2.0 * (joints as f64).ln()).sqrt();
    events.iter().map(rank).sum::<f64>() / count < 0.5 - slow / (12.0 * count).sqrt()
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
        let all: Vec<(usize, f64)> = (0..ALL).map(|k| (k, 1.0)).collect();
        let (mut taken, mut missed) = (0, 0);
        for _ in 0..200 {
            let speeds = speeds(&mut random);
            let by_chance = (0..ALL).sample(&mut random, 12);
            taken += usize::from(is_slower(&speeds, &by_chance, &all, 1));
            let slow = (0..ALL).filter(|k| speeds[*k] < 0.25).sample(&mut random, 12);
            missed += usize::from(!is_slower(&speeds, &slow, &all, 1));
        }
        // 2.5 standard deviations on one side are six of a thousand.
        assert!(taken <= 5, "{taken} of 200 by chance");
        assert_eq!(missed, 0, "of 200 in the slowest quarter");
    }

    #[test]
    fn a_joint_that_always_stands_tells_nothing() {
        let all: Vec<(usize, f64)> = (0..ALL).map(|k| (k, 1.0)).collect();
        let events: Vec<usize> = (0..ALL).step_by(20).collect();
        assert!(!is_slower(&[0.0; ALL], &events, &all, 1));
    }

    #[test]
    fn what_shows_where_a_joint_turns_around_is_no_sticking() {
        // Commands change most where the joint turns around, and there it is seen what befalls them.
        let mut random = ChaCha8Rng::seed_from_u64(12);
        let (mut taken, mut weighed, mut missed) = (0, 0, 0);
        for _ in 0..200 {
            let speeds = speeds(&mut random);
            let even: Vec<(usize, f64)> = (0..ALL).map(|k| (k, 1.0)).collect();
            let shows: Vec<(usize, f64)> = (0..ALL).map(|k| (k, (1.0 - speeds[k]).powi(2))).collect();
            let seen = (0..ALL).filter(|k| random.random::<f64>() < 0.1 * shows[*k].1).collect::<Vec<_>>();
            taken += usize::from(is_slower(&speeds, &seen, &even, 1));
            weighed += usize::from(is_slower(&speeds, &seen, &shows, 1));
            let slow = (0..ALL).filter(|k| speeds[*k] < 0.1).sample(&mut random, 12);
            missed += usize::from(!is_slower(&speeds, &slow, &shows, 1));
        }
        assert!(taken > 50 && weighed <= 5, "{taken} and {weighed} of 200");
        assert_eq!(missed, 0, "of 200 in the slowest tenth");
    }

    #[test]
    fn two_events_tell_nothing() {
        let speeds: Vec<f64> = (0..ALL).map(|k| k as f64).collect();
        let all: Vec<(usize, f64)> = (0..ALL).map(|k| (k, 1.0)).collect();
        assert!(!is_slower(&speeds, &[0, 1], &all, 1));
        assert!(is_slower(&speeds, &[0, 1, 2], &all, 1));
    }
}
