//! What the raw readings of each output say by themselves.

use parallax_model::system::Equations;
use parallax_runtime::delay::special::normal_cdf;
use serde::{Deserialize, Serialize};

use super::lattice::{Lattice, lattice};
use super::local::Local;
use super::peak::{Peak, peak};
use super::stuck::{Repeats, repeats};
use super::{LogDensity, ReadingEffect, found, outliers};
use crate::experiment::Experiment;
use crate::report::Value;
use crate::statistics::{median, root_mean_square};

/// Readings below which an output is not judged.
const ENOUGH: usize = 100;

/// Times the declared noise that the found one must be at least to count.
const LARGER: f64 = 1.15;

/// Steps of the noise from which a lattice matters.
const COARSE: f64 = 1.0;

/// Share of the readings from which effects are learnt; the rest, in time, is held out.
const LEARNT: f64 = 2.0 / 3.0;

/// How many times more outliers there may be once those close to each other are marked as well.
const MANY_MORE: f64 = 1.25;

/// Why a reading should not be fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Suspicion {
    /// It lies far from its neighbours.
    Outlier,
    /// It repeats the one before while the quantity moved.
    Stuck,
}

/// A reading that should not be fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suspicious {
    /// Its place among the experiment's samples.
    pub sample: usize,
    /// Why.
    pub why: Suspicion,
}

/// What was found of one output.
#[derive(Clone, Debug)]
struct Judged {
    effects: Vec<ReadingEffect>,
    /// Per reading of the output.
    suspicious: Vec<Option<Suspicion>>,
}

/// What the raw readings of all outputs say.
#[derive(Clone, Debug)]
pub(crate) struct Raw(Vec<Judged>);

impl Raw {
    /// Of an experiment as it was bound, before readings are thinned.
    pub(crate) fn of(equations: &Equations, experiment: &Experiment) -> Self {
        let outputs = equations.system().outputs.iter().enumerate();
        let judged = outputs.map(|(o, output)| {
            let (stamp, value) = experiment.output(o);
            let wrap = experiment.wraps.get(o).copied().flatten();
            let place = format!("output:{}", output.name);
            // A quantity with inertia moves smoothly; what shows a command jumps where that does.
            let smooth = !equations.system().shows_command(o);
            let local = Local::new(stamp, value, wrap);
            judge(local, &experiment.rests, wrap, smooth, output.noise, &place, &output.unit)
        });
        Raw(judged.collect())
    }

    /// All effects, significant or not.
    pub(crate) fn effects(&self) -> Vec<ReadingEffect> {
        self.0.iter().flat_map(|j| j.effects.iter().cloned()).collect()
    }

    /// Readings of one output that lie far from their neighbours, by their number among its readings.
    pub(crate) fn outliers(&self, output: usize) -> Vec<usize> {
        let all = self.0[output].suspicious.iter().enumerate();
        all.filter(|(_, why)| **why == Some(Suspicion::Outlier)).map(|(k, _)| k).collect()
    }

    /// Takes back what was said of the noise and of outliers at one output.
    pub(crate) fn take_back(&mut self, output: usize) {
        let judged = &mut self.0[output];
        judged.effects.retain(|e| e.name != "noise" && e.name != "outliers");
        for why in judged.suspicious.iter_mut().filter(|why| **why == Some(Suspicion::Outlier)) {
            *why = None;
        }
    }

    /// The standard deviation to believe of each output's readings where they show more than the system declares; 0 where
    /// they do not.
    pub(crate) fn believed(&self, equations: &Equations) -> Vec<f64> {
        let outputs = equations.system().outputs.iter().zip(&self.0);
        outputs
            .map(|(output, judged)| {
                let of = |name: &str, parameter: &str| {
                    let found = judged.effects.iter().find(|e| e.significant && e.name == name)?;
                    Some(found.parameters.get(parameter)?.value)
                };
                let beyond = of("noise", "std");
                let noise = beyond.map_or(0.0, |beyond| beyond.hypot(output.noise.unwrap_or(0.0)));
                // Rounding to a lattice errs evenly over one step.
                let rounding = of("quantization", "step").unwrap_or(0.0) / 12.0_f64.sqrt();
                noise.hypot(rounding)
            })
            .collect()
    }

