//! Gauss–Newton models of the loss, with linear coefficients solved for and eliminated.

use parallax_model::fit::Local;
use parallax_model::fit::separable::{Sums, eliminate};
use rayon::prelude::*;

use super::traces::Trace;
use super::{Evaluator, Fit, wrapped};
use crate::batch::BatchError;
use crate::identify::problem::Compared;

impl Evaluator<'_> {
    /// The losses with their Gauss–Newton models, linear coefficients eliminated, by exact derivatives.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub fn exact_locals(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Local>, BatchError> {
        Ok(self.eliminated(&self.models(points, share)?))
    }

    /// As [`exact_locals`](Self::exact_locals), by differences: a point and its neighbours run on lanes together, for a
    /// tenth of the time. The derivatives are right to about five digits, which a search does not feel.
    ///
    /// # Errors
    ///
    /// As [`exact_locals`](Self::exact_locals).
    pub fn locals(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Local>, BatchError> {
        let traces = self.differences(points, share)?;
        Ok(self.eliminated(&self.models_of(traces, points, share)))
    }

    /// The losses with their Gauss–Newton models by coordinates and then linear coefficients, and the fits.
    pub(in crate::identify) fn models(
        &self,
        points: &[Vec<f64>],
        share: f64,
    ) -> Result<Vec<(Local, Fit)>, BatchError> {
        Ok(self.models_of(self.traces(points, share)?, points, share))
    }

    fn models_of(&self, traces: Vec<Vec<Trace>>, points: &[Vec<f64>], share: f64) -> Vec<(Local, Fit)> {
        traces.into_par_iter().zip(points).map(|(traces, point)| self.model(&traces, point, share)).collect()
    }

    fn eliminated(&self, models: &[(Local, Fit)]) -> Vec<Local> {
        let linear: usize = self.problem.outputs.iter().map(|output| output.terms.len()).sum();
        models.iter().map(|(local, _)| eliminate(local, linear)).collect()
    }

    fn model(&self, traces: &[Trace], point: &[f64], share: f64) -> (Local, Fit) {
        let problem = self.problem;
        let n = problem.coordinates.len();
        let linear: usize = problem.outputs.iter().map(|output| output.terms.len()).sum();
        let all = n + linear;
        let mut total = Local::zero(all);
        let mut fit = Fit { coefficients: Vec::new(), squares: Vec::new(), samples: Vec::new() };
        let mut column = n;
        for (output, trace) in problem.outputs.iter().zip(traces) {
            let k = output.terms.len();
            let coefficients = self.solve(output, trace, share);
            let mut squares = 0.0;
            let mut samples = 0;
            // Only this output's own columns are touched: those of the coordinates and of its coefficients.
            let width = n + k;
            let mut row = vec![0.0; width];
            let mut information = vec![0.0; width * width];
            let mut gradient = vec![0.0; width];
            for episode in 0..problem.episodes {
                let (from, until) = (problem.spans[episode][0], problem.until(episode, share));
                for (step, value) in output.values[episode].iter().enumerate() {
                    if !output.counts(episode, step, from, until) {
                        continue;
                    }
                    let at = step * trace.width;
                    let terms = &trace.values[episode][at..at + trace.width];
                    let slopes = &trace.slopes[episode][at * n..(at + trace.width) * n];
                    let predicted = match k {
                        0 => terms[0],
                        _ => terms.iter().zip(&coefficients).map(|(x, c)| x * c).sum(),
                    };
                    let residual = wrapped(value - predicted, output.wrap);
                    row.fill(0.0);
                    for (term, slopes) in slopes.chunks_exact(n.max(1)).enumerate() {
                        let coefficient = coefficients.get(term).copied().unwrap_or(1.0);
                        for (entry, slope) in row.iter_mut().zip(slopes) {
                            *entry -= coefficient * slope;
                        }
                    }
                    for (entry, term) in row[n..].iter_mut().zip(terms) {
                        *entry = -term;
                    }
                    for i in 0..width {
                        let a = row[i];
                        gradient[i] += a * residual;
                        let to = &mut information[i * width..i * width + i + 1];
                        to.iter_mut().zip(&row).for_each(|(to, b)| *to += a * b);
                    }
                    squares += residual * residual;
                    samples += 1;
                }
            }
            let weight = match output.noise {
                Some(noise) => 1.0 / (noise * noise),
                None => samples as f64 / squares.max(f64::MIN_POSITIVE),
            };
            let place = |i: usize| if i < n { i } else { column + i - n };
            for i in 0..width {
                total.gradient[place(i)] += weight * gradient[i];
                for j in 0..=i {
                    let value = weight * information[i * width + j];
                    total.information[place(i) * all + place(j)] += value;
                    if i != j {
                        total.information[place(j) * all + place(i)] += value;
                    }
                }
            }
            fit.coefficients.push(coefficients);
            fit.squares.push(squares);
            fit.samples.push(samples);
            column += k;
        }
        total.cost = self.loss(&fit) + self.prior(point);
        for (i, (coordinate, z)) in problem.coordinates.iter().zip(point).enumerate() {
            if let Some((mean, std)) = coordinate.prior_of_place() {
                total.information[i * all + i] += 1.0 / (std * std);
                total.gradient[i] += (z - mean) / (std * std);
            }
        }
        (total, fit)
    }

    /// The best coefficients for a trace.
    fn solve(&self, output: &Compared, trace: &Trace, share: f64) -> Vec<f64> {
        let problem = self.problem;
        let mut sums = Sums::new(output.terms.len());
        if output.terms.is_empty() {
            return Vec::new();
        }
        for episode in 0..problem.episodes {
            let (from, until) = (problem.spans[episode][0], problem.until(episode, share));
            for (step, value) in output.values[episode].iter().enumerate() {
                if output.counts(episode, step, from, until) {
                    let at = step * trace.width;
                    sums.add(&trace.values[episode][at..at + trace.width], *value);
                }
            }
        }
        sums.solve().0
    }
}
