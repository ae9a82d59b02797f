//! Commands that never arrived, one by one: the machine went on with the one before.
//!
//! A model that believes the recorded commands takes what many losses leave for process noise, so much of it that it learns
//! from every reading, and no single loss shows for longer than one. So the process noise is lowered step by step, as the
//! temperature is in deterministic annealing (Rose 1998): the losses that show best are believed first, and with less noise
//! the others show for longer. What was believed too soon is taken back once it no longer explains anything.

use parallax_model::effect::Place;

use super::acted::{Acted, TOLD, refitted};
use super::beam::{Beam, FIRST_RATE, Losses};
use super::found;
use super::scatter;
use super::still::come_at_rest;
use crate::experiment::Held;
use crate::filter::{self, Noise, Start};
use crate::library;
use crate::report::Value;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;
use crate::shooting::{lateness, locate};
use crate::simulator::Simulator;
use crate::statistics::root_mean_square;

/// Steps by which the process noise is lowered, the size of one in the logarithm of its variance, and looks at each.
const STEPS: usize = 7;
const STEP: f64 = 1.15;
const LOOKS: usize = 3;

/// Rounds under a fit to what is believed, at most.
const ROUNDS: usize = 8;

/// Rounds that bring nothing, after which nothing more is expected: beliefs may go back and forth.
const PATIENCE: usize = 2;

/// Share of the mean squared error of short windows without losses down to which they must bring it where it stays above that of an
/// exact model.
const LEFT: f64 = 0.1;

/// Changes of a command from which the losses of some can be told.
const ENOUGH: usize = 10;

/// Share of the commands beyond which it is no loss but another effect.
pub(super) const MOST: f64 = 0.4;

/// Losses from which they are an effect, and the share of the commands from which fewer are as well: one of a thousand that
/// seems to be lost is where the model is off by a little.
pub(super) const FEWEST: usize = 3;
pub(super) const RAREST: f64 = 0.01;

/// Share of a typical change of the command below which one tells nothing of what such changes do.
const LEAST_CHANGE: f64 = 0.05;

/// Mean square of the share of lost commands that acted after all from which they were not lost: that of shares which are anything
/// that is nearer to none than to all.
const PARTLY: f64 = 1.0 / 12.0;

/// The same, with what the noise of the readings adds to it, below which they are known to be lost as a whole: what the form of another
/// effect is off by seems to be a part of some commands.
const WHOLLY: f64 = 0.03;

/// Commands of one input, as they were sent and as they are believed to have acted.
struct Believed<'a> {
    clean: Setup,
    input: usize,
    sent: &'a Held,
    /// Share of the commands that is believed lost.
    rate: f64,
}

/// What was found under one fit to what is believed.
struct Round {
    cost: f64,
    error: f64,
    /// Share of the commands that is lost, and how many tell it.
    rate: f64,
    of: usize,
    /// Mean square of the share of each lost command that acted after all, with what noise adds to it.
    arrived: f64,
    acted: Held,
}

/// What the innovations of a fitted model say of the losses at one input, where it can be losses of few.
pub(super) fn look(setup: &Setup, fit: &Fit, noise: &Noise, input: usize) -> Option<Losses> {
    Believed::nothing(setup, input).look(fit, noise)
}

/// The losses at one input under a hypothesis, and −2 log evidence with them.
pub(super) fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Acted> {
    let mut believed = Believed::nothing(setup, input);
    let first = believed.look(base, &base.innovation.noise)?;
    // Losses that hardly show above the process noise that they were taken for show once there is less of it, unless a model that
    // lacks something else needs it.
    let shows = base.shooting_error <= INEXACT && first.lost.contains(&true);
    if first.gain < TOLD && !shows {
        return None;
    }
    believed.revise(&first.lost);
    believed.anneal(base);
    let Round { cost, error, rate, of: telling, arrived, acted } = believed.settle(base)?;
    believed.clean.experiment.inputs[input] = acted.clone();
    let (of, losses) = (believed.changes().len(), believed.stamps());
    let accident = losses.len() < FEWEST && (losses.len() as f64) < RAREST * of as f64;
    let told = -0.5 * (cost - base.innovation.evidence_cost);
    if accident
        || told < TOLD
        || come_at_rest(setup, base, &losses, believed.changes().into_iter().map(|at| (at, 1.0)))
    {
        return None;
    }
    // Of those that hardly change anything nobody knows: they are lost as often as the others.
    let std = (rate * (1.0 - rate) / telling as f64).sqrt();
    let value = Value { value: rate, std, unit: String::new() };
    let density = scatter::density_at_input(setup, base, input, (f64::INFINITY, rate.sqrt()));
    let effect =
        found("drops", place.to_string(), ("rate", value), -2.0 * told, true, density.unwrap_or_default());
    let recorded = believed.sent.clone();
    let wholly = arrived < WHOLLY;
    Some(Acted { input, recorded, acted, effect, by_chance: true, wholly, cost, error })
}

