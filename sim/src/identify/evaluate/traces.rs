//! Predictions with their derivatives by all coordinates: by differences of neighbours on lanes, or exact.

use parallax_model::lanes::F64x16;
use parallax_model::node_model::Directions;
use rayon::prelude::*;

use super::stretch::Stretches;
use super::{Evaluator, Run};
use crate::batch::{BatchError, Made, Slope};

/// How far neighbours are, in widths of the bounds or spreads of a state.
const DIFFERENCE: f64 = 1e-6;
/// Directions that one run differentiates by.
const DIRECTIONS: usize = 8;

/// What one stretch predicts at one point, with derivatives by the numbers that it feels.
pub(super) struct Trace<'g> {
    /// Those numbers, by their places in the point.
    pub(super) columns: Vec<usize>,
    pub(super) outputs: Vec<Predicted<'g>>,
    /// The state with which it ends, in units of its spread, with derivatives `[leaf][column]`; empty where it is not cut.
    pub(super) end: Vec<f64>,
    pub(super) end_slopes: Vec<f64>,
}

/// Predictions of one output over the stretch's steps.
pub(super) struct Predicted<'g> {
    pub(super) width: usize,
    /// `[step][term]`
    pub(super) values: Vec<f64>,
    slopes: Slopes<'g>,
}

/// Derivatives of terms.
enum Slopes<'g> {
    /// Exact ones, `[step][term][column]`.
    Exact(Vec<f64>),
    /// Those that the neighbours in every direction show.
    Near(Vec<Neighbour<'g>>),
}

/// Where the terms of a neighbour are, and one over how far it is.
struct Neighbour<'g> {
    lanes: Lanes<'g>,
    per: f64,
}

/// One environment's terms among those of its group, `[step][block][term]`.
#[derive(Clone, Copy)]
struct Lanes<'g> {
    kept: &'g [F64x16],
    blocks: usize,
    block: usize,
    lane: usize,
}

impl<'g> Lanes<'g> {
    /// The terms of every step.
    fn steps(&self, width: usize) -> impl Iterator<Item = &'g [F64x16]> {
        let first = self.block * width;
        self.kept.chunks_exact(width * self.blocks).map(move |step| &step[first..first + width])
    }
}

impl Predicted<'_> {
    /// The derivatives of the prediction with these coefficients, none for the leaf itself: into `rows` of `width` numbers for
    /// each step, one for each column.
    pub(super) fn derive(&self, coefficients: &[f64], rows: &mut [f64], width: usize) {
        let coefficient = |term: usize| coefficients.get(term).copied().unwrap_or(1.0);
        match &self.slopes {
            Slopes::Exact(slopes) => {
                let columns = slopes.len() / self.values.len().max(1);
                if columns == 0 {
                    return;
                }
                for (row, slopes) in
                    rows.chunks_exact_mut(width).zip(slopes.chunks_exact(self.width * columns))
                {
                    row[..columns].fill(0.0);
                    for (term, slopes) in slopes.chunks_exact(columns).enumerate() {
                        row.iter_mut().zip(slopes).for_each(|(to, slope)| *to += coefficient(term) * slope);
                    }
                }
            }
            Slopes::Near(neighbours) => {
                let weights: Vec<f64> = (0..self.width).map(coefficient).collect();
                for (column, Neighbour { lanes, per }) in neighbours.iter().enumerate() {
                    let here = self.values.chunks_exact(self.width);
                    let steps = rows.chunks_exact_mut(width).zip(here).zip(lanes.steps(self.width));
                    for ((row, here), there) in steps {
                        let mut moved = 0.0;
                        for ((weight, here), there) in weights.iter().zip(here).zip(there) {
                            moved += weight * (there[lanes.lane] - here);
                        }
                        row[column] = moved * per;
                    }
                }
            }
        }
    }
}

/// What a group has made: per output `[step][block][term]`, and states at the cut `[block][leaf]`.
type Kept = (Vec<Vec<F64x16>>, Vec<F64x16>);

