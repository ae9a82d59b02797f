//! Losses and derivatives of many points at once, by replaying the recorded actions through the computation graph.

mod model;
mod moved;
mod scatter;
mod stretch;
mod sums;
mod traces;
mod track;

use std::ops::Range;

use parallax_model::fit::View;

use super::coordinate::Coordinate;
use super::error::IdentifyError;
use super::problem::{Compared, Problem};
use crate::batch::{Batch, BatchError, Environments, Given, Made, Passes, Place};

pub(super) use model::Model;
pub(super) use scatter::Scattered;
use stretch::{Carried, Stretches, settles};
pub(super) use sums::Fit;

/// Blocks of lanes that run together at most: enough that looking into the tables costs little, few enough to stay in the
/// first cache.
const BLOCKS: usize = 4;

/// Replays recorded actions at any point of a [`Problem`].
pub struct Evaluator<'p> {
    problem: &'p Problem,
    batch: Batch<'p>,
    /// The outputs of each node.
    of_node: Vec<Vec<usize>>,
    /// What a piece begins with.
    carried: Carried,
}

/// One stretch at one point.
#[derive(Debug, Clone, Copy)]
struct Run {
    /// Its place among the points.
    point: usize,
    /// Its place among the stretches.
    stretch: usize,
}

impl std::fmt::Debug for Evaluator<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Evaluator").field("batch", &self.batch).finish_non_exhaustive()
    }
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
        let carried = Carried { places: Vec::new(), scales: Vec::new(), settles: None };
        let mut evaluator = Self { problem, batch, of_node, carried };
        evaluator.carried = evaluator.carries()?;
        Ok(evaluator)
    }

    /// What a piece begins with. Spreads are those of the run from the start values: any of the right size will do. Whatever
    /// is missing to run the graph shows here, not in the middle of a search.
    fn carries(&self) -> Result<Carried, BatchError> {
        /// At so many moments states are looked at.
        const MOMENTS: usize = 8;
        let problem = self.problem;
        let places: Vec<Place> = self.batch.states().collect();
        let carriers: Vec<usize> = places
            .iter()
            .filter_map(|place| match place {
                Place::State { node, .. } => Some(*node),
                _ => None,
            })
            .collect();
        let start = problem.start();
        let stretches = self.stretches(View::whole(1.0));
        let runs: Vec<Run> =
            (0..problem.episodes * MOMENTS).map(|index| Run { point: 0, stretch: index / MOMENTS }).collect();
        let mut environments = self.environments(&[&start], &runs, &stretches)?;
        let passes = (0..runs.len()).map(|index| {
            let cut = stretches.all[index / MOMENTS].passes.end * (index % MOMENTS + 1) / MOMENTS;
            Passes { first: 0, cut, end: cut + 1 }
        });
        environments.set_passes(passes.collect())?;
        let groups = self.batch.visit::<f64, Vec<f64>>(
            &environments,
            1,
            |_| Vec::new(),
            |_, _| {},
            |kept, states| {
                for place in &places {
                    if let Place::State { node, leaf } = *place {
                        kept.push(states.block(node, 0)[leaf]);
                    }
                }
            },
        )?;
        let scales = (0..places.len()).map(|leaf| {
            let values: Vec<f64> = groups.iter().filter_map(|(_, kept)| kept.get(leaf).copied()).collect();
            let n = values.len().max(1) as f64;
            let mean = values.iter().sum::<f64>() / n;
            let spread = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / n).sqrt();
            // What does not move has a spread of its own size.
            if spread > 1e-6 * mean.abs() && spread.is_finite() { spread } else { mean.abs().max(1.0) }
        });
        let scales = scales.collect();
        Ok(Carried { scales, settles: settles(problem, &carriers), places })
    }

    /// One environment for each run.
    fn environments(
        &self,
        points: &[&[f64]],
        runs: &[Run],
        stretches: &Stretches,
    ) -> Result<Environments<'_>, BatchError> {
        let problem = self.problem;
        let number = |(coordinate, z): (&Coordinate, &f64)| coordinate.put(*z);
        let numbers: Vec<Vec<f64>> =
            points.iter().map(|point| problem.coordinates.iter().zip(*point).map(number).collect()).collect();
        let mut environments = self.batch.environments(runs.len());
        environments.quiet();
        let stretch_of = |run: &Run| &stretches.all[run.stretch];
        let episodes: Vec<u32> = runs.iter().map(|run| stretch_of(run).episode as u32).collect();
        environments.set_episodes(&episodes)?;
        environments.set_passes(runs.iter().map(|run| stretch_of(run).passes).collect())?;
        for recorded in &problem.given {
            let given = Given::PerEpisode { steps: recorded.steps, values: &recorded.values };
            environments.give(&recorded.node, given)?;
        }
        for (environment, run) in runs.iter().enumerate() {
            let stretch = stretch_of(run);
            for (coordinate, value) in problem.coordinates.iter().zip(&numbers[run.point]) {
                if coordinate.recording.is_some_and(|recording| recording != stretch.episode) {
                    continue;
                }
                for place in &coordinate.places {
                    environments.put(environment, *place, *value);
                }
            }
            let Some(first) = self.first_of(stretches, stretch) else { continue };
            let states = self.carried.places.iter().zip(&self.carried.scales);
            for ((place, scale), z) in states.zip(&points[run.point][first..]) {
                environments.put(environment, *place, z * scale);
            }
        }
        Ok(environments)
    }

    /// How many environments run together, so that the cores have equal shares of what a stretch has. Nothing found depends
    /// on it.
    fn together(&self, environments: usize, stretches: usize, lanes: usize) -> usize {
        let of_stretch = environments.div_ceil(stretches.max(1));
        let groups = of_stretch.div_ceil(lanes * BLOCKS).max(1);
        let threads = rayon::current_num_threads().max(1);
        let fair = (groups * stretches).next_multiple_of(threads).div_ceil(stretches.max(1));
        of_stretch.div_ceil(fair.max(groups)).next_multiple_of(lanes)
    }

    fn episodes_of(&self, coordinate: &Coordinate) -> Range<usize> {
        match coordinate.recording {
            Some(recording) => recording..recording + 1,
            None => 0..self.problem.episodes,
        }
    }

    fn prior(&self, point: &[f64]) -> f64 {
        let priors = self.problem.coordinates.iter().zip(point);
        priors.filter_map(|(c, z)| c.prior_of_place().map(|(mean, std)| ((z - mean) / std).powi(2))).sum()
    }

    /// Predictions of every output over the whole recordings, `[output][episode][step]`, with these coefficients.
    pub(super) fn predict(
        &self,
        point: &[f64],
        coefficients: &[Vec<f64>],
    ) -> Result<Vec<Vec<Vec<f64>>>, BatchError> {
        let problem = self.problem;
        let runs: Vec<Run> = (0..problem.episodes).map(|stretch| Run { point: 0, stretch }).collect();
        let mut environments = self.environments(&[point], &runs, &self.stretches(View::whole(1.0)))?;
        environments.set_passes(vec![Passes::until(usize::MAX); problem.episodes])?;
        let start = |members: &[usize]| {
            let episode = members[0] % problem.episodes;
            problem.outputs.iter().map(|o| vec![f64::NAN; o.values[episode].len()]).collect::<Vec<_>>()
        };
        let keep = |kept: &mut Vec<Vec<f64>>, made: &Made<'_, f64>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let message = made.block(0);
                let Some(to) = kept[index].get_mut(made.seq as usize) else { continue };
                let values = (0..output.width()).map(|k| output.value(message, k, 1.0));
                *to = match coefficients[index].as_slice() {
                    [] => values.sum(),
                    coefficients => values.zip(coefficients).map(|(value, c)| c * value).sum(),
                };
            }
        };
        let groups = self.batch.visit::<f64, _>(&environments, 1, start, keep, |_, _| {})?;
        let mut found = vec![vec![Vec::new(); problem.episodes]; problem.outputs.len()];
        for (members, kept) in groups {
            for (index, values) in kept.into_iter().enumerate() {
                found[index][members[0] % problem.episodes] = values;
            }
        }
        Ok(found)
    }
}

impl Compared {
    /// How many values of a message make up a prediction.
    fn width(&self) -> usize {
        self.terms.len().max(1)
    }

    /// Gives the constant among the coefficients what was taken off the recorded values.
    fn uncentre(&self, coefficients: &mut [f64]) {
        if let Some(constant) = self.terms.iter().position(Option::is_none) {
            coefficients[constant] += self.centre;
        }
    }

    /// Value `k` of a message's prediction: the leaf itself, or what a linear coefficient multiplies.
    #[inline(always)]
    fn value<T: Copy>(&self, message: &[T], k: usize, one: T) -> T {
        match self.terms.get(k) {
            None => message[self.leaf],
            Some(term) => term.map_or(one, |leaf| message[leaf]),
        }
    }
}

/// `difference` brought within half a period of zero.
pub(super) fn wrapped(difference: f64, period: Option<f64>) -> f64 {
    match period {
        Some(period) => difference - period * (difference / period + 0.5).floor(),
        None => difference,
    }
}