    /// The experiment without the readings that should not be fitted, and what was left out.
    pub(crate) fn cleaned(&self, experiment: &Experiment) -> (Experiment, Vec<Suspicious>) {
        let mut seen = vec![0; self.0.len()];
        let mut left_out = Vec::new();
        for (index, sample) in experiment.samples.iter().enumerate() {
            let place = seen[sample.output];
            seen[sample.output] += 1;
            if let Some(Some(why)) = self.0[sample.output].suspicious.get(place) {
                left_out.push(Suspicious { sample: index, why: *why });
            }
        }
        let mut kept = experiment.clone();
        let mut index = 0;
        kept.samples.retain(|_| {
            index += 1;
            left_out.binary_search_by_key(&(index - 1), |s| s.sample).is_err()
        });
        (kept, left_out)
    }
}

/// Effects at outputs that the raw readings show, significant or not: `quantization`, `stuck`, `outliers`, `drops` and,
/// where the system declares it, `noise`.
///
/// Give the experiment as it was bound, before readings are thinned. Outputs of fewer than a hundred readings are left
/// out; so is the noise of an output whose readings move more between samples than they scatter.
#[must_use]
pub fn examine(equations: &Equations, experiment: &Experiment) -> Vec<ReadingEffect> {
    Raw::of(equations, experiment).effects()
}

/// The experiment without outliers and stuck readings of outputs that have significantly many, and what was left out.
///
/// A fit of the mean takes such readings for motion.
#[must_use]
pub fn cleaned(equations: &Equations, experiment: &Experiment) -> (Experiment, Vec<Suspicious>) {
    Raw::of(equations, experiment).cleaned(experiment)
}

fn judge(
    local: Local,
    rests: &[(f64, f64)],
    wrap: Option<f64>,
    smooth: bool,
    declared: Option<f64>,
    place: &str,
    unit: &str,
) -> Judged {
    let n = local.value.len();
    let mut out = Judged { effects: Vec::new(), suspicious: vec![None; n] };
    if n < ENOUGH || local.value.iter().all(|v| *v == local.value[0]) {
        return out;
    }
    out.effects.extend(drops(&local, place));
    let lattice = lattice(&local.value);
    let learnt = (LEARNT * n as f64) as usize;

    let repeated = repeats(&local, rests, wrap, lattice);
    let rate = repeated.rate(1..learnt);
    let evidence = -2.0 * rate.log_evidence;
    let stuck = repeated.stuck(rate.value);
    let count = stuck.iter().filter(|s| **s).count();
    let is_stuck = count >= 3 && evidence < -super::DECISIVE;
    // Readings that are stuck say nothing of the noise; without them the others are interpolated across.
    let kept: Vec<usize> = (0..n).filter(|k| !(is_stuck && stuck[*k])).collect();
    let pick = |from: &[f64]| kept.iter().map(|k| from[*k]).collect::<Vec<f64>>();
    let mut clean = Local::new(pick(&local.stamp), pick(&local.value), wrap);
    let step = lattice.map_or(0.0, |l| l.step);
    let rounding = step / 12.0_f64.sqrt();
    let largest = local.value.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let floor = declared.unwrap_or(0.0).max(rounding).max(1e-9 * largest);
    let before = clean.value.clone();
    let mut marked = if smooth { outliers::mark(&mut clean, floor) } else { vec![false; before.len()] };
    let mut noise = Noise::new(&clean, declared, floor);
    let mut alleged = outlier_effect(&clean, &before, &marked, &noise, place);
    let significant = |effect: &Option<ReadingEffect>| effect.as_ref().is_some_and(|e| e.significant);
    if significant(&alleged) {
        let mut others = clean.clone();
        others.value.clone_from(&before);
        let again = outliers::mark_again(&mut others, floor);
        let count = |marked: &[bool]| marked.iter().filter(|m| **m).count() as f64;
        // Beside the corners of a motion that is not smooth there are ever more: these are judged by a model, if they are lone.
        if count(&again) < MANY_MORE * count(&marked) {
            (clean, marked) = (others, again);
            noise = Noise::new(&clean, declared, floor);
            alleged = outlier_effect(&clean, &before, &marked, &noise, place);
        }
    }
    let has_outliers = significant(&alleged);

    if count > 0 {
        let density = stuck_density(&local, &repeated, &rate, &noise, learnt);
        let mut value = share_of(&rate);
        value.std *= repeated.spread(rate.value, 1..learnt);
        out.effects.push(found("stuck", place.into(), ("rate", value), evidence, is_stuck, density));
    }
    out.effects.extend(alleged);
    for (&k, marked) in kept.iter().zip(&marked) {
        if *marked && has_outliers {
            out.suspicious[k] = Some(Suspicion::Outlier);
        }
    }
    for (entry, stuck) in out.suspicious.iter_mut().zip(&stuck) {
        if *stuck && is_stuck {
            *entry = Some(Suspicion::Stuck);
        }
    }
    if let Some(lattice) = lattice {
        out.effects.push(quantization(&noise, lattice, place, unit));
    }
    if let Some(declared) = declared.filter(|_| clean.is_noise()) {
        let believed = (declared * declared + rounding * rounding).sqrt();
        out.effects.push(excess(&noise, believed, has_outliers, place, unit));
    }
    out
}

