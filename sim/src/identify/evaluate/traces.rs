//! Predictions with their derivatives by all coordinates: by differences of neighbours on lanes, or exact.

use parallax_model::lanes::F64x16;
use parallax_model::node_model::Directions;
use rayon::prelude::*;

use super::{Evaluator, TOGETHER};
use crate::batch::{BatchError, Made, Slope};

/// How far neighbours are, in widths of the bounds.
const DIFFERENCE: f64 = 1e-6;
/// Directions that one run differentiates by.
const DIRECTIONS: usize = 8;

/// Predictions of one output: `[episode][step][term]`, with derivatives by all coordinates.
pub(super) struct Trace {
    pub(super) width: usize,
    pub(super) values: Vec<Vec<f64>>,
    /// `[episode][step][term][coordinate]`
    pub(super) slopes: Vec<Vec<f64>>,
}

impl Evaluator<'_> {
    /// Predictions of all outputs with their derivatives by differences, at every point.
    pub(super) fn differences(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Vec<Trace>>, BatchError> {
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
                let count = output.values[episode].len() * output.width();
                vec![F64x16::splat(f64::NAN); count * blocks]
            });
            room.collect::<Vec<Vec<F64x16>>>()
        };
        let keep = |kept: &mut Vec<Vec<F64x16>>, made: &Made<'_, F64x16>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let (width, blocks) = (output.width(), made.blocks());
                let first = made.seq as usize * width * blocks;
                let Some(room) = kept[index].get_mut(first..first + width * blocks) else { continue };
                for (block, room) in room.chunks_exact_mut(width).enumerate() {
                    let message = made.block(block);
                    for (k, to) in room.iter_mut().enumerate() {
                        *to = output.value(message, k, F64x16::splat(1.0));
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
                let width = compared.width();
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

    /// Predictions of all outputs with their derivatives, at every point.
    pub(super) fn traces(&self, points: &[Vec<f64>], share: f64) -> Result<Vec<Vec<Trace>>, BatchError> {
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
                let count = output.values[episode].len() * output.width();
                vec![Directions::from_value(f64::NAN); count]
            });
            room.collect::<Vec<Vec<Directions>>>()
        };
        let keep = |kept: &mut Vec<Vec<Directions>>, made: &Made<'_, Directions>| {
            for &index in &self.of_node[made.node] {
                let output = &problem.outputs[index];
                let (message, step) = (made.block(0), made.seq as usize);
                let width = output.width();
                let Some(room) = kept[index].get_mut(step * width..(step + 1) * width) else { continue };
                for (k, to) in room.iter_mut().enumerate() {
                    *to = output.value(message, k, Directions::from_value(1.0));
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
                let width = output.width();
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
}
