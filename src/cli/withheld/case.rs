//! One case: its folder is diagnosed as `parallax diagnose --system FOLDER/system.toml FOLDER` would, and what came out is
//! kept as one line of JSON.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context, anyhow};
use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::options::Pattern;
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::import::{self, read_system_text};
use parallax_runtime::recording::log::Log;
use serde::{Deserialize, Serialize};

use super::baselines::{self, BaselineResult};
use super::separate::{Separation, separate};
use super::truth::{CaseOptions, OPTIONS};

/// What the diagnosis said of one case.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct CaseResult {
    /// The case's name.
    pub(crate) case: String,
    /// How long the diagnosis took (s).
    pub(crate) seconds: f64,
    /// The diagnosis, if there was one.
    pub(crate) found: Option<Finding>,
    /// Why there was none.
    pub(crate) error: Option<String>,
    /// What an experiment made of a class of several effects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) separation: Option<Separation>,
    /// What the baselines said, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) baselines: BTreeMap<String, BaselineResult>,
}

/// The part of a report that is scored. Numbers that are not finite are absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Finding {
    /// Whether a gap was detected.
    pub(crate) detected: bool,
    /// Named answers by probability.
    pub(crate) answers: Vec<NamedAnswer>,
    /// Probability of "no gap".
    pub(crate) no_gap: f64,
    /// Probability that no named effect belongs to the cause.
    pub(crate) unexplained: f64,
    /// Share of the gap beyond the best named answer that a flexible residual closes.
    pub(crate) unexplained_share: f64,
    /// The most probable place.
    pub(crate) place: Option<String>,
    /// Share of the refitted held-out gap that the answer closes.
    pub(crate) closed: Option<f64>,
    /// Share of the nominal held-out gap that the answer closes, calibration included.
    #[serde(default)]
    pub(crate) closed_total: Option<f64>,
}

/// One answer of a diagnosis.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct NamedAnswer {
    /// The effects.
    pub(crate) effects: Vec<NamedEffect>,
    /// Its probability.
    pub(crate) probability: f64,
}

/// An effect of an answer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct NamedEffect {
    /// Its name and place, `coulomb@joint:axis`.
    pub(crate) label: String,
    /// Estimate and standard deviation of each parameter.
    pub(crate) parameters: BTreeMap<String, (f64, Option<f64>)>,
}

/// Diagnoses the case in `folder`; a failure, a panic included, is a result as well. Given the run's folder, a class of
/// several effects is put to the experiment that is proposed for it. None where `stop` was set meanwhile.
pub(crate) fn diagnose_case(folder: &Path, run: Option<&Path>, stop: &Arc<AtomicBool>) -> Option<CaseResult> {
    let stopped = || stop.load(Ordering::Relaxed);
    let read = |folder: &Path| {
        let (system, log, options) = read(folder)?;
        anyhow::Ok((system, log, Options { stop: Some(stop.clone()), ..options }))
    };
    let case = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let start = Instant::now();
    let result = guarded(|| {
        let (system, log, options) = read(folder)?;
        Ok(diagnose(&system, &log, &options, &|_, _| ())?.report)
    });
    let seconds = start.elapsed().as_secs_f64();
    let mut out = CaseResult { case, seconds, ..CaseResult::default() };
    if stopped() {
        return None;
    }
    match result {
        Ok(report) => {
            out.found = Some(Finding::of(&report));
            if let Some(run) = run {
                let again = || {
                    let (system, log, options) = read(folder)?;
                    Ok(separate(run, &out.case, &report, &system, &log, &options))
                };
                out.separation = guarded(again).unwrap_or_else(|error| {
                    Some(Separation { error: Some(format!("{error:#}")), ..Separation::default() })
                });
            }
        }
        Err(error) => out.error = Some(format!("{error:#}")),
    }
    (!stopped()).then_some(out)
}

/// Tries the other methods on the case in `folder`. None where `stop` was set meanwhile.
pub(crate) fn try_baselines(
    folder: &Path,
    mut result: CaseResult,
    stop: &Arc<AtomicBool>,
) -> Option<CaseResult> {
    let Ok((system, log, _)) = read(folder) else { return Some(result) };
    for baseline in baselines::ALL {
        let start = Instant::now();
        let answer = guarded(|| (baseline.answer)(&system, &log, stop));
        if stop.load(Ordering::Relaxed) {
            return None;
        }
        let mut said = answer.unwrap_or_else(|error| BaselineResult {
            error: Some(format!("{error:#}")),
            ..Default::default()
        });
        said.seconds = start.elapsed().as_secs_f64();
        result.baselines.insert(baseline.name.to_owned(), said);
    }
    Some(result)
}

/// What the case tells: its system, its recording and its options.
fn read(folder: &Path) -> anyhow::Result<(System, Log, Options)> {
    let log = import::folder(folder)?;
    let (_, system) = read_system_text(&folder.join("system.toml"))?;
    let signals: Vec<(&str, &str)> = log.signals.iter().map(|s| (s.name.as_str(), s.unit.as_str())).collect();
    system.check_signals(&signals)?;
    let path = folder.join(OPTIONS);
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let stated: CaseOptions = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    let exclude: Result<Vec<Pattern>, _> = stated.exclude.iter().map(|pattern| pattern.parse()).collect();
    Ok((system, log, Options { exclude: exclude?, ..Options::default() }))
}

/// Runs `work`; a panic becomes an error.
fn guarded<T>(work: impl FnOnce() -> anyhow::Result<T>) -> anyhow::Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|cause| {
        let said =
            cause.downcast_ref::<String>().map(String::as_str).or(cause.downcast_ref::<&str>().copied());
        Err(anyhow!("it panicked: {}", said.unwrap_or("no message")))
    })
}

impl Finding {
    /// What is scored of a report.
    fn of(report: &Report) -> Self {
        let finite = |value: f64| if value.is_finite() { value } else { 0.0 };
        let named = report.which.iter().filter(|answer| !answer.effects.is_empty());
        Finding {
            detected: report.gap.detected,
            answers: named
                .map(|answer| NamedAnswer {
                    effects: answer
                        .effects
                        .iter()
                        .map(|effect| NamedEffect {
                            label: effect.label(),
                            parameters: effect
                                .parameters
                                .iter()
                                .filter(|(_, value)| value.value.is_finite())
                                .map(|(name, v)| {
                                    (name.clone(), (v.value, v.std.is_finite().then_some(v.std)))
                                })
                                .collect(),
                        })
                        .collect(),
                    probability: finite(answer.probability),
                })
                .collect(),
            no_gap: report
                .which
                .iter()
                .filter(|answer| answer.effects.is_empty())
                .map(|answer| finite(answer.probability))
                .sum(),
            unexplained: finite(report.unexplained.probability),
            unexplained_share: finite(report.unexplained.share),
            place: report.where_.first().map(|place| place.place.clone()),
            closed: Some(report.how_far.closed_by_effect.value).filter(|value| value.is_finite()),
            closed_total: Some(report.how_far.closed_total.value).filter(|value| value.is_finite()),
        }
    }
}
