//! Losses and derivatives of many points at once, by replaying the recorded actions through the computation graph.

use parallax_model::fit::Local;
use parallax_model::fit::separable::{Sums, eliminate};
use parallax_model::lanes::{F64x16, InMemory, Kernel, Level, Simd};
use parallax_model::node_model::Directions;
use parallax_model::{Dual, Scalar};
use rayon::prelude::*;

use super::coordinate::Coordinate;
use super::error::IdentifyError;
use super::problem::{Compared, Problem};
use crate::batch::{Batch, BatchError, Environments, Given, Made, Slope};

/// Points that run together: a few blocks of lanes, so that both the lanes and the cores are filled.
const TOGETHER: usize = 2 * F64x16::LANES;
/// How far neighbours are, in widths of the bounds.
const DIFFERENCE: f64 = 1e-6;
/// Directions that one run differentiates by.
const DIRECTIONS: usize = 8;

/// Replays recorded actions at any point of a [`Problem`].
pub struct Evaluator<'p> {
    problem: &'p Problem,
    batch: Batch<'p>,
    /// The outputs of each node.
    of_node: Vec<Vec<usize>>,
}

impl std::fmt::Debug for Evaluator<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Evaluator").field("batch", &self.batch).finish_non_exhaustive()
    }
}

/// What predictions sum up to at one point: per output, over all recordings.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    /// Coefficients of the linear terms.
    pub(super) coefficients: Vec<Vec<f64>>,
    /// Sum of squared residuals.
    pub(super) squares: Vec<f64>,
    /// Values that count.
    pub(super) samples: Vec<usize>,
}

/// Predictions of one output: `[episode][step][term]`, with derivatives by all coordinates.
struct Trace {
    width: usize,
    values: Vec<Vec<f64>>,
    /// `[episode][step][term][coordinate]`
    slopes: Vec<Vec<f64>>,
}

impl<'p> Evaluator<'p> {
    /// An evaluator of this problem.
    ///
    /// # Errors
    ///
    /// [`IdentifyError::Batch`] where a node cannot be computed, for instance because it is plain Rust.
    pub fn new(problem: &'p Problem) -> Result<Self, IdentifyError> {
        let batch = Batch::new(&problem.graph, &problem.compiled, 0)?;
        let outputs_of = |node| {
            let outputs = problem.outputs.iter().enumerate();
            outputs.filter(|(_, output)| output.node == node).map(|(index, _)| index).collect()
        };
        let of_node = (0..problem.graph.nodes().len()).map(outputs_of).collect();
        let evaluator = Self { problem, batch, of_node };
        // Whatever is missing shows now, not in the middle of a search.
        evaluator.environments(&[problem.start()])?;
        Ok(evaluator)
    }

