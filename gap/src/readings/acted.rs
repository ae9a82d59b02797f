//! Commands that acted otherwise than they were recorded, one by one: those that never arrived ([`super::lost`]), and those
//! that came late by chance ([`super::late`]) or where they are large ([`super::large`]).
//!
//! To a model that believes the recorded commands each of them is a kick from nowhere, which it takes for noise. Once it is
//! known what acted, the noise is the sensors' again, and what else there is shows. So they are looked for in rounds, under
//! the nominal model and under the leading answer, and believed where stating each of them costs less than it explains.

use parallax_model::effect::{Effect, Place, PlaceKind};
use rayon::prelude::*;

use super::{ReadingEffect, large, late, lost};
use crate::experiment::{Experiment, Held};
use crate::hypothesis::EffectAt;
use crate::judge::Judge;
use crate::options::Options;
use crate::posterior::Posterior;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;

/// Log likelihood by which commands that acted otherwise must explain more than nothing.
pub(super) const TOLD: f64 = 10.0;

/// Difference of −2 log evidence by which they must beat every other answer, under a model that reaches the noise without them and
/// under one that does not.
const DECISIVE: (f64, f64) = (10.0, 20.0);

/// The same by which a leading effect that reaches the noise must beat the nominal model for this one to be no base to look from.
const EXPLAINED: f64 = 150.0;

/// Share of what the best of them explains from which commands that are late where they are large are what happened.
const MOST: f64 = 0.5;

/// Mean squared error of short windows, in noise units squared, below which nothing is left but noise.
const AT_FLOOR: f64 = 1.0;

/// Commands of one input that acted otherwise than they were recorded.
#[derive(Clone, Debug)]
pub(crate) struct Acted {
    /// The input.
    pub(super) input: usize,
    /// The commands as they were recorded.
    pub(super) recorded: Held,
    /// What acted, and when.
    pub(super) acted: Held,
    /// What happened to them, as an effect.
    pub(crate) effect: ReadingEffect,
    /// Whether it befell them by chance: what goes with their size is no effect of the library.
    pub(crate) by_chance: bool,
    /// Whether each of them is known to have been lost as a whole.
    pub(super) wholly: bool,
    /// −2 log evidence with them, and the mean squared residual of short windows, in noise units squared.
    pub(super) cost: f64,
    pub(super) error: f64,
}

impl Acted {
    /// The recording with what acted in place of what was sent.
    pub(crate) fn replaced(&self, mut experiment: Experiment) -> Experiment {
        experiment.inputs[self.input] = self.acted.clone();
        experiment
    }

    /// The setup with the commands as they were recorded.
    pub(crate) fn as_recorded(&self, setup: &Setup) -> Setup {
        let mut setup = setup.clone();
        setup.experiment.inputs[self.input] = self.recorded.clone();
        setup
    }
}

/// What became of the commands of one input, at this place, under a hypothesis.
type Way = fn(&Setup, &Fit, usize, &Place) -> Option<Acted>;

