//! What predictions do where a delay that scatters is another one, and what every message says of it.

use parallax_model::fit::View;

use super::stretch::Stretches;
use super::traces::Trace;
use super::{Evaluator, wrapped};
use crate::batch::BatchError;
use crate::identify::humps::Reading;

/// How far the delay is moved at least for its derivatives, s: less would show how a simulation goes from tick to tick.
const MOVED: f64 = 2e-3;
/// How far it is moved, in units of its spread: the outer nodes of Gauss and Hermite's quadrature with three, under which
/// a normal distribution's moments are right up to the fifth.
const NODES: f64 = 1.732_050_807_568_877_2;

/// What is known of variances.
#[derive(Debug, Clone)]
pub(super) struct Variances {
    /// Per delay that scatters, s².
    pub(super) delays: Vec<f64>,
    /// Per output.
    pub(super) noise: Vec<f64>,
}

impl Variances {
    /// The largest share by which one differs from that of another time.
    pub(super) fn differ(&self, other: &Variances) -> f64 {
        let pairs = self.delays.iter().zip(&other.delays).chain(self.noise.iter().zip(&other.noise));
        pairs.map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max)
    }
}

/// What predictions do where a delay that scatters is another one, `[episode][output]`: lists of terms, as in a trace.
pub(super) struct Moved {
    /// By a second of the delay.
    pub(super) slopes: Vec<Vec<Vec<f64>>>,
    /// By its square.
    pub(super) bends: Vec<Vec<Vec<f64>>>,
}

/// One message's outputs: which, and where in their lists.
pub(super) struct Message<'p> {
    pub(super) outputs: &'p [usize],
    pub(super) episode: usize,
    pub(super) step: usize,
}

impl Evaluator<'_> {
    /// Predictions of the mean at one point, and what they do where a delay that scatters is another one.
    pub(super) fn around(
        &self,
        point: &[f64],
        variances: &Variances,
        stretches: &Stretches,
    ) -> Result<(Vec<Trace<'static>>, Vec<Moved>), BatchError> {
        let problem = self.problem;
        // The point itself, and for each delay three points in a row.
        let mut points = vec![point.to_vec()];
        let mut steps = Vec::new();
        for (&delay, variance) in problem.scattered.iter().zip(&variances.delays) {
            let coordinate = &problem.coordinates[delay];
            let width = coordinate.high - coordinate.low;
            let h = ((NODES * variance.sqrt()).max(MOVED) / width).min(0.5);
            let middle = point[delay].clamp(h, 1.0 - h);
            for by in [-h, 0.0, h] {
                let mut moved = point.to_vec();
                moved[delay] = middle + by;
                points.push(moved);
            }
            steps.push(h * width);
        }
        let mut traces = self.traces(&points, stretches)?;
        let others = traces.split_off(1);
        let mut traces = traces.pop().unwrap_or_default();
        let moved: Vec<Moved> =
            steps.iter().zip(others.chunks(3)).map(|(h, three)| moved(three, *h)).collect();
        // E y: half the variance times the second derivative is added to every term.
        for (moved, variance) in moved.iter().zip(&variances.delays) {
            for (trace, bends) in traces.iter_mut().zip(&moved.bends) {
                for (output, bends) in trace.outputs.iter_mut().zip(bends) {
                    output
                        .values
                        .iter_mut()
                        .zip(bends)
                        .for_each(|(value, bend)| *value += 0.5 * variance * bend);
                }
            }
        }
        Ok((traces, moved))
    }

    /// What every message says of the first delay that scatters.
    pub(super) fn readings(
        &self,
        point: &[f64],
        variances: &Variances,
        coefficients: &[Vec<f64>],
    ) -> Result<Vec<Reading>, BatchError> {
        let stretches = self.stretches(View::whole(1.0));
        let (traces, moved) = self.around(point, variances, &stretches)?;
        let (Some(moved), Some(variance)) = (moved.first(), variances.delays.first()) else {
            return Ok(Vec::new());
        };
        let of = |Message { outputs, episode, step }: Message<'_>| {
            let said = outputs.iter().filter_map(|&index| {
                let output = &self.problem.outputs[index];
                let recorded = output.values[episode][step];
                let at = step - stretches.all[episode].steps[index].start;
                let own = &coefficients[index];
                let mean = combined(&traces[episode].outputs[index].values, own, at);
                let slope = combined(&moved.slopes[episode][index], own, at);
                let bend = combined(&moved.bends[episode][index], own, at);
                // From the prediction at the mean delay on, which the mean of predictions is not.
                let residual = wrapped(recorded - mean, output.wrap) + 0.5 * variance * bend;
                recorded.is_finite().then_some([residual, slope, bend, variances.noise[index].sqrt()])
            });
            Reading(said.collect())
        };
        Ok(self.messages(&stretches).map(of).filter(|reading| !reading.0.is_empty()).collect())
    }

    /// The messages that are compared, each with all its outputs.
    pub(super) fn messages<'s>(&'s self, stretches: &'s Stretches) -> impl Iterator<Item = Message<'s>> {
        let nodes = self.of_node.iter().filter(|outputs| !outputs.is_empty());
        nodes.flat_map(move |outputs| {
            stretches.all.iter().flat_map(move |stretch| {
                let steps = stretch.steps[outputs[0]].clone();
                steps.map(move |step| Message { outputs, episode: stretch.episode, step })
            })
        })
    }
}

/// Number `at` of a list of terms, summed with these coefficients; without any, of the leaf itself.
pub(super) fn combined(terms: &[f64], coefficients: &[f64], at: usize) -> f64 {
    match coefficients {
        [] => terms[at],
        own => terms[at * own.len()..].iter().zip(own).map(|(term, c)| term * c).sum(),
    }
}

/// Slopes and second derivatives of predictions by a delay, from those with one that is by `h` s shorter, the same, and
/// longer.
fn moved(three: &[Vec<Trace<'_>>], h: f64) -> Moved {
    let each = |of: &dyn Fn(f64, f64, f64) -> f64| {
        let episodes = three[1].iter().enumerate().map(|(episode, middle)| {
            let outputs = middle.outputs.iter().enumerate().map(|(index, middle)| {
                let [low, high] = [0, 2].map(|k| &three[k][episode].outputs[index].values);
                low.iter().zip(&middle.values).zip(high).map(|((a, b), c)| of(*a, *b, *c)).collect()
            });
            outputs.collect()
        });
        episodes.collect()
    };
    Moved {
        slopes: each(&|low, _, high| (high - low) / (2.0 * h)),
        bends: each(&|low, middle, high| (low - 2.0 * middle + high) / (h * h)),
    }
}
