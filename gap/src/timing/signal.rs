//! The stamps of a log: rates, gaps, jitter, and clocks that run apart.

use parallax_runtime::recording::log::{Log, Signal};
use serde::{Deserialize, Serialize};

use super::ENOUGH;
use crate::statistics::{median, standard_deviation};

/// Times the usual step from which a step is a gap.
const GAP: f64 = 1.5;

/// Difference of rates, as a share, within which two clocks are taken for one nominal rate.
const NEAR: f64 = 0.01;

/// The stamps of one signal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SignalTiming {
    /// Its name.
    pub signal: String,
    /// How many samples it has.
    pub samples: usize,
    /// Samples a second: one over the usual step.
    pub rate: f64,
    /// Standard deviation of the steps that are no gaps (s).
    pub jitter: f64,
    /// Steps longer than one and a half times the usual.
    pub gaps: usize,
    /// The longest step (s).
    pub longest: f64,
    /// Samples that the gaps have room for.
    pub missing: usize,
    /// Its clock against that of the first signal of like rate, where the two run apart.
    pub clock: Option<RelativeClock>,
}

/// A clock that runs apart from another one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RelativeClock {
    /// The other signal.
    pub against: String,
    /// Seconds gained for each second, if both were to sample at one rate.
    pub skew: f64,
    /// Its standard deviation.
    pub std: f64,
}

/// Measures every signal with at least twenty samples.
#[must_use]
pub fn signals(log: &Log) -> Vec<SignalTiming> {
    let usable: Vec<&Signal> = log.signals.iter().filter(|s| s.times.len() >= ENOUGH).collect();
    let grids: Vec<Grid> = usable.iter().map(|s| Grid::of(s)).collect();
    usable
        .iter()
        .enumerate()
        .map(|(k, signal)| {
            let grid = &grids[k];
            let even: Vec<f64> = grid.steps.iter().copied().filter(|s| *s <= GAP * grid.usual).collect();
            let gaps: Vec<f64> = grid.steps.iter().copied().filter(|s| *s > GAP * grid.usual).collect();
            let room = gaps.iter().map(|g| (g / grid.usual).round() as usize - 1).sum();
            SignalTiming {
                signal: signal.name.clone(),
                samples: signal.times.len(),
                rate: 1.0 / grid.usual,
                jitter: standard_deviation(&even),
                gaps: gaps.len(),
                longest: grid.steps.iter().copied().fold(0.0, f64::max),
                missing: room,
                clock: (0..k).find_map(|other| apart(grid, &grids[other], &usable[other].name)),
            }
        })
        .collect()
}

/// The even grid that a signal's stamps follow.
struct Grid {
    steps: Vec<f64>,
    usual: f64,
    /// Period and its standard deviation by least squares; absent where the stamps follow none.
    fitted: Option<(f64, f64)>,
    span: f64,
}

impl Grid {
    fn of(signal: &Signal) -> Self {
        let first = signal.times[0];
        let times: Vec<f64> = signal.times.iter().map(|t| (t - first) as f64 * 1e-9).collect();
        let steps: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
        let usual = median(&mut steps.clone()).max(1e-12);
        // Each stamp has a number on the grid, counted from the one before.
        let mut numbers = vec![0.0];
        for step in &steps {
            numbers.push(numbers[numbers.len() - 1] + (step / usual).round());
        }
        let n = times.len() as f64;
        let (mean_k, mean_t) = (numbers.iter().sum::<f64>() / n, times.iter().sum::<f64>() / n);
        let spread: f64 = numbers.iter().map(|k| (k - mean_k).powi(2)).sum();
        let along: f64 = numbers.iter().zip(&times).map(|(k, t)| (k - mean_k) * (t - mean_t)).sum();
        let period = along / spread.max(1e-300);
        let residuals: Vec<f64> =
            numbers.iter().zip(&times).map(|(k, t)| t - mean_t - period * (k - mean_k)).collect();
        let off = standard_deviation(&residuals);
        let fitted = (spread > 0.0 && off < 0.5 * usual).then(|| (period, off / spread.sqrt()));
        Grid { steps, usual, fitted, span: times[times.len() - 1] }
    }
}

/// Whether two signals of one nominal rate drift apart by more than a tenth of a sample.
fn apart(of: &Grid, against: &Grid, name: &str) -> Option<RelativeClock> {
    let ((a, error_a), (b, error_b)) = (of.fitted?, against.fitted?);
    let ratio = a / b;
    let whole = if ratio >= 1.0 { ratio.round() } else { 1.0 / (1.0 / ratio).round() };
    let skew = ratio / whole - 1.0;
    // Stamps wander more slowly than white noise: their error is taken three times as large.
    let std = 3.0 * (error_a / a).hypot(error_b / b);
    let drift = skew.abs() * of.span.min(against.span);
    let real = skew.abs() < NEAR && skew.abs() > 4.0 * std && drift > 0.1 * of.usual.min(against.usual);
    real.then(|| RelativeClock { against: name.into(), skew, std })
}
