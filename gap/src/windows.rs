//! Fits by short windows: which windows, their loss along a minimisation, and what is left over.

use crate::filter::Pass;
use crate::fit::{Local, Minimum, minimise};
use crate::hypothesis::Hypothesis;
use crate::innovation::SETTLING_READINGS;
use crate::setup::Setup;
use crate::shooting::{Residuals, States, Walked, Window, reweigh, shoot};
use crate::simulator::Simulator;

/// A fit by short windows.
pub struct Shot {
    /// Parameters, N log(SSE/N) with the priors, and its curvature.
    pub minimum: Minimum,
    /// −2 log evidence.
    pub cost: f64,
    residuals: Residuals,
}

impl Shot {
    /// Mean squared residual in units of the sensors' noise.
    #[must_use]
    pub fn error(&self, setup: &Setup) -> f64 {
        let outputs = self.residuals.squares.iter().zip(&setup.output_noise);
        let squares: f64 = outputs.map(|(s, noise)| s / (noise * noise)).sum();
        squares / self.residuals.counts.iter().sum::<usize>().max(1) as f64
    }

    /// Mean squared residual of each output, in units of its sensor's noise, squared.
    #[must_use]
    pub fn output_errors(&self, setup: &Setup) -> Vec<f64> {
        let outputs = self.residuals.squares.iter().zip(&self.residuals.counts).zip(&setup.output_noise);
        outputs.map(|((squares, count), noise)| squares / ((*count).max(1) as f64 * noise * noise)).collect()
    }

    /// p / tr(H⁻¹ Σ g gᵀ): 1 for independent residuals, less where they are correlated within a window (the
    /// adjustment of composite likelihoods: Varin, Reid & Firth 2011, section 2.3).
    #[must_use]
    pub fn independence(&self) -> f64 {
        let Some(inverse) = self.minimum.covariance() else { return 1.0 };
        let p = inverse.nrows();
        if p == 0 {
            return 1.0;
        }
        let trace = (&inverse * self.spread(p)).trace();
        if trace > 0.0 { (p as f64 / trace).min(1.0) } else { 1.0 }
    }

    /// Σ g gᵀ over windows.
    fn spread(&self, p: usize) -> nalgebra::DMatrix<f64> {
        let mut spread = nalgebra::DMatrix::<f64>::zeros(p, p);
        for g in &self.residuals.scores {
            for i in 0..p {
                for j in 0..p {
                    spread[(i, j)] += g[i] * g[j];
                }
            }
        }
        spread
    }

    /// Standard deviations by the sandwich H⁻¹ (Σ g gᵀ) H⁻¹ over windows (White 1982; clusters: Liang & Zeger 1986),
    /// but no smaller than the curvature alone gives.
    #[must_use]
    pub fn std(&self) -> Vec<f64> {
        let plain = self.minimum.std();
        let Some(inverse) = self.minimum.covariance() else { return plain };
        let p = plain.len();
        let sandwich = &inverse * self.spread(p) * &inverse;
        (0..p).map(|i| sandwich[(i, i)].max(0.0).sqrt().max(plain[i])).collect()
    }
}

/// Most windows that are fitted: beyond that the log is represented by some of them.
const MOST_WINDOWS: usize = 320;

/// Windows over the training segments, their states guessed by a filter's walk. The same ones for every hypothesis.
#[must_use]
pub fn windows(setup: &Setup, simulator: &dyn Simulator, walked: &Pass) -> Vec<Window> {
    let (n, known) = (setup.equations.system().states.len(), walked.states());
    let mut windows = Vec::new();
    let mut next = 0;
    for segment in &setup.train {
        // Stamps are in the order of the segments.
        let begin = next + walked.stamp[next..].iter().take_while(|s| **s < segment.from).count();
        let end = begin + walked.stamp[begin..].iter().take_while(|s| **s < segment.to).count();
        next = end;
        // The filter must have seen a few readings of each output, or it knows no speed. A wrong guess could not be
        // mended: where dry friction holds a joint, predictions do not depend on its speed.
        let settled = begin + SETTLING_READINGS * setup.experiment.wraps.len();
        if settled >= end {
            continue;
        }
        let start = walked.stamp[settled];
        let count = ((segment.to - start) / setup.horizon).floor().max(1.0);
        let length = (segment.to - start) / count;
        let mut first = settled;
        for k in 0..count as usize {
            let (from, to) = (start + k as f64 * length, start + (k + 1) as f64 * length);
            first += walked.stamp[first..end].iter().take_while(|s| **s < from).count();
            let readings = walked.stamp[first..end].iter().take_while(|s| **s < to).count();
            // A gap in the data leaves windows that say nothing.
            if readings <= n {
                continue;
            }
            // The filter's state at the window's first reading; it has seen all earlier ones.
            let found = &walked.state[first * known..(first + 1) * known];
            let (mut state, std) = simulator.start(&found[..n], segment.guess.std(), walked.stamp[first]);
            if state.len() == known {
                state.copy_from_slice(found);
            }
            windows.push(Window::new(from, to, state, std));
        }
    }
    representative(setup, windows, MOST_WINDOWS)
}

