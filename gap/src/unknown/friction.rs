//! Dry friction of an unknown kind: one that changes with time, and one that remembers the way.
//!
//! No entry of the library is either, and each is close enough to one that is to pass for it: friction that wears off is dry
//! friction on average, hysteresis of whatever kind is friction that builds up over a way. As bumps over time, and as a sum
//! of bristles of many lengths (a Maxwell slip model with smooth elements: Al-Bender, Lampaert & Swevers 2005, "The generalized
//! Maxwell-slip model"), they need no form, and contain dry friction that is constant, or nearly one that builds up as Dahl's does.

use parallax_model::effect::Effect;
use parallax_model::plant::{Feature, Residual, Target, Variable};
use rayon::prelude::*;

use super::{BUMPS, bumps, weight_of};
use crate::library;
use crate::search::{Begin, Fit, fit_from};
use crate::setup::Setup;
use crate::stop::UNKNOWN;

/// Size of a force as a share of what drives the joint, as the library believes it of its own frictions.
const SHARE: f64 = 0.5;

/// Ways over which bristles bend, the shortest and the longest as shares of a joint's range, and how many.
const LENGTHS: (f64, f64, usize) = (0.003, 0.5, 6);

/// Share of the known force from where the search begins as well.
const LITTLE: f64 = 0.1;

/// Most steps of a search: forces that change do so far from where it begins.
const STEPS: usize = 8;

/// The kinds of a friction that no entry of the library is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Changing,
    Remembering,
}

/// Dry friction of unknown kinds in the place of the single effect of `known`, [dry friction](is_dry), from where it is.
#[must_use]
pub fn in_place_of(setup: &Setup, known: &Fit) -> Vec<Fit> {
    let Some(at) = known.hypothesis.effects.first() else { return Vec::new() };
    let Some(joint) = library::place_index(setup, &at.place) else { return Vec::new() };
    // In the place of a friction that depends on the speed alone, bristles make up for what its curve near standstill is off by.
    let remembers = at.effect == Effect::CoulombDahl;
    let kinds = [Some(Kind::Changing), remembers.then_some(Kind::Remembering)];
    kinds
        .into_par_iter()
        .flatten()
        .filter(|_| !setup.stop.leaves_out(|| UNKNOWN.into()))
        .map(|kind| in_place(setup, known, joint, kind))
        .collect()
}

/// Whether a fit is of friction that changes with time.
#[must_use]
pub fn changes(fit: &Fit) -> bool {
    matches!(&fit.residuals[..], [Residual { target: Target::Friction(_), .. }])
}

/// Whether a fit is of dry friction alone.
#[must_use]
pub fn is_dry(fit: &Fit) -> bool {
    fit.hypothesis.effects.len() == 1 && is_part_of(fit)
}

/// Whether dry friction is among a fit's effects.
#[must_use]
pub fn is_part_of(fit: &Fit) -> bool {
    let dry = |effect: Effect| effect.is_dry() || effect == Effect::CoulombDahl;
    fit.hypothesis.effects.iter().any(|at| dry(at.effect))
}

fn in_place(setup: &Setup, known: &Fit, joint: usize, kind: Kind) -> Fit {
    let size = SHARE * setup.joints[joint].force;
    // Of a friction with several forces the mean of the two directions, or what is left at speed.
    let number = |name: &str| {
        let fitted = &known.hypothesis.fitted;
        known.hypothesis.of_effect(0).find(|k| fitted[*k].name == name)
    };
    let force = |theta: &[f64]| {
        let of = |name: &str| number(name).map(|k| theta[k]);
        let either = of("forward").zip(of("backward")).map(|(a, b)| 0.5 * (a + b));
        let of_load = of("ratio").map(|ratio| ratio * setup.joints[joint].force);
        of("force").or(of("coulomb")).or(either).or(of_load).unwrap_or(0.0)
    };
    let residual = match kind {
        Kind::Changing => {
            let (from, to) = setup.experiment.own_span();
            Residual { target: Target::Friction(joint), features: bumps(Variable::Time, from, to, 2 * BUMPS) }
        }
        Kind::Remembering => {
            let (shortest, longest, count) = LENGTHS;
            let width = setup.joints[joint].position.width();
            let ratio = (longest / shortest).powf(1.0 / (count - 1) as f64);
            let length = |k: usize| width * shortest * ratio.powi(k as i32);
            let features = (0..count).map(|k| Feature::Bristles { deflection: length(k) }).collect();
            Residual { target: Target::Hysteresis(joint), features }
        }
    };
    // The bristles that bend over a way like the known friction's.
    let way = number("deflection").map_or(0.0, |k| known.estimate()[k]);
    let nearest = residual.features.iter().position(|feature| match feature {
        Feature::Bristles { deflection } => *deflection >= way,
        _ => false,
    });
    let mut hypothesis = library::hypothesis(setup, &[]);
    let calibrated = hypothesis.fitted.len();
    hypothesis.residual = true;
    let start = |theta: &[f64], share: f64| {
        let mut start = theta[..calibrated].to_vec();
        let force = share * force(theta);
        let here = |k: usize| kind == Kind::Changing || nearest.is_none_or(|nearest| nearest == k);
        start.extend((0..residual.features.len()).map(|k| if here(k) { force } else { 0.0 }));
        start
    };
    // States of windows that stick to a joint at rest do not lead away from there: with little friction nothing sticks.
    let starts = [1.0, LITTLE].map(|share| Begin {
        innovations: start(known.theta(), share),
        windows: start(&known.shooting.theta, share),
    });
    hypothesis.fitted.extend((0..residual.features.len()).map(|k| weight_of(k, size)));
    fit_from(setup, known, hypothesis, vec![residual], &starts, STEPS)
}
