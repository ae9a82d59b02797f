//! All hypotheses, weighed: once, and again where what was found says that the data are to be seen otherwise.

use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::DMatrix;
use parallax_model::system::Equations;

use super::screen::{chosen, outgrown, screen};
use super::{DiagnosisError, Options, prepare};
use crate::combine;
use crate::detect;
use crate::experiment::Experiment;
use crate::held_out;
use crate::hypothesis::EffectAt;
use crate::library;
use crate::posterior;
use crate::readings::{self, Acted, Raw, ReadingEffect};
use crate::report::Absorbed;
use crate::search::{self, Fit, INEXACT};
use crate::setup::{Setup, without_rests};
use crate::signature::Nuisance;
use crate::unknown;

/// What the search found, before the conclusions.
pub(super) struct Found {
    pub(super) setup: Setup,
    pub(super) null: Fit,
    pub(super) answers: posterior::Posterior,
    pub(super) p_value: f64,
    pub(super) not_testable: Vec<library::NotTestable>,
    pub(super) absorbed: Vec<Absorbed>,
    /// What the raw readings show.
    pub(super) readings: Vec<ReadingEffect>,
}

impl Found {
    /// Whether the leading answer reaches the sensors' noise.
    fn reaches_noise(&self) -> bool {
        self.answers.leader(&self.null).shooting_error <= INEXACT
    }
}

/// Every single effect, fitted, before they are weighed.
pub(super) struct Searched {
    pub(super) setup: Setup,
    pub(super) null: Fit,
    nuisance: Nuisance,
    pub(super) fits: Vec<Fit>,
    /// What was fitted, the most promising first.
    pub(super) promising: Vec<EffectAt>,
    /// The signature of each of the candidates.
    columns: Vec<DMatrix<f64>>,
    absorbed: Vec<Absorbed>,
    not_testable: Vec<library::NotTestable>,
}

/// What all rounds on one recording share.
pub(super) struct Rounds<'a> {
    pub(super) equations: Equations,
    pub(super) title: &'a str,
    pub(super) options: &'a Options,
    /// Whether the effects that the options name are checked against what this system has.
    pub(super) checked: bool,
    pub(super) progress: &'a (dyn Fn(f64, &str) + Sync),
}

