//! Hidden delays that are another one for every message: their mean with everything else, and their spread.
//!
//! A reading that is late by a little more than the mean shows the machine a little earlier: where the prediction changes fast,
//! readings scatter more than their noise, and all outputs of one message together. To second order in the delay's deviation δ,
//!
//! ```text
//! y = ŷ(μ) + ŷ′ δ + ½ ŷ″ δ² + noise,    E y = ŷ + ½ ŷ″ s²,    cov y = σ² + s² ŷ′ ŷ′ᵀ
//! ```
//!
//! so that −2 log likelihood is Σ rᵀV⁻¹r + log |V| with V the covariance of each message. Gauss and Newton's method moves
//! what the mean depends on under these weights, Fisher's scoring the variances in turn (both steps are those of one Fisher
//! scoring: the information has no cross terms between mean and covariance where V changes slowly with the former). What a
//! constant delay would call noise is thus told apart from it: by when it is there.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::separable::{eliminate, pseudo_inverse};
use parallax_model::fit::{Best, Bounds, Local, View, bounded_step};

use super::model::PARTS;
use super::moved::{Message, Moved, Variances, combined};
use super::stretch::Stretches;
use super::traces::Trace;
use super::{Evaluator, wrapped};
use crate::batch::BatchError;
use crate::identify::humps::Reading;

/// Most steps.
const STEPS: usize = 30;
/// It has converged when a step promises less of −2 log likelihood, …
const SETTLED: f64 = 1e-3;
/// … and variances change by less than this share.
const STEADY: f64 = 1e-3;
/// −2 log likelihood may rise by so much in a step.
const TOLERATED: f64 = 3.0;

/// Spreads that were found, at the best point under them.
#[derive(Debug, Clone)]
pub(in crate::identify) struct Scattered {
    /// The best point.
    pub(in crate::identify) best: Best,
    /// The model there, by coordinates and then linear coefficients.
    pub(in crate::identify) local: Local,
    /// What each part of the recordings' time adds to it.
    pub(in crate::identify) parts: Vec<Local>,
    /// Linear coefficients, per output.
    pub(in crate::identify) coefficients: Vec<Vec<f64>>,
    /// Per delay that scatters: its spread, s, and the standard deviation of its square, s².
    pub(in crate::identify) spreads: Vec<(f64, f64)>,
    /// What every message says of the delay whose humps are asked for.
    pub(in crate::identify) readings: Vec<Reading>,
}

/// Everything at one point under some variances.
struct Seen {
    local: Local,
    /// What each part of the recordings' time adds to it, priors apart.
    parts: Vec<Local>,
    coefficients: Vec<Vec<f64>>,
    /// Scores of the variances, delays, then outputs, part by part; and their information.
    scores: Vec<DVector<f64>>,
    information: DMatrix<f64>,
}