impl<'a> Believed<'a> {
    fn nothing(setup: &'a Setup, input: usize) -> Self {
        Believed { clean: setup.clone(), input, sent: &setup.experiment.inputs[input], rate: FIRST_RATE }
    }

    fn acted(&self) -> &Held {
        &self.clean.experiment.inputs[self.input]
    }

    /// Looks again and again, each time with less process noise than the fit has.
    fn anneal(&mut self, fit: &Fit) {
        let mut noise = fit.innovation.noise.clone();
        for _ in 0..STEPS {
            for _ in 0..LOOKS {
                let Some(found) = self.look(fit, &noise).filter(|_| !self.clean.stop.asked()) else { break };
                if !self.revise(&found.lost) {
                    break;
                }
            }
            if noise.log_process <= self.clean.noise.process_floor {
                break;
            }
            noise.log_process = (noise.log_process - STEP).max(self.clean.noise.process_floor);
        }
    }

    /// Fits the hypothesis to what is believed, and believes what the fit says, in turn. Gives the likeliest of it that can be losses.
    fn settle(&mut self, base: &Fit) -> Option<Round> {
        let mut best: Option<Round> = None;
        let (mut worse, mut settled, mut from) = (0, false, base.clone());
        for _ in 0..ROUNDS {
            if worse == PATIENCE || self.stamps().is_empty() || self.clean.stop.asked() {
                break;
            }
            let fit = refitted(&self.clean, &from);
            let Some(beam) = self.beam(&fit, &fit.innovation.noise) else { break };
            let (mut rate, (arrived, noise)) = (self.rate, beam.arrived());
            let found = beam.losses(&mut rate);
            let Some(found) = can_be(found) else { break };
            self.rate = rate;
            let (cost, error) = (fit.innovation.evidence_cost + self.price(&found), fit.shooting_error);
            // What leaves predictions worse than no loss at all is no loss, and what leaves much to be explained follows that.
            let nearer = error <= base.shooting_error.min(INEXACT.max(LEFT * base.shooting_error));
            // What is off by about as much as it explains is something else, and the form of another effect may hold the machine
            // still.
            let is_loss =
                arrived - noise < PARTLY && (base.hypothesis.effects.is_empty() || self.are_single());
            worse += 1;
            if nearer && is_loss && best.as_ref().is_none_or(|best| cost < best.cost) {
                worse = 0;
                let (rate, of, acted) = (found.rate, found.of, self.acted().clone());
                best = Some(Round { cost, error, rate, of, arrived, acted });
            }
            // Beside the same losses a fit may get further from where it came to: the first one began beside none.
            let same = !self.revise(&found.lost);
            if same && settled {
                break;
            }
            settled = same;
            if error < from.shooting_error {
                (worse, from) = (0, fit);
            }
        }
        best
    }

    /// Stamps of the commands that are believed lost (s).
    fn stamps(&self) -> Vec<f64> {
        let (sent, acted) = (self.sent, self.acted());
        let lost = (1..sent.values.len()).filter(|&k| acted.values[k] != sent.values[k]);
        lost.map(|k| sent.times[k]).collect()
    }

    /// Stamps of the commands that change anything (s).
    fn changes(&self) -> Vec<f64> {
        let sent = self.sent;
        let changes = (1..sent.values.len()).filter(|&k| sent.values[k] != sent.values[k - 1]);
        changes.map(|k| sent.times[k]).collect()
    }

    /// What the innovations say of all commands, where it can be losses of few.
    fn look(&mut self, fit: &Fit, noise: &Noise) -> Option<Losses> {
        let mut rate = self.rate;
        let found = self.beam(fit, noise)?.losses(&mut rate);
        self.rate = rate;
        can_be(found)
    }

