//! Times that scatter, and commands that are lost: what they leave in the innovations of a fitted model.
//!
//! A reading taken at another time is wrong by its rate times the difference; so the innovation's variance grows with
//! the square of what a small delay would change. A command that is lost leaves the one before for one more period: a
//! shift of known size, now and then. A wrong mean leaves innovations that resemble their neighbours instead, so only
//! white ones are judged.

use parallax_model::effect::{Effect, Place, PlaceKind};

use super::peak::{Peak, peak};
use super::{LogDensity, ReadingEffect, found};
use crate::hypothesis::EffectAt;
use crate::innovation::{Segment, walk};
use crate::library;
use crate::report::Value;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::{median, root_mean_square};

/// Correlation of successive innovations up to which they count as white.
const WHITE: f64 = 0.25;

/// Whitened innovations, and what a small delay at one place would change in them (1/s).
struct Sensitivity {
    innovations: Vec<f64>,
    by_delay: Vec<f64>,
}

/// Scatter at every input and output under a fitted model of the mean: `jitter` of both, `drops` of inputs.
///
/// Places where the model has a delay that this log cannot show are left out.
#[must_use]
pub fn scatter(setup: &Setup, fit: &Fit) -> Vec<ReadingEffect> {
    let system = setup.equations.system();
    let inputs = system.inputs.iter().map(|i| Place::new(PlaceKind::Input, i.name.clone()));
    let outputs = system.outputs.iter().map(|o| Place::new(PlaceKind::Output, o.name.clone()));
    let mut effects = Vec::new();
    for (place, input) in inputs.map(|p| (p, true)).chain(outputs.map(|p| (p, false))) {
        let Some(train) = sensitivity(setup, fit, &setup.train, &place) else { continue };
        let Some(test) = sensitivity(setup, fit, &setup.test, &place) else { continue };
        let name = place.to_string();
        effects.extend(jitter(&train, &test, &name));
        if input {
            let index = system.inputs.iter().position(|i| i.name == place.key).unwrap_or(0);
            let times = &setup.experiment.inputs[index].times;
            let period = median(&mut times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>());
            effects.extend(drops(&train, &test, period, &name));
        }
    }
    effects
}

fn sensitivity(setup: &Setup, fit: &Fit, segments: &[Segment], place: &Place) -> Option<Sensitivity> {
    let mut effects = fit.hypothesis.effects.clone();
    effects.retain(|e| !(e.effect == Effect::Delay && e.place == *place));
    effects.push(EffectAt { effect: Effect::Delay, place: place.clone() });
    let hypothesis = library::hypothesis(setup, &effects);
    let simulator = library::simulator(setup, &hypothesis, Vec::new());
    let known = |name: &str, slot| {
        let same = fit.hypothesis.fitted.iter().position(|f| f.slot == slot && f.name == name);
        same.map(|k| fit.theta()[k])
    };
    let last = hypothesis.fitted.len().checked_sub(1)?;
    // A delay that was fitted stays where it is; elsewhere a small one stands for none.
    let fitted_delay = fit.hypothesis.fitted.iter().zip(fit.theta()).find(|(f, _)| f.name == "delay");
    let theta: Vec<f64> = hypothesis
        .fitted
        .iter()
        .enumerate()
        .map(|(k, f)| {
            let start = f.starts.first().copied().unwrap_or(f.null);
            if k == last && effects.len() > fit.hypothesis.effects.len() {
                0.01 * start
            } else if k == last {
                fitted_delay.map_or(start, |(_, value)| *value)
            } else {
                known(&f.name, f.slot).unwrap_or(f.null)
            }
        })
        .collect();
    let pass = walk(&simulator, segments, &setup.noise, &fit.innovation.noise, &theta);
    let p = hypothesis.fitted.len();
    let by_delay: Vec<f64> = pass.whitened_by_parameter().iter().skip(last).step_by(p).copied().collect();
    let innovations = pass.whitened();
    let usable = innovations.len() > 50
        && by_delay.len() == innovations.len()
        && innovations.iter().chain(&by_delay).all(|v| v.is_finite())
        && root_mean_square(&by_delay) > 0.0;
    usable.then_some(Sensitivity { innovations, by_delay })
}

