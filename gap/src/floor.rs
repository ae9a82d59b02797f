//! What the predictions of an exact model are off by: the noise of the readings, and what earlier readings leave open of the state.

use crate::filter::{Noise, Uncertainty};
use crate::innovation::{Segment, walk_plain};
use crate::quantify;
use crate::setup::Setup;
use crate::simulator::{Prediction, Simulator, Transition};

/// A prediction under way.
struct Free {
    /// Stamps of its readings (s).
    from: f64,
    to: f64,
    uncertainty: Uncertainty,
}

/// The mean squared error, in noise units squared, that predictions over the horizon on held-out time have where the model is exact.
///
/// As in [`predict`](quantify::predict), each starts from the state that a filter has; `noise` leads the walk. How well the filter
/// of an exact model knows its state, and how that grows until a reading, has no process noise in it and no readings that are noisier
/// than the system says.
#[must_use]
pub fn expected(setup: &Setup, simulator: &dyn Simulator, theta: &[f64], noise: &Noise) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for (segment, starts) in quantify::starts(setup) {
        for variance in variances(setup, simulator, (theta, noise), &segment, starts) {
            sum += 1.0 + variance;
            count += 1;
        }
    }
    if count == 0 { 1.0 } else { sum / count as f64 }
}

/// The variance of every reading that is predicted from one of the `starts`, but for its own noise, in noise units squared.
fn variances(
    setup: &Setup,
    simulator: &dyn Simulator,
    (theta, noise): (&[f64], &Noise),
    segment: &Segment,
    starts: impl Iterator<Item = f64>,
) -> Vec<f64> {
    let mut found = Vec::new();
    let n = simulator.states();
    let pass = walk_plain(simulator, std::slice::from_ref(segment), &setup.noise, noise, theta);
    let (Some(first), Some(last)) = (pass.event.iter().min().copied(), pass.event.iter().max().copied())
    else {
        return found;
    };
    let mut read: Vec<Option<usize>> = vec![None; last + 1 - first];
    pass.event.iter().enumerate().for_each(|(k, event)| read[event - first] = Some(k));
    let last_before = |start: f64| pass.stamp.iter().rposition(|stamp| *stamp < start);
    let mut begins: Vec<(usize, f64)> =
        starts.filter_map(|start| Some((pass.event[last_before(start)?], start))).collect();
    begins.sort_by_key(|(event, _)| *event);
    let mut begins = begins.into_iter().peekable();

    let mut run = simulator.run_at(theta);
    let guess = &segment.guess;
    let (mut x, std) = simulator.start(guess.state(segment.from), guess.std(), run.events()[first].time);
    let mut uncertainty = Uncertainty::new(&std);
    let mut active: Vec<Free> = Vec::new();
    let (mut transition, mut prediction) = (Transition::default(), Prediction::default());
    for index in first..=last {
        if let (Some(reading), Some(k)) = (run.events()[index].reading, read[index - first]) {
            run.observe(index, &x, &mut prediction);
            let unit = setup.output_noise[reading.output];
            let free = active.iter().find(|free| (free.from..free.to).contains(&reading.stamp));
            found.extend(free.map(|free| free.uncertainty.variance(&prediction.by_state) / (unit * unit)));
            active.retain(|free| free.to > reading.stamp);
            uncertainty.read(&prediction.by_state, unit * unit);
            x.copy_from_slice(&pass.state[k * n..(k + 1) * n]);
        }
        while let Some((_, from)) = begins.next_if(|(event, _)| *event <= index) {
            let to = (from + setup.horizon).min(segment.to);
            active.push(Free { from, to, uncertainty: uncertainty.clone() });
        }
        if index < last {
            run.advance(index, &mut x, &mut transition);
            uncertainty.advance(&transition.by_state);
            active.iter_mut().for_each(|free| free.uncertainty.advance(&transition.by_state));
        }
    }
    found
}
