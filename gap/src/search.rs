//! Fits every hypothesis and weighs them: short windows find the minimum, the innovation likelihood ranks.

use rayon::prelude::*;

use crate::filter::Pass;
use crate::fit::{Minimum, minimise};
use crate::hypothesis::Hypothesis;
use crate::innovation::{InnovationFit, Segment, fit, walk};
use crate::library;
use crate::setup::Setup;
use crate::shooting::{Residuals, Window, shoot};
use crate::simulator::Simulator;
use parallax_model::plant::Residual;

/// A hypothesis, fitted.
#[derive(Clone, Debug)]
pub struct Fit {
    /// What was fitted.
    pub hypothesis: Hypothesis,
    /// The flexible residuals it carries.
    pub residuals: Vec<Residual>,
    /// Its fit by innovation likelihood.
    pub innovation: InnovationFit,
    /// Its fit by short windows, and N log(SSE/N) with the priors.
    pub shooting: Minimum,
    /// Bayesian information criterion of the short windows.
    pub shooting_cost: f64,
}

impl Fit {
    /// The parameters.
    #[must_use]
    pub fn theta(&self) -> &[f64] {
        &self.innovation.minimum.theta
    }
}

/// Windows over the training segments, their states guessed by a filter's walk.
#[must_use]
pub fn windows(setup: &Setup, segments: &[Segment], walked: &Pass) -> Vec<Window> {
    let n = setup.equations.system().states.len();
    let mut windows = Vec::new();
    for segment in segments {
        let count = ((segment.to - segment.from) / setup.horizon).floor().max(1.0);
        let length = (segment.to - segment.from) / count;
        for k in 0..count as usize {
            let from = segment.from + k as f64 * length;
            let to = from + length;
            // The filter's state at the window's first reading; it has seen all earlier ones.
            let Some(reading) = walked.stamp.iter().position(|s| *s >= from && *s < to) else { continue };
            let state = walked.state[reading * n..(reading + 1) * n].to_vec();
            windows.push(Window { from, to, guess: state.clone(), state, std: segment.std.clone() });
        }
    }
    windows
}

/// Fits a hypothesis by short windows from one start, re-estimating each output's noise.
fn fit_windows(
    simulator: &dyn Simulator,
    hypothesis: &Hypothesis,
    windows: &[Window],
    variance: &[f64],
    floor: &[f64],
    start: &[f64],
) -> (Minimum, f64, Vec<f64>) {
    let (n, p) = (simulator.states(), simulator.parameters());
    let mut variance = variance.to_vec();
    let mut windows = windows.to_vec();
    let mut last = Residuals::default();
    let minimum = minimise(&hypothesis.fitted, start, 25, |theta, accepted| {
        let mut run = simulator.run(theta);
        let (mut local, residuals) = shoot(&mut *run, &mut windows, n, p, &variance);
        if accepted {
            let mut changed = false;
            for (o, v) in variance.iter_mut().enumerate() {
                let free = residuals.counts[o].saturating_sub(n * windows.len() / variance_count(&residuals)).max(1);
                let fresh = (residuals.squares[o] / free as f64).max(floor[o]);
                changed |= (fresh / *v).ln().abs() > 0.02;
                *v = fresh;
            }
            if changed {
                local = shoot(&mut *run, &mut windows, n, p, &variance).0;
            }
        }
        if !local.cost.is_finite() {
            local.cost = f64::INFINITY;
        }
        last = residuals;
        local
    });
    let readings: usize = last.counts.iter().sum();
    let cost = minimum.cost + p as f64 * (readings.max(1) as f64).ln();
    (minimum, cost, variance)
}

fn variance_count(residuals: &Residuals) -> usize {
    residuals.counts.iter().filter(|c| **c > 0).count().max(1)
}

/// The nominal model, refitted: the null hypothesis.
#[must_use]
pub fn null(setup: &Setup) -> Fit {
    let hypothesis = library::hypothesis(setup, &[]);
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    let walked = walk(&simulator, &setup.train, &setup.noise, &setup.noise.initial, &start);
    let noise = walked.refit_noise(&setup.noise.scale, &setup.noise.initial, &setup.noise.limits, setup.noise.process_floor);
    let innovation = fit(&simulator, &hypothesis, &setup.train, &setup.noise, &noise, &start);
    let windows = windows(setup, &setup.train, &innovation.pass);
    let (floor, variance) = variances(setup);
    let (shooting, shooting_cost, _) =
        fit_windows(&simulator, &hypothesis, &windows, &variance, &floor, &innovation.minimum.theta);
    Fit { hypothesis, residuals: Vec::new(), innovation, shooting, shooting_cost }
}

fn variances(setup: &Setup) -> (Vec<f64>, Vec<f64>) {
    let floor: Vec<f64> = setup.output_noise.iter().map(|s| 0.25 * s * s).collect();
    let variance = setup.output_noise.iter().map(|s| 4.0 * s * s).collect();
    (floor, variance)
}

/// Fits a hypothesis: every start by short windows, the best of them by innovation likelihood.
#[must_use]
pub fn fit_hypothesis(setup: &Setup, null: &Fit, hypothesis: Hypothesis, residuals: Vec<Residual>) -> Fit {
    let simulator = library::simulator(setup, &hypothesis, residuals.clone());
    let windows = windows(setup, &setup.train, &null.innovation.pass);
    let (floor, variance) = variances(setup);
    let mut best: Option<(Minimum, f64)> = None;
    for mut start in hypothesis.starts() {
        continue_from(null, &hypothesis, &mut start);
        let (minimum, cost, _) = fit_windows(&simulator, &hypothesis, &windows, &variance, &floor, &start);
        if best.as_ref().is_none_or(|(_, c)| cost < *c) {
            best = Some((minimum, cost));
        }
    }
    let (shooting, shooting_cost) = best.unwrap_or_else(|| (null.shooting.clone(), f64::INFINITY));
    let mut innovation =
        fit(&simulator, &hypothesis, &setup.train, &setup.noise, &null.innovation.noise, &shooting.theta);
    // The two losses can end in different minima; the effect's null is always a candidate.
    let mut start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.starts.first().copied().unwrap_or(f.null)).collect();
    continue_from(null, &hypothesis, &mut start);
    let other = fit(&simulator, &hypothesis, &setup.train, &setup.noise, &null.innovation.noise, &start);
    if other.evidence_cost < innovation.evidence_cost {
        innovation = other;
    }
    Fit { hypothesis, residuals, innovation, shooting, shooting_cost }
}

/// Puts the calibrated parameters where the null model's fit left them.
fn continue_from(null: &Fit, hypothesis: &Hypothesis, start: &mut [f64]) {
    for (value, fitted) in start.iter_mut().zip(&hypothesis.fitted) {
        let known = null.hypothesis.fitted.iter().position(|f| f.slot == fitted.slot);
        if let Some(index) = known {
            *value = null.theta()[index];
        }
    }
}

/// Fits all single effects, in parallel.
#[must_use]
pub fn singles(setup: &Setup, null: &Fit, effects: &[crate::hypothesis::EffectAt]) -> Vec<Fit> {
    effects
        .par_iter()
        .map(|at| fit_hypothesis(setup, null, library::hypothesis(setup, std::slice::from_ref(at)), Vec::new()))
        .collect()
}