impl Sensitivity {
    fn is_white(&self) -> bool {
        let (mut across, mut along) = (0.0, 0.0);
        for pair in self.innovations.windows(2) {
            across += pair[0] * pair[1];
            along += pair[0] * pair[0];
        }
        along > 0.0 && across.abs() < WHITE * along
    }

    /// Log likelihood of innovations of variance `floor`² + (spread × sensitivity)².
    fn log_jitter(&self, spread: f64, floor: f64) -> f64 {
        let pairs = self.innovations.iter().zip(&self.by_delay);
        pairs
            .map(|(e, h)| {
                let variance = floor * floor + (spread * h).powi(2);
                -0.5 * (e * e / variance + variance.ln())
            })
            .sum()
    }

    /// The same with the floor that makes it largest.
    fn best_floor(&self, spread: f64) -> f64 {
        let size = root_mean_square(&self.innovations);
        let candidates = (0..60).map(|k| size * 1.05_f64.powi(-k));
        candidates
            .max_by(|a, b| self.log_jitter(spread, *a).total_cmp(&self.log_jitter(spread, *b)))
            .unwrap_or(size)
    }
}

fn jitter(train: &Sensitivity, test: &Sensitivity, place: &str) -> Option<ReadingEffect> {
    let plain = train.best_floor(0.0);
    let null = train.log_jitter(0.0, plain);
    // The spread at which it would double the variance, give or take a factor of a hundred.
    let natural = plain / root_mean_square(&train.by_delay);
    let spread = peak(1e-2 * natural, 1e2 * natural, |spread| {
        train.log_jitter(spread, train.best_floor(spread)) - null
    });
    let floor = train.best_floor(spread.value);
    let count = test.innovations.len() as f64;
    let constant = 0.5 * std::f64::consts::TAU.ln();
    let without = test.log_jitter(0.0, plain) / count - constant;
    let with = test.log_jitter(spread.value, floor) / count - constant;
    let density = LogDensity { without, with, best: with.max(without) };
    let value = Value { value: spread.value, std: spread.std, unit: "s".into() };
    let notable = train.is_white() && spread.value > 0.2 * natural && with > without;
    Some(found("jitter", place.into(), ("spread", value), -2.0 * spread.log_evidence, notable, density))
}

/// A command that is lost shifts the innovation by what a delay of one period would.
fn drops(train: &Sensitivity, test: &Sensitivity, period: f64, place: &str) -> Option<ReadingEffect> {
    if period <= 0.0 {
        return None;
    }
    let size = root_mean_square(&train.innovations);
    let log = |of: &Sensitivity, rate: f64, floor: f64| -> f64 {
        of.innovations
            .iter()
            .zip(&of.by_delay)
            .map(|(e, h)| {
                let (near, lost) = ((e / floor).powi(2), ((e - period * h) / floor).powi(2));
                let most = (-0.5 * near).max(-0.5 * lost);
                let sum = (1.0 - rate) * (-0.5 * near - most).exp() + rate * (-0.5 * lost - most).exp();
                most + sum.ln() - floor.ln()
            })
            .sum()
    };
    let floors: Vec<f64> = (0..40).map(|k| size * 1.05_f64.powi(-k)).collect();
    let best = |rate: f64| {
        let floor = floors.iter().copied().max_by(|a, b| log(train, rate, *a).total_cmp(&log(train, rate, *b)));
        floor.unwrap_or(size)
    };
    let plain = best(0.0);
    let null = log(train, 0.0, plain);
    let rate: Peak = peak(1e-3, 0.9, |rate| log(train, rate, best(rate)) - null);
    let floor = best(rate.value);
    let count = test.innovations.len() as f64;
    let constant = 0.5 * std::f64::consts::TAU.ln();
    let without = log(test, 0.0, plain) / count - constant;
    let with = log(test, rate.value, floor) / count - constant;
    let density = LogDensity { without, with, best: with.max(without) };
    let value = Value { value: rate.value, std: rate.std, unit: String::new() };
    let notable = train.is_white() && with > without;
    Some(found("drops", place.into(), ("rate", value), -2.0 * rate.log_evidence, notable, density))
}
