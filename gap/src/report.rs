//! The answer: what a diagnosis found, as `report.json` states it, with the series that its plots need.

mod answer;
mod bars;
mod closed_loop;
mod explained;
mod format;
pub mod html;
mod maps;
mod overlay;
mod readings;
mod recorded;
pub mod sentence;
pub mod svg;
pub mod text;

use serde::{Deserialize, Serialize};

use crate::closed_loop::ClosedLoop;
use crate::excitation::Promise;
use crate::explain::Explanation;
use crate::maps::Map;
use crate::nodes::Nodes;
use crate::plot::{axis, draw};
use crate::readings::ReadingEffect;
use crate::stop::UNKNOWN;
use crate::timing::Timing;
use crate::whiteness::Whiteness;

/// A whole diagnosis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// One sentence: where the gap lies, what causes it, how far it closes.
    pub summary: String,
    /// Name of the system that was believed.
    pub system: String,
    /// Titles of the recordings that were diagnosed.
    pub recordings: Vec<String>,
    /// Whether there is a gap at all.
    pub gap: Gap,
    /// How long the machine rested, beyond what is looked at of each rest (s): no command changed and no reading moved. Of a machine in
    /// independent pieces, the longest of theirs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rests_s: Option<f64>,
    /// The calibrated parameters under the leading answer.
    pub calibration: Vec<Calibration>,
    /// Places by probability.
    #[serde(rename = "where")]
    pub where_: Vec<Where>,
    /// Inside the plant: what the innovations of the refitted nominal model depend on.
    #[serde(default)]
    pub maps: Vec<Map>,
    /// What the stamps prove: delays, jitter, losses, rates and clocks against what the graph declares.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    /// Each node of a recorded graph, replayed alone on its recorded inputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nodes: Option<Nodes>,
    /// Answers by probability; an empty effect list is "no gap".
    pub which: Vec<Which>,
    /// How readings scatter, repeat and are spaced: effects that leave every mean as it is, significant or not.
    #[serde(default)]
    pub readings: Vec<ReadingEffect>,
    /// What no named effect explains.
    pub unexplained: Unexplained,
    /// Effects that a calibrated parameter already covers.
    pub absorbed: Vec<Absorbed>,
    /// Effects that this system or log cannot show.
    pub not_testable: Vec<NotTestable>,
    /// Effects that this log cannot tell apart.
    pub confusable: Vec<Confusable>,
    /// Errors of prediction on held-out time.
    pub how_far: HowFar,
    /// What a task costs in closed loop, as recorded and as simulated; `null` where no task was given.
    #[serde(default)]
    pub closed_loop: Option<ClosedLoop>,
    /// Path of the corrected system, if one was written.
    pub corrected_system: Option<String>,
    /// Why effects that the user asked about are not the answer.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub explanations: Vec<Explanation>,
    /// What was left out, where the diagnosis was interrupted: probabilities are those among what was weighed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interrupted: Option<Interrupted>,
    /// The files that were diagnosed, so that another command can go on from there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub made_from: Option<MadeFrom>,
}

/// What an interrupted diagnosis left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interrupted {
    /// Effects that were not weighed, and steps that were not made.
    pub not_tried: Vec<String>,
}

impl Report {
    /// Whether causes without a name were put beside the named ones; an interrupted diagnosis may not have come to it.
    #[must_use]
    pub fn tried_the_unknown(&self) -> bool {
        self.interrupted.as_ref().is_none_or(|i| i.not_tried.iter().all(|what| what != UNKNOWN))
    }
}

/// What a diagnosis was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MadeFrom {
    /// The recordings.
    pub recordings: Vec<std::path::PathBuf>,
    /// The system file; absent where the recording's own was used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub system: Option<std::path::PathBuf>,
    /// Where in each recording the diagnosed part begins (s from its first stamp), if one was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<f64>,
    /// Where it ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to: Option<f64>,
    /// Length of windows and predictions (s), if one was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub horizon: Option<f64>,
    /// Seed of the diagnosis.
    pub seed: u64,
}

/// Whether simulation and reality differ.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gap {
    /// Whether they do, after the calibrated parameters were refitted.
    pub detected: bool,
    /// Probability of so large a difference by chance.
    pub p_value: f64,
    /// Root mean square of predictions after calibration and before any effect, in noise units.
    pub score: f64,
}

/// A calibrated parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Its name.
    pub name: String,
    /// What the system file states.
    pub nominal: f64,
    /// What the fit found.
    pub value: f64,
    /// Standard deviation.
    pub std: f64,
    /// Its unit.
    pub unit: String,
    /// Whether it moved by more than two standard deviations.
    pub significant: bool,
    /// Whether it ended at a bound of its `calibrate`: the data ask for more than it may move.
    #[serde(default)]
    pub at_bound: bool,
}

