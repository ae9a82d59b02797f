//! Unknowns: a flexible residual force and a flexible residual reading, which compete with the named effects.
//!
//! Sums of bumps over state, command and time with normal priors on their weights: finite-dimensional Gaussian
//! processes, whose evidence charges them for their freedom (Kennedy & O'Hagan 2001 call such a term discrepancy). Dry friction
//! of another kind than the library's is one as well ([`friction`]).

pub mod friction;

use nalgebra::{DMatrix, DVector};
use parallax_model::plant::{Feature, Residual, Target, Variable};

use crate::equations::MOST_VARIABLES;
use crate::hypothesis::{Fitted, Prior, Slot};
use crate::innovation::walk;
use crate::library;
use crate::search::{Begin, Fit, fit_from};
use crate::setup::Setup;
use crate::statistics::quantile;
use crate::windows::FEW;

/// Which unknown a residual stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// A force, or a rate of change of any state that does not only integrate another.
    Force,
    /// A reading.
    Sensor,
}

/// Most bumps over a range; twice as many over time.
const BUMPS: usize = 7;

/// The residuals of one kind, over the ranges that the null fit visited.
#[must_use]
pub fn residuals(setup: &Setup, null: &Fit, unknown: Unknown) -> Vec<Residual> {
    let targets: Vec<Target> = match unknown {
        Unknown::Force => {
            (0..setup.noise.scale.len()).filter(|i| setup.noise.scale[*i] > 0.0).map(Target::State).collect()
        }
        Unknown::Sensor => (0..setup.experiment.wraps.len()).map(Target::Output).collect(),
    };
    // The richest residual that still fits beside the states, the calibrated parameters and an effect.
    let room = MOST_VARIABLES.saturating_sub(setup.noise.scale.len() + null.hypothesis.fitted.len() + 8);
    let features = (2..=BUMPS)
        .rev()
        .map(|bumps| features(setup, null, unknown, bumps))
        .find(|features| features.len() * targets.len() <= room)
        .unwrap_or_default();
    targets.into_iter().map(|target| Residual { target, features: features.clone() }).collect()
}

fn features(setup: &Setup, null: &Fit, unknown: Unknown, count: usize) -> Vec<Feature> {
    let n = setup.equations.system().states.len();
    let pass = &null.innovation.pass;
    let mut features = Vec::new();
    for state in 0..n {
        // Effects that are part of the system have states of their own behind its own.
        let own = pass.state.iter().skip(state).step_by(pass.states().max(1));
        let mut values: Vec<f64> = own.copied().collect();
        let (low, high) = (quantile(&mut values, 0.01), quantile(&mut values, 0.99));
        features.extend(bumps(Variable::State(state), low, high, count));
    }
    if unknown == Unknown::Force {
        for (input, range) in setup.input_range.iter().enumerate() {
            features.extend(bumps(Variable::Input(input), range.low, range.high, count));
        }
    }
    let (from, to) = setup.experiment.own_span();
    features.extend(bumps(Variable::Time, from, to, 2 * count));
    features
}

/// Triangles that overlap by half, from end to end of a range; their sum is 1 within it.
fn bumps(of: Variable, low: f64, high: f64, count: usize) -> Vec<Feature> {
    let width = (high - low) / (count - 1) as f64;
    let count = if width.is_finite() && width > 0.0 { count } else { 0 };
    (0..count).map(|k| Feature::Bump { of, centre: low + width * k as f64, width }).collect()
}

/// A residual and the size of its weights, as a share of what it is added to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Which unknown.
    pub unknown: Unknown,
    /// Standard deviation of the weights' prior, as a share of the natural size of the target.
    pub share: f64,
}

/// Sizes of the weights' prior that are tried.
const SHARES: [f64; 4] = [0.003, 0.03, 0.2, 1.0];

/// The kinds of unknown that a system allows.
#[must_use]
pub fn kinds(setup: &Setup) -> Vec<Unknown> {
    let moving = setup.noise.scale.iter().any(|s| *s > 0.0);
    [Unknown::Force, Unknown::Sensor].into_iter().filter(|u| moving || *u == Unknown::Sensor).collect()
}

