//! How far: errors of prediction over the horizon on held-out time, each from a state estimated by earlier samples.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use parallax_model::plant::Plant;

use crate::equations::EquationsSimulator;
use crate::filter::Noise;
use crate::innovation::{Segment, walk};
use crate::report::{Interval, Overlay, WORST_SHARE};
use crate::setup::Setup;
use crate::simulator::{Simulator, Trajectory, wrapped};
use crate::statistics::root_mean_square;

/// Squared errors of the predictions that start at one time: the block of the bootstrap.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Block {
    /// Sum of squared errors in noise units.
    pub squares: f64,
    /// How many readings were predicted.
    pub count: usize,
}

/// Predictions of one row of the table.
#[derive(Clone, Debug, Default)]
pub struct Row {
    /// Errors by start.
    pub blocks: Vec<Block>,
    /// Every predicted reading: output, stamp, measured, predicted.
    pub readings: Vec<(usize, f64, f64, f64)>,
}

impl Row {
    /// Adds the predictions of another one.
    pub fn extend(&mut self, other: &Row) {
        self.blocks.extend_from_slice(&other.blocks);
        self.readings.extend_from_slice(&other.readings);
    }

    /// Mean squared error in noise units squared.
    #[must_use]
    pub fn mean_square(&self) -> f64 {
        let count: usize = self.blocks.iter().map(|b| b.count).sum();
        self.blocks.iter().map(|b| b.squares).sum::<f64>() / count.max(1) as f64
    }
}

/// Predicts the held-out segments.
///
/// The filter runs up to each start, from two horizons before the segment where the log allows, or from where a sensor that is at its
/// limit last showed more; from there the model runs free to the horizon. Starts follow each other by one horizon, so that every
/// reading is predicted once.
#[must_use]
pub fn predict(setup: &Setup, simulator: &dyn Simulator, theta: &[f64], noise: &Noise) -> Row {
    let mut row = Row::default();
    let n = simulator.states();
    for (segment, starts) in starts(setup) {
        let pass = walk(simulator, std::slice::from_ref(&segment), &setup.noise, noise, theta);
        let mut run = simulator.run_at(theta);
        for start in starts {
            let end = (start + setup.horizon).min(segment.to);
            let Some(last) = pass.stamp.iter().rposition(|s| *s < start) else { break };
            let mut trajectory = Trajectory::from(&pass.state[last * n..(last + 1) * n]);
            let mut block = Block::default();
            let mut index = pass.event[last];
            while index + 1 < run.events().len() {
                trajectory.advance(&mut *run, index);
                index += 1;
                let Some(reading) = run.events()[index].reading else {
                    // A reading is taken at its stamp or earlier: past the end there is none left.
                    if run.events()[index].time > end {
                        break;
                    }
                    continue;
                };
                if reading.stamp >= end {
                    break;
                }
                if reading.stamp < start {
                    continue;
                }
                let predicted = trajectory.observe(&mut *run, index);
                let error = wrapped(reading.value - predicted, run.wrap(reading.output));
                let unit = setup.output_noise[reading.output];
                block.squares += (error / unit).powi(2);
                block.count += 1;
                row.readings.push((reading.output, reading.stamp, reading.value, reading.value - error));
            }
            row.blocks.push(block);
        }
    }
    row
}

/// The held-out segments as the filter enters them, and where predictions of each start (s).
pub(crate) fn starts(
    setup: &Setup,
) -> impl Iterator<Item = (Segment, impl Iterator<Item = f64> + use<>)> + '_ {
    let (horizon, (begin, _)) = (setup.horizon, setup.experiment.span());
    setup.test.iter().map(move |segment| {
        let mut from = (segment.from - 2.0 * horizon).max(begin);
        let parts = setup.experiment.spans().into_iter();
        // No further than its own recording goes.
        let own = parts.map(|(first, _)| first).filter(|first| *first <= segment.from).fold(begin, f64::max);
        while from > own && segment.from - from < BLIND * horizon && is_blind(setup, from, segment.from) {
            from = (from - horizon).max(own);
        }
        // The filter needs readings before the first start, or it knows no speed.
        let (first, end) = (segment.from.max(from + horizon), segment.to);
        let starts = std::iter::successors(Some(first), move |start| Some(start + horizon))
            .take_while(move |start| start + 0.5 * horizon < end);
        (Segment { from, ..segment.clone() }, starts)
    })
}

