//! Effects ranked by the Bayesian information criterion (Schwarz, Annals of Statistics 6, 1978) of a sum of squares.

use std::sync::atomic::{AtomicBool, Ordering};

use parallax_gap::fit::{Local, minimise};
use parallax_gap::hypothesis::{Fitted, Hypothesis};
use parallax_gap::library;
use parallax_gap::setup::Setup;
use parallax_gap::simulator::Simulator;
use rayon::prelude::*;

use super::BaselineResult;

/// Gauss–Newton steps in all, and those from each start.
const ITERATIONS: usize = 12;
const FEW: usize = 3;

/// How many effects are named.
const NAMED: usize = 3;

/// How a method turns a model into residuals.
pub(super) struct Method<'a> {
    /// What is fitted beside the hypothesis' own parameters, such as where a simulation begins.
    pub(super) nuisances: Vec<Fitted>,
    /// The residuals of a model at θ, with the nuisances after the hypothesis' parameters.
    pub(super) residuals: &'a (dyn Fn(&dyn Simulator, &[f64]) -> Squares + Sync),
}

/// A sum of squared residuals with its derivatives.
pub(super) struct Squares {
    squares: f64,
    count: f64,
    information: Vec<f64>,
    gradient: Vec<f64>,
}

impl Squares {
    /// No residuals yet, of a model with `parameters`.
    pub(super) fn new(parameters: usize) -> Self {
        Squares {
            squares: 0.0,
            count: 0.0,
            information: vec![0.0; parameters * parameters],
            gradient: vec![0.0; parameters],
        }
    }

    /// Adds a residual with its derivatives by θ.
    pub(super) fn add(&mut self, residual: f64, slope: &[f64]) {
        let p = slope.len();
        self.squares += residual * residual;
        self.count += 1.0;
        for (j, s) in slope.iter().enumerate() {
            self.gradient[j] += s * residual;
            for (k, t) in slope.iter().enumerate() {
                self.information[j * p + k] += s * t;
            }
        }
    }

    /// N log(SSE/N): the noise is profiled out.
    fn local(&self) -> Local {
        let variance = (self.squares / self.count.max(1.0)).max(1e-12);
        Local {
            cost: self.count * variance.ln(),
            information: self.information.iter().map(|value| value / variance).collect(),
            gradient: self.gradient.iter().map(|value| value / variance).collect(),
        }
    }
}

/// Effects by criterion; a gap is said to be where one of them is below the refitted nominal system. Once `stop` is set,
/// what is left of them is not tried.
pub(super) fn rank(setup: &Setup, method: &Method<'_>, stop: &AtomicBool) -> BaselineResult {
    let (candidates, _) = library::candidates(setup);
    let of = |hypothesis: Hypothesis| criterion(setup, &hypothesis, method);
    let null = of(library::hypothesis(setup, &[]));
    let mut ranked: Vec<(f64, String)> = candidates
        .par_iter()
        .filter(|_| !stop.load(Ordering::Relaxed))
        .map(|at| (of(library::hypothesis(setup, std::slice::from_ref(at))), at.label()))
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let detected = ranked.first().is_some_and(|(best, _)| *best < null);
    let mut ranking: Vec<String> = Vec::new();
    for (_, label) in ranked {
        // Forms of one effect are one answer.
        if !ranking.contains(&label) {
            ranking.push(label);
        }
    }
    ranking.truncate(NAMED);
    BaselineResult { detected, ranking, ..BaselineResult::default() }
}

/// N log(SSE/N) + p log N at the best of the hypothesis' starts.
fn criterion(setup: &Setup, hypothesis: &Hypothesis, method: &Method<'_>) -> f64 {
    let simulator = library::simulator(setup, hypothesis, Vec::new());
    let nuisances = &method.nuisances;
    let mut fitted = hypothesis.fitted.clone();
    fitted.extend(nuisances.iter().cloned());
    let loss = |theta: &[f64], _| (method.residuals)(&simulator, theta).local();
    let from = |start: &[f64], steps: usize| minimise(&fitted, start, steps, loss);
    let starts = hypothesis.starts().into_iter().map(|mut start| {
        start.extend(nuisances.iter().map(|f| f.null));
        start
    });
    // A few steps tell which of several starts is worth the rest.
    let tried = starts.map(|start| from(&start, FEW)).min_by(|a, b| a.cost.total_cmp(&b.cost));
    let Some(tried) = tried else { return f64::INFINITY };
    let theta = from(&tried.theta, ITERATIONS - FEW).theta;
    let squares = (method.residuals)(&simulator, &theta);
    squares.local().cost + fitted.len() as f64 * squares.count.max(1.0).ln()
}