fn share_of(rate: &Peak) -> Value {
    Value { value: rate.value, std: rate.std, unit: String::new() }
}

/// Residuals of readings without outliers and stuck ones, and what is believed of their size.
struct Noise {
    /// In units of one reading's error.
    residuals: Vec<f64>,
    /// How many of them are learnt from.
    learnt: usize,
    independence: f64,
    /// What the system declares, else what the readings show.
    unit: f64,
    /// What the readings show.
    found: f64,
}

impl Noise {
    fn new(clean: &Local, declared: Option<f64>, floor: f64) -> Self {
        let residuals: Vec<f64> = clean.residuals().into_iter().flatten().collect();
        let learnt = (LEARNT * residuals.len() as f64) as usize;
        let found = root_mean_square(&residuals[..learnt]).max(0.1 * floor).max(1e-12);
        Noise {
            learnt,
            independence: clean.independence().0,
            unit: declared.unwrap_or(found),
            found,
            residuals,
        }
    }

    /// Mean log density of the held-out residuals, scored on bins of one noise unit.
    fn score(&self, density: impl Fn(f64) -> f64) -> f64 {
        let held_out = &self.residuals[self.learnt..];
        let sum: f64 = held_out.iter().map(|r| density(*r).max(-700.0)).sum();
        sum / held_out.len().max(1) as f64 + self.unit.ln()
    }
}

/// Log density of the normal distribution.
fn log_normal(residual: f64, std: f64) -> f64 {
    -0.5 * (residual / std).powi(2) - (std * std::f64::consts::TAU.sqrt()).ln()
}

/// Noise beyond what is believed: a normal distribution of another width, of which the effect is what must be added. Where
/// there are outliers, those too small to be marked would widen it; the median does not see them.
fn excess(noise: &Noise, believed: f64, outliers: bool, place: &str, unit: &str) -> ReadingEffect {
    let learnt = &noise.residuals[..noise.learnt];
    let count = learnt.len() as f64;
    let squares: f64 = if outliers {
        let typical = 1.4826 * median(&mut learnt.iter().map(|r| r.abs()).collect::<Vec<_>>());
        count * typical * typical
    } else {
        learnt.iter().map(|r| r * r).sum()
    };
    let log = |std: f64| noise.independence * (-0.5 * squares / (std * std) - count * std.ln());
    let null = log(believed);
    let at = peak(believed, 1e3 * believed, |std| log(std) - null);
    let without = noise.score(|r| log_normal(r, believed));
    let with = noise.score(|r| log_normal(r, at.value));
    let density = LogDensity { without, with, best: with.max(free(noise)) };
    let larger = at.value > LARGER * believed;
    let added = (at.value * at.value - believed * believed).max(0.0).sqrt();
    let std = if added > 0.0 { at.std * at.value / added } else { at.value };
    let value = Value { value: added, std, unit: unit.into() };
    found("noise", place.into(), ("std", value), -2.0 * at.log_evidence, larger, density)
}