impl Evaluator<'_> {
    /// What `see` makes of the predictions of all stretches at every point, with their derivatives by differences.
    pub(super) fn differences<R: Send>(
        &self,
        points: &[Vec<f64>],
        stretches: &Stretches,
        see: impl Fn(&[Trace<'_>], &[f64]) -> R + Sync,
    ) -> Result<Vec<R>, BatchError> {
        let problem = self.problem;
        let count = stretches.all.len();
        let columns: Vec<Vec<usize>> =
            stretches.all.iter().map(|stretch| self.columns(stretches, stretch)).collect();
        // Every point, and its neighbours in every direction.
        let mut near: Vec<Vec<f64>> = Vec::new();
        let mut runs: Vec<Run> = Vec::new();
        let mut first = Vec::with_capacity(points.len() * count);
        for point in points {
            let here = near.len();
            near.push(point.clone());
            near.extend((0..point.len()).map(|i| {
                let mut neighbour = point.clone();
                neighbour[i] += difference(point[i]);
                neighbour
            }));
            for (stretch, columns) in columns.iter().enumerate() {
                first.push(runs.len());
                runs.push(Run { point: here, stretch });
                runs.extend(columns.iter().map(|column| Run { point: here + column + 1, stretch }));
            }
        }
        let slices: Vec<&[f64]> = near.iter().map(Vec::as_slice).collect();
        let environments = self.environments(&slices, &runs, stretches)?;
        let start = |members: &[usize]| {
            let blocks = members.len().div_ceil(F64x16::LANES);
            let stretch = &stretches.all[runs[members[0]].stretch];
            let room =
                problem.outputs.iter().zip(&stretch.steps).map(|(output, steps)| {
                    vec![F64x16::splat(f64::NAN); steps.len() * output.width() * blocks]
                });
            (runs[members[0]].stretch, (room.collect(), Vec::new()))
        };
        let keep = |(stretch, (kept, _)): &mut (usize, Kept), made: &Made<'_, F64x16>| {
            for &index in &self.of_node[made.node] {
                let (output, steps) = (&problem.outputs[index], &stretches.all[*stretch].steps[index]);
                let step = made.seq as usize;
                if !steps.contains(&step) {
                    continue;
                }
                let (width, blocks) = (output.width(), made.blocks());
                let first = (step - steps.start) * width * blocks;
                let room = &mut kept[index][first..first + width * blocks];
                for (block, room) in room.chunks_exact_mut(width).enumerate() {
                    let message = made.block(block);
                    for (k, to) in room.iter_mut().enumerate() {
                        *to = output.value(message, k, F64x16::splat(1.0));
                    }
                }
            }
        };
        let groups = self.batch.visit::<F64x16, (usize, Kept)>(
            &environments,
            self.together(runs.len(), count, F64x16::LANES),
            start,
            keep,
            |(_, (_, ends)), states| {
                ends.extend((0..states.blocks()).flat_map(|block| self.carried.of(states, block)));
            },
        )?;
        let mut of_environment = vec![(0usize, 0usize); runs.len()];
        for (group, (members, _)) in groups.iter().enumerate() {
            for (position, &member) in members.iter().enumerate() {
                of_environment[member] = (group, position);
            }
        }
        let m = self.carried.len();
        let trace = |index: usize, point: &[f64], columns: &Vec<usize>| {
            let at = |neighbour: usize| {
                let (group, position) = of_environment[first[index] + neighbour];
                let (members, (_, kept)) = &groups[group];
                let blocks = members.len().div_ceil(F64x16::LANES);
                (kept, blocks, position / F64x16::LANES, position % F64x16::LANES)
            };
            let w = columns.len();
            let outputs = problem.outputs.iter().enumerate().map(|(output, compared)| {
                let lanes = |neighbour: usize| {
                    let ((kept, _), blocks, block, lane) = at(neighbour);
                    Lanes { kept: &kept[output], blocks, block, lane }
                };
                let width = compared.width();
                let here = lanes(0);
                let values = here.steps(width).flatten().map(|terms| terms[here.lane]).collect();
                let near = columns.iter().enumerate().map(|(j, &place)| Neighbour {
                    lanes: lanes(j + 1),
                    per: 1.0 / difference(point[place]),
                });
                Predicted { width, values, slopes: Slopes::Near(near.collect()) }
            });
            let end_of = |neighbour: usize, leaf: usize| {
                let ((_, ends), _, block, lane) = at(neighbour);
                ends[block * m + leaf][lane] / self.carried.scales[leaf]
            };
            let ((_, ends), ..) = at(0);
            let cut = if ends.is_empty() { 0 } else { m };
            let end: Vec<f64> = (0..cut).map(|leaf| end_of(0, leaf)).collect();
            let mut end_slopes = vec![0.0; cut * w];
            for (j, &place) in columns.iter().enumerate() {
                for leaf in 0..cut {
                    end_slopes[leaf * w + j] = (end_of(j + 1, leaf) - end[leaf]) / difference(point[place]);
                }
            }
            Trace { columns: columns.clone(), outputs: outputs.collect(), end, end_slopes }
        };
        let seen = points.par_iter().enumerate().map(|(index, point)| {
            let of_point = columns.par_iter().enumerate();
            let traces: Vec<Trace<'_>> =
                of_point.map(|(stretch, columns)| trace(index * count + stretch, point, columns)).collect();
            see(&traces, point)
        });
        Ok(seen.collect())
    }

    /// Exact predictions and derivatives of whole recordings, `[point][stretch]`.
    pub(super) fn traces(
        &self,
        points: &[Vec<f64>],
        stretches: &Stretches,
    ) -> Result<Vec<Vec<Trace<'static>>>, BatchError> {
        let problem = self.problem;
        let n = problem.coordinates.len();
        let copies = n.div_ceil(DIRECTIONS).max(1);
        let each = problem.episodes * copies;
        let runs: Vec<Run> = (0..points.len())
            .flat_map(|point| (0..each).map(move |at| Run { point, stretch: at / copies }))
            .collect();
        let slices: Vec<&[f64]> = points.iter().map(Vec::as_slice).collect();
        let mut environments = self.environments(&slices, &runs, stretches)?;
        for (environment, run) in runs.iter().enumerate() {
            let first = environment % copies * DIRECTIONS;
            let mut slopes = Vec::new();
            for (direction, at) in (first..n.min(first + DIRECTIONS)).enumerate() {
                let coordinate = &problem.coordinates[at];
                if self.episodes_of(coordinate).contains(&run.stretch) {
                    let (_, slope) = coordinate.at(points[run.point][at]);
                    let of = |&place| Slope { place, direction, slope };
                    slopes.extend(coordinate.places.iter().map(of));
                }
            }
            environments.incline(environment, slopes);
        }
        let start = |members: &[usize]| {
            let stretch = &stretches.all[runs[members[0]].stretch];
            let room =
                problem.outputs.iter().zip(&stretch.steps).map(|(output, steps)| {
                    vec![Directions::from_value(f64::NAN); steps.len() * output.width()]
                });
            (runs[members[0]].stretch, room.collect())
        };
        let keep = |(stretch, kept): &mut (usize, Vec<Vec<Directions>>), made: &Made<'_, Directions>| {
            for &index in &self.of_node[made.node] {
                let (output, steps) = (&problem.outputs[index], &stretches.all[*stretch].steps[index]);
                let (message, step) = (made.block(0), made.seq as usize);
                if !steps.contains(&step) {
                    continue;
                }
                let (width, at) = (output.width(), step - steps.start);
                for (k, to) in kept[index][at * width..(at + 1) * width].iter_mut().enumerate() {
                    *to = output.value(message, k, Directions::from_value(1.0));
                }
            }
        };
        let groups = self.batch.visit::<Directions, (usize, Vec<Vec<Directions>>)>(
            &environments,
            1,
            start,
            keep,
            |_, _| {},
        )?;
        let mut of_environment: Vec<Option<Vec<Vec<Directions>>>> = vec![None; runs.len()];
        for (members, (_, kept)) in groups {
            of_environment[members[0]] = Some(kept);
        }
        let traces = (0..points.len()).map(|point| {
            let of_episode = (0..problem.episodes).map(|episode| {
                let first = (point * problem.episodes + episode) * copies;
                let parts: Vec<&Vec<Vec<Directions>>> =
                    of_environment[first..first + copies].iter().flatten().collect();
                let outputs = problem.outputs.iter().enumerate().map(|(index, output)| {
                    let count = parts.first().map_or(0, |part| part[index].len());
                    let gradient =
                        |at: usize, j: usize| parts[j / DIRECTIONS][index][at].gradient[j % DIRECTIONS];
                    let slopes =
                        (0..count).flat_map(|at| (0..n).map(move |j| (at, j))).map(|(at, j)| gradient(at, j));
                    Predicted {
                        width: output.width(),
                        slopes: Slopes::Exact(slopes.collect()),
                        values: (0..count).map(|at| parts[0][index][at].value).collect(),
                    }
                });
                let outputs = outputs.collect();
                Trace { columns: (0..n).collect(), outputs, end: Vec::new(), end_slopes: Vec::new() }
            });
            of_episode.collect()
        });
        Ok(traces.collect())
    }
}

/// How far the neighbour of a number is: away from the nearer bound.
fn difference(z: f64) -> f64 {
    if z > 0.5 { -DIFFERENCE } else { DIFFERENCE }
}