/// Commands that acted otherwise, where that explains more than every other answer; `raw` is the recording before it was
/// thinned.
#[must_use]
pub(crate) fn acted(
    setup: &Setup,
    raw: &Experiment,
    null: &Fit,
    answers: &Posterior,
    options: &Options,
) -> Option<Acted> {
    let leader = answers.leader(null);
    let others = [Some(null), Some(leader), answers.residual(true), answers.residual(false)];
    let best = others.into_iter().flatten().map(|f| f.innovation.evidence_cost).fold(f64::INFINITY, f64::min);
    let system = setup.equations.system();
    let ways: [(Effect, Way); 3] =
        [(Effect::Drops, lost::under), (Effect::Jitter, late::under), (Effect::Delay, large::under)];
    let judge = Judge::new(null, []);
    let gain = null.innovation.evidence_cost - leader.innovation.evidence_cost;
    let explained = leader.shooting_error <= INEXACT && gain > EXPLAINED;
    let tried = |(input, effect, under): (usize, Effect, Way)| {
        let place = Place::new(PlaceKind::Input, system.inputs[input].name.clone());
        let at = EffectAt { effect, place: place.clone() };
        let open = |at: &EffectAt| {
            let mut stated = system.effects.iter();
            options.allows(at)
                && !stated.any(|e| e.name == at.effect.name() && e.place == at.place.to_string())
        };
        if !open(&at) || setup.stop.asked() {
            return None;
        }
        // Under the nominal model first: what they leave for others to explain is looked for afterwards. A leader stands in for
        // what is no effect of the library, however much it explains.
        let plain = (!explained || effect == Effect::Delay).then_some(null);
        let named = (!leader.hypothesis.effects.is_empty()).then_some(leader);
        // What joined the leader's first effect may be there for what these commands left.
        let mean = EffectAt { effect: Effect::Delay, place: place.clone() };
        let late = alike(answers).find(|fit| effect != Effect::Drops && is_only(fit, &mean));
        let mut bases = plain.into_iter().chain(part_of(answers, leader)).chain(named).chain(late);
        let lost = EffectAt { effect: Effect::Drops, place: place.clone() };
        bases.find_map(|base| {
            let mut acted = under(setup, base, input, &place).filter(|acted| {
                // What is less than a leading effect's form may be off by is its form; where that leaves nothing, or they were
                // lost as a whole, a few lost commands may still be told, times that scatter a little are of how commands are
                // held between their stamps. A machine that sticks, or is stopped, forgets what it was told whatever became of
                // it, and a form of that which leaves anything does so in such moments: there lost commands must show as well as
                // an effect does. A delay of the same commands is the mean of their times, whatever they go with, and no form of
                // them.
                let forgets = base.hypothesis.effects.iter().any(|at| forgets(at.effect));
                let shows = !forgets || base.innovation.evidence_cost - acted.cost > EXPLAINED;
                let (lost, at_floor) = (effect == Effect::Drops, base.shooting_error < AT_FLOOR);
                let is_mean = !lost && is_only(base, &mean);
                let material =
                    judge.is_material_from(base.shooting_error, acted.error) && (!lost || shows || at_floor);
                let told = lost && shows && (at_floor || acted.wholly);
                let form = base.shooting_error <= INEXACT
                    && !base.hypothesis.effects.is_empty()
                    && !(is_mean || material || told);
                let margin = if base.shooting_error <= INEXACT { DECISIVE.0 } else { DECISIVE.1 };
                acted.cost < best - margin && !form
            })?;
            if effect == Effect::Jitter
                && open(&lost)
                && let Some(drops) = late::as_lost(setup, base, &acted)
            {
                acted.effect = drops;
            }
            Some(acted)
        })
    };
    // Averaged commands are no longer those that were sent.
    let as_sent = |input: &usize| raw.inputs[*input].times == setup.experiment.inputs[*input].times;
    let inputs = (0..system.inputs.len()).filter(as_sent);
    let all: Vec<(usize, Effect, Way)> =
        inputs.flat_map(|input| ways.map(|(effect, under)| (input, effect, under))).collect();
    let found: Vec<Acted> = all.into_par_iter().filter_map(tried).collect();
    // Times that are free follow what one rule says as well, and whatever else the model lacks.
    let gain = found.iter().map(|acted| best - acted.cost).fold(0.0, f64::max);
    let ruled = |acted: &Acted| !acted.by_chance && best - acted.cost > MOST * gain;
    // Of equals the first.
    found.into_iter().min_by(|a, b| ruled(b).cmp(&ruled(a)).then(a.cost.total_cmp(&b.cost)))
}

/// Whether an effect has the machine forget what it was told: it stands, whatever became of a command.
fn forgets(effect: Effect) -> bool {
    effect.is_dry() || matches!(effect, Effect::EndStop | Effect::EndStopLower | Effect::EndStopBoth)
}

/// What the data do not tell from the leading answer.
fn alike(answers: &Posterior) -> impl Iterator<Item = &Fit> {
    answers.answers.first().into_iter().flat_map(|answer| &answer.alike)
}

pub(super) fn is_only(fit: &Fit, at: &EffectAt) -> bool {
    fit.hypothesis.effects.len() == 1 && fit.hypothesis.effects[0] == *at
}

/// The best answer with a single effect that is one of several of the leader's.
fn part_of<'a>(answers: &'a Posterior, leader: &Fit) -> Option<&'a Fit> {
    let effects = &leader.hypothesis.effects;
    let singles = answers.answers.iter().flat_map(|answer| [&answer.fit].into_iter().chain(&answer.alike));
    let parts = singles.filter(|fit| {
        let own = &fit.hypothesis.effects;
        effects.len() > 1 && own.len() == 1 && effects.contains(&own[0])
    });
    parts.min_by(|a, b| answers.cost(a).total_cmp(&answers.cost(b)))
}

/// The same hypothesis, fitted to a recording with other commands, from where it is.
pub(super) fn refitted(setup: &Setup, base: &Fit) -> Fit {
    if base.hypothesis.effects.is_empty() {
        return search::null_from(setup, &base.innovation.noise, base.theta());
    }
    search::fit_part(setup, base, base.hypothesis.clone(), base)
}
