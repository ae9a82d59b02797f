//! Signatures: what an effect leaves in the innovations of the null model, and which effects look alike.

use nalgebra::{DMatrix, DVector};
use parallax_model::effect::Effect;

use crate::hypothesis::{EffectAt, Hypothesis};
use crate::innovation::walk;
use crate::library;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::median;

/// Cosine from which two signatures count as one.
pub const SAME: f64 = 0.97;

/// How many times the median a reading's sensitivity counts for at most where one effect is held against others.
const USUAL: f64 = 10.0;

/// Frequencies from which a spring inside a joint starts.
const FREQUENCIES: usize = 3;

/// The nuisance directions of a log: what the calibrated parameters can produce, as an orthonormal basis.
#[derive(Clone, Debug)]
pub struct Nuisance {
    basis: DMatrix<f64>,
    /// The columns that the basis spans.
    free: DMatrix<f64>,
    /// Whitened innovations of the null fit, zero where the likelihood is not of them.
    pub innovations: DVector<f64>,
    /// 1 for each reading that the likelihood is of, 0 for those that only tell where the states began: their predicted
    /// variances are those of a guess.
    counts: DVector<f64>,
}

impl Nuisance {
    /// From the null fit.
    #[must_use]
    pub fn new(null: &Fit) -> Self {
        let counts = DVector::from_vec(null.innovation.pass.weights());
        let innovations = DVector::from_vec(null.innovation.pass.whitened()).component_mul(&counts);
        let p = null.hypothesis.fitted.len();
        let rows = null.innovation.pass.readings();
        let columns =
            DMatrix::from_row_slice(rows, p, &null.innovation.pass.whitened_by_parameter()[..rows * p]);
        let columns = weighted(&columns, &counts);
        // A parameter that rests on its bound is not free to take an effect's place.
        let free: Vec<usize> = (0..p).filter(|j| !null.rests(*j)).collect();
        let free = columns.select_columns(&free);
        Nuisance { basis: orthonormal(&free), free, innovations, counts }
    }

    /// Innovations without nuisance directions.
    #[cfg(test)]
    pub(crate) fn plain(innovations: DVector<f64>) -> Self {
        let counts = DVector::from_element(innovations.len(), 1.0);
        let none = DMatrix::zeros(innovations.len(), 0);
        Nuisance { basis: none.clone(), free: none, innovations, counts }
    }

    /// A signature with the nuisance directions projected out.
    #[must_use]
    pub fn project(&self, signature: &DVector<f64>) -> DVector<f64> {
        let seen = signature.component_mul(&self.counts);
        &seen - &self.basis * (self.basis.transpose() * &seen)
    }

    /// Columns with the nuisance directions projected out.
    #[must_use]
    pub fn project_columns(&self, columns: &DMatrix<f64>) -> DMatrix<f64> {
        beside(&self.basis, &weighted(columns, &self.counts))
    }

    /// Whether the nuisance directions do what these columns do, up to this share of their length: of all readings, and also if none counts
    /// for many times as much as most. Where a model runs away from a machine all its sensitivities become one.
    #[must_use]
    pub fn covers(&self, columns: &DMatrix<f64>, share: f64) -> bool {
        if self.project_columns(columns).norm() >= share * columns.norm() {
            return false;
        }
        let seen = weighted(columns, &self.counts);
        let size: Vec<f64> = seen.row_iter().map(|row| row.norm()).collect();
        let mut there: Vec<f64> = size.iter().copied().filter(|size| *size > 0.0).collect();
        if there.is_empty() {
            return true;
        }
        let most = USUAL * median(&mut there);
        let weights =
            DVector::from_iterator(size.len(), size.iter().map(|size| 1.0 / (size / most).max(1.0)));
        let (free, seen) = (weighted(&self.free, &weights), weighted(&seen, &weights));
        beside(&orthonormal(&free), &seen).norm() < share * seen.norm()
    }
}

/// Columns with a weight for each reading.
fn weighted(columns: &DMatrix<f64>, weights: &DVector<f64>) -> DMatrix<f64> {
    let mut columns = columns.clone();
    columns.column_iter_mut().for_each(|mut column| column.component_mul_assign(weights));
    columns
}

/// What columns have beside an orthonormal basis.
fn beside(basis: &DMatrix<f64>, columns: &DMatrix<f64>) -> DMatrix<f64> {
    columns - basis * (basis.transpose() * columns)
}

/// An orthonormal basis of the columns' span; columns that add less than a millionth of their length are left out.
#[must_use]
pub fn orthonormal(columns: &DMatrix<f64>) -> DMatrix<f64> {
    let mut basis: Vec<DVector<f64>> = Vec::new();
    for column in columns.column_iter() {
        let mut v = column.into_owned();
        let length = v.norm();
        // Twice is enough (Giraud, Langou & Rozložník 2005).
        for _ in 0..2 {
            for b in &basis {
                let along = b.dot(&v);
                v.axpy(-along, b, 1.0);
            }
        }
        let left = v.norm();
        if length.is_finite() && length > 0.0 && left > 1e-6 * length {
            basis.push(v / left);
        }
    }
    if basis.is_empty() { DMatrix::zeros(columns.nrows(), 0) } else { DMatrix::from_columns(&basis) }
}