/// At most `most` of the windows: half of them even in time, half even over how far the readings move within a window,
/// so that rest and motion are both there.
#[must_use]
pub fn representative(setup: &Setup, windows: Vec<Window>, most: usize) -> Vec<Window> {
    let count = windows.len();
    if count <= most {
        return windows;
    }
    let samples = &setup.experiment.samples;
    let motion: Vec<f64> = windows
        .iter()
        .map(|window| {
            let begin = samples.partition_point(|s| s.stamp < window.from);
            let inside = &samples[begin..begin + samples[begin..].partition_point(|s| s.stamp < window.to)];
            let mut spread = vec![(f64::INFINITY, f64::NEG_INFINITY); setup.experiment.wraps.len()];
            for sample in inside {
                let (low, high) = &mut spread[sample.output];
                (*low, *high) = (low.min(sample.value), high.max(sample.value));
            }
            let scaled = spread.iter().zip(&setup.output_scale);
            scaled.map(|((low, high), scale)| ((high - low) / scale.max(1e-300)).max(0.0)).sum()
        })
        .collect();
    let half = most / 2;
    let mut kept = vec![false; count];
    for k in 0..half {
        kept[k * count / half] = true;
    }
    let mut rest: Vec<usize> = (0..count).filter(|k| !kept[*k]).collect();
    rest.sort_by(|a, b| motion[*a].total_cmp(&motion[*b]).then(a.cmp(b)));
    for k in 0..most - half {
        kept[rest[k * rest.len() / (most - half)]] = true;
    }
    windows.into_iter().zip(kept).filter(|(_, kept)| *kept).map(|(window, _)| window).collect()
}

/// Fits a hypothesis by short windows from one start, re-estimating each output's noise.
#[must_use]
pub fn fit_windows(
    setup: &Setup,
    simulator: &dyn Simulator,
    hypothesis: &Hypothesis,
    windows: &[Window],
    start: &[f64],
    iterations: usize,
) -> Shot {
    let mut loss = WindowsLoss {
        setup,
        simulator,
        windows: windows.to_vec(),
        at: None,
        variance: setup.output_noise.iter().map(|s| 4.0 * s * s).collect(),
        residuals: Residuals::default(),
        trial: None,
    };
    let mut minimum =
        minimise(&hypothesis.fitted, start, iterations, |theta, accepted| loss.at(theta, accepted));
    // On the way the states follow θ to first order. Where settling them finds something better, the fit goes on.
    let resumed = if iterations > FEW { RESUMED } else { 0 };
    for _ in 0..resumed {
        loss.at = None;
        let again = minimise(&hypothesis.fitted, &minimum.theta, iterations, |theta, accepted| {
            loss.at(theta, accepted)
        });
        let gain = minimum.cost - again.cost;
        minimum = again;
        if gain.is_nan() || gain < 1.0 {
            break;
        }
    }
    let cost = minimum.evidence_cost(&hypothesis.fitted) + loss.residuals.volume;
    Shot { minimum, cost, residuals: loss.residuals }
}

/// Fits of so few iterations end where they are.
pub const FEW: usize = 4;

/// How often a fit goes on after its states were settled.
const RESUMED: usize = 2;

/// The loss of short windows along a minimisation.
struct WindowsLoss<'a> {
    setup: &'a Setup,
    simulator: &'a dyn Simulator,
    /// Windows with the states that belong to the accepted θ.
    windows: Vec<Window>,
    /// The accepted θ.
    at: Option<Vec<f64>>,
    variance: Vec<f64>,
    residuals: Residuals,
    /// The last θ that was tried, with what was found there.
    trial: Option<Trial>,
}

/// A point that was tried.
struct Trial {
    theta: Vec<f64>,
    windows: Vec<Window>,
    local: Local,
    residuals: Residuals,
    walked: Walked,
}

impl WindowsLoss<'_> {
    fn at(&mut self, theta: &[f64], accepted: bool) -> Local {
        let known = self.trial.take().filter(|trial| self.at.is_some() && trial.theta == theta);
        let trial = known.unwrap_or_else(|| {
            // A trial that is rejected must not leave its initial states behind.
            let mut windows = self.windows.clone();
            let states = match &self.at {
                Some(at) => {
                    let step: Vec<f64> = theta.iter().zip(at).map(|(to, from)| to - from).collect();
                    windows.iter_mut().for_each(|window| window.follow(&step));
                    States::Kept
                }
                None => States::Settled,
            };
            let (local, residuals, walked) =
                shoot(self.simulator, theta, &mut windows, &self.variance, states);
            Trial { theta: theta.to_vec(), windows, local, residuals, walked }
        });
        let mut local = trial.local.clone();
        if accepted {
            self.windows = trial.windows;
            self.at = Some(trial.theta);
            self.residuals = trial.residuals;
            if self.refit_noise() {
                let (simulator, variance) = (self.simulator, &self.variance);
                let windows = &mut self.windows;
                local = reweigh(&trial.walked, simulator, theta, windows, variance, &mut self.residuals)
                    .unwrap_or_else(|| {
                        let (local, residuals, _) = shoot(simulator, theta, windows, variance, States::Kept);
                        self.residuals = residuals;
                        local
                    });
            }
        } else {
            self.trial = Some(trial);
        }
        if !local.cost.is_finite() {
            local.cost = f64::INFINITY;
        }
        local
    }

    /// Takes each output's noise from its residuals. Gives whether that changed anything.
    fn refit_noise(&mut self) -> bool {
        let found = &self.residuals;
        let n = self.simulator.states();
        let outputs = found.counts.iter().filter(|c| **c > 0).count().max(1);
        let mut changed = false;
        for (o, v) in self.variance.iter_mut().enumerate() {
            // Residuals are at least the sensor's noise; the initial states take up some of it.
            let floor = 0.25 * self.setup.output_noise[o].powi(2);
            let free = found.counts[o].saturating_sub(n * self.windows.len() / outputs).max(1);
            let fresh = (found.squares[o] / free as f64).max(floor);
            changed |= (fresh / *v).ln().abs() > 0.02;
            if fresh.is_finite() {
                *v = fresh;
            }
        }
        changed
    }
}