/// How many horizons before a segment a filter enters it at the earliest.
const BLIND: f64 = 20.0;

/// Whether some sensor is at its limit nearly all the time between two times.
fn is_blind(setup: &Setup, from: f64, to: f64) -> bool {
    let samples = &setup.experiment.samples;
    let at = |time: f64| samples.partition_point(|s| s.stamp < time);
    setup.noise.is_blind(samples[at(from)..at(to)].iter().map(|s| (s.output, s.value)))
}

/// Halves the integration step until that changes the nominal system's predictions by far less than the noise.
pub fn refine_step(setup: &mut Setup) {
    let joints = setup.joints.len();
    let plant = Plant::new(setup.equations.clone(), &[], Vec::new(), vec![1.0; joints]);
    let predict = |step: f64| {
        let simulator = EquationsSimulator::new(plant.clone(), Vec::new(), &setup.experiment, step);
        predict(setup, &simulator, &[], &setup.noise.initial)
    };
    let mut step = setup.step;
    let mut coarse = predict(step);
    for _ in 0..4 {
        let fine = predict(0.5 * step);
        let pairs = coarse.readings.iter().zip(&fine.readings);
        let changes: Vec<f64> = pairs.map(|(a, b)| (a.3 - b.3) / setup.output_noise[a.0]).collect();
        // What a wrong model predicts is no truth to reach: a small share of its error is enough as well.
        let enough = (0.1_f64).max(0.01 * fine.mean_square().sqrt());
        let change = root_mean_square(&changes);
        if change.is_nan() || change <= enough {
            break;
        }
        step *= 0.5;
        coarse = fine;
    }
    setup.step = step;
}

/// 1 − (MSE after − floor)/(MSE before − floor), with a bootstrap interval over the starts.
///
/// The floor is one noise unit squared. Where there was no gap to close the share is zero.
#[must_use]
pub fn closed(before: &Row, after: &Row, seed: u64) -> Interval {
    closed_to(1.0, before, after, seed)
}

/// The same to another `floor` (noise units squared).
#[must_use]
pub fn closed_to(floor: f64, before: &Row, after: &Row, seed: u64) -> Interval {
    let share = |b: f64, a: f64| {
        let gap = b - floor;
        if a.is_nan() || b.is_nan() {
            // A prediction that fails closes nothing.
            WORST_SHARE
        } else if gap > 1e-9 {
            (1.0 - (a - floor).max(0.0) / gap).clamp(WORST_SHARE, 1.0)
        } else {
            0.0
        }
    };
    let blocks = before.blocks.len().min(after.blocks.len());
    let value = share(before.mean_square(), after.mean_square());
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let draws: Vec<f64> = (0..1000)
        .filter_map(|_| {
            let (mut b, mut a, mut count) = (0.0, 0.0, 0);
            for _ in 0..blocks {
                let k = random.random_range(0..blocks);
                b += before.blocks[k].squares;
                a += after.blocks[k].squares;
                count += before.blocks[k].count;
            }
            (count > 0).then(|| share(b / count as f64, a / count as f64))
        })
        .collect();
    Interval::of(value, draws)
}

/// The overlay of an output from two rows that predicted the same readings.
#[must_use]
pub fn overlay(setup: &Setup, output: usize, before: &Row, after: &Row) -> Overlay {
    let stated = &setup.equations.system().outputs[output];
    let mut overlay = Overlay {
        output: stated.name.clone(),
        unit: stated.unit.clone(),
        noise: setup.output_noise[output],
        ..Overlay::default()
    };
    let mut later = after.readings.iter().filter(|r| r.0 == output);
    for (_, stamp, measured, predicted) in before.readings.iter().filter(|r| r.0 == output) {
        let Some((_, _, _, with)) = later.by_ref().find(|r| r.1 == *stamp) else { break };
        overlay.stamp.push(*stamp);
        overlay.measured.push(*measured);
        overlay.before.push(*predicted);
        overlay.after.push(*with);
    }
    // Predictions are within half a turn of the readings they belong to; followed across its wraps, the angle of a
    // stretch is one line.
    if setup.experiment.wraps[output].is_some() {
        let followed = crate::noise::unwrapped(&overlay.measured, setup.experiment.wraps[output]);
        for (k, value) in followed.into_iter().enumerate() {
            let turn = value - overlay.measured[k];
            overlay.measured[k] += turn;
            overlay.before[k] += turn;
            overlay.after[k] += turn;
        }
    }
    overlay
}