/// Held-out score of a density that is free: the residuals that were learnt from, smoothed.
fn free(noise: &Noise) -> f64 {
    let mut sorted: Vec<f64> = noise.residuals[..noise.learnt].to_vec();
    sorted.sort_by(f64::total_cmp);
    // A few hundred quantiles stand for all; their spacing is far below the width.
    let thin: Vec<f64> = sorted.iter().copied().step_by((sorted.len() / 400).max(1)).collect();
    let width = 0.9 * noise.found * (sorted.len().max(2) as f64).powf(-0.2);
    noise.score(|r| {
        let sum: f64 = thin.iter().map(|c| log_normal(r - c, width).exp()).sum();
        (sum / thin.len().max(1) as f64).max(1e-300).ln()
    })
}

/// Relative accuracy of a step that is believed at best.
const DIGITS: f64 = 1e-6;

/// Errors of a prediction by the neighbours that are tried for readings on a lattice, in sizes of the residuals.
const PREDICTED: [f64; 7] = [0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5];

/// A lattice of values. Readings are predicted to fall on it: the score knows of a prediction only the cell.
fn quantization(noise: &Noise, lattice: Lattice, place: &str, unit: &str) -> ReadingEffect {
    let step = lattice.step;
    let coarse = step > COARSE * noise.unit;
    let cell = |error: f64, r: f64| {
        let probability = normal_cdf((r + 0.5 * step) / error) - normal_cdf((r - 0.5 * step) / error);
        probability.max(1e-300).ln() - noise.unit.ln()
    };
    // How well the neighbours, which lie on the lattice as well, predict a reading is learnt.
    let learnt = |error: &f64| noise.residuals[..noise.learnt].iter().map(|r| cell(*error, *r)).sum::<f64>();
    let errors = PREDICTED.map(|share| share * noise.found);
    let error = errors.into_iter().max_by(|a, b| learnt(a).total_cmp(&learnt(b))).unwrap_or(noise.found);
    let cell = |r: f64| cell(error, r);
    let without = noise.score(|r| log_normal(r, noise.unit));
    let with = noise.score(cell).max(noise.score(|r| log_normal(r, noise.found)));
    let density = LogDensity { without, with, best: with.max(free(noise)) };
    // Values are written with so many digits.
    let std = lattice.std.max(DIGITS * step);
    let value = Value { value: step, std, unit: unit.into() };
    // One parameter, known to a part in a thousand of its prior.
    let evidence = lattice.chance() + 2.0 * 1e3_f64.ln();
    found("quantization", place.into(), ("step", value), evidence, coarse, density)
}

/// Score with and without repeats; a repeat is a value of its own under the effect.
fn stuck_density(local: &Local, repeated: &Repeats, rate: &Peak, noise: &Noise, learnt: usize) -> LogDensity {
    let mut sums = [0.0; 2];
    let mut count = 0.0;
    for k in learnt..local.value.len() {
        let Some((residual, _)) = local.residual(k) else { continue };
        let plain = (log_normal(residual, noise.found) + noise.unit.ln()).max(-700.0);
        let (repeat, _) = repeated.repeats[k];
        let moved = (1.0 - rate.value) * plain.exp();
        sums[0] += plain;
        sums[1] += if repeat { (rate.value + moved).ln() } else { (1.0 - rate.value).ln() + plain };
        count += 1.0;
    }
    let [without, with] = sums.map(|s| s / f64::max(count, 1.0));
    LogDensity { without, with, best: with.max(without) }
}

