//! What a score test promises of a further effect.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::{Candidate, overlap};
use crate::hypothesis::EffectAt;
use crate::judge::is_nothing;
use crate::search::Fit;
use crate::setup::Setup;
use crate::signature::{self, Nuisance};

/// Effects, each with its [signature](signature::columns), by what a score test of the base's innovations promises of them, the
/// most promising first.
#[must_use]
pub fn by_promise(
    setup: &Setup,
    base: &Fit,
    nuisance: &Nuisance,
    effects: &[EffectAt],
    columns: &[DMatrix<f64>],
) -> Vec<EffectAt> {
    let mut scores: Vec<(f64, &EffectAt)> = effects
        .par_iter()
        .zip(columns)
        .map(|(at, columns)| (score_with(setup, base, nuisance, at, columns), at))
        .collect();
    // The sort is stable: of equal effects the library's order holds.
    scores.sort_by(|a, b| b.0.total_cmp(&a.0));
    scores.into_iter().map(|(_, at)| at.clone()).collect()
}

/// Whether no effect of the library promises anything beside a fit.
pub(super) fn leaves_nothing(setup: &Setup, fit: &Fit, pool: &[Candidate<'_>]) -> bool {
    is_nothing(most_left(setup, fit, pool), 0.0)
}

/// What the effect that promises most beside a fit promises in a score test.
pub(super) fn most_left(setup: &Setup, fit: &Fit, pool: &[Candidate<'_>]) -> f64 {
    most_of(setup, fit, pool.par_iter().map(|other| other.at))
}

/// The same of any effects.
pub fn most_of<'a>(setup: &Setup, fit: &Fit, effects: impl ParallelIterator<Item = &'a EffectAt>) -> f64 {
    let setup = &setup.with_lines_of(&fit.innovation.pass);
    let nuisance = Nuisance::new(fit);
    let others = effects.filter(|at| !fit.hypothesis.effects.iter().any(|own| overlap(own, at)));
    others.map(|at| score(setup, fit, &nuisance, at)).reduce(|| 0.0, f64::max)
}

/// How much of the base's squared innovations an effect's signature takes, at most: a score test.
pub(super) fn score(setup: &Setup, base: &Fit, nuisance: &Nuisance, at: &EffectAt) -> f64 {
    score_with(setup, base, nuisance, at, &signature::columns(setup, base, at))
}

/// The same where the signature at the first start is known.
fn score_with(setup: &Setup, base: &Fit, nuisance: &Nuisance, at: &EffectAt, first: &DMatrix<f64>) -> f64 {
    let further = signature::columns_at_further_starts(setup, base, at);
    further.iter().map(|columns| score_of(nuisance, columns)).fold(score_of(nuisance, first), f64::max)
}

pub(super) fn score_of(nuisance: &Nuisance, columns: &DMatrix<f64>) -> f64 {
    let basis = signature::orthonormal(&nuisance.project_columns(columns));
    let along: DVector<f64> = basis.transpose() * &nuisance.innovations;
    Some(along.norm_squared()).filter(|score| score.is_finite()).unwrap_or(0.0)
}
