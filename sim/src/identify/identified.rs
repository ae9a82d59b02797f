//! The result of an identification, as it is reported and written down.

use parallax_model::fit::Stop;
use serde::{Deserialize, Serialize};

use super::combination::Combination;
use super::coordinate::Sort;
use super::error::IdentifyError;
use super::evaluate::Evaluator;
use super::location::Location;
use super::problem::Problem;

/// The result of an identification.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Identified {
    /// Everything that was found: parameters, first states, delays, linear coefficients.
    pub estimates: Vec<Estimate>,
    /// Their covariance, row by row, to first order in their own units; huge where the data say nothing.
    pub covariance: Vec<f64>,
    /// What is determined where single numbers are not.
    pub combinations: Vec<Combination>,
    /// What that means, in sentences.
    pub remarks: Vec<String>,
    /// How well each output is predicted.
    pub outputs: Vec<Score>,
    /// −2 log likelihood at the estimate, up to a constant.
    pub loss: f64,
    /// Why the search ended; absent: it was stopped.
    pub stop: Option<Stop>,
    /// Rollouts of a recording that it took; one with derivatives counts once more for each parameter.
    pub rollouts: u64,
    /// What the search ended at, between 0 and 1.
    pub point: Vec<f64>,
    /// Delays that come in two humps, where a mixture was asked for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub humps: Vec<Humps>,
}

/// A delay whose messages come in two humps; its estimates hold the mean and the standard deviation of both together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Humps {
    /// The delay, by the name of its estimate.
    pub delay: String,
    /// Where in the graph it stands.
    pub places: Vec<Location>,
    /// The earlier and the later one.
    pub humps: Vec<Hump>,
    /// How far their means are apart, s.
    pub apart: Known,
    /// By how much Schwarz's criterion prefers two humps to one, in units of −2 log likelihood.
    pub evidence: f64,
}

/// A normal distribution among those of a delay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hump {
    /// Its share of the messages.
    pub share: Known,
    /// Its mean, s. The standard deviation is that of its distance from the mean of all, which has one of its own.
    pub mean: Known,
    /// Its standard deviation, s.
    pub spread: Known,
}

/// A number with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// The number.
    pub value: f64,
    /// Its standard deviation.
    pub std: f64,
}

impl Known {
    pub(super) fn new(value: f64, variance: f64) -> Self {
        Self { value, std: variance.max(0.0).sqrt() }
    }
}

/// One number that was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// What people call it.
    pub name: String,
    /// What kind of number it is.
    pub sort: Sort,
    /// Where in the graph it stands; several places are tied to each other.
    pub places: Vec<Location>,
    /// Its value.
    pub value: f64,
    /// Its standard deviation; absent where the data do not determine it.
    pub std: Option<f64>,
    /// Where it lies with 95 % probability; its bounds where the data do not determine it.
    pub interval: [f64; 2],
    /// The bounds of the search; absent where it was solved for.
    pub bounds: Option<[f64; 2]>,
    /// Whether it ended at a bound.
    pub at_bound: bool,
    /// Its unit.
    pub unit: String,
}

/// How well an output is predicted: root mean squares of the open-loop error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The output, `NODE.LEAF`.
    pub output: String,
    /// Over the time that the fit saw.
    pub fitted: f64,
    /// How many values that were.
    pub samples: usize,
    /// Over the time that it did not see; absent where all was fitted.
    pub held_out: Option<f64>,
    /// The declared noise.
    pub noise: Option<f64>,
}

/// Predictions beside what was recorded, for pictures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Reconstruction {
    /// The output, `NODE.LEAF`.
    pub output: String,
    /// The period of an angle that wraps.
    pub wrap: Option<f64>,
    /// One for each recording.
    pub recordings: Vec<Series>,
}

/// One output over one recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Series {
    /// When the steps started, s.
    pub times: Vec<f64>,
    /// What was recorded.
    pub recorded: Vec<f64>,
    /// What is predicted, open loop from the first state.
    pub predicted: Vec<f64>,
    /// From when on no fit has seen it, s.
    pub held_out_from: f64,
    /// Until when it is compared, s: `to` of the specification, or the recording's end.
    pub compared_until: f64,
}

impl Identified {
    /// The estimate of this name.
    pub fn estimate(&self, name: &str) -> Option<&Estimate> {
        self.estimates.iter().find(|estimate| estimate.name == name)
    }

    /// The sum of several numbers, with its standard deviation: what the data tell of delays in a row is their sum. None
    /// where one of them was not asked for.
    pub fn sum(&self, names: &[&str]) -> Option<(f64, f64)> {
        let place = |name: &&str| self.estimates.iter().position(|estimate| estimate.name == **name);
        let places: Vec<usize> = names.iter().map(place).collect::<Option<_>>()?;
        let value = places.iter().map(|&i| self.estimates[i].value).sum();
        let all = self.estimates.len();
        let pairs = places.iter().flat_map(|&i| places.iter().map(move |&j| (i, j)));
        let variance: f64 = pairs.map(|(i, j)| self.covariance[i * all + j]).sum();
        Some((value, variance.max(0.0).sqrt()))
    }

    /// Predictions at the estimate beside what was recorded.
    ///
    /// # Errors
    ///
    /// [`IdentifyError::Batch`] as [`Evaluator::new`].
    pub fn reconstruction(&self, problem: &Problem) -> Result<Vec<Reconstruction>, IdentifyError> {
        let evaluator = Evaluator::new(problem)?;
        let mut linear = self.estimates[problem.coordinates.len()..].iter().map(|estimate| estimate.value);
        let coefficients: Vec<Vec<f64>> =
            problem.outputs.iter().map(|output| linear.by_ref().take(output.terms.len()).collect()).collect();
        let predicted = evaluator.predict(&self.point, &coefficients)?;
        let outputs = problem.outputs.iter().zip(predicted).map(|(output, predicted)| {
            let series = predicted.into_iter().enumerate().map(|(episode, predicted)| Series {
                times: output.times[episode].clone(),
                recorded: output.values[episode].clone(),
                predicted,
                held_out_from: problem.spans[episode][1],
                compared_until: problem.spans[episode][2],
            });
            let recordings = series.collect();
            Reconstruction { output: output.name.clone(), wrap: output.wrap, recordings }
        });
        Ok(outputs.collect())
    }
}