/// A second, wide component of the noise.
fn outlier_effect(
    clean: &Local,
    before: &[f64],
    marked: &[bool],
    noise: &Noise,
    place: &str,
) -> Option<ReadingEffect> {
    let count = marked.iter().filter(|m| **m).count();
    if count == 0 {
        return None;
    }
    // Residuals as they were, against neighbours that are clean.
    let residuals: Vec<(usize, f64)> = (0..marked.len())
        .filter_map(|k| {
            let (residual, factor) = clean.residual(k)?;
            Some((k, residual + (before[k] - clean.value[k]) / factor))
        })
        .collect();
    let learnt = (LEARNT * residuals.len() as f64) as usize;
    let values: Vec<f64> = residuals.iter().map(|r| r.1).collect();
    let inside: Vec<f64> = residuals[..learnt].iter().filter(|(k, _)| !marked[*k]).map(|r| r.1).collect();
    let outside: Vec<f64> = residuals.iter().filter(|(k, _)| marked[*k]).map(|r| r.1).collect();
    let std = root_mean_square(&inside).max(1e-12);
    let far = root_mean_square(&outside).max(6.0 * std);
    let all = root_mean_square(&values[..learnt]).max(1e-12);
    let null: f64 = values[..learnt].iter().map(|r| log_normal(*r, all)).sum();
    let rate = outliers::rate(&values[..learnt], noise.independence, std, far);
    // The size of outliers is a second parameter, the noise is one on both sides.
    let evidence = -2.0 * (rate.log_evidence - noise.independence * null) + (learnt.max(1) as f64).ln();
    let scored =
        Noise { residuals: values, learnt, independence: noise.independence, unit: noise.unit, found: std };
    let without = scored.score(|r| log_normal(r, all));
    let with = scored.score(|r| outliers::log_mixture(r, rate.value, std, far));
    let density = LogDensity { without, with, best: with.max(free(&scored)) };
    Some(found("outliers", place.into(), ("rate", share_of(&rate)), evidence, count >= 3, density))
}

/// Longest pause, in periods, that counts as readings that were lost rather than as a log that was interrupted.
const PAUSE: f64 = 20.0;

/// Rate of losses that any log may have.
const USUAL: f64 = 1e-4;

/// Readings that are missing on an even grid of stamps.
fn drops(local: &Local, place: &str) -> Option<ReadingEffect> {
    let gaps: Vec<f64> = local.stamp.windows(2).map(|w| w[1] - w[0]).collect();
    let period = median(&mut gaps.clone());
    let deviation = median(&mut gaps.iter().map(|g| (g - period).abs()).collect::<Vec<_>>());
    if period <= 0.0 || deviation > 0.1 * period {
        return None;
    }
    let missing = |from: &[f64]| -> f64 {
        from.iter()
            .map(|g| g / period)
            .filter(|g| *g > 1.5 && *g < PAUSE && (g - g.round()).abs() < 0.25)
            .map(|g| g.round() - 1.0)
            .sum()
    };
    let learnt = (LEARNT * gaps.len() as f64) as usize;
    let (lost, kept) = (missing(&gaps[..learnt]), learnt as f64);
    if missing(&gaps) < 3.0 {
        return None;
    }
    let log = |rate: f64, lost: f64, kept: f64| lost * rate.ln() + kept * (1.0 - rate).ln();
    let rate = peak(USUAL, 0.9, |rate| log(rate, lost, kept) - log(USUAL, lost, kept));
    let (lost, kept) = (missing(&gaps[learnt..]), (gaps.len() - learnt) as f64);
    let score = |rate: f64| log(rate, lost, kept) / (lost + kept).max(1.0);
    let best = (lost / (lost + kept).max(1.0)).clamp(USUAL, 0.9);
    let (without, with) = (score(USUAL), score(rate.value));
    let density = LogDensity { without, with, best: with.max(score(best)) };
    let value = Value { value: rate.value, std: rate.std, unit: String::new() };
    Some(found("drops", place.into(), ("rate", value), -2.0 * rate.log_evidence, true, density))
}