/// What a fit changes in the whitened innovations of the null model: the effect's own part of them.
///
/// Both walks use the null model's noise, so that they weigh readings alike.
#[must_use]
pub fn of_fit(setup: &Setup, null: &Fit, fit: &Fit) -> DVector<f64> {
    let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
    let with = walk(&simulator, &setup.train, &setup.noise, &null.innovation.noise, fit.estimate());
    let mut theta = fit.estimate().to_vec();
    for (value, fitted) in theta.iter_mut().zip(&fit.hypothesis.fitted) {
        // Calibrated parameters keep their place: the signature is the effect's alone.
        match null.hypothesis.fitted.iter().position(|f| f.slot == fitted.slot) {
            None => *value = fitted.null,
            // But where the effect is that such a parameter has another value, it goes back to where the null left it.
            Some(index) if fit.hypothesis.frees(fitted.slot) => *value = null.theta()[index],
            Some(_) => {}
        }
    }
    let without = walk(&simulator, &setup.train, &setup.noise, &null.innovation.noise, &theta);
    DVector::from_vec(without.whitened()) - DVector::from_vec(with.whitened())
}

/// Length of an effect's columns up to which it leaves no trace.
pub const TRACE: f64 = 1e-9;

/// Derivatives of a fit's whitened innovations by the parameters of a further effect, at the first of its starts, the smallest,
/// at which it leaves a trace: a limit may be out of reach there.
#[must_use]
pub fn columns(setup: &Setup, null: &Fit, effect: &EffectAt) -> DMatrix<f64> {
    let hypothesis = library::hypothesis(setup, &effects(null, effect));
    let first = columns_of(setup, null, &hypothesis, 0);
    let traces = |columns: &DMatrix<f64>| columns.norm() > TRACE;
    if traces(&first) {
        return first;
    }
    let starts = hypothesis.fitted.iter().map(|f| f.starts.len()).max().unwrap_or(0);
    (1..starts).map(|start| columns_of(setup, null, &hypothesis, start)).find(traces).unwrap_or(first)
}

/// The same at the further starts of an effect, where it is what it does and not its size that they differ by: a spring inside
/// a joint is seen at its frequency. Nothing for all other effects.
#[must_use]
pub fn columns_at_further_starts(setup: &Setup, null: &Fit, effect: &EffectAt) -> Vec<DMatrix<f64>> {
    match effect.effect {
        Effect::Flexibility | Effect::FlexibilityFar => {
            let hypothesis = library::hypothesis(setup, &effects(null, effect));
            (1..FREQUENCIES).map(|start| columns_of(setup, null, &hypothesis, start)).collect()
        }
        _ => Vec::new(),
    }
}

/// The effects of a fit, and a further one.
fn effects(null: &Fit, further: &EffectAt) -> Vec<EffectAt> {
    null.hypothesis.effects.iter().chain([further]).cloned().collect()
}

/// Derivatives of a fit's whitened innovations by what `hypothesis` has beyond it, at one of its starts.
#[must_use]
pub fn columns_of(setup: &Setup, null: &Fit, hypothesis: &Hypothesis, start: usize) -> DMatrix<f64> {
    let simulator = library::simulator(setup, hypothesis, Vec::new());
    let theta: Vec<f64> = hypothesis
        .fitted
        .iter()
        .map(|f| match null.hypothesis.fitted.iter().position(|n| n.slot == f.slot) {
            Some(index) => null.theta()[index],
            None => f.starts.get(start).or(f.starts.first()).copied().unwrap_or(f.null),
        })
        .collect();
    let pass = walk(&simulator, &setup.train, &setup.noise, &null.innovation.noise, &theta);
    let p = hypothesis.fitted.len();
    let all = DMatrix::from_row_slice(pass.readings(), p, &pass.whitened_by_parameter());
    let own: Vec<DVector<f64>> = hypothesis
        .fitted
        .iter()
        .enumerate()
        .filter(|(_, f)| hypothesis.frees(f.slot) || !null.hypothesis.fitted.iter().any(|n| n.slot == f.slot))
        .map(|(j, f)| all.column(j) * f.scale)
        .collect();
    if own.is_empty() { DMatrix::zeros(pass.readings(), 0) } else { DMatrix::from_columns(&own) }
}

/// Cosine between two vectors, 0 where one vanishes.
#[must_use]
pub fn cosine(a: &DVector<f64>, b: &DVector<f64>) -> f64 {
    let lengths = a.norm() * b.norm();
    if lengths > 0.0 && lengths.is_finite() { (a.dot(b) / lengths).abs() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_alike_only_where_a_model_runs_away_is_not_covered() {
        let column = |elsewhere: fn(f64) -> f64| {
            DMatrix::from_fn(200, 1, |k, _| if k < 5 { 1e6 } else { elsewhere(k as f64) })
        };
        let (free, other) = (column(|k| (0.1 * k).sin()), column(|k| (0.37 * k).cos()));
        let counts = DVector::from_element(200, 1.0);
        let nuisance =
            Nuisance { basis: orthonormal(&free), free: free.clone(), innovations: 0.0 * &counts, counts };
        assert!(nuisance.project_columns(&other).norm() < 1e-3 * other.norm());
        assert!(!nuisance.covers(&other, 0.03));
        assert!(nuisance.covers(&(-2.0 * free), 0.03));
    }
}