/// A place and its part in the gap.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Where {
    /// The place, such as `joint:axis`.
    pub place: String,
    /// Share of the gap that the best effect there explains.
    pub share: f64,
    /// Probability that the cause lies there.
    pub probability: f64,
}

/// An answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Which {
    /// The effects; none for "no gap".
    pub effects: Vec<FittedEffect>,
    /// What this data cannot tell apart from it, itself included.
    pub class: Vec<String>,
    /// Probability of the class.
    pub probability: f64,
}

/// An effect with its parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FittedEffect {
    /// The effect's name.
    pub name: String,
    /// Where it acts.
    pub place: String,
    /// Its parameters by name.
    pub parameters: std::collections::BTreeMap<String, Value>,
}

impl FittedEffect {
    /// Its name and place: `delay@input:u`.
    #[must_use]
    pub fn label(&self) -> String {
        format!("{}@{}", self.name, self.place)
    }
}

/// A number with its uncertainty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Value {
    /// The estimate.
    pub value: f64,
    /// Its standard deviation; infinite (`null` in JSON) where the data do not tell it, such as a limit that was never
    /// reached.
    #[serde(deserialize_with = "or_infinite")]
    pub std: f64,
    /// Its unit.
    pub unit: String,
}

/// JSON has no infinity.
fn or_infinite<'de, D: serde::Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::INFINITY))
}

/// What is left beyond the named effects.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Unexplained {
    /// Probability that no named effect belongs to the cause.
    pub probability: f64,
    /// Share of the gap that remains beyond the best named answer and that a flexible residual closes.
    pub share: f64,
    /// What is known to be there all the same, in words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
    /// What the innovations with the named answer are like; absent where none is named or there are too few.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub innovations: Option<Whiteness>,
}

/// An effect that a calibrated parameter covers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Absorbed {
    /// The effect, `viscous@joint:shaft`.
    pub effect: String,
    /// The parameter.
    pub by: String,
}

/// An effect that cannot be judged here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NotTestable {
    /// The effect.
    pub effect: String,
    /// Why.
    pub reason: String,
}

/// Effects of one signature.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Confusable {
    /// The effects.
    pub effects: Vec<String>,
    /// What would separate them.
    pub separate_by: String,
    /// What the experiment that would separate them promises.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub experiment: Option<Promise>,
}

/// Root mean square errors of prediction over the horizon, in noise units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HowFar {
    /// How far ahead was predicted (s).
    pub horizon_s: f64,
    /// With the system as it was given.
    pub nominal: f64,
    /// With its calibrated parameters refitted.
    pub refitted: f64,
    /// With the leading answer's effects.
    pub with_effect: f64,
    /// With a flexible residual on top.
    pub black_box: f64,
    /// The sensor's noise.
    pub noise_floor: f64,
    /// 1 − (MSE with effect − floor)/(MSE nominal − floor).
    pub closed_total: Interval,
    /// The same from the refitted row.
    pub closed_by_effect: Interval,
    /// Where the leading answer has several effects: what each of them closes (Shapley's value). The parts sum to
    /// `closed_by_effect`.
    #[serde(default)]
    pub split: Vec<Split>,
}

/// The part of one effect in what several close together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Split {
    /// The effect and its place.
    pub effect: String,
    /// Its part of the refitted gap.
    pub share: f64,
}

/// A value with its 95 % interval.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// The estimate.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The lowest share that is stated: beyond it the numbers say nothing more.
pub(crate) const WORST_SHARE: f64 = -10.0;

impl Interval {
    /// A value between the 2.5 and 97.5 % quantiles of its bootstrap draws, and never outside.
    pub(crate) fn of(value: f64, mut draws: Vec<f64>) -> Self {
        let mut at =
            |q: f64| if draws.is_empty() { value } else { crate::statistics::quantile(&mut draws, q) };
        Interval { value, low: at(0.025).min(value), high: at(0.975).max(value) }
    }
}

/// Measured and predicted readings of one output on held-out time, for the overlay.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Overlay {
    /// The output's name.
    pub output: String,
    /// Its unit.
    pub unit: String,
    /// One noise unit in that unit.
    pub noise: f64,
    /// Stamps (s).
    pub stamp: Vec<f64>,
    /// What was measured.
    pub measured: Vec<f64>,
    /// Predicted over the horizon by the refitted nominal system.
    pub before: Vec<f64>,
    /// Predicted over the horizon with the leading answer's effects.
    pub after: Vec<f64>,
}
