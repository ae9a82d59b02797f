//! The diagnosis from end to end: bind, fit, weigh, localise, quantify, report.

mod causes;
mod claims;
mod error;
mod prepare;
mod screen;

use parallax_model::effect::Effect;
use parallax_model::system::{EffectEntry, Equations, System};
use parallax_runtime::recording::log::Log;
use rayon::prelude::*;

use crate::answers;
use crate::bind::bind_all;
use crate::calibration;
use crate::combine;
use crate::detect;
use crate::excitation::{self, Wishes};
use crate::experiment::Experiment;
use crate::explain;
use crate::floor;
use crate::held_out;
use crate::hypothesis::EffectAt;
use crate::innovation::walk;
use crate::library;
use crate::maps;
pub use crate::options::Options;
use crate::pieces;
use crate::posterior::{self, Answer, Left};
use crate::quantify::{self, Row};
use crate::readings::{self, Acted, Raw, ReadingEffect};
use crate::report::{
    Absorbed, Confusable, FittedEffect, Gap, NotTestable, Overlay, Report, Split, Unexplained,
};
use crate::rows::Rows;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;
use crate::shapley;
use crate::signature::Nuisance;
use crate::unknown;
use causes::Models;
pub use error::DiagnosisError;
pub(crate) use prepare::prepare;
use screen::{chosen, limits_of_its_sensor, outgrown, screen};

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
    let mut raw = Raw::of(&equations, &experiment);
    // What is weighed again takes the rest of the bar: progress never goes back.
    let weigh = |raw: &Raw, experiment: &Experiment, held_out: Option<usize>, (from, to): (f64, f64)| {
        let progress = |done: f64, label: &str| progress(from + (to - from) * done, label);
        weigh_all(equations.clone(), experiment, raw, title, (options, checked), held_out, &progress)
    };
    // Who is stopped while it is weighed again has what was found before.
    let again = |raw: &Raw, experiment: &Experiment, held_out: Option<usize>, bar: (f64, f64)| match weigh(
        raw, experiment, held_out, bar,
    ) {
        Err(DiagnosisError::Stopped) => Ok(None),
        found => found.map(Some),
    };
    let mut found = weigh(&raw, &experiment, None, (0.0, 0.75))?;
    // What happens on held-out time alone cannot be learned, and shows once what happens elsewhere is known.
    let leader = found.answers.leader(&found.null);
    let fairer = || held_out::fairer(&found.setup, leader).filter(|_| !found.setup.stop.asked());
    let held_out = if found.reaches_noise() && found.answers.names() { fairer() } else { None };
    if held_out.is_some() {
        found = again(&raw, &experiment, held_out, (0.75, 0.8))?.unwrap_or(found);
    }
    // What was said of the readings before any model knew them is held to the models that do.
    let fits = [&found.null, found.answers.leader(&found.null)];
    let doubted = readings::contradicted(&found.setup, &raw, &experiment, &fits);
    if !doubted.is_empty() && !found.setup.stop.asked() {
        let mut believed = raw.clone();
        doubted.into_iter().for_each(|output| believed.take_back(output));
        // Readings that all count must not hide a model that predicted them.
        let hides = |again: &Found| !again.reaches_noise() && found.reaches_noise();
        if let Some(again) =
            again(&believed, &experiment, held_out, (0.8, 0.86))?.filter(|again| !hides(again))
        {
            (raw, found) = (believed, again);
        }
    }
    progress(0.86, "lost and late commands");
    let mut acted = readings::acted(&found.setup, &experiment, &found.null, &found.answers, options);
    if let Some(by_chance) = acted.as_ref().filter(|acted| acted.by_chance) {
        // What else there is shows once it is known what acted.
        let before = found.null.shooting_error;
        match again(&raw, &by_chance.replaced(experiment), held_out, (0.86, 0.92))? {
            Some(beside) => {
                found = beside;
                found.answers.forgive(&found.null, before);
            }
            None => acted = None,
        }
    }
    progress(0.92, "held-out time");
    Ok(conclude(title, options, found, acted))
}

