//! The diagnosis from end to end: bind, fit, weigh, localise, quantify, report.

mod beside;
mod causes;
mod claims;
mod error;
mod prepare;
mod screen;
mod weigh;

use parallax_model::effect::Effect;
use parallax_model::system::{EffectEntry, Equations, System};
use parallax_runtime::recording::log::Log;
use rayon::prelude::*;

use crate::answers;
use crate::bind::bind_all;
use crate::calibration;
use crate::excitation::{self, Wishes};
use crate::experiment::Experiment;
use crate::explain;
use crate::floor;
use crate::hypothesis::EffectAt;
use crate::innovation::walk;
use crate::library;
use crate::maps;
pub use crate::options::Options;
use crate::pieces;
use crate::posterior::{self, Answer, Left};
use crate::quantify::{self, Row};
use crate::readings::{self, Acted, ReadingEffect};
use crate::report::{Confusable, Gap, NotTestable, Overlay, Report, Split, Unexplained};
use crate::rows::Rows;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;
use crate::shapley;
use crate::whiteness::Whiteness;
use causes::Models;
pub use error::DiagnosisError;
pub(crate) use prepare::prepare;
use weigh::{Found, Rounds};

/// What comes out: the report, what its plots need, and what a corrected system needs.
#[derive(Clone, Debug)]
pub struct Diagnosis {
    /// The report.
    pub report: Report,
    /// One overlay per output.
    pub overlays: Vec<Overlay>,
    /// Calibrated and freed parameters of the nominal system, by name.
    pub calibrated: Vec<(String, f64)>,
    /// The same without any effect: what the nominal system was refitted to.
    pub refitted: Vec<(String, f64)>,
    /// The effects of the leading answer.
    pub effects: Vec<EffectEntry>,
    /// What the errors on held-out time are made of.
    pub(crate) rows: Rows,
}

