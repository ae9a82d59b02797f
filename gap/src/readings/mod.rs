//! Effects that leave the mean of every prediction as it is: they show in how readings scatter, repeat and are spaced.
//!
//! - [`examine`] looks at the raw readings of each output, without a model: noise beyond the declared one, a lattice of
//!   values, outliers, stuck and missing readings.
//! - [`scatter`] looks at the innovations of a fitted model: times of commands and readings that scatter, commands that
//!   are lost.
//! - [`cleaned`] gives a recording without the readings that would mislead a fit of the mean.
//!
//! Each effect is weighed against its own null by a likelihood; [`ReadingEffect::evidence`] is a difference of −2 log
//! evidence, as those of the other hypotheses. A model of the mean cannot lower an error that has no mean, so what an
//! effect explains is its part of the log predictive density of held-out readings.

mod acted;
mod banded;
mod beam;
mod doubt;
mod golden;
mod kicks;
mod large;
mod late;
pub mod lattice;
mod local;
mod lost;
mod odds;
mod outliers;
mod peak;
mod raw;
mod scatter;
mod sensitivity;
mod still;
mod stuck;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::report::Value;

pub(crate) use acted::{Acted, acted};
pub(crate) use doubt::contradicted;
pub(crate) use large::in_words;
pub(crate) use odds::{Way, odds};
pub(crate) use raw::Raw;
pub use raw::{Suspicion, Suspicious, cleaned, examine};
pub(crate) use scatter::noise_beside;
pub use scatter::{over_horizon, over_readings, scatter};

/// Share of the evidence of bad readings, of a lattice, or of times that scatter elsewhere, below which times that scatter are what these
/// leave behind.
pub(crate) const TRACE: f64 = 0.1;

/// The same at the bad readings' own place: the smaller ones are found where the reading hardly moves, and stay where it is
/// fast.
const TRACE_THERE: f64 = 0.3;

/// Whether an effect is what a stronger one leaves behind: bad readings that were not all taken out look like times that
/// scatter, times that scatter widely look like bad readings, and a coarse lattice repeats its values and is off by what the reading's rate decides.
#[must_use]
pub fn is_trace(effect: &ReadingEffect, all: &[ReadingEffect]) -> bool {
    let found = |names: &[&str]| {
        let names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
        all.iter().filter(move |e| e.significant && names.contains(&e.name))
    };
    match effect.name.as_str() {
        "jitter"
            if found(&["quantization"])
                .any(|e| effect.place == e.place && effect.evidence > TRACE * e.evidence) =>
        {
            true
        }
        "jitter" | "drops" => found(&["outliers", "stuck"]).any(|e| {
            let trace = if effect.place == e.place { TRACE_THERE } else { TRACE };
            (effect.place.starts_with("input:") || effect.place == e.place)
                && effect.evidence > trace * e.evidence
        }),
        // Times are now and then far off, and where the reading is fast so is what it shows.
        "outliers" => {
            found(&["jitter"]).any(|e| e.place == effect.place && effect.evidence > TRACE_THERE * e.evidence)
        }
        "stuck" => {
            found(&["quantization"]).any(|e| e.place == effect.place && effect.evidence > TRACE * e.evidence)
        }
        _ => false,
    }
}

/// Difference of −2 log evidence from which an effect counts as there.
const DECISIVE: f64 = 10.0;

/// One effect on how readings scatter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReadingEffect {
    /// The effect's name.
    pub name: String,
    /// Where it acts, such as `output:angle`.
    pub place: String,
    /// Its parameters by name.
    pub parameters: BTreeMap<String, Value>,
    /// −2 log evidence, less that of its absence: below zero it is likelier than not.
    pub evidence: f64,
    /// Whether the evidence is decisive and the effect larger than what the system declares.
    pub significant: bool,
    /// Mean log predictive density of held-out readings.
    pub log_density: LogDensity,
    /// The effect's part of what a free density gains over its absence there; absent where that gains nothing.
    pub share: Option<f64>,
}

/// Mean log predictive density of held-out readings: nats for each, scored on bins of one noise unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LogDensity {
    /// Without the effect.
    pub without: f64,
    /// With it.
    pub with: f64,
    /// Of a density estimated freely on the other readings, at least `with`.
    pub best: f64,
}

/// Gain of log density below which no share is stated (nats for each reading).
const GAIN: f64 = 1e-3;

impl LogDensity {
    /// Part of the gain of the best that the effect has.
    fn share(&self) -> Option<f64> {
        let most = self.best - self.without;
        (most > GAIN).then(|| ((self.with - self.without) / most).clamp(0.0, 1.0))
    }
}

/// One effect with one parameter, as it was found.
fn found(
    name: &str,
    place: String,
    parameter: (&str, Value),
    evidence: f64,
    significant: bool,
    log_density: LogDensity,
) -> ReadingEffect {
    ReadingEffect {
        name: name.into(),
        place,
        parameters: BTreeMap::from([(parameter.0.to_owned(), parameter.1)]),
        evidence,
        significant: significant && evidence < -DECISIVE,
        log_density,
        share: log_density.share(),
    }
}
