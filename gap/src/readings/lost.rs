//! Commands that never arrived, one by one: the machine went on with the one before.
//!
//! A model that believes the recorded commands takes what many losses leave for process noise, so much of it that it learns
//! from every reading, and no single loss shows for longer than one. So the process noise is lowered step by step, as the
//! temperature is in deterministic annealing (Rose 1998): the losses that show best are believed first, and with less noise
//! the others show for longer. What was believed too soon is taken back once it no longer explains anything.

use parallax_model::effect::Place;

use super::acted::{Acted, TOLD, refitted};
use super::found;
use super::kicks::{Kicks, Lost};
use super::scatter;
use crate::experiment::Held;
use crate::filter::Noise;
use crate::report::Value;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;

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

/// Share of the commands beyond which it is no loss but another effect.
const MOST: f64 = 0.4;

/// Losses from which they are an effect, and the share of the commands from which fewer are as well: one of a thousand that
/// seems to be lost is where the model is off by a little.
pub(super) const FEWEST: usize = 3;
pub(super) const RAREST: f64 = 0.01;

/// Commands of one input, as they were sent and as they are believed to have acted.
struct Believed<'a> {
    clean: Setup,
    input: usize,
    sent: &'a Held,
}

/// The losses at one input under a hypothesis, and −2 log evidence with them.
pub(super) fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Acted> {
    let mut believed = Believed { clean: setup.clone(), input, sent: &setup.experiment.inputs[input] };
    let mut noise = base.innovation.noise.clone();
    let first = believed.look(base, &noise)?.1;
    // Losses that hardly show above the process noise that they were taken for show once there is less of it, unless a model that
    // lacks something else needs it.
    let shows = base.shooting_error <= INEXACT && !first.otherwise.is_empty();
    if first.gain < TOLD && !shows {
        return None;
    }
    believed.revise(&first.otherwise);
    for _ in 0..STEPS {
        for _ in 0..LOOKS {
            let Some((_, lost)) = believed.look(base, &noise).filter(|_| !setup.stop.asked()) else { break };
            if !believed.revise(&lost.otherwise) {
                break;
            }
        }
        noise.log_process = (noise.log_process - STEP).max(setup.noise.process_floor);
    }
    let mut best: Option<(f64, f64, f64, Held)> = None;
    let mut worse = 0;
    for _ in 0..ROUNDS {
        if worse == PATIENCE || believed.losses(|_| true) == 0 || setup.stop.asked() {
            break;
        }
        let fit = refitted(&believed.clean, base);
        let Some((kicks, lost)) = believed.look(&fit, &fit.innovation.noise) else { break };
        let cost = fit.innovation.evidence_cost + believed.price(&kicks);
        // What leaves predictions worse than no loss at all is no loss, and what leaves much to be explained follows that.
        let most = base.shooting_error.min(INEXACT.max(LEFT * base.shooting_error));
        let nearer = fit.shooting_error <= most;
        worse += 1;
        if nearer && best.as_ref().is_none_or(|(least, ..)| cost < *least) {
            worse = 0;
            best = Some((cost, fit.shooting_error, lost.rate, believed.acted().clone()));
        }
        if !believed.revise(&lost.otherwise) {
            break;
        }
    }
    let (cost, error, rate, acted) = best?;
    believed.clean.experiment.inputs[input] = acted.clone();
    let (of, losses) = (believed.changes(|_| true), believed.losses(|_| true));
    let accident = losses < FEWEST && (losses as f64) < RAREST * of as f64;
    let told = -0.5 * (cost - base.innovation.evidence_cost);
    if accident || told < TOLD {
        return None;
    }
    // Of those that hardly change anything nobody knows: they are lost as often as the others.
    let std = (rate * (1.0 - rate) / of as f64).sqrt();
    let value = Value { value: rate, std, unit: String::new() };
    let density = scatter::density_at_input(setup, base, input, (f64::INFINITY, rate.sqrt()));
    let effect =
        found("drops", place.to_string(), ("rate", value), -2.0 * told, true, density.unwrap_or_default());
    let recorded = believed.sent.clone();
    Some(Acted { input, recorded, acted, effect, cost, error })
}

impl Believed<'_> {
    fn acted(&self) -> &Held {
        &self.clean.experiment.inputs[self.input]
    }

    /// Commands that are believed lost, of those sent at times for which `within` holds.
    fn losses(&self, within: impl Fn(f64) -> bool) -> usize {
        let (sent, acted) = (self.sent, self.acted());
        (1..sent.values.len()).filter(|&k| within(sent.times[k]) && acted.values[k] != sent.values[k]).count()
    }

    /// Commands that change anything, of those sent at such times.
    fn changes(&self, within: impl Fn(f64) -> bool) -> usize {
        let sent = self.sent;
        (1..sent.values.len())
            .filter(|&k| within(sent.times[k]) && sent.values[k] != sent.values[k - 1])
            .count()
    }

    /// What the innovations say of each command, and of all together where it can be losses of few.
    fn look(&self, fit: &Fit, noise: &Noise) -> Option<(Kicks, Lost)> {
        let kicks = Kicks::beside(&self.clean, fit, noise, (self.input, self.sent), f64::INFINITY)?;
        let lost = kicks.lost();
        (lost.rate < MOST).then_some((kicks, lost))
    }

    /// Believes the opposite of these commands. Gives whether there are any.
    fn revise(&mut self, otherwise: &[usize]) -> bool {
        let held = &mut self.clean.experiment.inputs[self.input];
        let mut lost: Vec<bool> = held.values.iter().zip(&self.sent.values).map(|(a, b)| a != b).collect();
        for &k in otherwise {
            lost[k] = !lost[k];
        }
        for (k, lost) in lost.into_iter().enumerate().skip(1) {
            held.values[k] = if lost { held.values[k - 1] } else { self.sent.values[k] };
        }
        !otherwise.is_empty()
    }

    /// What stating the losses costs on the time that is fitted: as little as the doubt about each of them allows, or all of
    /// it where the look would rather have others.
    fn price(&self, kicks: &Kicks) -> f64 {
        let trained = |time: f64| self.clean.train.iter().any(|s| (s.from..s.to).contains(&time));
        let gain = kicks.part(trained).lost().gain;
        if gain <= 0.0 {
            return -2.0 * gain;
        }
        let (of, lost) = (self.changes(trained) as f64, self.losses(trained) as f64);
        let rate = (lost / of.max(1.0)).clamp(1e-6, 1.0 - 1e-6);
        -2.0 * (lost * rate.ln() + (of - lost) * (1.0 - rate).ln()) + of.max(1.0).ln()
    }
}
