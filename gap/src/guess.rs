//! Where the states may be before a stretch's first reading.

use parallax_model::system::{Equations, Initial};

use crate::experiment::Experiment;
use crate::filter::Pass;
use crate::noise;
use crate::statistics::{median, quantile, root_mean_square};

/// The states before the first reading of any stretch of a log, and how far they may be from there.
///
/// A filter mends a wrong guess only where the readings depend on the state at the guess itself: thrust goes with the
/// square of a rotor's speed, so that no reading tells the speed of a rotor that is believed to stand. Where a walk has
/// passed already, the guess is what it found.
#[derive(Clone, Debug)]
pub struct Guess {
    state: Vec<f64>,
    std: Vec<f64>,
    along: Along,
}

/// What a walk found.
#[derive(Clone, Debug, Default)]
struct Along {
    /// In ascending order (s).
    stamps: Vec<f64>,
    /// stamps × states.
    states: Vec<f64>,
    /// For how long (s) a state is a guess for what comes after it.
    reach: f64,
}

/// Widths of where a state was seen that it may be away from a guess, where no reading shows it directly.
const WIDTHS: f64 = 1.0;

impl Guess {
    /// The same guess at all times.
    #[must_use]
    pub fn constant(state: Vec<f64>, std: Vec<f64>) -> Self {
        Guess { state, std, along: Along::default() }
    }

    /// The same with what is known along the way: states one after the other, at `stamps` (s, ascending), each of them a guess for
    /// `reach` (s).
    #[must_use]
    pub fn with_states(mut self, stamps: Vec<f64>, states: Vec<f64>, reach: f64) -> Self {
        self.along = Along { stamps, states, reach };
        self
    }

    /// The state at `stamp` (s), as far as earlier readings tell it.
    #[must_use]
    pub fn state(&self, stamp: f64) -> &[f64] {
        let n = self.state.len();
        let Along { stamps, states, reach } = &self.along;
        match stamps.partition_point(|s| *s < stamp).checked_sub(1) {
            Some(k) if stamp - stamps[k] <= *reach => &states[k * n..(k + 1) * n],
            _ => &self.state,
        }
    }

    /// How far the state may be from there (standard deviations): large where nothing is known.
    #[must_use]
    pub fn std(&self) -> &[f64] {
        &self.std
    }

    /// The guess after a walk of the nominal equations over the log; each of its states is one for `reach` (s).
    #[must_use]
    pub fn informed(&self, equations: &Equations, pass: &Pass, reach: f64) -> Self {
        let (n, width) = (self.state.len(), pass.states());
        let mut order: Vec<usize> = (0..pass.readings())
            .filter(|k| pass.state[k * width..k * width + n].iter().all(|x| x.is_finite()))
            .collect();
        order.sort_by(|a, b| pass.stamp[*a].total_cmp(&pass.stamp[*b]));
        if order.is_empty() {
            return self.clone();
        }
        let mut known = self.clone();
        let system = equations.system();
        for (i, state) in system.states.iter().enumerate() {
            let shown = system.shown_as(&state.name).is_some();
            if shown || is_rate(equations, i) || matches!(state.initial, Initial::Calibrated { .. }) {
                continue;
            }
            let mut seen: Vec<f64> = order.iter().map(|k| pass.state[k * width + i]).collect();
            (known.state[i], known.std[i]) =
                narrowed(&state.initial, (known.state[i], known.std[i]), &mut seen);
        }
        let stamps = order.iter().map(|k| pass.stamp[*k]).collect();
        let states = order.iter().flat_map(|k| pass.state[k * width..k * width + n].iter().copied());
        known.with_states(stamps, states.collect(), reach)
    }

    /// At an arbitrary time: at zero or their declared start, within what the outputs suggest.
    #[must_use]
    pub fn of(equations: &Equations, experiment: &Experiment, output_scale: &[f64], period: f64) -> Self {
        let system = equations.system();
        let n = system.states.len();
        let mut state = vec![0.0; n];
        let mut std = vec![f64::NAN; n];
        for (i, s) in system.states.iter().enumerate() {
            if let Some(output) = system.shown_as(&s.name) {
                let (_, values) = experiment.output(output);
                let values = noise::unwrapped(&values, experiment.wraps[output]);
                let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
                state[i] = mean;
                std[i] = 10.0 * output_scale[output].max(1e-9);
                if let Some(rate) = derivative_is_state(equations, i) {
                    let steps: Vec<f64> =
                        values.windows(2).map(|w| (w[1] - w[0]) / period.max(1e-9)).collect();
                    std[rate] = 3.0 * root_mean_square(&steps).max(1e-9);
                }
            }
        }
        for (i, s) in system.states.iter().enumerate() {
            if let Initial::Calibrated { value, low, high } = s.initial {
                state[i] = value;
                std[i] = 0.5 * (high - low);
            } else if let Initial::Fixed(value) = s.initial {
                state[i] = value;
            }
            if std[i].is_nan() {
                let largest = output_scale.iter().copied().fold(1.0, f64::max);
                std[i] = 10.0 * largest.max(state[i].abs());
            }
        }
        Guess { state, std, along: Along::default() }
    }
}

/// A guess and its standard deviation, given where a walk saw the state: a stated start stays, however far that is from there.
fn narrowed(initial: &Initial, (state, std): (f64, f64), seen: &mut [f64]) -> (f64, f64) {
    let (low, high) = (quantile(seen, 0.05), quantile(seen, 0.95));
    let middle = median(seen);
    let state = if matches!(initial, Initial::Free) { middle } else { state };
    let away = (high - low).max((state - middle).abs());
    (state, if high > low { std.min(WIDTHS * away) } else { std })
}

/// A state whose derivative is another state alone: it integrates, and no noise enters it.
pub(crate) fn kinematic(equations: &Equations, state: usize) -> bool {
    derivative_is_state(equations, state).is_some()
}

fn derivative_is_state(equations: &Equations, state: usize) -> Option<usize> {
    let system = equations.system();
    let text = system.states[state].derivative.text();
    system.states.iter().position(|s| s.name == text.trim())
}

/// A state that is the derivative of another one.
fn is_rate(equations: &Equations, state: usize) -> bool {
    (0..equations.system().states.len()).any(|i| derivative_is_state(equations, i) == Some(state))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stated_start_stays_and_is_as_far_off_as_the_state_was_seen() {
        // A rotor that hovers: from 1900 to 2100.
        let mut seen: Vec<f64> = (0..=200).map(|k| 1900.0 + f64::from(k)).collect();
        let narrow = |initial: f64, seen: &mut Vec<f64>| {
            narrowed(&Initial::Fixed(initial), (initial, 10.0 * initial.max(1e3)), seen)
        };
        assert_eq!(narrow(1995.5, &mut seen), (1995.5, 180.0), "ten times the start is as good as nothing");
        assert_eq!(narrow(0.0, &mut seen), (0.0, 2000.0), "it stands at first");
        assert_eq!(narrowed(&Initial::Free, (0.0, 1e4), &mut seen), (2000.0, 180.0));
        let mut still = vec![7.0; 50];
        assert_eq!(narrow(7.0, &mut still), (7.0, 1e4), "nothing was seen to move");
    }
}
