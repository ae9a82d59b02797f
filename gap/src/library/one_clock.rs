//! Signals that one clock stamped, as the irregularity of their stamps proves.

use std::collections::BTreeSet;

use parallax_model::effect::PlaceKind;

use crate::setup::Setup;

/// Share of the stamps that must be the same.
const SAME: f64 = 0.95;

/// How many lengths the intervals between the stamps must have, to the nanosecond: a grid that is written with so many digits has two or
/// three, wherever it came from.
const LENGTHS: usize = 30;

/// Distance (s) within which two stamps are one.
const ONE: f64 = 0.5e-9;

/// The signal of the other kind, a reading for an input and a command for an output, whose stamps are those of this input or output,
/// irregular as they are: no second clock has the same jitter.
pub(super) fn stamped_with(setup: &Setup, kind: PlaceKind, index: usize) -> Option<&str> {
    let (experiment, system) = (&setup.experiment, setup.equations.system());
    let readings = |output: usize| -> Vec<f64> {
        experiment.samples.iter().filter(|s| s.output == output).map(|s| s.stamp).collect()
    };
    let commands = |input: usize| &experiment.inputs[input].times;
    match kind {
        PlaceKind::Output => {
            let own = readings(index);
            let shared = (0..experiment.inputs.len()).find(|input| are_one(commands(*input), &own));
            shared.map(|input| system.inputs[input].name.as_str())
        }
        PlaceKind::Input => {
            let shared =
                (0..experiment.wraps.len()).find(|output| are_one(commands(index), &readings(*output)));
            shared.map(|output| system.outputs[output].name.as_str())
        }
        _ => None,
    }
}

/// Whether two lists of stamps (s), both increasing, are one, and irregular.
fn are_one(a: &[f64], b: &[f64]) -> bool {
    let mut common = Vec::new();
    let mut at = 0;
    for stamp in b {
        while at < a.len() && a[at] < stamp - ONE {
            at += 1;
        }
        if at < a.len() && a[at] <= stamp + ONE {
            common.push(*stamp);
        }
    }
    if (common.len() as f64) < SAME * a.len().min(b.len()) as f64 {
        return false;
    }
    let lengths = common.windows(2).map(|w| ((w[1] - w[0]) * 1e9).round() as i64);
    lengths.collect::<BTreeSet<i64>>().len() > LENGTHS
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stamps every 20 ms, each late by chance, to the nanosecond.
    fn jittered(seed: u64) -> Vec<f64> {
        let mut state = seed;
        let mut late = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 44) as f64 * 1e-10
        };
        (0..500).map(|k| ((0.02 * f64::from(k) + late()) * 1e9).round() * 1e-9).collect()
    }

    #[test]
    fn what_jitters_alike_is_stamped_by_one_clock() {
        let loop_times = jittered(1);
        assert!(are_one(&loop_times, &loop_times));
        // Every other reading was kept.
        let thinned: Vec<f64> = loop_times.iter().step_by(2).copied().collect();
        assert!(are_one(&loop_times, &thinned));
        assert!(!are_one(&loop_times, &jittered(2)), "a loop of its own");
    }

    #[test]
    fn stamps_on_a_grid_prove_nothing() {
        let grid: Vec<f64> = (0..500).map(|k| (f64::from(k) / 300.0 * 1e6).round() * 1e-6).collect();
        assert!(!are_one(&grid, &grid), "two clocks may be written so");
        assert!(!are_one(&[], &[]));
    }
}
