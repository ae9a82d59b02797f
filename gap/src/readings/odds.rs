//! What commands that are late on average are: all late by the same time, late by chance, or not there now and then.
//!
//! Times that are late and never early have a spread of about their mean: of an exponential distribution it is the mean, of a uniform one
//! from zero 0.58 of it, and less where something fixed is added. Where a share p of the commands is lost, which is then late by a period,
//! the mean is p periods and the spread √(p (1 − p)) of them, far more than the mean. So the mean says how large the spread would be, and
//! the innovations under a model that has the mean say whether it is there ([`super::kicks`]).

use parallax_model::effect::{Effect, Place, PlaceKind};

use super::kicks::Kicks;
use super::{ReadingEffect, found, late, lost, scatter};
use crate::hypothesis::EffectAt;
use crate::report::Value;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;

/// Spreads of times that are late and never early, in units of their mean: from where a third of the mean is by chance. Even in their
/// logarithm.
const SPREADS: (f64, f64) = (1.0 / 3.0, 1.2);
const GRID: usize = 9;

/// Steps in which less process noise is tried, as logarithms of variances, and how many at most: what scatters was taken for it.
const STEP: f64 = 1.0;
const STEPS: usize = 6;

/// One of these.
pub(crate) struct Way {
    /// The effect, and the same as it was found.
    pub(crate) effect: Effect,
    pub(crate) found: ReadingEffect,
    /// Log evidence against commands that are all late by the same time.
    pub(crate) log_evidence: f64,
}

/// What commands of one input may be that are late by this delay of a fit on average: late by chance, or lost.
pub(crate) fn odds(setup: &Setup, fit: &Fit, delay: &EffectAt) -> Vec<Way> {
    let Some(late) = OnAverage::of(setup, fit, delay) else { return Vec::new() };
    [late.by_chance(), late.now_and_then()].into_iter().flatten().collect()
}

/// Commands of one input that are late on average.
struct OnAverage<'a> {
    setup: &'a Setup,
    fit: &'a Fit,
    input: usize,
    place: &'a Place,
    /// By how much (s), and the standard deviation of that.
    mean: f64,
    std: f64,
    /// The commands' period, and the lateness to which responses belong (s).
    period: f64,
    unit: f64,
    /// What each command would leave, under the process noise of the fit and under less.
    levels: Vec<Kicks>,
    /// Log likelihood of commands that are all late by the same time.
    same: f64,
}

impl<'a> OnAverage<'a> {
    fn of(setup: &'a Setup, fit: &'a Fit, delay: &'a EffectAt) -> Option<Self> {
        let inputs = &setup.equations.system().inputs;
        let here = |name: &String| delay.place == Place::new(PlaceKind::Input, name.clone());
        let input = inputs.iter().position(|input| here(&input.name))?;
        let of = fit.hypothesis.effects.iter().position(|at| at == delay && at.effect == Effect::Delay)?;
        let parameter = fit.hypothesis.of_effect(of).next()?;
        let (mean, std) = (fit.theta()[parameter], fit.std()[parameter]);
        let period = setup.experiment.inputs[input].period();
        if period <= 0.0 || mean <= 0.0 || setup.stop.asked() {
            return None;
        }
        let unit = period.min(setup.period);
        let mut noise = fit.innovation.noise.clone();
        let mut levels = Vec::new();
        while levels.len() < STEPS && (levels.is_empty() || noise.log_process > setup.noise.process_floor) {
            levels.push(Kicks::new(setup, fit, &noise, input, unit)?.in_units_of(unit));
            noise.log_process -= STEP;
        }
        let same = levels.iter().map(|kicks| log(kicks, 0.0)).fold(f64::NEG_INFINITY, f64::max);
        let place = &delay.place;
        Some(Self { setup, fit, input, place, mean, std, period, unit, levels, same })
    }

    /// Log likelihood of a spread (s), against commands that are all late by the same time.
    fn log(&self, spread: f64) -> f64 {
        self.levels.iter().map(|kicks| log(kicks, spread)).fold(f64::NEG_INFINITY, f64::max) - self.same
    }

    /// They are late by chance.
    fn by_chance(&self) -> Option<Way> {
        let (low, high) = (SPREADS.0 * self.mean, SPREADS.1 * self.mean);
        let at = |k: usize| low * (high / low).powf(k as f64 / (GRID - 1) as f64);
        let all: Vec<(f64, f64)> = (0..GRID).map(at).map(|spread| (spread, self.log(spread))).collect();
        let top = all.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
        let mean_of = |of: &dyn Fn(f64) -> f64| {
            all.iter().map(|(spread, log)| of(*spread) * (log - top).exp()).sum::<f64>() / GRID as f64
        };
        let evidence = mean_of(&|_| 1.0);
        let spread = mean_of(&|spread| spread) / evidence;
        let log = self.of_changes(spread, top + evidence.ln())?;
        let std = (mean_of(&|other| (other - spread).powi(2)) / evidence).sqrt();
        let coarse = Value { value: spread, std, unit: "s".into() };
        let sharp = (log > 0.0).then(|| late::spread(self.setup, self.fit, self.input, self.place)).flatten();
        let left = sharp.as_ref().map_or(self.fit.shooting_error, |(_, left)| *left);
        if log > 0.0 && left.min(self.fit.shooting_error) > INEXACT {
            return None;
        }
        let value = sharp.map_or(coarse, |(value, _)| value);
        let share = value.value / self.unit;
        Some(self.way(Effect::Jitter, ("spread", value), (self.unit, share), log))
    }

    /// Some of them never arrive.
    fn now_and_then(&self) -> Option<Way> {
        let rate = self.mean / self.period;
        if !(lost::RAREST..lost::MOST).contains(&rate) {
            return None;
        }
        let spread = self.period * (rate * (1.0 - rate)).sqrt();
        let log = self.of_changes(spread, self.log(spread))?;
        if log > 0.0 && self.fit.shooting_error > INEXACT {
            return None;
        }
        let value = Value { value: rate, std: self.std / self.period, unit: String::new() };
        Some(self.way(Effect::Drops, ("rate", value), (f64::INFINITY, rate.sqrt()), log))
    }

    /// The log evidence for a spread, unless kicks at the same times that do not go with what the commands change, but are all alike or go
    /// with what others change, say as much for it: then it is nothing that befell the commands.
    fn of_changes(&self, spread: f64, evidence: f64) -> Option<f64> {
        let best = self.levels.iter().max_by(|a, b| log(a, spread).total_cmp(&log(b, spread)))?;
        let others = || [best.even(), best.exchanged()];
        let told = evidence <= 0.0 || others().iter().all(|other| log(other, spread) < log(best, spread));
        (told && evidence.is_finite()).then_some(evidence)
    }

    fn way(&self, effect: Effect, parameter: (&str, Value), (late, share): (f64, f64), log: f64) -> Way {
        let density = scatter::density_at_input(self.setup, self.fit, self.input, (late, share));
        let (name, place) = (effect.name(), self.place.to_string());
        let found = found(name, place, parameter, -2.0 * log, true, density.unwrap_or_default());
        Way { effect, found, log_evidence: log }
    }
}

/// Log likelihood of commands whose times have this spread (s), up to a constant.
fn log(kicks: &Kicks, spread: f64) -> f64 {
    -0.5 * if spread > 0.0 { kicks.of_spread(spread) } else { kicks.of_same() }
}
