//! Commands that came late by chance, one by one: the machine went on with the one before for so long.
//!
//! Responses are in proportion to the lateness where that is short beside what the plant does meanwhile, so that the most
//! likely lateness of all commands solves one banded linear system; where it is not, again from there (Gauss–Newton on
//! hidden times with a Gaussian prior, weighed by Laplace's approximation: Bishop 2006, section 4.4).

use parallax_model::effect::{Effect, Place};

use super::acted::{Acted, TOLD, refitted};
use super::kicks::{Kicks, Late};
use super::scatter::{self, MOST_PERIODS};
use super::still::come_at_rest;
use super::{ReadingEffect, found, lost};
use crate::experiment::Held;
use crate::filter::Noise;
use crate::hypothesis::{EffectAt, Slot};
use crate::library;
use crate::report::Value;
use crate::search::{self, Fit, INEXACT};
use crate::setup::Setup;

/// Rounds in which times are moved, at most.
const ROUNDS: usize = 5;

/// Share of the mean squared error of short windows without them down to which times that were moved must bring it where
/// it stays above that of an exact model: commands that are late by several periods are found a few at a time.
const LEFT: f64 = 0.05;

/// Log evidence from which times are moved at all: what scatters much hides in the noise that it is taken for, until the
/// first of it is known.
const WORTH_A_LOOK: f64 = 2.0;

/// Share of what times explain together that the most telling of them do.
const MOST: f64 = 0.5;

/// Standard deviation of a spread, as a share of it, up to which it is one.
const SURE: f64 = 0.5;

/// Steps in which another process noise is tried, as logarithms of variances, and how many at most.
const STEP: f64 = 1.0;
const STEPS: usize = 8;

/// Ratios of a spread to that of losses between which it is one of losses. A spread is found too large rather than too small: on
/// development data 1.0 to 1.6 times that of the losses that it was, and of times that scatter at most 0.7.
const AS_LOST: std::ops::Range<f64> = 1.0 / 1.3..2.0;

/// Part of the log, and the share of what its commands explain of all, beyond which times that scatter are what befell the machine once: a
/// gust kicks it for a while.
const ONCE: f64 = 0.125;
const MOST_OF_ONCE: f64 = 0.8;

/// Messages do not overtake each other: the least time between two (s).
const APART: f64 = 1e-9;

/// What one look at the innovations says of the times of commands.
#[derive(Clone)]
struct Look {
    /// The commands that it speaks of, by their index, and by how much each was late, in units.
    commands: Vec<usize>,
    shares: Vec<f64>,
    /// What each of these explains of the innovations.
    explained: Vec<f64>,
    late: Late,
    /// −2 log likelihood on the time that is fitted: of commands that scatter so, and of innovations as they are.
    scattered: f64,
    plain: f64,
    /// Log evidence for commands that scatter on the time that is fitted.
    fitted: f64,
    /// The innovations as they would be had no command been moved.
    all: Kicks,
}

/// The innovations under one process noise.
struct Level {
    /// The responses of commands as they are now, on all of the log and on the time that is fitted.
    kicks: Kicks,
    fitted: Kicks,
    /// By how much each command was moved already, in units.
    already: Vec<f64>,
    /// As the innovations would be had none been moved, and what they say.
    all: Kicks,
    late: Late,
}

impl Look {
    /// Whether they were late: kicks at the same times that do not go with what the commands change, but with what others do, or
    /// that are all alike, say less.
    fn is_of_changes(&self, most: f64) -> bool {
        let own = self.late.gain - self.all.exchanged().late(most).gain;
        own >= TOLD && self.all.go_with_changes(&self.late, most)
    }

    /// Whether the commands of one part of the log, between these times (s), say most of it.
    fn is_of_once(&self, recorded: &Held, (from, to): (f64, f64)) -> bool {
        let of = |k: usize| (recorded.times[self.commands[k]], self.explained[k].max(0.0));
        let all: Vec<(f64, f64)> = (0..self.commands.len()).map(of).collect();
        let length = ONCE * (to - from);
        let within = |begin: f64| {
            let part = all.iter().filter(|(time, _)| (begin..begin + length).contains(time));
            part.map(|(_, explained)| explained).sum::<f64>()
        };
        let most = all.iter().map(|(time, _)| within(*time)).fold(0.0, f64::max);
        most > MOST_OF_ONCE * all.iter().map(|(_, explained)| explained).sum::<f64>()
    }

