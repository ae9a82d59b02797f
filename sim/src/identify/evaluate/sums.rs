//! Sums along a run, which are all that a loss needs: nothing of the predictions is kept.

use parallax_model::Scalar;
use parallax_model::fit::View;
use parallax_model::fit::separable::Sums;
use parallax_model::lanes::{F32x32, F64x16, InMemory, Kernel, Level, Simd};
use rayon::prelude::*;

use super::stretch::{Stretch, Stretches};
use super::{Evaluator, Run};
use crate::batch::{BatchError, Made, Number};
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
    /// The losses at points between 0 and 1, and states at the cuts: −2 log likelihood up to a constant, with the priors, and
    /// with what it costs that pieces do not hold together. Not a number where a prediction is none.
    ///
    /// # Errors
    ///
    /// [`BatchError`] where the points cannot be put into the graph.
    pub fn losses(&self, points: &[Vec<f64>], view: View) -> Result<Vec<f64>, BatchError> {
        self.losses_on::<F64x16>(points, view)
    }

    /// As [`losses`](Self::losses), in single precision: about twice as fast, and right to three or four digits while
    /// predictions do not depend on the last digit of the first state. Enough to rank a population.
    ///
    /// # Errors
    ///
    /// As [`losses`](Self::losses).
    pub fn rough_losses(&self, points: &[Vec<f64>], view: View) -> Result<Vec<f64>, BatchError> {
        self.losses_on::<F32x32>(points, view)
    }

    fn losses_on<T: Number>(&self, points: &[Vec<f64>], view: View) -> Result<Vec<f64>, BatchError> {
        let (fits, gaps) = self.fits::<T>(points, view)?;
        let losses = fits.iter().zip(&gaps).zip(points);
        Ok(losses.map(|((fit, gap), point)| self.loss(fit) + self.prior(point) + gap).collect())
    }

    /// What predictions sum up to at every point, and what the gaps between pieces cost.
    pub(super) fn fits<T: Number>(
        &self,
        points: &[Vec<f64>],
        view: View,
    ) -> Result<(Vec<Fit>, Vec<f64>), BatchError> {
        let problem = self.problem;
        let stretches = self.stretches(view);
        let count = stretches.all.len();
        let runs: Vec<Run> = (0..points.len())
            .flat_map(|point| (0..count).map(move |stretch| Run { point, stretch }))
            .collect();
        let slices: Vec<&[f64]> = points.iter().map(Vec::as_slice).collect();
        let environments = self.environments(&slices, &runs, &stretches)?;
        let start = |members: &[usize]| {
            let blocks = members.len().div_ceil(T::LANES);
            let zero = T::constant(0.0);
            let sums = problem.outputs.iter();
            let sums: Vec<Vec<T>> =
                sums.map(|output| vec![zero; blocks * entries(output.terms.len())]).collect();
            (runs[members[0]].stretch, sums, Vec::new())
        };
        let groups = self.batch.visit::<T, (usize, Vec<Vec<T>>, Vec<T>)>(
            &environments,
            self.together(runs.len(), count, T::LANES),
            start,
            |(stretch, sums, _), made| self.see(&stretches.all[*stretch], sums, made),
            |(_, _, ends), states| {
                ends.extend((0..states.blocks()).flat_map(|block| self.carried.of(states, block)));
            },
        )?;
        // Stretch by stretch, in their order: the same bits however the groups ran.
        let mut of_environment = vec![(0usize, 0usize, 0usize); runs.len()];
        for (group, (members, _)) in groups.iter().enumerate() {
            for (position, &member) in members.iter().enumerate() {
                of_environment[member] = (group, position / T::LANES, position % T::LANES);
            }
        }
        let constants = self.constants(&stretches);
        let found = points.par_iter().enumerate().map(|(point, numbers)| {
            let mut fit = Fit { coefficients: Vec::new(), squares: Vec::new(), samples: Vec::new() };
            for (index, output) in problem.outputs.iter().enumerate() {
                let k = output.terms.len();
                let (samples, square) = constants[index];
                let mut total = Sums::new(k);
                let mut squares = 0.0;
                for stretch in 0..count {
                    let (group, block, lane) = of_environment[point * count + stretch];
                    let sums = &groups[group].1.1[index][block * entries(k)..(block + 1) * entries(k)];
                    if k == 0 {
                        squares += sums[0].get(lane);
                        continue;
                    }
                    let mut at = 0;
                    for i in 0..k {
                        for j in 0..=i {
                            total.gram[i * k + j] += sums[at].get(lane);
                            total.gram[j * k + i] = total.gram[i * k + j];
                            at += 1;
                        }
                        total.right[i] += sums[at].get(lane);
                        at += 1;
                    }
                }
                total.square = square;
                let (mut coefficients, left) =
                    if k == 0 { (Vec::new(), squares) } else { total.solve(T::EPSILON) };
                output.uncentre(&mut coefficients);
                fit.coefficients.push(coefficients);
                fit.squares.push(left);
                fit.samples.push(samples);
            }
            let m = self.carried.len();
            let mut gap = 0.0;
            for (index, stretch) in stretches.all.iter().enumerate() {
                let Some(first) = self.first_of(&stretches, stretch) else { continue };
                let (group, block, lane) = of_environment[point * count + index - 1];
                let ends = &groups[group].1.2[block * m..(block + 1) * m];
                for ((end, scale), z) in ends.iter().zip(&self.carried.scales).zip(&numbers[first..]) {
                    gap += ((end.get(lane) / scale - z) * stretches.tightness).powi(2);
                }
            }
            (fit, gap)
        });
        Ok(found.unzip())
    }

    /// Per output, how many values count and the sum of their squares.
    fn constants(&self, stretches: &Stretches) -> Vec<(usize, f64)> {
        let outputs = self.problem.outputs.iter().enumerate().map(|(index, output)| {
            let (mut samples, mut square) = (0, 0.0);
            for stretch in &stretches.all {
                for value in output.counted(stretch.episode, &stretch.steps[index]) {
                    samples += 1;
                    square += (value - output.centre).powi(2);
                }
            }
            (samples, square)
        });
        outputs.collect()
    }

    /// Adds an output of a group to its sums.
    fn see<T: Number>(&self, stretch: &Stretch, sums: &mut [Vec<T>], made: &Made<'_, T>) {
        let step = made.seq as usize;
        for &index in &self.of_node[made.node] {
            let output = &self.problem.outputs[index];
            if !stretch.steps[index].contains(&step) {
                continue;
            }
            let value = output.values[stretch.episode][step] - output.centre;
            if !value.is_finite() {
                continue;
            }
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