/// The size of the weights at which one linearisation around `base` promises the largest evidence.
#[must_use]
pub fn choose(setup: &Setup, null: &Fit, base: &Fit, unknown: Unknown) -> Choice {
    let weights = columns(setup, null, base, unknown);
    let innovations = DVector::from_vec(base.innovation.pass.whitened());
    let information = weights.transpose() * &weights;
    let gradient = weights.transpose() * innovations;
    let sizes: Vec<f64> = residuals(setup, null, unknown)
        .iter()
        .flat_map(|r| std::iter::repeat_n(natural_size(setup, r.target), r.features.len()))
        .collect();
    // With w ~ N(0, D²) the evidence gains ½ gᵀ (A + D⁻²)⁻¹ g − ½ ln det(I + D A D).
    let gain = |share: f64| {
        let mut matrix = information.clone();
        for i in 0..sizes.len() {
            for j in 0..sizes.len() {
                matrix[(i, j)] *= sizes[i] * sizes[j] * share * share;
            }
            matrix[(i, i)] += 1.0;
        }
        let scaled = DVector::from_fn(sizes.len(), |i, _| gradient[i] * sizes[i] * share);
        matrix.cholesky().map_or(f64::NEG_INFINITY, |c| {
            scaled.dot(&c.solve(&scaled)) - 2.0 * c.l().diagonal().iter().map(|d| d.ln()).sum::<f64>()
        })
    };
    let share = SHARES.into_iter().max_by(|a, b| gain(*a).total_cmp(&gain(*b))).unwrap_or(SHARES[0]);
    Choice { unknown, share }
}

/// The size of what a residual is added to.
fn natural_size(setup: &Setup, target: Target) -> f64 {
    match target {
        Target::State(state) => setup.state_rate[state],
        Target::Friction(joint) | Target::Hysteresis(joint) => setup.joints[joint].force,
        Target::Output(output) => 0.3 * setup.output_scale[output].max(setup.output_noise[output]),
    }
}

/// Fits the effects of `base` together with a residual.
#[must_use]
pub fn fit_unknown(setup: &Setup, null: &Fit, base: &Fit, choice: Choice) -> Fit {
    let residuals = residuals(setup, null, choice.unknown);
    let mut hypothesis = library::hypothesis(setup, &base.hypothesis.effects);
    hypothesis.residual = true;
    let mut start: Vec<f64> = base.theta().to_vec();
    let mut weight = 0;
    for residual in &residuals {
        let size = choice.share * natural_size(setup, residual.target);
        for _ in &residual.features {
            hypothesis.fitted.push(weight_of(weight, size));
            start.push(0.0);
            weight += 1;
        }
    }
    let mut by_windows = start.clone();
    by_windows[..base.shooting.theta.len()].copy_from_slice(&base.shooting.theta);
    // Weights enter linearly, so few steps reach the minimum.
    fit_from(setup, base, hypothesis, residuals, &[Begin { innovations: start, windows: by_windows }], FEW)
}

/// Derivatives of a fit's whitened innovations by the weights of an unknown, all zero.
#[must_use]
pub fn columns(setup: &Setup, null: &Fit, base: &Fit, unknown: Unknown) -> DMatrix<f64> {
    let residuals = residuals(setup, null, unknown);
    let mut hypothesis = base.hypothesis.clone();
    let calibrated = hypothesis.fitted.len();
    let weights: usize = residuals.iter().map(|r| r.features.len()).sum();
    hypothesis.fitted.extend((0..weights).map(|k| weight_of(k, 1.0)));
    let simulator = library::simulator(setup, &hypothesis, residuals);
    let mut theta = base.theta().to_vec();
    theta.resize(calibrated + weights, 0.0);
    let pass = walk(&simulator, &setup.train, &setup.noise, &base.innovation.noise, &theta);
    let all = DMatrix::from_row_slice(pass.readings(), theta.len(), &pass.whitened_by_parameter());
    all.columns(calibrated, weights).into_owned()
}

fn weight_of(index: usize, size: f64) -> Fitted {
    Fitted {
        slot: Slot::Weight(index),
        name: format!("weight {index}"),
        unit: String::new(),
        null: 0.0,
        prior: Prior::Normal { mean: 0.0, std: size },
        low: -50.0 * size,
        high: 50.0 * size,
        scale: size,
        starts: Vec::new(),
    }
}