    /// One environment for each point and recording.
    fn environments(&self, points: &[Vec<f64>]) -> Result<Environments<'_>, BatchError> {
        self.repeated(points, 1)
    }

    fn repeated(&self, points: &[Vec<f64>], copies: usize) -> Result<Environments<'_>, BatchError> {
        let problem = self.problem;
        let each = problem.episodes * copies;
        let mut environments = self.batch.environments(points.len() * each);
        environments.quiet();
        let episodes: Vec<u32> =
            (0..points.len() * each).map(|index| (index % each / copies) as u32).collect();
        environments.set_episodes(&episodes)?;
        for recorded in &problem.given {
            let given = Given::PerEpisode { steps: recorded.steps, values: &recorded.values };
            environments.give(&recorded.node, given)?;
        }
        for (index, point) in points.iter().enumerate() {
            for (coordinate, z) in problem.coordinates.iter().zip(point) {
                let (value, _) = coordinate.at(*z);
                for episode in self.episodes_of(coordinate) {
                    for copy in 0..copies {
                        let environment = (index * problem.episodes + episode) * copies + copy;
                        for place in &coordinate.places {
                            environments.put(environment, *place, value);
                        }
                    }
                }
            }
        }
        Ok(environments)
    }

    fn episodes_of(&self, coordinate: &Coordinate) -> std::ops::Range<usize> {
        match coordinate.recording {
            Some(recording) => recording..recording + 1,
            None => 0..self.problem.episodes,
        }
    }

    /// In how many passes all that counts happens.
    fn passes(&self, share: f64) -> usize {
        let of = |episode| self.batch.pass_at(episode, self.problem.until(episode, share));
        // The pass in which a step of that time runs is the one after.
        (0..self.problem.episodes).map(of).max().map_or(0, |passes| passes + 1)
    }

    /// The losses at points between 0 and 1: −2 log likelihood up to a constant, with the priors. `share` of the fitted time
    /// counts. Not a number where a prediction is none.
    pub fn losses(&self, points: &[Vec<f64>], share: f64) -> Vec<f64> {
        match self.fits(points, share) {
            Ok(fits) => {
                fits.iter().zip(points).map(|(fit, point)| self.loss(fit) + self.prior(point)).collect()
            }
            Err(_) => vec![f64::NAN; points.len()],
        }
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
    fn loss(&self, fit: &Fit) -> f64 {
        let outputs = self.problem.outputs.iter().zip(&fit.squares).zip(&fit.samples);
        outputs
            .map(|((output, squares), &samples)| match output.noise {
                Some(noise) => squares / (noise * noise),
                None => samples as f64 * (squares / samples.max(1) as f64).max(f64::MIN_POSITIVE).ln(),
            })
            .sum()
    }

    fn prior(&self, point: &[f64]) -> f64 {
        let priors = self.problem.coordinates.iter().zip(point);
        priors.filter_map(|(c, z)| c.prior_of_place().map(|(mean, std)| ((z - mean) / std).powi(2))).sum()
    }

    /// The losses with their Gauss–Newton models, linear coefficients eliminated, by exact derivatives.
    pub fn exact_locals(&self, points: &[Vec<f64>], share: f64) -> Vec<Local> {
        self.eliminated(&self.models(points, share))
    }

    /// As [`exact_locals`](Self::exact_locals), by differences: a point and its neighbours run on lanes together, for a
    /// tenth of the time. The derivatives are right to about five digits, which a search does not feel.
    pub fn locals(&self, points: &[Vec<f64>], share: f64) -> Vec<Local> {
        let Ok(traces) = self.differences(points, share) else { return Vec::new() };
        let models: Vec<(Local, Fit)> = traces
            .into_par_iter()
            .zip(points)
            .map(|(traces, point)| self.model(&traces, point, share))
            .collect();
        self.eliminated(&models)
    }

    fn eliminated(&self, models: &[(Local, Fit)]) -> Vec<Local> {
        let linear: usize = self.problem.outputs.iter().map(|output| output.terms.len()).sum();
        models.iter().map(|(local, _)| eliminate(local, linear)).collect()
    }

    /// Predictions of all outputs with their derivatives by differences, at every point.
    fn differences(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Vec<Trace>>, BatchError> {
        let problem = self.problem;
        let n = problem.coordinates.len();
        let mut neighbours = Vec::with_capacity(points.len() * (n + 1));
        for point in points {
            neighbours.push(point.clone());
            for (i, z) in point.iter().enumerate() {
                let mut neighbour = point.clone();
                // Away from the nearer bound.
                neighbour[i] = if *z > 0.5 { z - DIFFERENCE } else { z + DIFFERENCE };
                neighbours.push(neighbour);
            }
        }
        let environments = self.environments(&neighbours)?;
        let start = |members: &[usize]| {
            let blocks = members.len().div_ceil(F64x16::LANES);
            let episode = members[0] % problem.episodes;
            let room = problem.outputs.iter().map(|output| {
                let count = output.values[episode].len() * output.terms.len().max(1);
                vec![F64x16::splat(f64::NAN); count * blocks]
            });
            room.collect::<Vec<Vec<F64x16>>>()
        };
        let keep = |kept: &mut Vec<Vec<F64x16>>, made: &Made<'_, F64x16>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let width = output.terms.len().max(1);
                let blocks = made.blocks();
                let first = made.seq as usize * width * blocks;
                let Some(room) = kept[index].get_mut(first..first + width * blocks) else { continue };
                for (block, room) in room.chunks_exact_mut(width).enumerate() {
                    let message = made.block(block);
                    match output.terms.as_slice() {
                        [] => room[0] = message[output.leaf],
                        terms => {
                            for (to, term) in room.iter_mut().zip(terms) {
                                *to = term.map_or(F64x16::splat(1.0), |leaf| message[leaf]);
                            }
                        }
                    }
                }
            }
        };
        let groups = self.batch.visit(&environments, (TOGETHER, self.passes(share)), start, keep)?;
        let mut of_environment = vec![(0usize, 0usize); environments.len()];
        for (group, (members, _)) in groups.iter().enumerate() {
            for (position, &member) in members.iter().enumerate() {
                of_environment[member] = (group, position);
            }
        }
        let at = |neighbour: usize, episode: usize| of_environment[neighbour * problem.episodes + episode];
        let traces = points.par_iter().enumerate().map(|(index, point)| {
            let first = index * (n + 1);
            let outputs = problem.outputs.iter().enumerate().map(|(output, compared)| {
                let width = compared.terms.len().max(1);
                let mut trace = Trace { width, values: Vec::new(), slopes: Vec::new() };
                for episode in 0..problem.episodes {
                    let count = compared.values[episode].len() * width;
                    let column = |neighbour: usize| {
                        let (group, position) = at(first + neighbour, episode);
                        let (members, kept) = &groups[group];
                        let blocks = members.len().div_ceil(F64x16::LANES);
                        let (block, lane) = (position / F64x16::LANES, position % F64x16::LANES);
                        let kept = &kept[output];
                        move |k: usize| {
                            let (step, term) = (k / width, k % width);
                            kept[step * width * blocks + block * width + term][lane]
                        }
                    };
                    let here = column(0);
                    let values: Vec<f64> = (0..count).map(here).collect();
                    let mut slopes = vec![0.0; count * n];
                    for (j, z) in point.iter().enumerate() {
                        let there = column(j + 1);
                        let per = if *z > 0.5 { -1.0 / DIFFERENCE } else { 1.0 / DIFFERENCE };
                        for (k, value) in values.iter().enumerate() {
                            slopes[k * n + j] = (there(k) - value) * per;
                        }
                    }
                    trace.values.push(values);
                    trace.slopes.push(slopes);
                }
                trace
            });
            outputs.collect()
        });
        Ok(traces.collect())
    }

    /// The losses with their Gauss–Newton models by coordinates and then linear coefficients, and the fits.
    pub(super) fn models(&self, points: &[Vec<f64>], share: f64) -> Vec<(Local, Fit)> {
        let Ok(traces) = self.traces(points, share) else { return Vec::new() };
        traces.into_par_iter().zip(points).map(|(traces, point)| self.model(&traces, point, share)).collect()
    }

    /// Predictions of all outputs with their derivatives, at every point.
    fn traces(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Vec<Trace>>, BatchError> {
        let problem = self.problem;
        let n = problem.coordinates.len();
        let copies = n.div_ceil(DIRECTIONS).max(1);
        let mut environments = self.repeated(points, copies)?;
        for (index, point) in points.iter().enumerate() {
            for episode in 0..problem.episodes {
                for copy in 0..copies {
                    let first = copy * DIRECTIONS;
                    let mut slopes = Vec::new();
                    for (direction, at) in (first..n.min(first + DIRECTIONS)).enumerate() {
                        let coordinate = &problem.coordinates[at];
                        if self.episodes_of(coordinate).contains(&episode) {
                            let (_, slope) = coordinate.at(point[at]);
                            let of = |&place| Slope { place, direction, slope };
                            slopes.extend(coordinate.places.iter().map(of));
                        }
                    }
                    environments.incline((index * problem.episodes + episode) * copies + copy, slopes);
                }
            }
        }
        let start = |members: &[usize]| {
            let episode = members[0] / copies % problem.episodes;
            let room = problem.outputs.iter().map(|output| {
                let count = output.values[episode].len() * output.terms.len().max(1);
                vec![Directions::from_value(f64::NAN); count]
            });
            room.collect::<Vec<Vec<Directions>>>()
        };
        let keep = |kept: &mut Vec<Vec<Directions>>, made: &Made<'_, Directions>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let (message, step) = (made.block(0), made.seq as usize);
                let width = output.terms.len().max(1);
                let Some(room) = kept[index].get_mut(step * width..(step + 1) * width) else { continue };
                match output.terms.as_slice() {
                    [] => room[0] = message[output.leaf],
                    terms => {
                        for (to, term) in room.iter_mut().zip(terms) {
                            *to = term.map_or(Dual::constant(1.0), |leaf| message[leaf]);
                        }
                    }
                }
            }
        };
        let groups =
            self.batch.visit::<Directions, _>(&environments, (1, self.passes(share)), start, keep)?;
        let mut of_environment: Vec<Option<Vec<Vec<Directions>>>> = vec![None; environments.len()];
        for (members, kept) in groups {
            of_environment[members[0]] = Some(kept);
        }
        let traces = (0..points.len()).map(|point| {
            let outputs = problem.outputs.iter().enumerate().map(|(index, output)| {
                let width = output.terms.len().max(1);
                let mut trace = Trace { width, values: Vec::new(), slopes: Vec::new() };
                for episode in 0..problem.episodes {
                    let first = (point * problem.episodes + episode) * copies;
                    let parts: Vec<&Vec<Directions>> = of_environment[first..first + copies]
                        .iter()
                        .filter_map(|kept| kept.as_ref().map(|kept| &kept[index]))
                        .collect();
                    let count = parts.first().map_or(0, |part| part.len());
                    let mut slopes = Vec::with_capacity(count * n);
                    let gradient = |at: usize, j: usize| parts[j / DIRECTIONS][at].gradient[j % DIRECTIONS];
                    slopes.extend(
                        (0..count).flat_map(|at| (0..n).map(move |j| (at, j))).map(|(at, j)| gradient(at, j)),
                    );
                    trace.values.push((0..count).map(|at| parts[0][at].value).collect());
                    trace.slopes.push(slopes);
                }
                trace
            });
            outputs.collect()
        });
        Ok(traces.collect())
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

    /// Predictions of every output over the whole recordings, `[output][episode][step]`, with these coefficients.
    pub(super) fn predict(
        &self,
        point: &[f64],
        coefficients: &[Vec<f64>],
    ) -> Result<Vec<Vec<Vec<f64>>>, BatchError> {
        let problem = self.problem;
        let environments = self.environments(std::slice::from_ref(&point.to_vec()))?;
        let start = |members: &[usize]| {
            let episode = members[0] % problem.episodes;
            problem.outputs.iter().map(|o| vec![f64::NAN; o.values[episode].len()]).collect::<Vec<_>>()
        };
        let keep = |kept: &mut Vec<Vec<f64>>, made: &Made<'_, f64>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let message = made.block(0);
                let Some(to) = kept[index].get_mut(made.seq as usize) else { continue };
                *to = match output.terms.as_slice() {
                    [] => message[output.leaf],
                    terms => {
                        let terms = terms.iter().zip(&coefficients[index]);
                        terms.map(|(term, c)| c * term.map_or(1.0, |leaf| message[leaf])).sum()
                    }
                };
            }
        };
        let groups = self.batch.visit::<f64, _>(&environments, (1, usize::MAX), start, keep)?;
        let mut found = vec![vec![Vec::new(); problem.episodes]; problem.outputs.len()];
        for (members, kept) in groups {
            for (index, values) in kept.into_iter().enumerate() {
                found[index][members[0] % problem.episodes] = values;
            }
        }
        Ok(found)
    }
}

/// How many sums an output of so many terms needs: one of squares, or per term a row of the triangle and a right side.
const fn entries(terms: usize) -> usize {
    if terms == 0 { 1 } else { terms * (terms + 1) / 2 + terms }
}

/// `difference` brought within half a period of zero.
pub(super) fn wrapped(difference: f64, period: Option<f64>) -> f64 {
    match period {
        Some(period) => difference - period * (difference / period + 0.5).floor(),
        None => difference,
    }
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
        let terms = &self.output.terms;
        if terms.is_empty() {
            let mut error = T::On::<S>::constant(self.value) - message[self.output.leaf];
            if let Some(period) = self.output.wrap {
                error -= (error * (1.0 / period) + 0.5).floor() * period;
            }
            sums[0] += error * error;
            return;
        }
        let one = T::On::<S>::constant(1.0);
        let mut at = 0;
        for (i, term) in terms.iter().enumerate() {
            let a = term.map_or(one, |leaf| message[leaf]);
            for other in &terms[..=i] {
                let b = other.map_or(one, |leaf| message[leaf]);
                sums[at] += a * b;
                at += 1;
            }
            sums[at] += a * self.value;
            at += 1;
        }
    }
}
