//! Losses and derivatives of many points at once, by replaying the recorded actions through the computation graph.

mod model;
mod sums;
mod traces;

use std::ops::Range;

use parallax_model::lanes::F64x16;

use super::coordinate::Coordinate;
use super::error::IdentifyError;
use super::problem::{Compared, Problem};
use crate::batch::{Batch, BatchError, Environments, Given, Made};

pub(super) use sums::Fit;

/// Points that run together: a few blocks of lanes, so that both the lanes and the cores are filled.
const TOGETHER: usize = 2 * F64x16::LANES;

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

    fn episodes_of(&self, coordinate: &Coordinate) -> Range<usize> {
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
                let values = (0..output.width()).map(|k| output.value(message, k, 1.0));
                *to = match coefficients[index].as_slice() {
                    [] => values.sum(),
                    coefficients => values.zip(coefficients).map(|(value, c)| c * value).sum(),
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

impl Compared {
    /// How many values of a message make up a prediction.
    fn width(&self) -> usize {
        self.terms.len().max(1)
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
