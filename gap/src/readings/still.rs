//! Events that come where a joint hardly moves: there a machine that sticks differs from its model, and nothing that befalls
//! messages knows where the machine is.

use parallax_model::system::Point;

use crate::hypothesis::Slot;
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
    speeds(setup, fit).iter().any(|speeds| {
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

/// The speed of each joint at every reading.
fn speeds(setup: &Setup, fit: &Fit) -> Vec<Vec<f64>> {
    let (system, pass) = (setup.equations.system(), &fit.innovation.pass);
    let mut parameters = setup.equations.nominal();
    for (fitted, value) in fit.hypothesis.fitted.iter().zip(fit.theta()) {
        if let Slot::Nominal(index) = fitted.slot {
            parameters[index] = *value;
        }
    }
    let (n, width) = (system.states.len(), pass.states());
    let mut speeds = vec![Vec::with_capacity(pass.stamp.len()); system.joints.len()];
    for (stamp, state) in pass.stamp.iter().zip(pass.state.chunks(width.max(1))) {
        let inputs: Vec<f64> = setup.experiment.inputs.iter().map(|held| held.at(*stamp)).collect();
        let point = Point { parameters: &parameters, states: &state[..n], inputs: &inputs, time: *stamp };
        let lets = setup.equations.lets(&point, &[]);
        for (joint, speeds) in speeds.iter_mut().enumerate() {
            speeds.push(setup.equations.joint(joint, &point, &lets).velocity.abs());
        }
    }
    speeds
}
