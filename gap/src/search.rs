//! Fits every hypothesis and weighs them: short windows find the minimum, the innovation likelihood ranks.

use rayon::prelude::*;

use crate::filter::Pass;
use crate::fit::{Local, Minimum, minimise};
use crate::hypothesis::{EffectAt, Hypothesis};
use crate::innovation::{InnovationFit, SETTLING_READINGS, Segment, fit, walk};
use crate::library;
use crate::setup::Setup;
use crate::shooting::{Residuals, States, Window, shoot};
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
    /// −2 log evidence of the short windows.
    pub shooting_cost: f64,
    /// Mean squared residual of the short windows, in noise units squared.
    pub shooting_error: f64,
    /// Standard deviations of the short windows' estimate, robust to residuals that are correlated within a window.
    shooting_std: Vec<f64>,
    /// How many independent readings one reading of the windows is worth, at most 1.
    pub independence: f64,
}

/// Mean squared residual of the windows, in noise units squared, from which a model counts as inexact.
pub const INEXACT: f64 = 1.5;

impl Fit {
    /// The parameters by innovation likelihood, at which the evidence was taken.
    #[must_use]
    pub fn theta(&self) -> &[f64] {
        &self.innovation.minimum.theta
    }

    /// The parameters to report and to predict with.
    ///
    /// Where the model reaches the sensor's noise the likelihood is efficient. Where it does not, as on any real
    /// machine, one-step predictions are ruled by what the model lacks, and the short windows are the better judge:
    /// they ask for what the simulator is for, a prediction over the horizon.
    #[must_use]
    pub fn estimate(&self) -> &[f64] {
        if self.by_windows() { &self.shooting.theta } else { self.theta() }
    }

    /// Standard deviations of [`Fit::estimate`].
    #[must_use]
    pub fn std(&self) -> Vec<f64> {
        if self.by_windows() { self.shooting_std.clone() } else { self.innovation.minimum.std() }
    }

    fn by_windows(&self) -> bool {
        self.shooting_error > INEXACT && self.shooting.theta.len() == self.theta().len()
    }
}

/// Most Gauss–Newton steps of a fit.
const ITERATIONS: usize = 25;

/// The same where the parameters that are added enter linearly.
const FEW_ITERATIONS: usize = 4;

/// A fit by short windows.
struct Shot {
    minimum: Minimum,
    cost: f64,
    residuals: Residuals,
}

impl Shot {
    /// Mean squared residual in units of the sensors' noise.
    fn error(&self, setup: &Setup) -> f64 {
        let outputs = self.residuals.squares.iter().zip(&setup.output_noise);
        let squares: f64 = outputs.map(|(s, noise)| s / (noise * noise)).sum();
        squares / self.residuals.counts.iter().sum::<usize>().max(1) as f64
    }

