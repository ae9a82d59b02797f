//! Machines that fall apart: each independent piece is diagnosed by itself, and the answers are put together.
//!
//! Six joints that share nothing have six causes, each to be found among the effects of its own joint. Evidence of
//! independent pieces multiplies, so the answer of the whole is one of every piece, with the product of their
//! probabilities; what is left out of one piece costs nothing elsewhere.

use parallax_model::system::System;
use parallax_runtime::recording::log::Log;

use crate::bind::bind_all;
use crate::diagnosis::{Diagnosis, DiagnosisError, diagnose_bound};
use crate::library;
use crate::options::Options;
use crate::report::{Gap, Interrupted, Report, Split, Unexplained, Which, sentence};
use crate::rows::Rows;
use crate::setup::Setup;
use crate::whiteness::Whiteness;

/// Answers of the whole that are listed.
const LISTED: usize = 12;

/// Diagnoses every piece that the options concern, and puts the answers together.
///
/// # Errors
///
/// The first piece's [`DiagnosisError`].
pub(crate) fn diagnose(
    system: &System,
    pieces: &[System],
    logs: &[Log],
    options: &Options,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Diagnosis, DiagnosisError> {
    let title = logs.iter().map(|log| log.title.as_str()).collect::<Vec<_>>().join(", ");
    if options.names_effects() {
        let (equations, experiment) = bind_all(system, logs)?;
        options.check(&library::known(&Setup::new(equations, experiment, options.horizon)))?;
    }
    let asked: Vec<&System> = pieces.iter().filter(|piece| options.concerns(piece)).collect();
    let count = asked.len() as f64;
    let mut found = Vec::new();
    for (k, piece) in asked.into_iter().enumerate() {
        let (equations, experiment) = bind_all(piece, logs)?;
        let part = |done: f64, what: &str| progress((k as f64 + done) / count, what);
        match diagnose_bound(equations, experiment, &title, options, false, &part) {
            // What was found of the pieces before is worth a report.
            Err(DiagnosisError::Stopped) if !found.is_empty() => {
                let mut names = piece.outputs.iter().map(|o| format!("everything at output:{}", o.name));
                note(&mut found, names.by_ref());
                break;
            }
            other => found.push(other?),
        }
    }
    Ok(together(found, options.seed))
}

fn note(found: &mut [Diagnosis], left_out: impl Iterator<Item = String>) {
    if let Some(last) = found.last_mut() {
        let interrupted = last.report.interrupted.get_or_insert(Interrupted { not_tried: Vec::new() });
        interrupted.not_tried.extend(left_out);
    }
}

/// What a piece contributes to an answer of the whole.
#[derive(Clone, Copy)]
enum Choice<'a> {
    /// Its gap has this cause, or it has no gap where there are no effects.
    Named(&'a Which),
    /// Its gap has no named cause.
    Unexplained(f64),
}

impl<'a> Choice<'a> {
    fn of(report: &'a Report) -> Self {
        let none = report.which.iter().find(|w| w.effects.is_empty());
        match (report.gap.detected, report.which.iter().find(|w| !w.effects.is_empty())) {
            (true, Some(first)) if first.probability >= report.unexplained.probability => {
                Choice::Named(first)
            }
            (true, _) => Choice::Unexplained(report.unexplained.probability),
            (false, _) => none.map_or(Choice::Unexplained(0.0), Choice::Named),
        }
    }

    fn probability(&self) -> f64 {
        match self {
            Choice::Named(which) => which.probability,
            Choice::Unexplained(probability) => *probability,
        }
    }
}

/// The innovations that are least like chance.
fn worst(all: impl Iterator<Item = Whiteness>) -> Option<Whiteness> {
    all.max_by(|a, b| a.score.total_cmp(&b.score))
}

fn together(found: Vec<Diagnosis>, seed: u64) -> Diagnosis {
    let reports: Vec<&Report> = found.iter().map(|d| &d.report).collect();
    let which = which(&reports);
    let rows = Rows::joined(found.iter().map(|d| &d.rows));
    let horizon = reports.iter().map(|r| r.how_far.horizon_s).fold(0.0, f64::max);
    let how_far = rows.how_far(horizon, split(&reports), seed);
    let detected: Vec<&&Report> = reports.iter().filter(|r| r.gap.detected).collect();
    let nameless = |r: &&&Report| matches!(Choice::of(r), Choice::Unexplained(_));
    let unexplained = Unexplained {
        // That no named effect belongs to the cause: that none does in any piece with a gap.
        probability: detected.iter().map(|r| r.unexplained.probability).product::<f64>()
            * f64::from(u8::from(!detected.is_empty())),
        share: if detected.is_empty() { 0.0 } else { rows.left() },
        hint: reports.iter().find_map(|r| r.unexplained.hint.clone()),
        innovations: worst(detected.iter().filter_map(|r| r.unexplained.innovations)),
    };
    let outputs = |d: &Diagnosis| d.overlays.iter().map(|o| o.output.clone()).collect::<Vec<_>>();
    let open: Vec<String> = found.iter().filter(|d| nameless(&&&d.report)).flat_map(outputs).collect();
    let p_value = reports.iter().map(|r| r.gap.p_value).fold(1.0, f64::min) * reports.len() as f64;
    let gap = Gap { detected: !detected.is_empty(), p_value: p_value.min(1.0), score: how_far.refitted };
    let some_named = which.first().is_some_and(|w| !w.effects.is_empty());
    let not_tried: Vec<String> =
        reports.iter().filter_map(|r| r.interrupted.as_ref()).flat_map(|i| i.not_tried.clone()).collect();
    let mut report = Report {
        summary: String::new(),
        system: reports.first().map_or_else(String::new, |r| r.system.clone()),
        recordings: reports.first().map_or_else(Vec::new, |r| r.recordings.clone()),
        gap,
        rests_s: reports.iter().filter_map(|r| r.rests_s).reduce(f64::max),
        calibration: all(&reports, |r| &r.calibration),
        where_: all(&reports, |r| &r.where_),
        maps: all(&reports, |r| &r.maps),
        timing: None,
        nodes: None,
        which,
        readings: all(&reports, |r| &r.readings),
        unexplained,
        absorbed: all(&reports, |r| &r.absorbed),
        not_testable: all(&reports, |r| &r.not_testable),
        confusable: all(&reports, |r| &r.confusable),
        how_far,
        closed_loop: None,
        corrected_system: None,
        explanations: all(&reports, |r| &r.explanations),
        interrupted: (!not_tried.is_empty()).then_some(Interrupted { not_tried }),
        made_from: None,
    };
    report.where_.sort_by(|a, b| b.probability.total_cmp(&a.probability).then(b.share.total_cmp(&a.share)));
    report.summary = sentence::summary(&report);
    if some_named && !open.is_empty() {
        report.summary += &format!(" None of the named effects describes the gap at {}.", open.join(", "));
    }
    let mut whole = Diagnosis {
        report,
        overlays: Vec::new(),
        calibrated: Vec::new(),
        refitted: Vec::new(),
        effects: Vec::new(),
        rows: Rows::default(),
    };
    for piece in found {
        whole.overlays.extend(piece.overlays);
        whole.calibrated.extend(piece.calibrated);
        whole.refitted.extend(piece.refitted);
        whole.effects.extend(piece.effects);
    }
    whole.rows = rows;
    whole
}

fn all<T: Clone>(reports: &[&Report], of: impl Fn(&Report) -> &Vec<T>) -> Vec<T> {
    reports.iter().flat_map(|r| of(r).iter().cloned()).collect()
}

/// The leading answer of every piece together, and what it becomes where one piece has another answer.
fn which(reports: &[&Report]) -> Vec<Which> {
    let leaders: Vec<Choice<'_>> = reports.iter().map(|r| Choice::of(r)).collect();
    let mut out = vec![combined(&leaders)];
    for (k, report) in reports.iter().enumerate().filter(|(_, r)| r.gap.detected) {
        for other in &report.which {
            if matches!(leaders[k], Choice::Named(leader) if leader == other) {
                continue;
            }
            let mut choices = leaders.clone();
            choices[k] = Choice::Named(other);
            out.push(combined(&choices));
        }
    }
    let (mut named, none): (Vec<Which>, Vec<Which>) = out.into_iter().partition(|w| !w.effects.is_empty());
    named.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    named.truncate(LISTED);
    let no_gap = |r: &&Report| r.which.iter().find(|w| w.effects.is_empty()).map_or(0.0, |w| w.probability);
    let probability = reports.iter().map(no_gap).product();
    let leads = none.into_iter().next().filter(|_| reports.iter().all(|r| !r.gap.detected));
    named.push(leads.unwrap_or(Which { effects: Vec::new(), class: Vec::new(), probability }));
    named.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    named
}

/// One answer of the whole. Its class has every answer that differs from it in one piece by what that piece cannot tell.
fn combined(choices: &[Choice<'_>]) -> Which {
    let named: Vec<&Which> = choices
        .iter()
        .filter_map(|choice| match choice {
            Choice::Named(which) if !which.effects.is_empty() => Some(*which),
            _ => None,
        })
        .collect();
    let first = |w: &Which| w.class.first().cloned().unwrap_or_default();
    let label = |at: usize, other: Option<&String>| {
        let of = |(k, w): (usize, &&Which)| match other {
            Some(other) if k == at => other.clone(),
            _ => first(w),
        };
        named.iter().enumerate().map(of).collect::<Vec<_>>().join(" + ")
    };
    let mut class = Vec::new();
    if !named.is_empty() {
        class.push(label(0, None));
    }
    for (k, which) in named.iter().enumerate() {
        class.extend(which.class.iter().skip(1).map(|other| label(k, Some(other))));
    }
    Which {
        effects: named.iter().flat_map(|w| w.effects.clone()).collect(),
        class,
        probability: choices.iter().map(Choice::probability).product(),
    }
}

/// What each effect closes of the whole gap: its part of its piece's, by that piece's part of the squared error.
fn split(reports: &[&Report]) -> Vec<Split> {
    let excess = |r: &Report| (r.how_far.refitted.powi(2) - 1.0).max(0.0);
    let total: f64 = reports.iter().map(|r| excess(r)).sum();
    let mut out = Vec::new();
    for report in reports {
        let weight = excess(report) / total.max(1e-12);
        if let Choice::Named(leader) = Choice::of(report) {
            let only = leader.effects.len() == 1;
            let alone = only.then(|| Split {
                effect: leader.class.first().cloned().unwrap_or_default(),
                share: report.how_far.closed_by_effect.value,
            });
            let parts = alone.into_iter().chain(report.how_far.split.iter().cloned());
            out.extend(parts.map(|s| Split { share: weight * s.share, ..s }));
        }
    }
    if out.len() > 1 { out } else { Vec::new() }
}
