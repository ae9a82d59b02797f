//! Commands that never arrived, one by one: the machine went on with the one before.
//!
//! To a model that believes the recorded commands each loss is a kick from nowhere, which it takes for noise. Once the
//! losses are known the noise is the sensors' again, and the next losses show. So they are looked for in rounds, under the
//! nominal model and under the leading answer, and believed where stating each of them costs less than it explains.

use parallax_model::effect::{Effect, Place, PlaceKind};

use super::kicks::{Kicks, Lost};
use super::scatter::{self, MOST_PERIODS};
use super::{ReadingEffect, found};
use crate::experiment::{Experiment, Held};
use crate::hypothesis::EffectAt;
use crate::options::Options;
use crate::posterior::Posterior;
use crate::report::Value;
use crate::search::{self, Fit};
use crate::setup::Setup;

/// Rounds in which further losses are looked for, at most.
const ROUNDS: usize = 4;

/// Log likelihood by which losses must explain more than nothing.
const TOLD: f64 = 10.0;

/// Share of the commands beyond which it is no loss but another effect.
const MOST: f64 = 0.4;

/// Losses from which they are an effect, and the share of the commands from which fewer are as well: one of a thousand that
/// seems to be lost is where the model is off by a little.
const FEWEST: usize = 3;
const RAREST: f64 = 0.01;

/// Difference of −2 log evidence by which losses must beat every other answer.
const DECISIVE: f64 = 20.0;

/// Commands of one input that are lost.
#[derive(Clone, Debug)]
pub(crate) struct LostCommands {
    /// The input.
    pub(crate) input: usize,
    /// The commands as they were recorded.
    pub(crate) recorded: Held,
    /// What acted: each lost command replaced by the one before it.
    acted: Held,
    /// The losses as an effect.
    pub(crate) effect: ReadingEffect,
}

impl LostCommands {
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

/// Lost commands that explain more than every other answer; `raw` is the recording before it was thinned.
#[must_use]
pub(crate) fn lost(
    setup: &Setup,
    raw: &Experiment,
    null: &Fit,
    answers: &Posterior,
    options: &Options,
) -> Option<LostCommands> {
    let leader = answers.leader(null);
    let others = [Some(null), Some(leader), answers.residual(true), answers.residual(false)];
    let best = others.into_iter().flatten().map(|f| f.innovation.evidence_cost).fold(f64::INFINITY, f64::min);
    let system = setup.equations.system();
    let mut leading: Option<(f64, LostCommands)> = None;
    for (input, entry) in system.inputs.iter().enumerate() {
        let place = Place::new(PlaceKind::Input, entry.name.clone());
        let at = EffectAt { effect: Effect::Drops, place: place.clone() };
        let stated = system.effects.iter().any(|e| e.name == "drops" && e.place == place.to_string());
        // Averaged commands are no longer those that were sent.
        let averaged = raw.inputs[input].times != setup.experiment.inputs[input].times;
        if stated || averaged || !options.allows(&at) || setup.stop.asked() {
            continue;
        }
        // Under the nominal model first: what the losses leave for others to explain is looked for afterwards.
        let bases = [null, leader].into_iter().take(if leader.hypothesis.effects.is_empty() { 1 } else { 2 });
        let believed =
            |base: &Fit| under(setup, base, input, &place).filter(|(cost, _)| *cost < best - DECISIVE);
        if let Some((cost, lost)) = bases.into_iter().find_map(believed)
            && leading.as_ref().is_none_or(|(least, _)| cost < *least)
        {
            leading = Some((cost, lost));
        }
    }
    leading.map(|(_, lost)| lost)
}

/// The losses at one input under a hypothesis, and −2 log evidence with them.
fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<(f64, LostCommands)> {
    let recorded = &setup.experiment.inputs[input];
    let (mut clean, mut fit) = (setup.clone(), base.clone());
    let mut first: Option<Lost> = None;
    for _ in 0..ROUNDS {
        let Some(lost) = round(&clean, &fit, input) else { break };
        let held = &mut clean.experiment.inputs[input];
        for &k in &lost.commands {
            held.values[k] = held.values[k - 1];
        }
        fit = match base.hypothesis.effects.is_empty() {
            true => search::null(&clean),
            false => {
                let null = search::null(&clean);
                search::fit_part(&clean, &null, base.hypothesis.clone(), base)
            }
        };
        first.get_or_insert(lost);
    }
    let first = first?;
    let acted = clean.experiment.inputs[input].clone();
    let differ = |k: &usize| acted.values[*k] != recorded.values[*k];
    let changes = |k: &usize| recorded.values[*k] != recorded.values[*k - 1];
    let trained = |k: &usize| setup.train.iter().any(|s| (s.from..s.to).contains(&recorded.times[*k]));
    let all: Vec<usize> = (1..recorded.values.len()).filter(changes).collect();
    let code = |of: usize, lost: usize| {
        let (of, lost) = (of as f64, lost as f64);
        let rate = (lost / of.max(1.0)).clamp(1e-6, 1.0 - 1e-6);
        -2.0 * (lost * rate.ln() + (of - lost) * (1.0 - rate).ln()) + of.max(1.0).ln()
    };
    let count = |which: &dyn Fn(&usize) -> bool| all.iter().filter(|k| which(k)).count();
    let cost = fit.innovation.evidence_cost + code(count(&trained), count(&|k| trained(k) && differ(k)));
    let losses = count(&differ);
    let rate = losses as f64 / all.len().max(1) as f64;
    let accident = losses < FEWEST && rate < RAREST;
    if rate > MOST || losses == 0 || accident || is_late(&clean, &fit, input) {
        return None;
    }
    let std = (rate * (1.0 - rate) / all.len() as f64).sqrt();
    let value = Value { value: rate, std, unit: String::new() };
    let density = scatter::density_of_losses(setup, base, input, rate);
    let effect = found(
        "drops",
        place.to_string(),
        ("rate", value),
        -2.0 * first.gain,
        true,
        density.unwrap_or_default(),
    );
    Some((cost, LostCommands { input, recorded: recorded.clone(), acted, effect }))
}

/// Whether the times of the commands that arrived scatter: then those that were latest passed for lost.
fn is_late(setup: &Setup, fit: &Fit, input: usize) -> bool {
    let kicks = Kicks::new(setup, fit, &fit.innovation.noise, input, f64::INFINITY);
    kicks.is_some_and(|kicks| kicks.late(MOST_PERIODS * kicks.lateness()).log_evidence > TOLD)
}

/// Losses that one look at the innovations shows.
fn round(setup: &Setup, fit: &Fit, input: usize) -> Option<Lost> {
    let lost = Kicks::new(setup, fit, &fit.innovation.noise, input, f64::INFINITY)?.lost();
    (lost.gain > TOLD && lost.rate < MOST && !lost.commands.is_empty()).then_some(lost)
}