    /// p / tr(H⁻¹ Σ g gᵀ): 1 for independent residuals, less where they are correlated within a window (the
    /// adjustment of composite likelihoods: Varin, Reid & Firth 2011, section 2.3).
    fn independence(&self) -> f64 {
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
    fn std(&self) -> Vec<f64> {
        let plain = self.minimum.std();
        let Some(inverse) = self.minimum.covariance() else { return plain };
        let p = plain.len();
        let sandwich = &inverse * self.spread(p) * &inverse;
        (0..p).map(|i| sandwich[(i, i)].max(0.0).sqrt().max(plain[i])).collect()
    }
}

/// Windows over the training segments, their states guessed by a filter's walk.
#[must_use]
pub fn windows(setup: &Setup, segments: &[Segment], walked: &Pass) -> Vec<Window> {
    let n = setup.equations.system().states.len();
    let mut windows = Vec::new();
    for segment in segments {
        // The filter must have seen a few readings of each output, or it knows no speed. A wrong guess could not be
        // mended: where dry friction holds a joint, predictions do not depend on its speed.
        let settled = SETTLING_READINGS * setup.experiment.wraps.len();
        let inside = walked.stamp.iter().filter(|s| **s >= segment.from && **s < segment.to);
        let Some(begin) = inside.copied().nth(settled) else { continue };
        let count = ((segment.to - begin) / setup.horizon).floor().max(1.0);
        let length = (segment.to - begin) / count;
        for k in 0..count as usize {
            let from = begin + k as f64 * length;
            let to = from + length;
            // The filter's state at the window's first reading; it has seen all earlier ones.
            let Some(reading) = walked.stamp.iter().position(|s| *s >= from && *s < to) else { continue };
            let state = walked.state[reading * n..(reading + 1) * n].to_vec();
            windows.push(Window::new(from, to, state, segment.std.clone()));
        }
    }
    windows
}

/// Fits a hypothesis by short windows from one start, re-estimating each output's noise.
fn fit_windows(
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
    for _ in 0..RESUMED {
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
    let cost = minimum.evidence_cost(&hypothesis.fitted);
    Shot { minimum, cost, residuals: loss.residuals }
}

/// How often a fit goes on after its states were settled.
const RESUMED: usize = 3;

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
    trial: Option<(Vec<f64>, Vec<Window>, Local, Residuals)>,
}

impl WindowsLoss<'_> {
    fn at(&mut self, theta: &[f64], accepted: bool) -> Local {
        let known = self.trial.take().filter(|trial| self.at.is_some() && trial.0 == theta);
        let (_, trial, mut local, found) = known.unwrap_or_else(|| {
            // A trial that is rejected must not leave its initial states behind.
            let mut trial = self.windows.clone();
            let states = match &self.at {
                Some(at) => {
                    let step: Vec<f64> = theta.iter().zip(at).map(|(to, from)| to - from).collect();
                    trial.iter_mut().for_each(|window| window.follow(&step));
                    States::Kept
                }
                None => States::Settled,
            };
            let (local, found) = shoot(self.simulator, theta, &mut trial, &self.variance, states);
            (theta.to_vec(), trial, local, found)
        });
        if accepted {
            self.windows = trial;
            self.at = Some(theta.to_vec());
            self.residuals = found;
            if self.refit_noise() {
                (local, self.residuals) =
                    shoot(self.simulator, theta, &mut self.windows, &self.variance, States::Kept);
            }
        } else {
            self.trial = Some((theta.to_vec(), trial, local.clone(), found));
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

/// The nominal model, refitted: the null hypothesis.
#[must_use]
pub fn null(setup: &Setup) -> Fit {
    let hypothesis = library::hypothesis(setup, &[]);
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let start: Vec<f64> = hypothesis.fitted.iter().map(|f| f.null).collect();
    let walked = walk(&simulator, &setup.train, &setup.noise, &setup.noise.initial, &start);
    let noise = walked.refit_noise(
        &setup.noise.scale,
        &setup.noise.initial,
        &setup.noise.limits,
        setup.noise.process_floor,
    );
    let innovation = fit(&simulator, &hypothesis, &setup.train, &setup.noise, &noise, &start, ITERATIONS);
    let windows = windows(setup, &setup.train, &innovation.pass);
    let shot = fit_windows(setup, &simulator, &hypothesis, &windows, &innovation.minimum.theta, ITERATIONS);
    assemble(setup, hypothesis, Vec::new(), innovation, shot)
}

fn assemble(
    setup: &Setup,
    hypothesis: Hypothesis,
    residuals: Vec<Residual>,
    innovation: InnovationFit,
    shot: Shot,
) -> Fit {
    Fit {
        hypothesis,
        residuals,
        innovation,
        shooting_cost: shot.cost,
        shooting_error: shot.error(setup),
        shooting_std: shot.std(),
        independence: shot.independence(),
        shooting: shot.minimum,
    }
}

/// Fits a hypothesis: every start by short windows, the best of them by innovation likelihood.
#[must_use]
pub fn fit_hypothesis(setup: &Setup, null: &Fit, hypothesis: Hypothesis, residuals: Vec<Residual>) -> Fit {
    let simulator = library::simulator(setup, &hypothesis, residuals.clone());
    let windows = windows(setup, &setup.train, &null.innovation.pass);
    let mut best: Option<Shot> = None;
    let mut starts = hypothesis.starts();
    for start in &mut starts {
        continue_from(null, &hypothesis, start);
        let shot = fit_windows(setup, &simulator, &hypothesis, &windows, start, ITERATIONS);
        if best.as_ref().is_none_or(|b| shot.cost < b.cost) {
            best = Some(shot);
        }
    }
    let Some(mut shot) = best else { return null.clone() };
    let refine = |start: &[f64]| {
        fit(&simulator, &hypothesis, &setup.train, &setup.noise, &null.innovation.noise, start, ITERATIONS)
    };
    let mut innovation = refine(&shot.minimum.theta);
    // The two losses can end in different minima; the effect's null is always a candidate.
    if let Some(start) = starts.first() {
        let other = refine(start);
        if other.evidence_cost < innovation.evidence_cost {
            innovation = other;
        }
    }
    // Each loss starts from the other's answer as well, with the states that its own filter found.
    let own = self::windows(setup, &setup.train, &innovation.pass);
    let again = fit_windows(setup, &simulator, &hypothesis, &own, &innovation.minimum.theta, ITERATIONS);
    if again.cost < shot.cost {
        shot = again;
    }
    assemble(setup, hypothesis, residuals, innovation, shot)
}

/// Fits a hypothesis that extends another one, by innovation likelihood from a given start.
#[must_use]
pub fn fit_from(
    setup: &Setup,
    base: &Fit,
    hypothesis: Hypothesis,
    residuals: Vec<Residual>,
    start: &[f64],
) -> Fit {
    let simulator = library::simulator(setup, &hypothesis, residuals.clone());
    // Weights enter linearly, so few steps reach the minimum.
    let innovation = fit(
        &simulator,
        &hypothesis,
        &setup.train,
        &setup.noise,
        &base.innovation.noise,
        start,
        FEW_ITERATIONS,
    );
    let windows = windows(setup, &setup.train, &base.innovation.pass);
    // From where the windows left the base, which may differ from where the innovations did.
    let mut from = start.to_vec();
    from[..base.shooting.theta.len()].copy_from_slice(&base.shooting.theta);
    let shot = fit_windows(setup, &simulator, &hypothesis, &windows, &from, FEW_ITERATIONS);
    assemble(setup, hypothesis, residuals, innovation, shot)
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

/// Fits all single effects, in parallel; `done` is told of each.
#[must_use]
pub fn singles(setup: &Setup, null: &Fit, effects: &[EffectAt], done: &(dyn Fn(&str) + Sync)) -> Vec<Fit> {
    effects
        .par_iter()
        .map(|at| {
            let fit =
                fit_hypothesis(setup, null, library::hypothesis(setup, std::slice::from_ref(at)), Vec::new());
            done(&at.label());
            fit
        })
        .collect()
}
