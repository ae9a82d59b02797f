//! Sums along a run, which are all that a loss needs: nothing of the predictions is kept.

use parallax_model::Scalar;
use parallax_model::fit::separable::Sums;
use parallax_model::lanes::{F64x16, InMemory, Kernel, Level, Simd};
use rayon::prelude::*;

use super::{Evaluator, TOGETHER};
use crate::batch::{BatchError, Made};
use crate::identify::problem::Compared;

/// What predictions sum up to at one point: per output, over all recordings.
#[derive(Debug, Clone)]
pub(in crate::identify) struct Fit {
    /// Coefficients of the linear terms.
    pub(in crate::identify) coefficients: Vec<Vec<f64>>,
    /// Sum of squared residuals.
    pub(in crate::identify) squares: Vec<f64>,
    /// Values that count.
    pub(in crate::identify) samples: Vec<usize>,
}

impl Evaluator<'_> {
    /// The losses at points between 0 and 1: −2 log likelihood up to a constant, with the priors. `share` of the fitted time
    /// counts. Not a number where a prediction is none.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub fn losses(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<f64>, BatchError> {
        let fits = self.fits(points, share)?;
        Ok(fits.iter().zip(points).map(|(fit, point)| self.loss(fit) + self.prior(point)).collect())
    }

    /// What predictions sum up to at every point.
    fn fits(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Fit>, BatchError> {
        let problem = self.problem;
        let environments = self.environments(points)?;
        let start = |members: &[usize]| {
            let blocks = members.len().div_ceil(F64x16::LANES);
            let episode = members[0] % problem.episodes;
            let sums = problem.outputs.iter();
            let zero = F64x16::splat(0.0);
            let sums: Vec<Vec<F64x16>> =
                sums.map(|output| vec![zero; blocks * entries(output.terms.len())]).collect();
            (episode, sums)
        };
        let groups = self.batch.visit::<F64x16, _>(
            &environments,
            (TOGETHER, self.passes(share)),
            start,
            |(episode, sums), made| self.see(*episode, sums, made, share),
        )?;
        // Recording by recording, in their order: the same bits however the groups ran.
        let mut of_environment = vec![(0usize, 0usize, 0usize); environments.len()];
        for (group, (members, _)) in groups.iter().enumerate() {
            for (position, &member) in members.iter().enumerate() {
                let lane = position % F64x16::LANES;
                of_environment[member] = (group, position / F64x16::LANES, lane);
            }
        }
        let constants = self.constants(share);
        let fits = (0..points.len()).into_par_iter().map(|point| {
            let mut fit = Fit { coefficients: Vec::new(), squares: Vec::new(), samples: Vec::new() };
            for (index, output) in problem.outputs.iter().enumerate() {
                let k = output.terms.len();
                let (samples, square) = constants[index];
                let mut total = Sums::new(k);
                let mut squares = 0.0;
                for episode in 0..problem.episodes {
                    let (group, block, lane) = of_environment[point * problem.episodes + episode];
                    let sums = &groups[group].1.1[index][block * entries(k)..(block + 1) * entries(k)];
                    if k == 0 {
                        squares += sums[0][lane];
                        continue;
                    }
                    let mut at = 0;
                    for i in 0..k {
                        for j in 0..=i {
                            total.gram[i * k + j] += sums[at][lane];
                            total.gram[j * k + i] = total.gram[i * k + j];
                            at += 1;
                        }
                        total.right[i] += sums[at][lane];
                        at += 1;
                    }
                }
                total.square = square;
                let (coefficients, left) = if k == 0 { (Vec::new(), squares) } else { total.solve() };
                fit.coefficients.push(coefficients);
                fit.squares.push(left);
                fit.samples.push(samples);
            }
            fit
        });
        Ok(fits.collect())
    }

    /// Per output, how many values count and the sum of their squares.
    fn constants(&self, share: f64) -> Vec<(usize, f64)> {
        let problem = self.problem;
        let of = |output: &Compared| {
            let (mut samples, mut square) = (0, 0.0);
            for episode in 0..problem.episodes {
                let (from, until) = (problem.spans[episode][0], problem.until(episode, share));
                for (step, value) in output.values[episode].iter().enumerate() {
                    if output.counts(episode, step, from, until) {
                        samples += 1;
                        square += value * value;
                    }
                }
            }
            (samples, square)
        };
        problem.outputs.iter().map(of).collect()
    }

    /// Adds an output of a group to its sums.
    fn see(&self, episode: usize, sums: &mut [Vec<F64x16>], made: &Made<'_, F64x16>, share: f64) {
        let problem = self.problem;
        for &index in &self.of_node[made.node] {
            let output = &problem.outputs[index];
            let (from, until) = (problem.spans[episode][0], problem.until(episode, share));
            let step = made.seq as usize;
            if !output.counts(episode, step, from, until) {
                continue;
            }
            let value = output.values[episode][step];
            let width = entries(output.terms.len());
            for (block, sums) in sums[index].chunks_exact_mut(width).enumerate() {
                Level::widest().run(Accumulate { output, value, message: made.block(block), sums });
            }
        }
    }

    /// −2 log likelihood: with the declared noise, or, where there is none, with the one that suits best.
    pub(super) fn loss(&self, fit: &Fit) -> f64 {
        let outputs = self.problem.outputs.iter().zip(&fit.squares).zip(&fit.samples);
        outputs
            .map(|((output, squares), &samples)| match output.noise {
                Some(noise) => squares / (noise * noise),
                None => samples as f64 * (squares / samples.max(1) as f64).max(f64::MIN_POSITIVE).ln(),
            })
            .sum()
    }
}

/// How many sums an output of so many terms needs: one of squares, or per term a row of the triangle and a right side.
const fn entries(terms: usize) -> usize {
    if terms == 0 { 1 } else { terms * (terms + 1) / 2 + terms }
}

/// Adds what was predicted for one value to the sums of a block.
struct Accumulate<'a, T> {
    output: &'a Compared,
    value: f64,
    message: &'a [T],
    sums: &'a mut [T],
}

impl<T: InMemory> Kernel for Accumulate<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let message = T::registers::<S>(self.message);
        let sums = T::registers_mut::<S>(self.sums);
        let one = T::On::<S>::constant(1.0);
        if self.output.terms.is_empty() {
            let mut error = T::On::<S>::constant(self.value) - self.output.value(message, 0, one);
            if let Some(period) = self.output.wrap {
                error -= (error * (1.0 / period) + 0.5).floor() * period;
            }
            sums[0] += error * error;
            return;
        }
        let mut at = 0;
        for i in 0..self.output.terms.len() {
            let a = self.output.value(message, i, one);
            for j in 0..=i {
                let b = self.output.value(message, j, one);
                sums[at] += a * b;
                at += 1;
            }
            sums[at] += a * self.value;
            at += 1;
        }
    }
}