/// Everything up to the weights of the answers.
fn weigh_all(
    equations: Equations,
    experiment: &Experiment,
    raw: &Raw,
    title: &str,
    (options, checked): (&Options, bool),
    held_out: Option<usize>,
    progress: &(dyn Fn(f64, &str) + Sync),
) -> Result<Found, DiagnosisError> {
    progress(0.0, "nominal model");
    let readings = raw.effects();
    let (setup, null) = prepare(equations, experiment, raw, title, options, held_out)?;
    if setup.stop.asked() {
        return Err(DiagnosisError::Stopped);
    }
    // Parameters that are off show most at the frequencies of the commands, and hide what repeats at another.
    let setup = setup.with_more_lines_of(&null.innovation.pass);
    let nuisance = Nuisance::new(&null);
    let (mut candidates, mut not_testable) = library::candidates(&setup);
    candidates.extend(outgrown(&setup, &null));
    if checked {
        let mut known = library::known(&setup);
        known.extend(candidates.iter().cloned());
        options.check(&known)?;
    }
    let candidates = chosen(candidates, &mut not_testable, options);
    let (candidates, columns, absorbed) = screen(&setup, &null, &nuisance, candidates, &mut not_testable);

    let done = std::sync::atomic::AtomicUsize::new(0);
    let promising = combine::by_promise(&setup, &null, &nuisance, &candidates, &columns);
    let mut fits = search::singles(&setup, &null, &promising, &|label| {
        let k = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        progress(0.05 + 0.45 * k as f64 / candidates.len() as f64, label);
    });
    if let Some(limits) =
        limits_of_its_sensor(&setup, &fits, &mut not_testable).filter(|_| !setup.stop.asked())
    {
        fits.extend(search::singles(&setup, &null, &[limits], &|_| ()));
    }
    if fits.is_empty() && setup.stop.asked() {
        return Err(DiagnosisError::Stopped);
    }
    progress(0.5, "unknown cause");
    let weighed = std::sync::atomic::AtomicUsize::new(0);
    let mut answers = posterior::weigh(&setup, &null, &nuisance, fits, options, &|label| {
        let k = weighed.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        progress((0.5 + 0.1 * k as f64).min(1.0), label);
    });
    answers.hold_to_predictions(&setup);
    let mut columns = columns;
    columns
        .extend(unknown::kinds(&setup).into_iter().map(|kind| unknown::columns(&setup, &null, &null, kind)));
    let score = detect::p_value(&nuisance, &columns, options.seed);
    let p_value = detect::by_either(score, answers.log_evidence);
    Ok(Found { setup, null, answers, p_value, not_testable, absorbed, readings })
}

/// What the search found, before the conclusions.
struct Found {
    setup: Setup,
    null: Fit,
    answers: posterior::Posterior,
    p_value: f64,
    not_testable: Vec<library::NotTestable>,
    absorbed: Vec<Absorbed>,
    /// What the raw readings show.
    readings: Vec<ReadingEffect>,
}

impl Found {
    /// Whether the leading answer reaches the sensors' noise.
    fn reaches_noise(&self) -> bool {
        self.answers.leader(&self.null).shooting_error <= INEXACT
    }
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
    let (mut with_best, mut times_are_all) = (None, false);
    if detected && acted.is_none() && !answers.names() {
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
        answers.refute(setup, &null);
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
    let best = &answers.leader(&null).clone();
    readings.extend(scattered);

    let explanations = explain::explain(
        &explain::Evidence {
            setup,
            null: &null,
            posterior: &answers,
            absorbed: &absorbed,
            not_testable: &not_testable,
        },
        &options.explain,
    );

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
    let black_box = answers.residual(named).map_or_else(|| with_effect.clone(), row);

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
    if detected && named && acted.is_none() && (causes.is_empty() || closes_nothing) {
        answers.doubt(left_of_what_can_be(setup, best, refitted, with_effect, options.seed));
    }
    if let Some(acted) = acted {
        readings.push(acted.effect.clone());
        causes.push(acted.effect);
    }
    if !(causes.is_empty() || detected && named) {
        answers.stand_beside_another(&null);
    }
    let hint = of_size.as_ref().map(readings::in_words);
    let unexplained = Unexplained { probability: answers.unexplained, share, hint };
    let chance = causes.iter().chain(&of_size).map(|r| (0.5 * r.evidence).exp()).fold(p_value, f64::min);
    let (mean_detected, detected) = (detected, detected || !causes.is_empty());
    let shown = if mean_detected && named { best } else { &null };
    let which = answers::which(setup, &answers, &causes);
    let report = Report {
        summary: String::new(),
        system: system.name.clone(),
        recordings: vec![title.into()],
        gap: Gap { detected, p_value: chance.max(f64::MIN_POSITIVE), score: how_far.refitted },
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
        // Where there is no gap, nothing asks to be told apart; an experiment is the dearest part of a report.
        confusable: if mean_detected { confusable(setup, &null, &answers, options.seed) } else { Vec::new() },
        how_far,
        closed_loop: None,
        corrected_system: None,
        explanations,
        interrupted: setup.stop.interrupted(|label| answers.answers.iter().any(|a| a.class.contains(label))),
        made_from: None,
    };
    let mut found = if mean_detected && named { answers::fitted_effects(setup, best) } else { Vec::new() };
    found.extend(causes.iter().map(|r| FittedEffect {
        name: r.name.clone(),
        place: r.place.clone(),
        parameters: r.parameters.clone(),
    }));
    let effects = answers::corrected_effects(setup, &found);
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
fn left_of_what_can_be(setup: &Setup, best: &Fit, before: &Row, after: &Row, seed: u64) -> Left {
    let simulator = library::simulator(setup, &best.hypothesis, best.residuals.clone());
    let floor = floor::expected(setup, &simulator, best.estimate(), &best.innovation.noise);
    if after.mean_square() <= floor {
        return Left { closed: 1.0, above: 0.0 };
    }
    let closed = quantify::closed_to(floor, before, after, seed);
    let closed = if closed.value > 0.0 { closed.high } else { closed.value };
    let reached = best.shooting_error <= INEXACT;
    let above = if reached { (1.0 - closed) * (before.mean_square() / floor - 1.0).max(0.0) } else { 0.0 };
    Left { closed, above }
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
