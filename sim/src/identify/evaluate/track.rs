//! States at the cuts: from piece to piece along the recordings, what fits best of what a machine with these parameters can
//! do.
//!
//! A prediction of a whole recording from its first state may leave it for good at the first moment at which little decides
//! (a pendulum that stands upright). Here every piece is taken up where the one before has ended, corrected by what was
//! recorded: a few states drawn around, then Gauss and Newton's method by the state alone. It costs little, for a state is
//! small and pieces are short, and needs no filter.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::View;
use parallax_model::lanes::F64x16;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::stretch::Stretches;
use super::sums::Fit;
use super::{Evaluator, Run, wrapped};
use crate::batch::{BatchError, Made, Number};

/// How far the states lie around that are tried, in units of their spread: the prediction itself, then further and further.
const AROUND: [f64; 16] =
    [0.0, 0.01, 0.01, 0.02, 0.02, 0.04, 0.04, 0.07, 0.07, 0.1, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6];
/// How far a state is believed to lie from the prediction, in the same units.
const BELIEF: f64 = 0.3;
/// Steps of Gauss and Newton's method for each piece.
const STEPS: usize = 2;
/// Shares of a step that are tried.
const SHARES: [f64; 3] = [1.0, 0.4, 0.1];
/// How far neighbours are.
const DIFFERENCE: f64 = 1e-6;

/// What a piece looks like from one state.
struct Glimpse {
    /// What was recorded less what is predicted, in units of the noise.
    residuals: Vec<f64>,
    /// The state with which the next piece begins.
    end: Vec<f64>,
}

impl Glimpse {
    /// What it costs, with the belief that it begins near the prediction.
    fn cost(&self, start: &[f64], predicted: &[f64]) -> f64 {
        let squares = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
        let away = squares(&mut start.iter().zip(predicted).map(|(a, b)| (a - b) / BELIEF));
        let cost = squares(&mut self.residuals.iter().copied()) + away;
        if cost.is_finite() && self.end.iter().all(|value| value.is_finite()) { cost } else { f64::INFINITY }
    }
}