    /// The commands that say most of it.
    fn telling(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.commands.len()).collect();
        order.sort_by(|a, b| self.explained[*b].total_cmp(&self.explained[*a]));
        let mut left = MOST * self.explained.iter().filter(|e| **e > 0.0).sum::<f64>();
        let says = |k: &usize| {
            let more = left > 0.0;
            left -= self.explained[*k];
            more
        };
        order.into_iter().take_while(says).map(|k| self.commands[k]).collect()
    }
}

/// Commands that were moved to when they most likely acted, under a hypothesis that was fitted to that.
struct Moved {
    setup: Setup,
    /// −2 log evidence with the price of the times, and the mean squared error of short windows, in noise units squared.
    cost: f64,
    error: f64,
    /// What the innovations say then.
    last: Look,
    /// What all are late by beside that (s).
    delay: f64,
    /// The longest spread that was looked for, and the lateness to which responses belong (s).
    most: f64,
    unit: f64,
}

/// The times at which the commands of one input acted under a hypothesis.
pub(super) fn under(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Acted> {
    let recorded = &setup.experiment.inputs[input];
    let Moved { setup: clean, cost, error, last, delay, most, unit } =
        moved_in_rounds(setup, base, input, place)?;
    let told = -0.5 * (cost - base.innovation.evidence_cost);
    // Times are told where a command changes much.
    let telling: Vec<f64> = last.telling().iter().map(|k| recorded.times[*k]).collect();
    let all = last.commands.iter().map(|k| recorded.times[*k]).zip(last.all.energies());
    let once = last.is_of_once(recorded, setup.experiment.span());
    // A spread that is not told from none is of times that are their mean.
    let scatters = last.late.std < SURE * last.late.spread;
    if told < TOLD
        || !scatters
        || once
        || !last.is_of_changes(most)
        || come_at_rest(setup, base, &telling, all)
    {
        return None;
    }
    let mut acted = clean.experiment.inputs[input].clone();
    // What all are late by is of their times, and nothing beside them.
    acted.times.iter_mut().for_each(|time| *time += delay);
    let value = Value { value: last.late.spread, std: last.late.std, unit: "s".into() };
    let density = scatter::density_at_input(setup, base, input, (unit, last.late.spread / unit));
    let effect =
        found("jitter", place.to_string(), ("spread", value), -2.0 * told, true, density.unwrap_or_default());
    Some(Acted {
        input,
        recorded: recorded.clone(),
        acted,
        effect,
        by_chance: true,
        wholly: false,
        cost,
        error,
    })
}

/// By how much the commands of one input scatter (s), where they can be moved, as responses to times that differ much are not in
/// proportion to them; and the mean squared error of short windows that is left then, in noise units squared.
pub(super) fn spread(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<(Value, f64)> {
    let Moved { last, error, .. } = moved_in_rounds(setup, base, input, place)?;
    let Late { spread, std, .. } = last.late;
    (std < SURE * spread).then(|| (Value { value: spread, std, unit: "s".into() }, error))
}

/// Moves the commands of one input to when they most likely acted, and looks again, as long as that explains more.
fn moved_in_rounds(setup: &Setup, base: &Fit, input: usize, place: &Place) -> Option<Moved> {
    let recorded = &setup.experiment.inputs[input];
    let period = recorded.period();
    if period <= 0.0 {
        return None;
    }
    let (most, unit) = (MOST_PERIODS * period, period.min(setup.period));
    let look = |clean: &Setup, fit: &Fit| look(clean, fit, (input, recorded), (unit, most));
    // All by their mean, where that alone explains something.
    let in_time = |clean: &mut Setup, fit: Fit| {
        let Some(mean) = mean_lateness(clean, &fit, place) else { return fit };
        clean.experiment.inputs[input].times.iter_mut().for_each(|time| *time += mean);
        refitted(clean, base)
    };
    let (mut clean, mut fit, mut last) = (setup.clone(), base.clone(), look(setup, base)?);
    if last.late.log_evidence < WORTH_A_LOOK && last.late.gain > TOLD {
        fit = in_time(&mut clean, fit);
        last = look(&clean, &fit)?;
    }
    if last.late.log_evidence < WORTH_A_LOOK {
        return None;
    }
    let mut best: Option<(f64, f64, Setup, Look)> = None;
    let mut delay = of_all(base, place);
    // Times that are short beside the commands' period, under a model that leaves nothing else, are as their responses say, in
    // proportion; of all of the log, as most of what speaks for them lies in how much else scatters.
    if fit.shooting_error <= INEXACT && last.late.spread < period && last.fitted > WORTH_A_LOOK {
        let mut there = clean.clone();
        there.experiment.inputs[input] = moved(recorded, &last, unit);
        let cost = fit.innovation.evidence_cost - 2.0 * last.late.log_evidence;
        best = Some((cost, fit.shooting_error, there, last.clone()));
    }
    for _ in 0..ROUNDS {
        clean.experiment.inputs[input] = moved(recorded, &last, unit);
        let fit = refitted(&clean, base);
        let fit = in_time(&mut clean, fit);
        last = look(&clean, &fit)?;
        // Mean and spread are paid for. Whatever is still to come does not count: times that explain the readings do so
        // once they are moved.
        let price = last.scattered - last.plain + 2.0 * (last.commands.len() as f64).ln();
        let cost = fit.innovation.evidence_cost + price.max(0.0);
        if best.as_ref().is_some_and(|(least, ..)| cost > least - 1.0) {
            break;
        }
        // What wants to be larger than it can be is something else.
        if fit.shooting_error <= INEXACT.max(LEFT * base.shooting_error) && last.late.spread < 0.95 * most {
            best = Some((cost, fit.shooting_error, clean.clone(), last.clone()));
            delay = of_all(&fit, place);
        }
    }
    let (cost, error, setup, last) = best?;
    Some(Moved { setup, cost, error, last, delay, most, unit })
}

/// Late commands as lost ones, where that is what their times say.
pub(super) fn as_lost(setup: &Setup, base: &Fit, late: &Acted) -> Option<ReadingEffect> {
    let sent = &late.recorded;
    let changes: Vec<usize> =
        (1..sent.values.len()).filter(|&k| sent.values[k] != sent.values[k - 1]).collect();
    let count = changes.len() as f64;
    let mean = changes.iter().map(|&k| late.acted.times[k] - sent.times[k]).sum::<f64>() / count;
    let spread = late.effect.parameters.get("spread")?;
    let rate = lost_share(mean, spread.value, sent.period())?;
    // The share goes with the square of the spread, and is known no better than that.
    let std = (rate * (1.0 - rate) / count).sqrt().hypot(2.0 * rate * spread.std / spread.value);
    let value = Value { value: rate, std, unit: String::new() };
    let density = scatter::density_at_input(setup, base, late.input, (f64::INFINITY, rate.sqrt()));
    let (place, evidence) = (late.effect.place.clone(), late.effect.evidence);
    Some(found("drops", place, ("rate", value), evidence, true, density.unwrap_or_default()))
}

/// The share of commands that is lost, where that is what their times say: one that is lost is late by a period, and the others are not
/// at all, so that of a share p the mean is p periods and the spread √(p (1 − p)) of them. What is late by chance is so more often and by
/// less: its spread is about its mean, not twice it.
fn lost_share(mean: f64, spread: f64, period: f64) -> Option<f64> {
    let share = mean / period;
    let ratio = spread / (period * (share * (1.0 - share)).sqrt());
    ((lost::RAREST..lost::MOST).contains(&share) && AS_LOST.contains(&ratio)).then_some(share)
}

/// The delay of all commands that a fit has there (s).
pub(super) fn of_all(fit: &Fit, place: &Place) -> f64 {
    let effects = &fit.hypothesis.effects;
    let of = effects.iter().position(|at| at.effect == Effect::Delay && at.place == *place);
    of.and_then(|of| fit.hypothesis.of_effect(of).next()).map_or(0.0, |k| fit.theta()[k])
}

/// How late all commands still are (s), where that explains something: calibrated parameters, fitted meanwhile, can stand in
/// for much of it.
fn mean_lateness(setup: &Setup, fit: &Fit, place: &Place) -> Option<f64> {
    let delay = EffectAt { effect: Effect::Delay, place: place.clone() };
    let mut stated = setup.equations.system().effects.iter();
    if fit.hypothesis.effects.contains(&delay)
        || stated.any(|e| e.name == delay.effect.name() && e.place == place.to_string())
    {
        return None;
    }
    let mut effects = fit.hypothesis.effects.clone();
    effects.push(delay);
    let with = search::fit_part(setup, fit, library::hypothesis(setup, &effects), fit);
    let slot = Slot::Effect { effect: effects.len() - 1, parameter: 0 };
    let mean = with.theta()[with.hypothesis.fitted.iter().position(|f| f.slot == slot)?];
    (with.innovation.evidence_cost < fit.innovation.evidence_cost).then_some(mean)
}

/// Looks at the innovations of a model under commands that were moved already; times in units of `unit` (s).
///
/// Commands that scatter are process noise to a model that takes them as they were sent: without them there is less. Where they
/// were moved as is likeliest, the noise that was fitted then lacks what they do not tell: there is more.
fn look(
    clean: &Setup,
    fit: &Fit,
    (input, recorded): (usize, &Held),
    (unit, most): (f64, f64),
) -> Option<Look> {
    let times = &clean.experiment.inputs[input].times;
    let trained = |stamp: f64| clean.train.iter().any(|s| (s.from..s.to).contains(&stamp));
    let under = |noise: &Noise| {
        let kicks = Kicks::new(clean, fit, noise, input, unit)?.in_units_of(unit);
        let late_by = |k: &usize| (times[*k] - recorded.times[*k]) / unit;
        let already: Vec<f64> = kicks.commands().iter().map(late_by).collect();
        let all = kicks.with(&already);
        let late = all.late(most);
        Some(Level { fitted: kicks.part(trained), kicks, already, all, late })
    };
    let mut best = under(&fit.innovation.noise)?;
    // What every noise is held to: commands that are all late by the same time, and as they are.
    let (same, plain) = (best.all.of_same(), best.fitted.plain());
    let same_fitted = best.fitted.with(&best.already).of_same();
    for direction in [-STEP, STEP] {
        let (mut noise, begun) = (fit.innovation.noise.clone(), best.late.log_evidence);
        for _ in 0..STEPS {
            noise.log_process += direction;
            if best.late.log_evidence <= 0.0 || noise.log_process < clean.noise.process_floor {
                break;
            }
            let Some(mut next) = under(&noise) else { break };
            next.late.log_evidence -= 0.5 * (next.all.of_same() - same);
            if next.late.log_evidence <= best.late.log_evidence {
                break;
            }
            best = next;
        }
        if best.late.log_evidence > begun {
            break;
        }
    }
    let Level { kicks, fitted, already, all, late } = best;
    let shares = all.shares(&late)?;
    let explained = all.explained(&shares);
    let scattered = fitted.scattered(&already, &late);
    let part = fitted.with(&already);
    let fitted = part.late(most).log_evidence - 0.5 * (part.of_same() - same_fitted);
    Some(Look { commands: kicks.commands(), shares, explained, late, scattered, plain, fitted, all })
}

/// The commands at the times that the look found, in their order.
fn moved(recorded: &Held, look: &Look, unit: f64) -> Held {
    moved_by(recorded, look.commands.iter().zip(&look.shares).map(|(k, share)| (*k, share * unit)))
}

/// The commands, some of them late by so much (s), in their order: none overtakes another.
pub(super) fn moved_by(recorded: &Held, late: impl Iterator<Item = (usize, f64)>) -> Held {
    let mut held = recorded.clone();
    for (k, late) in late {
        held.times[k] += late;
    }
    let mut last = f64::NEG_INFINITY;
    for time in &mut held.times {
        *time = time.max(last + APART);
        last = *time;
    }
    held
}

#[cfg(test)]
mod tests {
    use super::lost_share;

    #[test]
    fn what_is_rarely_late_by_a_period_is_lost() {
        let period = 0.005;
        for share in [0.02, 0.1, 0.2, 0.35] {
            let (mean, spread) = (share * period, period * f64::sqrt(share * (1.0 - share)));
            for off in [0.85, 1.0, 1.15, 1.6] {
                assert!(
                    lost_share(mean, off * spread, period).is_some_and(|found| (found - share).abs() < 1e-9)
                );
            }
        }
        // Half a normal distribution, an exponential and a uniform one.
        for ratio in [1.32, 1.0, 1.73] {
            for spread in [0.02, 0.1, 0.2, 0.5, 1.0, 2.0] {
                assert_eq!(
                    lost_share(ratio * spread * period, spread * period, period),
                    None,
                    "{ratio} {spread}"
                );
            }
        }
        assert_eq!(lost_share(-0.1 * period, 0.3 * period, period), None, "none acts before it is sent");
        assert_eq!(lost_share(f64::NAN, 0.3 * period, period), None);
    }
}