impl Rounds<'_> {
    /// What was found in the end, and commands that acted otherwise than they were recorded. What is weighed again takes the rest of the
    /// bar: progress never goes back.
    pub(super) fn run(&self, experiment: Experiment) -> Result<(Found, Option<Acted>), DiagnosisError> {
        let experiment = without_rests(experiment, self.options.horizon);
        let mut raw = Raw::of(&self.equations, &experiment);
        let mut found = self.weigh(&raw, &experiment, None, (0.0, 0.75))?;
        // What happens on held-out time alone cannot be learned, and shows once what happens elsewhere is known.
        let leader = found.answers.leader(&found.null);
        let fairer = || held_out::fairer(&found.setup, leader).filter(|_| !found.setup.stop.asked());
        let held_out = if found.reaches_noise() && found.answers.names() { fairer() } else { None };
        if held_out.is_some() {
            found = self.again(&raw, &experiment, held_out, (0.75, 0.8))?.unwrap_or(found);
        }
        // What was said of the readings before any model knew them is held to the models that do.
        let fits = [&found.null, found.answers.leader(&found.null)];
        let doubted = readings::contradicted(&found.setup, &raw, &experiment, &fits);
        if !doubted.is_empty() && !found.setup.stop.asked() {
            let mut believed = raw.clone();
            doubted.into_iter().for_each(|output| believed.take_back(output));
            // Readings that all count must not hide a model that predicted them.
            let hides = |again: &Found| !again.reaches_noise() && found.reaches_noise();
            let again = self.again(&believed, &experiment, held_out, (0.8, 0.86))?;
            if let Some(again) = again.filter(|again| !hides(again)) {
                (raw, found) = (believed, again);
            }
        }
        (self.progress)(0.86, "lost and late commands");
        let acted = readings::acted(&found.setup, &experiment, &found.null, &found.answers, self.options);
        let Some(by_chance) = acted.as_ref().filter(|acted| acted.by_chance) else {
            return Ok((found, acted));
        };
        // What else there is shows once it is known what acted.
        let before = found.null.shooting_error;
        let beside = self.again(&raw, &by_chance.replaced(experiment), held_out, (0.86, 0.92))?;
        let Some(mut beside) = beside else { return Ok((found, None)) };
        beside.answers.forgive(&beside.null, before);
        beside.answers.stand_beside_another(&beside.null);
        Ok((beside, acted))
    }

    /// Everything up to the weights of the answers, from where the progress bar is to where it will be.
    fn weigh(
        &self,
        raw: &Raw,
        experiment: &Experiment,
        held_out: Option<usize>,
        (from, to): (f64, f64),
    ) -> Result<Found, DiagnosisError> {
        let progress = |done: f64, label: &str| (self.progress)(from + (to - from) * done, label);
        let (options, equations) = (self.options, self.equations.clone());
        let Searched { setup, null, nuisance, fits, promising, columns, absorbed, not_testable } =
            self.search(equations, raw, experiment, held_out, &|done, label| progress(0.5 * done, label))?;
        let mut gathered = posterior::Gathered::new(&setup, &null, fits, &promising);
        if let Some(best) = gathered.best(&null).cloned() {
            let more = |done: f64, label: &str| progress(0.5 + 0.1 * done, label);
            if let Some((joint, left)) = self.beside(&setup, &best, experiment, &more) {
                gathered.join(&setup, &null, joint, left);
            }
        }
        progress(0.6, "unknown cause");
        let weighed = AtomicUsize::new(0);
        let mut answers = posterior::weigh(&setup, &null, &nuisance, gathered, options, &|label| {
            let k = weighed.fetch_add(1, Ordering::Relaxed) + 1;
            progress((0.6 + 0.1 * k as f64).min(1.0), label);
        });
        answers.leave_out_nothing(&setup, &null);
        answers.hold_to_predictions(&setup);
        let mut columns = columns;
        columns.extend(
            unknown::kinds(&setup).into_iter().map(|kind| unknown::columns(&setup, &null, &null, kind)),
        );
        let score = detect::p_value(&nuisance, &columns, options.seed);
        let p_value = detect::by_either(score, answers.log_evidence);
        Ok(Found { setup, null, answers, p_value, not_testable, absorbed, readings: raw.effects() })
    }

    /// Every single effect, fitted; `progress` goes from 0 to 1.
    pub(super) fn search(
        &self,
        equations: Equations,
        raw: &Raw,
        experiment: &Experiment,
        held_out: Option<usize>,
        progress: &(dyn Fn(f64, &str) + Sync),
    ) -> Result<Searched, DiagnosisError> {
        progress(0.0, "nominal model");
        let options = self.options;
        let (setup, null) = prepare(equations, experiment, raw, self.title, options, held_out)?;
        if setup.stop.asked() {
            return Err(DiagnosisError::Stopped);
        }
        // Parameters that are off show most at the frequencies of the commands, and hide what repeats at another.
        let setup = setup.with_more_lines_of(&null.innovation.pass);
        let nuisance = Nuisance::new(&null);
        let (mut candidates, mut not_testable) = library::candidates(&setup);
        candidates.extend(outgrown(&setup, &null));
        if self.checked {
            let mut known = library::known(&setup);
            known.extend(candidates.iter().cloned());
            options.check(&known)?;
        }
        let candidates = chosen(candidates, &mut not_testable, options);
        let (candidates, columns, absorbed) = screen(&setup, &null, &nuisance, candidates, &mut not_testable);
        let done = AtomicUsize::new(0);
        let promising = combine::by_promise(&setup, &null, &nuisance, &candidates, &columns);
        let fits = search::singles(&setup, &null, &promising, &|label| {
            let k = done.fetch_add(1, Ordering::Relaxed) + 1;
            progress(0.1 + 0.9 * k as f64 / candidates.len() as f64, label);
        });
        if fits.is_empty() && setup.stop.asked() {
            return Err(DiagnosisError::Stopped);
        }
        Ok(Searched { setup, null, nuisance, fits, promising, columns, absorbed, not_testable })
    }

    /// The same; nothing for who is stopped meanwhile, and has what was found before.
    fn again(
        &self,
        raw: &Raw,
        experiment: &Experiment,
        held_out: Option<usize>,
        bar: (f64, f64),
    ) -> Result<Option<Found>, DiagnosisError> {
        match self.weigh(raw, experiment, held_out, bar) {
            Err(DiagnosisError::Stopped) => Ok(None),
            found => found.map(Some),
        }
    }
}