impl Evaluator<'_> {
    /// The points with states at the cuts of all recordings, each in units of its spread. Of the linear coefficients those are
    /// taken that suit the view's share of the data.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub fn states(&self, points: &[Vec<f64>], view: View) -> Result<Vec<Vec<f64>>, BatchError> {
        let (fits, _) = self.fits::<F64x16>(points, View::whole(view.share))?;
        let stretches = self.stretches(view);
        let mut found = points.to_vec();
        found.iter_mut().for_each(|point| point.resize(self.width(&stretches), 0.0));
        let tasks: Vec<(usize, usize)> =
            (0..points.len()).flat_map(|point| (0..self.problem.episodes).map(move |e| (point, e))).collect();
        for piece in 0..stretches.pieces - 1 {
            let ends = match piece {
                0 => {
                    let first =
                        |&(point, episode): &(usize, usize)| (point, episode * stretches.pieces, Vec::new());
                    let runs = tasks.iter().map(first).collect();
                    self.glimpses(&found, runs, &fits, &stretches)?.into_iter().map(|seen| seen.end).collect()
                }
                _ => self.correct(&mut found, &tasks, piece, &fits, &stretches)?,
            };
            for (&(point, episode), end) in tasks.iter().zip(ends) {
                let next = &stretches.all[episode * stretches.pieces + piece + 1];
                if let Some(first) = self.first_of(&stretches, next) {
                    found[point][first..first + end.len()].copy_from_slice(&end);
                }
            }
        }
        // The last piece begins as well where the recording says.
        if stretches.pieces > 1 {
            self.correct(&mut found, &tasks, stretches.pieces - 1, &fits, &stretches)?;
        }
        Ok(found)
    }

    /// Corrects the states with which a piece begins, and gives those with which it ends.
    fn correct(
        &self,
        found: &mut [Vec<f64>],
        tasks: &[(usize, usize)],
        piece: usize,
        fits: &[Fit],
        stretches: &Stretches,
    ) -> Result<Vec<Vec<f64>>, BatchError> {
        let m = self.carried.len();
        let stretch = |episode: usize| episode * stretches.pieces + piece;
        let first = |episode: usize| self.first_of(stretches, &stretches.all[stretch(episode)]).unwrap_or(0);
        let predicted: Vec<Vec<f64>> =
            tasks.iter().map(|&(p, e)| found[p][first(e)..first(e) + m].to_vec()).collect();
        let mut random = ChaCha8Rng::seed_from_u64(piece as u64);
        let mut drawn = |spread: f64| -> Vec<f64> {
            (0..m).map(|_| spread * Distribution::<f64>::sample(&StandardNormal, &mut random)).collect()
        };
        let around: Vec<Vec<f64>> = AROUND.iter().map(|spread| drawn(*spread)).collect();
        let tries = |starts: &dyn Fn(usize) -> Vec<Vec<f64>>| {
            let of = |(task, &(point, episode)): (usize, &(usize, usize))| {
                starts(task).into_iter().map(move |start| (point, stretch(episode), start))
            };
            tasks.iter().enumerate().flat_map(of).collect::<Vec<_>>()
        };
        // The best of those around.
        let runs = tries(&|task| around.iter().map(|by| plus(&predicted[task], by, 1.0)).collect());
        let seen = self.glimpses(found, runs.clone(), fits, stretches)?;
        let mut now: Vec<(f64, Vec<f64>, Vec<f64>)> = Vec::new();
        for (task, (runs, seen)) in runs.chunks(around.len()).zip(seen.chunks(around.len())).enumerate() {
            let mut best = (f64::INFINITY, predicted[task].clone(), predicted[task].clone());
            for ((_, _, start), seen) in runs.iter().zip(seen) {
                let cost = seen.cost(start, &predicted[task]);
                if cost < best.0 {
                    best = (cost, start.clone(), seen.end.clone());
                }
            }
            now.push(best);
        }
        for _ in 0..STEPS {
            let unit =
                |j: usize| (0..m).map(move |i| if i == j { DIFFERENCE } else { 0.0 }).collect::<Vec<f64>>();
            let runs = tries(&|task| {
                let here = std::iter::once(now[task].1.clone());
                here.chain((0..m).map(|j| plus(&now[task].1, &unit(j), 1.0))).collect()
            });
            let seen = self.glimpses(found, runs, fits, stretches)?;
            let steps: Vec<Vec<f64>> = seen
                .chunks(m + 1)
                .enumerate()
                .map(|(task, seen)| newton(seen, &now[task].1, &predicted[task]))
                .collect();
            let runs =
                tries(&|task| SHARES.iter().map(|share| plus(&now[task].1, &steps[task], *share)).collect());
            let seen = self.glimpses(found, runs.clone(), fits, stretches)?;
            let each = runs.chunks(SHARES.len()).zip(seen.chunks(SHARES.len()));
            for ((now, predicted), (runs, seen)) in now.iter_mut().zip(&predicted).zip(each) {
                for ((_, _, start), seen) in runs.iter().zip(seen) {
                    let cost = seen.cost(start, predicted);
                    if cost < now.0 {
                        *now = (cost, start.clone(), seen.end.clone());
                    }
                }
            }
        }
        for (&(point, episode), (_, start, _)) in tasks.iter().zip(&now) {
            found[point][first(episode)..first(episode) + m].copy_from_slice(start);
        }
        Ok(now.into_iter().map(|(_, _, end)| end).collect())
    }

    /// Runs stretches of points from states: point, stretch, state (none for the first of a recording).
    fn glimpses(
        &self,
        points: &[Vec<f64>],
        tries: Vec<(usize, usize, Vec<f64>)>,
        fits: &[Fit],
        stretches: &Stretches,
    ) -> Result<Vec<Glimpse>, BatchError> {
        let problem = self.problem;
        let started: Vec<Vec<f64>> = tries
            .iter()
            .map(|(point, stretch, start)| {
                let mut point = points[*point].clone();
                if let Some(first) = self.first_of(stretches, &stretches.all[*stretch]) {
                    point[first..first + start.len()].copy_from_slice(start);
                }
                point
            })
            .collect();
        let each = tries.iter().enumerate();
        let runs: Vec<Run> = each.map(|(point, (_, stretch, _))| Run { point, stretch: *stretch }).collect();
        let slices: Vec<&[f64]> = started.iter().map(Vec::as_slice).collect();
        let environments = self.environments(&slices, &runs, stretches)?;
        let noise: Vec<Vec<f64>> = fits
            .iter()
            .map(|fit| {
                let outputs = problem.outputs.iter().zip(fit.squares.iter().zip(&fit.samples));
                let of = |(squares, samples): (&f64, &usize)| {
                    (squares / (*samples).max(1) as f64).sqrt().max(f64::MIN_POSITIVE)
                };
                outputs.map(|(output, seen)| output.noise.unwrap_or_else(|| of(seen))).collect()
            })
            .collect();
        let of_members = |members: &[usize]| members.to_vec();
        let groups = self.batch.visit::<F64x16, (Vec<usize>, Vec<Glimpse>)>(
            &environments,
            self.together(runs.len(), problem.episodes, F64x16::LANES),
            |members| {
                let glimpse = |_: &usize| Glimpse { residuals: Vec::new(), end: Vec::new() };
                (of_members(members), members.iter().map(glimpse).collect())
            },
            |(members, seen), made| self.compare(members, seen, made, (&tries, fits, &noise, stretches)),
            |(_, seen), states| {
                for (position, seen) in seen.iter_mut().enumerate() {
                    let state = self.carried.of(states, position / F64x16::LANES);
                    let lane = position % F64x16::LANES;
                    let scaled =
                        state.zip(&self.carried.scales).map(|(value, scale)| value.get(lane) / scale);
                    seen.end = scaled.collect();
                }
            },
        )?;
        let mut found: Vec<Option<Glimpse>> = runs.iter().map(|_| None).collect();
        for (members, (_, seen)) in groups {
            for (member, seen) in members.into_iter().zip(seen) {
                found[member] = Some(seen);
            }
        }
        Ok(found.into_iter().flatten().collect())
    }

    /// Adds what was just made to what each member has seen.
    #[allow(clippy::type_complexity, reason = "what does not change, handed through")]
    fn compare(
        &self,
        members: &[usize],
        seen: &mut [Glimpse],
        made: &Made<'_, F64x16>,
        (tries, fits, noise, stretches): (&[(usize, usize, Vec<f64>)], &[Fit], &[Vec<f64>], &Stretches),
    ) {
        let step = made.seq as usize;
        for &index in &self.of_node[made.node] {
            let output = &self.problem.outputs[index];
            let stretch = &stretches.all[tries[members[0]].1];
            if !stretch.steps[index].contains(&step) {
                continue;
            }
            let value = output.values[stretch.episode][step];
            if !value.is_finite() {
                continue;
            }
            for (position, (&member, seen)) in members.iter().zip(seen.iter_mut()).enumerate() {
                let (message, lane) = (made.block(position / F64x16::LANES), position % F64x16::LANES);
                let point = tries[member].0;
                let terms = (0..output.width()).map(|k| output.value(message, k, F64x16::splat(1.0))[lane]);
                let predicted: f64 = match fits[point].coefficients[index].as_slice() {
                    [] => terms.sum(),
                    coefficients => terms.zip(coefficients).map(|(term, c)| term * c).sum(),
                };
                seen.residuals.push(wrapped(value - predicted, output.wrap) / noise[point][index]);
            }
        }
    }
}

/// `a + share b`
fn plus(a: &[f64], b: &[f64], share: f64) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + share * b).collect()
}

/// The step of Gauss and Newton's method from a state and its neighbours; none where it has no solution.
fn newton(seen: &[Glimpse], start: &[f64], predicted: &[f64]) -> Vec<f64> {
    let m = start.len();
    let here = &seen[0].residuals;
    let slope = |j: usize, k: usize| (seen[j + 1].residuals[k] - here[k]) / DIFFERENCE;
    let mut information = DMatrix::identity(m, m) / (BELIEF * BELIEF);
    let mut gradient = DVector::from_fn(m, |j, _| (start[j] - predicted[j]) / (BELIEF * BELIEF));
    for (k, residual) in here.iter().enumerate() {
        for i in 0..m {
            gradient[i] += slope(i, k) * residual;
            for j in 0..m {
                information[(i, j)] += slope(i, k) * slope(j, k);
            }
        }
    }
    match information.cholesky().map(|factor| factor.solve(&gradient)) {
        Some(step) if step.iter().all(|value| value.is_finite()) => step.iter().map(|value| -value).collect(),
        _ => vec![0.0; m],
    }
}