impl Evaluator<'_> {
    /// The best point from `best` on, with the spreads of the delays that scatter.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub(in crate::identify) fn scattered(&self, best: &Best) -> Result<Scattered, BatchError> {
        let problem = self.problem;
        let bounds = Bounds::unit(best.point.len());
        let ones = vec![1.0; best.point.len()];
        let (fits, _) =
            self.fits::<parallax_model::lanes::F64x16>(std::slice::from_ref(&best.point), View::whole(1.0))?;
        let deviation = |index: usize| {
            let (squares, samples) = (fits[0].squares[index], fits[0].samples[index].max(1) as f64);
            (squares / samples).max(f64::MIN_POSITIVE)
        };
        let outputs = problem.outputs.iter().enumerate();
        let noise = outputs.map(|(index, output)| match output.noise {
            Some(noise) => noise * noise,
            // Half of what is left, to begin with.
            None => 0.5 * deviation(index),
        });
        let begin = |&delay: &usize| {
            let coordinate = &problem.coordinates[delay];
            (0.05 * (coordinate.high - coordinate.low)).powi(2)
        };
        let mut variances =
            Variances { delays: problem.scattered.iter().map(begin).collect(), noise: noise.collect() };
        let mut point = best.point.clone();
        let mut now = self.seen(&point, &variances, &fits[0].coefficients)?;
        let mut damping = 1e-9;
        for _ in 0..STEPS {
            let declared = problem.outputs.iter().map(|output| output.noise.is_some());
            let next = now.variances(&variances, declared);
            let linear = now.local.gradient.len() - point.len();
            let model = eliminate(&now.local, linear);
            let n = point.len();
            let step = bounded_step(
                [bounds.low(), bounds.high(), &ones],
                &point,
                &DMatrix::from_row_slice(n, n, &model.information),
                &DVector::from_row_slice(&model.gradient),
                damping,
            );
            let step = step.unwrap_or_else(|| vec![0.0; n]);
            let promised: f64 = step.iter().zip(&model.gradient).map(|(by, slope)| -by * slope).sum();
            if promised < SETTLED && next.differ(&variances) < STEADY {
                break;
            }
            let mut trial: Vec<f64> = point.iter().zip(&step).map(|(z, by)| z + by).collect();
            bounds.clamp(&mut trial);
            let seen = self.seen(&trial, &next, &now.coefficients)?;
            // The steps solve for the mean under given weights; how these change with it is left out, and so the likelihood
            // need not rise at every step.
            if seen.local.cost.is_finite() && seen.local.cost < now.local.cost + TOLERATED {
                (point, variances, now) = (trial, next, seen);
                damping = (damping * 0.1).max(1e-9);
            } else if damping > 1e6 {
                break;
            } else {
                damping = (damping * 100.0).max(1e-4);
            }
        }
        let readings = if problem.asks_for_humps() {
            self.readings(&point, &variances, &now.coefficients)?
        } else {
            Vec::new()
        };
        let covariance = now.covariance();
        let spreads =
            variances.delays.iter().enumerate().map(|(j, v)| (v.sqrt(), covariance[(j, j)].max(0.0).sqrt()));
        Ok(Scattered {
            best: Best { point, loss: now.local.cost },
            spreads: spreads.collect(),
            coefficients: now.coefficients,
            local: now.local,
            parts: now.parts,
            readings,
        })
    }

    /// The model at one point under these variances; the linear coefficients are those that suit best.
    fn seen(
        &self,
        point: &[f64],
        variances: &Variances,
        coefficients: &[Vec<f64>],
    ) -> Result<Seen, BatchError> {
        let stretches = self.stretches(View::whole(1.0));
        let (traces, moved) = self.around(point, variances, &stretches)?;
        // The covariance depends on the coefficients, and they on it: twice is enough.
        let first = self.whitened((&traces, &moved), &stretches, point, variances, coefficients);
        let step = first.linear_step(point.len());
        let mut coefficients = coefficients.to_vec();
        for (coefficient, by) in coefficients.iter_mut().flatten().zip(step) {
            *coefficient += by;
        }
        Ok(self.whitened((&traces, &moved), &stretches, point, variances, &coefficients))
    }

    fn whitened(
        &self,
        (traces, moved): (&[Trace<'_>], &[Moved]),
        stretches: &Stretches,
        point: &[f64],
        variances: &Variances,
        coefficients: &[Vec<f64>],
    ) -> Seen {
        let problem = self.problem;
        let n = point.len();
        let linear: usize = problem.outputs.iter().map(|output| output.terms.len()).sum();
        let all = n + linear;
        let (delays, outputs) = (problem.scattered.len(), problem.outputs.len());
        let of_episode = PARTS.div_ceil(problem.episodes);
        let mut parts = vec![Local::zero(all); of_episode * problem.episodes];
        let mut scores = vec![DVector::<f64>::zeros(delays + outputs); of_episode * problem.episodes];
        let mut information = DMatrix::zeros(delays + outputs, delays + outputs);
        // Where an output's coefficients begin.
        let mut columns = Vec::with_capacity(outputs);
        let mut column = n;
        for output in &problem.outputs {
            columns.push(column);
            column += output.terms.len();
        }
        // Derivatives of the predictions, `[episode][output]`: rows of n.
        let slopes: Vec<Vec<Vec<f64>>> = traces
            .iter()
            .map(|trace| {
                let of = |(index, predicted): (usize, &super::traces::Predicted<'_>)| {
                    let mut rows = vec![0.0; n * predicted.values.len() / predicted.width];
                    predicted.derive(&coefficients[index], &mut rows, n);
                    rows
                };
                trace.outputs.iter().enumerate().map(of).collect()
            })
            .collect();
        for Message { outputs: own, episode, step } in self.messages(stretches) {
            let recorded = |index: usize| problem.outputs[index].values[episode][step];
            let present: Vec<usize> =
                own.iter().copied().filter(|&index| recorded(index).is_finite()).collect();
            if present.is_empty() {
                continue;
            }
            let size = present.len();
            let steps = &stretches.all[episode].steps[own[0]];
            let part = (step - steps.start) * of_episode / steps.len();
            let part = episode * of_episode + part;
            let (local, score) = (&mut parts[part], &mut scores[part]);
            let mut rows = DMatrix::<f64>::zeros(size, all + 1);
            let (mut towards, mut bends) =
                (DMatrix::<f64>::zeros(size, delays), DMatrix::<f64>::zeros(size, delays));
            for (k, &index) in present.iter().enumerate() {
                let (output, predicted) = (&problem.outputs[index], &traces[episode].outputs[index]);
                let at = step - stretches.all[episode].steps[index].start;
                let terms = &predicted.values[at * predicted.width..(at + 1) * predicted.width];
                let own = &coefficients[index];
                let prediction = combined(&predicted.values, own, at);
                let slopes = &slopes[episode][index][at * n..(at + 1) * n];
                for (i, slope) in slopes.iter().enumerate() {
                    rows[(k, i)] = *slope;
                }
                for (i, term) in terms.iter().take(own.len()).enumerate() {
                    rows[(k, columns[index] + i)] = *term;
                }
                rows[(k, all)] = wrapped(recorded(index) - prediction, output.wrap);
                for (j, moved) in moved.iter().enumerate() {
                    towards[(k, j)] = combined(&moved.slopes[episode][index], own, at);
                    bends[(k, j)] = combined(&moved.bends[episode][index], own, at);
                }
            }
            // What a delay's variance v adds is v g gᵀ + ½ v² b bᵀ, with slopes g and second derivatives b.
            let of_delay = |j: usize, slope: f64, bend: f64| {
                let (g, b) = (towards.column(j), bends.column(j));
                g * g.transpose() * slope + b * b.transpose() * bend
            };
            let mut covariance = DMatrix::from_diagonal(&DVector::from_iterator(
                size,
                present.iter().map(|&index| variances.noise[index]),
            ));
            for (j, variance) in variances.delays.iter().enumerate() {
                covariance += of_delay(j, *variance, 0.5 * variance * variance);
            }
            let Some(factor) = covariance.cholesky() else {
                local.cost = f64::NAN;
                continue;
            };
            let residual: DVector<f64> = rows.column(all).into_owned();
            let weighted = factor.solve(&residual);
            let inverse = factor.inverse();
            local.cost += residual.dot(&weighted) + 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
            // L⁻¹ of the rows: their products are the information.
            let white = factor.l().solve_lower_triangular(&rows).unwrap_or(rows);
            for k in 0..size {
                for i in 0..all {
                    let a = white[(k, i)];
                    if a == 0.0 {
                        continue;
                    }
                    local.gradient[i] -= a * white[(k, all)];
                    for j in 0..=i {
                        local.information[i * all + j] += a * white[(k, j)];
                    }
                }
            }
            // V⁻¹ times d V by each delay's variance; by a noise's, d V is a one on the diagonal.
            let through: Vec<DMatrix<f64>> = variances
                .delays
                .iter()
                .enumerate()
                .map(|(j, variance)| &inverse * of_delay(j, 1.0, *variance))
                .collect();
            let place = |k: usize| delays + present[k];
            for (j, own) in through.iter().enumerate() {
                score[j] += (own * &weighted).dot(&residual) - own.trace();
                for (l, other) in through.iter().enumerate() {
                    information[(j, l)] += (own * other).trace();
                }
                let twice = own * &inverse;
                for k in 0..size {
                    information[(j, place(k))] += twice[(k, k)];
                    information[(place(k), j)] += twice[(k, k)];
                }
            }
            for k in 0..size {
                score[place(k)] += weighted[k].powi(2) - inverse[(k, k)];
                for l in 0..size {
                    information[(place(k), place(l))] += inverse[(k, l)].powi(2);
                }
            }
        }
        let mut local = Local::zero(all);
        for part in &mut parts {
            for i in 0..all {
                for j in 0..i {
                    part.information[j * all + i] = part.information[i * all + j];
                }
            }
            local.cost += part.cost;
            local.information.iter_mut().zip(&part.information).for_each(|(sum, value)| *sum += value);
            local.gradient.iter_mut().zip(&part.gradient).for_each(|(sum, value)| *sum += value);
        }
        local.cost += self.prior(point);
        for (i, (coordinate, z)) in problem.coordinates.iter().zip(point).enumerate() {
            if let Some((mean, std)) = coordinate.prior_of_place() {
                local.information[i * all + i] += 1.0 / (std * std);
                local.gradient[i] += (z - mean) / (std * std);
            }
        }
        let declared: Vec<bool> = problem.outputs.iter().map(|output| output.noise.is_some()).collect();
        // What is declared is not estimated.
        for (k, _) in declared.iter().enumerate().filter(|(_, declared)| **declared) {
            let k = delays + k;
            scores.iter_mut().for_each(|score| score[k] = 0.0);
            information.row_mut(k).fill(0.0);
            information.column_mut(k).fill(0.0);
            information[(k, k)] = 1.0;
        }
        Seen { local, parts, coefficients: coefficients.to_vec(), scores, information }
    }
}

impl Seen {
    /// The covariance of the variances: the information is half of what is summed up. Where the parts' scores scatter by more
    /// than that says, as where delays are not normal, that counts (H. White, Econometrica 50, 1982).
    fn covariance(&self) -> DMatrix<f64> {
        let inverse = pseudo_inverse(&self.information);
        let count = self.scores.len() as f64;
        let mean = self.scores.iter().sum::<DVector<f64>>() / count;
        let mut scatter = DMatrix::zeros(mean.len(), mean.len());
        for score in &self.scores {
            scatter += (score - &mean) * (score - &mean).transpose();
        }
        scatter *= count / (count - 1.0).max(1.0);
        let robust = &inverse * scatter * &inverse;
        let mut covariance = 2.0 * inverse;
        for i in 0..mean.len() {
            covariance[(i, i)] = covariance[(i, i)].max(robust[(i, i)]);
        }
        covariance
    }

    /// The next variances, none less than a fifth or more than five times of what it was.
    fn variances(&self, now: &Variances, declared: impl Iterator<Item = bool>) -> Variances {
        let step = pseudo_inverse(&self.information) * self.scores.iter().sum::<DVector<f64>>();
        let within = |value: f64, by: f64| (value + by).clamp(0.2 * value, 5.0 * value);
        let delays = now.delays.iter().zip(step.iter()).map(|(value, by)| within(*value, *by));
        let noise = now.noise.iter().zip(step.iter().skip(now.delays.len())).zip(declared);
        let noise = noise.map(|((value, by), declared)| if declared { *value } else { within(*value, *by) });
        Variances { delays: delays.collect(), noise: noise.collect() }
    }

    /// Where the linear coefficients, the last of the model, are best.
    fn linear_step(&self, n: usize) -> Vec<f64> {
        let all = self.local.gradient.len();
        let inner = DMatrix::from_fn(all - n, all - n, |i, j| self.local.information[(n + i) * all + n + j]);
        let gradient = DVector::from_iterator(all - n, self.local.gradient[n..].iter().copied());
        let step = pseudo_inverse(&inner) * gradient;
        step.iter().map(|by| -by).collect()
    }
}