    /// The commands along a walk of what is believed; nothing where they hardly change, or an effect with a memory spreads them.
    fn beam(&self, fit: &Fit, noise: &Noise) -> Option<Beam<'_>> {
        let (setup, acted) = (&self.clean, self.acted());
        if self.changes().len() < ENOUGH {
            return None;
        }
        let mut disturbed = setup.clone();
        let other = self.otherwise();
        disturbed.experiment.inputs[self.input] = other.clone();
        let plain = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
        let aside = library::simulator(&disturbed, &fit.hypothesis, fit.residuals.clone());
        let theta = fit.theta();
        let stamps = plain.in_force(theta, self.input)?;
        let in_force =
            stamps.iter().map(|s| acted.times.partition_point(|t| t <= s).saturating_sub(1)).collect();
        let (mut run, mut beside) = (plain.run_at(theta), aside.run_at(theta));
        let late = lateness(run.events());
        let own = setup.train.iter().map(|s| (s, true)).chain(setup.test.iter().map(|s| (s, false)));
        let (mut starts, mut trained) = (Vec::new(), Vec::new());
        for (segment, is_trained) in own {
            let (from, to) = (segment.from, segment.to);
            let Some((first, end)) = locate(run.events(), late, from, to) else { continue };
            let guess = &segment.guess;
            let (state, std) = plain.start(guess.state(from), guess.std(), run.events()[first].time);
            starts.push(Start { first, end, from, counts_from: from, weighs_from: from, to, state, std });
            trained.push(is_trained);
        }
        let chains =
            filter::chains(&mut *run, &mut *beside, &starts, plain.states(), &setup.noise.scale, noise);
        let stretches = chains.into_iter().zip(trained).collect();
        Some(Beam { sent: self.sent, acted, other, in_force, stretches })
    }

    /// Whether the losses come one by one, as chance has it: a machine that holds still while the command goes on looks as if many in a
    /// row were lost.
    fn are_single(&self) -> bool {
        let (sent, acted) = (&self.sent.values, &self.acted().values);
        let is_lost = |k: usize| acted[k] != sent[k];
        let runs = (1..sent.len()).filter(|&k| is_lost(k) && !is_lost(k - 1)).count();
        2 * runs > self.stamps().len()
    }

    /// For each command another one that may have acted: the opposite of what is believed, or any other where that is the same.
    fn otherwise(&self) -> Held {
        let (sent, acted) = (self.sent, self.acted());
        let changes: Vec<f64> = sent.values.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let typical = root_mean_square(&changes);
        let mut other = acted.clone();
        for (k, value) in other.values.iter_mut().enumerate() {
            let opposite =
                if *value != sent.values[k] { sent.values[k] } else { acted.values[k.saturating_sub(1)] };
            let differs = (opposite - *value).abs() > LEAST_CHANGE * typical;
            *value = if differs { opposite } else { *value + typical };
        }
        other
    }

    /// Believes that these commands were lost. Gives whether that is new.
    fn revise(&mut self, lost: &[bool]) -> bool {
        let held = &mut self.clean.experiment.inputs[self.input];
        let mut new = false;
        for (k, lost) in lost.iter().enumerate().skip(1) {
            let value = if *lost { held.values[k - 1] } else { self.sent.values[k] };
            new |= value != held.values[k];
            held.values[k] = value;
        }
        new
    }

    /// What stating the losses costs on the time that is fitted: as little as the doubt about each of them allows, or all of
    /// it where the look would rather have others.
    fn price(&self, found: &Losses) -> f64 {
        if found.trained <= 0.0 {
            return -2.0 * found.trained;
        }
        let trained = |time: f64| self.clean.train.iter().any(|s| (s.from..s.to).contains(&time));
        let count = |stamps: Vec<f64>| stamps.into_iter().filter(|stamp| trained(*stamp)).count() as f64;
        let (lost, of) = (count(self.stamps()), count(self.changes()));
        let rate = (lost / of.max(1.0)).clamp(1e-6, 1.0 - 1e-6);
        -2.0 * (lost * rate.ln() + (of - lost) * (1.0 - rate).ln()) + of.max(1.0).ln()
    }
}

/// What can be losses of few.
fn can_be(found: Losses) -> Option<Losses> {
    (found.gain.is_finite() && found.rate < MOST).then_some(found)
}