/// Diagnoses one recording. `progress` is told what is done, from 0 to 1.
///
/// # Errors
///
/// [`DiagnosisError`] when system and recording do not fit together or the log cannot carry a diagnosis.
pub fn diagnose(
    system: &System,
    log: &Log,
    options: &Options,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Diagnosis, DiagnosisError> {
    diagnose_all(system, std::slice::from_ref(log), options, progress)
}

/// Diagnoses several recordings of one machine together: the parameters are shared, states and constants are each
/// recording's own. Of three or more, every third is held out as a whole.
///
/// # Errors
///
/// [`DiagnosisError`] when system and recordings do not fit together or cannot carry a diagnosis.
pub fn diagnose_all(
    system: &System,
    logs: &[Log],
    options: &Options,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Diagnosis, DiagnosisError> {
    let titles: Vec<&str> = logs.iter().map(|log| log.title.as_str()).collect();
    let independent = system.independent();
    let mut found = if independent.len() > 1 {
        pieces::diagnose(system, &independent, logs, options, progress)?
    } else {
        let (equations, experiment) = bind_all(system, logs)?;
        diagnose_experiment(equations, experiment, &titles.join(", "), options, progress)?
    };
    found.report.recordings = titles.into_iter().map(str::to_owned).collect();
    Ok(found)
}

/// Diagnoses one recording that is already bound to a system; `title` is its name in the report.
///
/// # Errors
///
/// [`DiagnosisError`] when the log cannot carry a diagnosis.
pub fn diagnose_experiment(
    equations: Equations,
    experiment: Experiment,
    title: &str,
    options: &Options,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Diagnosis, DiagnosisError> {
    diagnose_bound(equations, experiment, title, options, true, progress)
}

/// The same; the effects that the options name are `checked` against what this system has, or already were.
pub(crate) fn diagnose_bound(
    equations: Equations,
    experiment: Experiment,
    title: &str,
    options: &Options,
    checked: bool,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Diagnosis, DiagnosisError> {
    let rounds = Rounds { equations, title, options, checked, progress };
    let (found, acted) = rounds.run(experiment)?;
    progress(0.92, "held-out time");
    Ok(conclude(title, options, found, acted))
}

/// Share of its probability that all else keeps where something is known to be there that is no effect.
const KNOWN_TO_BE_NONE: f64 = 0.01;

/// Share of what the leading answer leaves of held-out time that another one, which follows the other windows no worse, must
/// predict to refute it. Evidence is of one-step predictions; what holds there and fails on fresh motion is no machine.
const OVERTAKES: f64 = 0.9;

fn conclude(title: &str, options: &Options, found: Found, acted: Option<Acted>) -> Diagnosis {
    let Found { setup, null, mut answers, p_value, not_testable, absorbed, mut readings } = found;
    // What goes with the commands themselves is known to be there, and no effect of the library.
    let (acted, of_size) = match acted {
        Some(acted) if !acted.by_chance => (None, Some(acted.effect)),
        acted => (acted, None),
    };
    let setup = &setup;
    // Without the effect the machine is predicted from what was sent, with it from what arrived.
    let recorded = acted.as_ref().map(|acted| acted.as_recorded(setup));
    let scored = recorded.as_ref().unwrap_or(setup);
    let system = setup.equations.system();
    let stated = |r: &ReadingEffect| system.effects.iter().any(|e| e.name == r.name && e.place == r.place);
    let allowed = |r: &ReadingEffect| {
        let (effect, place) = (Effect::from_name(&r.name), r.place.parse());
        effect.zip(place.ok()).is_some_and(|(effect, place)| options.allows(&EffectAt { effect, place }))
    };
    let possible = |mut all: Vec<ReadingEffect>| {
        all.retain(|r| allowed(r) && !stated(r) && of_size.as_ref().is_none_or(|of| of.place != r.place));
        all
    };
    readings = possible(readings);
    let predicted = |setup: &Setup, fit: &Fit| {
        let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
        quantify::predict(setup, &simulator, fit.estimate(), &fit.innovation.noise)
    };
    let row = |fit: &Fit| predicted(setup, fit);
    let refitted = predicted(scored, &null);
    let gain = |answers: &posterior::Posterior| answers.cost(&null) - answers.cost(answers.leader(&null));
    if acted.is_none() && causes::are_all(&readings, &refitted, gain(&answers)) {
        answers.name_none(&null);
    }
    let mut detected = p_value < 0.01 && answers.no_gap < 0.5;
    let worse = |with: &Row| quantify::closed(&refitted, with, options.seed).high < 0.0;
    if detected && acted.is_none() && of_size.is_none() {
        answers.weigh_times(setup, &null, options, &|way| allowed(way) && !stated(way));
    }
    let (mut with_best, mut times_are_all) = (None, false);
    if detected && acted.is_none() && !answers.names() {
        answers.weigh_sharp(setup, &null);
        claims::hold_unknown(&mut answers, &null, &row, &refitted, options.seed);
    }
    while detected && answers.names() {
        let with = row(answers.leader(&null));
        let overtakes = |other: &Row| quantify::closed(&with, other, options.seed).low > OVERTAKES;
        let overtaken = || answers.no_worse_by_windows().any(|fit| overtakes(&row(fit)));
        if acted.is_some() || !(worse(&with) || overtaken()) {
            with_best = Some(with);
            break;
        }
        // Friction that is smoothed around rest creeps where the machine stands.
        if !answers.sharpen(setup, &null) {
            answers.refute(setup, &null);
        }
    }
    if acted.is_none() {
        with_best = with_best.map(|with| answers.shorten(setup, &null, &row, with));
    }
    if let Some(with) = &with_best
        && acted.is_none()
        && causes::are_times(
            &possible(readings::scatter(setup, &null)),
            gain(&answers),
            &quantify::closed(&refitted, with, options.seed),
        )
    {
        answers.name_none(&null);
        (detected, with_best, times_are_all) = (false, None, true);
    }
    if of_size.is_some() {
        answers.know_unknown(KNOWN_TO_BE_NONE);
        (detected, with_best) = (true, None);
    }
    let named = answers.names();
    let mut scattered =
        possible(readings::scatter(setup, if detected && named { answers.leader(&null) } else { &null }));
    if detected
        && named
        && scattered.iter().filter_map(mean_of).any(|mean| answers.takes_for_mean(setup, &null, &mean))
    {
        with_best = Some(row(answers.leader(&null)));
        scattered = possible(readings::scatter(setup, answers.leader(&null)));
    }
    let mut explanations = explain::explain(
        &explain::Evidence {
            setup,
            null: &null,
            posterior: &answers,
            absorbed: &absorbed,
            not_testable: &not_testable,
        },
        &options.explain,
    );
    // Where there is no gap, nothing asks to be told apart; an experiment is the dearest part of a report.
    let confusable = if detected { confusable(setup, &null, &answers, options.seed) } else { Vec::new() };
    let sharper = detected && named && answers.sharpen(setup, &null);
    let sharp = detected && named && answers.leader(&null).hypothesis.halvings > 0;
    if sharper {
        with_best = Some(row(answers.leader(&null)));
        scattered = possible(readings::scatter(setup, answers.leader(&null)));
    }
    let best = &answers.leader(&null).clone();
    readings.extend(scattered);

    let nominal_theta: Vec<f64> = null.hypothesis.fitted.iter().map(|f| f.null).collect();
    let simulator = library::simulator(scored, &null.hypothesis, Vec::new());
    let pass = walk(&simulator, &setup.train, &setup.noise, &null.innovation.noise, &nominal_theta);
    let noise = pass.refit_noise(
        &setup.noise.scale,
        &null.innovation.noise,
        &setup.noise.limits,
        setup.noise.process_floor,
    );
    let nominal = quantify::predict(scored, &simulator, &nominal_theta, &noise);
    // With commands that acted otherwise the null, too, is another one once that is known.
    let known = || if acted.is_some() { row(&null) } else { refitted.clone() };
    let with_effect = with_best.unwrap_or_else(known);
    // A residual that was fitted beside a smoother answer may be worse than none beside the sharp one.
    let gains = |black_box: &Row| !sharp || black_box.mean_square() < with_effect.mean_square();
    let black_box = answers.residual(named).map(row).filter(gains).unwrap_or_else(|| with_effect.clone());

    let rows = Rows { nominal, refitted, with_effect, black_box };
    let Rows { refitted, with_effect, .. } = &rows;
    let split =
        if detected && named { split(setup, &null, best, &row(&null), with_effect) } else { Vec::new() };
    let how_far = rows.how_far(setup.horizon, split, options.seed);
    let share = if detected { rows.left() } else { 0.0 };
    let overlays = (0..setup.experiment.wraps.len())
        .map(|o| quantify::overlay(setup, o, refitted, with_effect))
        .collect();

    let named_one = (detected, detected && named);
    let models = Models::new(setup, &null, &answers, &rows, named_one, acted.as_ref(), times_are_all);
    let mut causes = models.causes(&readings);
    // Beside causes that only scatter, what closes little may do so because of them; what closes nothing is doubted there as well.
    let closes_nothing = how_far.closed_by_effect.value <= 0.0;
    let innovations =
        (detected && named).then(|| Whiteness::of(&best.innovation.pass, setup.horizon)).flatten();
    if detected && named && acted.is_none() && (causes.is_empty() || closes_nothing) {
        let by_chance = innovations.is_some_and(|left| left.is_chance());
        answers.doubt(left_of_what_can_be(setup, best, refitted, with_effect, by_chance, options.seed));
    }
    // Beside commands that acted otherwise they were weighed so from the start.
    if !(causes.is_empty() || detected && named || acted.is_some()) {
        answers.stand_beside_another(&null);
    }
    if let Some(acted) = acted {
        readings.push(acted.effect.clone());
        causes.push(acted.effect);
    }
    let hint = of_size.as_ref().map(readings::in_words);
    let unexplained = Unexplained { probability: answers.unexplained, share, hint, innovations };
    let chance = causes.iter().chain(&of_size).map(|r| (0.5 * r.evidence).exp()).fold(p_value, f64::min);
    let (mean_detected, detected) = (detected, detected || !causes.is_empty());
    let shown = if mean_detected && named { best } else { &null };
    let which = answers::which(setup, &answers, &causes);
    // Commands that are late on average, and not all by the same time.
    let known = |way: &&ReadingEffect| causes.iter().any(|cause| cause.place == way.place);
    let way = answers.leading_way().filter(|way| mean_detected && named && !known(way)).cloned();
    readings.extend(way.clone());
    let of_readings =
        explain::of_readings(setup, options, &explanations, (&readings, &causes), which.first());
    explanations.extend(of_readings);
    let report = Report {
        summary: String::new(),
        system: system.name.clone(),
        recordings: vec![title.into()],
        gap: Gap { detected, p_value: chance.max(f64::MIN_POSITIVE), score: how_far.refitted },
        rests_s: setup.experiment.left_out(),
        calibration: calibration::moved(setup, shown),
        where_: answers::places(&answers, &causes),
        maps: if mean_detected { maps::maps(setup, &null, options.seed) } else { Vec::new() },
        timing: None,
        nodes: None,
        which,
        readings,
        unexplained,
        absorbed,
        not_testable: not_testable
            .into_iter()
            .map(|n| NotTestable { effect: n.effect.label(), reason: n.reason })
            .collect(),
        confusable,
        how_far,
        closed_loop: None,
        corrected_system: None,
        explanations,
        interrupted: setup.stop.interrupted(|label| answers.answers.iter().any(|a| a.class.contains(label))),
        made_from: None,
    };
    let mut found = if mean_detected && named { answers::fitted_effects(setup, best) } else { Vec::new() };
    if way.as_ref().is_some_and(|way| way.name == Effect::Drops.name()) {
        // What is lost is late by a period: that is all of the delay.
        found.clear();
    }
    found.extend(causes.iter().chain(&way).map(answers::as_fitted));
    let effects = answers::corrected_effects(setup, &shown.hypothesis, &found);
    let (calibrated, refitted) = (calibration::values(setup, shown), calibration::values(setup, &null));
    let mut diagnosis = Diagnosis { report, overlays, calibrated, refitted, effects, rows };
    diagnosis.report.summary = crate::report::sentence::summary(&diagnosis.report);
    diagnosis
}

/// The delay that is the mean of an output's times, if those scatter.
fn mean_of(r: &ReadingEffect) -> Option<EffectAt> {
    let place = r.place.parse().ok().filter(|_| r.significant && r.name == Effect::Jitter.name())?;
    r.place.starts_with("output:").then_some(EffectAt { effect: Effect::Delay, place })
}

/// What the `best` answer leaves on held-out time of what an exact model would not, its rows before and `after`. What may close
/// something is given the benefit of the doubt, unless the best guess is that it closes nothing.
fn left_of_what_can_be(
    setup: &Setup,
    best: &Fit,
    before: &Row,
    after: &Row,
    by_chance: bool,
    seed: u64,
) -> Left {
    let simulator = library::simulator(setup, &best.hypothesis, best.residuals.clone());
    let floor = floor::expected(setup, &simulator, best.estimate(), &best.innovation.noise);
    if after.mean_square() <= floor {
        return Left { closed: 1.0, above: 0.0, by_chance };
    }
    let closed = quantify::closed_to(floor, before, after, seed);
    let closed = if closed.value > 0.0 { closed.high } else { closed.value };
    let reached = best.shooting_error <= INEXACT;
    let above = if reached { (1.0 - closed) * (before.mean_square() / floor - 1.0).max(0.0) } else { 0.0 };
    Left { closed, above, by_chance }
}

/// What each of several effects closes; nothing for one.
fn split(setup: &Setup, null: &Fit, best: &Fit, refitted: &Row, with_effect: &Row) -> Vec<Split> {
    let effects = &best.hypothesis.effects;
    if effects.len() < 2 || setup.stop.leaves_out(|| "the share of each effect".into()) {
        return Vec::new();
    }
    let gap = (refitted.mean_square() - 1.0).max(1e-12);
    let closed = |row: &Row| (refitted.mean_square() - row.mean_square().max(1.0)) / gap;
    let gain = |set: usize| {
        let chosen: Vec<EffectAt> =
            effects.iter().enumerate().filter(|(k, _)| set >> k & 1 == 1).map(|(_, e)| e.clone()).collect();
        if chosen.is_empty() {
            0.0
        } else if chosen.len() == effects.len() {
            closed(with_effect)
        } else {
            let fit = search::fit_part(setup, null, library::hypothesis(setup, &chosen), best);
            let simulator = library::simulator(setup, &fit.hypothesis, Vec::new());
            // What alone makes predictions worse, however much, closes nothing alone.
            closed(&quantify::predict(setup, &simulator, fit.estimate(), &fit.innovation.noise)).max(0.0)
        }
    };
    let gains: Vec<f64> = (0..1_usize << effects.len()).into_par_iter().map(gain).collect();
    let shares = shapley::values(effects.len(), |set| gains[set]);
    effects.iter().zip(shares).map(|(e, share)| Split { effect: e.label(), share }).collect()
}

/// Classes of several effects, each with the experiment that would tell its members apart.
fn confusable(setup: &Setup, null: &Fit, posterior: &posterior::Posterior, seed: u64) -> Vec<Confusable> {
    let classes = posterior.answers.iter().filter(|a: &&Answer| a.class.len() > 1 && a.probability > 0.01);
    classes
        .map(|answer| {
            let candidates: Vec<&Fit> = [&answer.fit].into_iter().chain(&answer.alike).collect();
            if setup.stop.leaves_out(|| "experiments that separate what looks alike".into()) {
                let separate_by = "no experiment was looked for".into();
                return Confusable { effects: answer.class.clone(), separate_by, experiment: None };
            }
            let wishes = Wishes { seed, ..Wishes::default() };
            let (separate_by, experiment) = match excitation::design(setup, null, &candidates, &wishes) {
                Ok(design) => (design.to_string(), Some(design.promise())),
                Err(error) => (format!("no experiment was found: {error}"), None),
            };
            Confusable { effects: answer.class.clone(), separate_by, experiment }
        })
        .collect()
}
