//! Times that scatter, and commands that are lost: what they leave in the innovations of a fitted model.
//!
//! A reading taken at another time is wrong by its rate times the difference. A command that acts at another time, or is
//! lost, kicks the plant; how far that moves each innovation is found by running the filter along commands that were
//! disturbed at random. Either way the innovation's variance grows with the square of that size, reading by reading. A
//! wrong mean leaves innovations that resemble their neighbours instead, so only white ones are judged.

use parallax_model::effect::Place;
use parallax_model::effect::PlaceKind;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::peak::peak;
use super::{LogDensity, ReadingEffect, TRACE, found};
use crate::experiment::Held;
use crate::filter::{Noise, Pass};
use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::quantify;
use crate::report::Value;
use crate::search::Fit;
use crate::setup::Setup;
use crate::simulator::wrapped;
use crate::statistics::{median, root_mean_square};

/// Correlation of successive innovations up to which they count as free of a wrong mean.
const WHITE: f64 = 0.25;

/// Disturbed runs whose mean square stands for the variance.
const RUNS: u64 = 16;

/// Disturbed runs over which errors over the horizon are averaged.
const HORIZON_RUNS: u64 = 4;

/// Readings on each side over which the mean square is smoothed.
const SMOOTH: usize = 1;

/// Readings on each side from which the rate of an output is taken.
const RATE: usize = 2;

/// Share of the innovations' size that a scatter must make up to be named.
const NOTABLE: f64 = 0.2;

/// How far a declared noise may be exceeded, as the logarithm of its variance.
const OPEN: f64 = 12.0;

/// Periods of a command by which its times may scatter: beyond that it would be another command.
const MOST_PERIODS: f64 = 5.0;

/// Share of commands that is lost in the disturbed runs.
const LOST: f64 = 0.1;

/// Whitened innovations, and the standard deviation that one unit of an effect adds to each.
struct Sensitivity {
    innovations: Vec<f64>,
    size: Vec<f64>,
}

/// Scatter at every input and output under a fitted model of the mean: `jitter` of both, `drops` of inputs.
///
/// Jitter and drops at one input leave nearly the same trace; only the likelier of the two can be significant. Times that
/// scatter at one place leave a weaker trace at others as well, which is not significant either.
#[must_use]
pub fn scatter(setup: &Setup, fit: &Fit) -> Vec<ReadingEffect> {
    let system = setup.equations.system();
    let segments = [&setup.train, &setup.test];
    let noise = open_noise(setup, fit);
    let passes = segments.map(|s| pass(setup, fit, &noise, s));
    let mut effects: Vec<ReadingEffect> = Vec::new();
    for (o, output) in system.outputs.iter().enumerate() {
        let place = Place::new(PlaceKind::Output, output.name.clone()).to_string();
        let [Some(train), Some(test)] = passes.each_ref().map(|p| of_reading(setup, p, o)) else { continue };
        effects.extend(judge("jitter", "spread", "s", (1e-6, f64::MAX), &train, &test, &place));
    }
    for (i, input) in system.inputs.iter().enumerate() {
        let place = Place::new(PlaceKind::Input, input.name.clone()).to_string();
        let times = &setup.experiment.inputs[i].times;
        let period = median(&mut times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>());
        if period <= 0.0 {
            continue;
        }
        let disturbed = |change: &Change<'_>, unit: f64| {
            let both = [0, 1].map(|k| {
                let walked = |disturbed: &Setup| pass(disturbed, fit, &noise, segments[k]);
                let squares = disturbances(setup, i, change, &walked, &passes[k])?;
                of_command(&passes[k], &squares, unit)
            });
            let [train, test] = both;
            Some((train?, test?))
        };
        if let Some((train, test)) = disturbed(&|held, random| late(held, 0.3 * period, random), 0.3 * period)
        {
            effects.extend(judge(
                "jitter",
                "spread",
                "s",
                (1e-6, MOST_PERIODS * period),
                &train,
                &test,
                &place,
            ));
        }
        // The variance grows with the rate, so that the size is for its root.
        if let Some((train, test)) = disturbed(&|held, random| lossy(held, LOST, random), LOST.sqrt()) {
            effects.extend(judge("drops", "rate", "", (1e-3, 0.9), &train, &test, &place));
        }
    }
    let best = |all: &mut dyn Iterator<Item = &ReadingEffect>| all.map(|e| e.evidence).fold(0.0, f64::min);
    let strongest = best(&mut effects.iter());
    let here: Vec<f64> =
        effects.iter().map(|e| best(&mut effects.iter().filter(|o| o.place == e.place))).collect();
    for (effect, here) in effects.iter_mut().zip(here) {
        effect.significant &= effect.evidence <= here && effect.evidence < TRACE * strongest;
    }
    effects
}

/// What commands that scatter so do to predictions over the horizon on held-out time: the mean square of the change, in
/// noise units squared. Nothing for effects on readings, which leave no trace in what is predicted.
#[must_use]
pub fn over_horizon(setup: &Setup, fit: &Fit, effect: &ReadingEffect) -> Option<f64> {
    let system = setup.equations.system();
    let input = system.inputs.iter().position(|i| effect.place == format!("input:{}", i.name))?;
    let size = effect.parameters.values().next()?.value;
    let row = |setup: &Setup| {
        let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
        quantify::predict(setup, &simulator, fit.estimate(), &fit.innovation.noise)
    };
    let plain = row(setup);
    let runs: Vec<f64> = (0..HORIZON_RUNS)
        .into_par_iter()
        .filter_map(|run| {
            let mut random = ChaCha8Rng::seed_from_u64(run);
            let mut disturbed = setup.clone();
            let held = &mut disturbed.experiment.inputs[input];
            *held = if effect.name == "drops" {
                lossy(held, size, &mut random)
            } else {
                late(held, size, &mut random)
            };
            let row = row(&disturbed);
            if row.readings.len() != plain.readings.len() {
                return None;
            }
            let pairs = row.readings.iter().zip(&plain.readings);
            let changes = pairs.map(|(a, b)| {
                let change = wrapped(a.3 - b.3, setup.experiment.wraps[a.0]);
                (change / setup.output_noise[a.0]).powi(2)
            });
            Some(changes.sum::<f64>() / plain.readings.len().max(1) as f64)
        })
        .collect();
    (!runs.is_empty()).then(|| runs.iter().sum::<f64>() / runs.len() as f64)
}

fn pass(setup: &Setup, fit: &Fit, noise: &Noise, segments: &[Segment]) -> Pass {
    let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
    walk_plain(&simulator, segments, &setup.noise, noise, fit.theta())
}

/// The fit's noise, with that of the readings free to exceed what is declared: times that scatter are noise to a filter
/// that does not know them, and one that believes its readings too much follows them.
fn open_noise(setup: &Setup, fit: &Fit) -> Noise {
    let model = &setup.noise;
    let limits: Vec<(f64, f64)> = model.limits.iter().map(|l| (l.0, l.1.max(l.0 + OPEN))).collect();
    let mut noise = fit.innovation.noise.clone();
    for _ in 0..2 {
        let walked = pass(setup, fit, &noise, &setup.train);
        noise = walked.refit_noise(&model.scale, &noise, &limits, model.process_floor);
    }
    noise
}

/// What a second of lateness changes in each innovation of one output: the predicted reading's rate.
fn of_reading(setup: &Setup, pass: &Pass, output: usize) -> Option<Sensitivity> {
    let (stamp, value) = setup.experiment.output(output);
    let wrap = setup.experiment.wraps.get(output).copied().flatten();
    let mut found = Sensitivity { innovations: Vec::new(), size: Vec::new() };
    for k in (0..pass.readings()).filter(|k| pass.output[*k] == output) {
        let at = stamp.partition_point(|s| *s < pass.stamp[k]);
        let (before, after) = (at.saturating_sub(RATE), (at + RATE).min(stamp.len() - 1));
        let span = stamp[after] - stamp[before];
        if span > 0.0 {
            let rate = wrapped(value[after] - value[before], wrap) / span;
            found.innovations.push(pass.innovation[k] / pass.variance[k].sqrt());
            found.size.push(rate.abs() / pass.variance[k].sqrt());
        }
    }
    found.usable()
}

/// Disturbs a command at random.
type Change<'a> = dyn Fn(&Held, &mut ChaCha8Rng) -> Held + Sync + 'a;

/// Mean square over disturbed runs of what a disturbance of a command adds to each whitened innovation; nothing where
/// the runs do not predict the same readings.
fn disturbances(
    setup: &Setup,
    input: usize,
    change: &Change<'_>,
    walked: &(dyn Fn(&Setup) -> Pass + Sync),
    plain: &Pass,
) -> Option<Vec<f64>> {
    let mut squares = vec![0.0; plain.readings()];
    let others: Vec<Pass> = (0..RUNS)
        .into_par_iter()
        .map(|run| {
            let mut random = ChaCha8Rng::seed_from_u64(run);
            let mut disturbed = setup.clone();
            disturbed.experiment.inputs[input] = change(&setup.experiment.inputs[input], &mut random);
            walked(&disturbed)
        })
        .collect();
    for other in others {
        if other.stamp != plain.stamp {
            return None;
        }
        for (k, square) in squares.iter_mut().enumerate() {
            *square += (other.innovation[k] - plain.innovation[k]).powi(2) / plain.variance[k] / RUNS as f64;
        }
    }
    Some(squares)
}

/// The same for one unit of the effect, smoothed over neighbours.
fn of_command(plain: &Pass, squares: &[f64], unit: f64) -> Option<Sensitivity> {
    let size = (0..squares.len())
        .map(|k| {
            let around = &squares[k.saturating_sub(SMOOTH)..(k + SMOOTH + 1).min(squares.len())];
            (around.iter().sum::<f64>() / around.len() as f64).sqrt() / unit
        })
        .collect();
    Sensitivity { innovations: plain.whitened(), size }.usable()
}

/// Commands that act up to √12 `spread` late or, on average, at their time.
fn late(held: &Held, spread: f64, random: &mut ChaCha8Rng) -> Held {
    let half = 3.0_f64.sqrt() * spread;
    let mut out = held.clone();
    let mut last = f64::NEG_INFINITY;
    for time in &mut out.times {
        // Messages do not overtake each other.
        *time = (*time + random.random_range(-half..half)).max(last + 1e-9);
        last = *time;
    }
    out
}

/// Commands of which some are lost: the one before stays.
fn lossy(held: &Held, rate: f64, random: &mut ChaCha8Rng) -> Held {
    let mut out = held.clone();
    for k in 1..out.values.len() {
        if random.random_bool(rate.clamp(0.0, 1.0)) {
            out.values[k] = out.values[k - 1];
        }
    }
    out
}

impl Sensitivity {
    fn usable(self) -> Option<Self> {
        let finite = self.innovations.iter().chain(&self.size).all(|v| v.is_finite());
        (self.innovations.len() > 50 && finite && root_mean_square(&self.size) > 0.0).then_some(self)
    }

    fn is_white(&self) -> bool {
        let (mut across, mut along) = (0.0, 0.0);
        for pair in self.innovations.windows(2) {
            across += pair[0] * pair[1];
            along += pair[0] * pair[0];
        }
        // Errors of single readings may leave innovations of alternating sign behind, a wrong mean does not.
        along > 0.0 && across < WHITE * along
    }

    /// Log likelihood of innovations of variance `floor`² + (scale × size)².
    fn log(&self, scale: f64, floor: f64) -> f64 {
        let (mut quadratic, mut logarithms) = (0.0, 0.0);
        // One logarithm for a few readings.
        for (innovations, sizes) in self.innovations.chunks(4).zip(self.size.chunks(4)) {
            let mut product = 1.0_f64;
            for (e, h) in innovations.iter().zip(sizes) {
                let variance = floor * floor + (scale * h).powi(2);
                quadratic += e * e / variance;
                product *= variance;
            }
            logarithms += product.ln();
        }
        -0.5 * (quadratic + logarithms)
    }

    /// The floor that makes it largest, by golden section on its logarithm.
    fn floor(&self, scale: f64) -> f64 {
        let size = root_mean_square(&self.innovations).max(1e-12);
        let ratio = 0.5 * (5.0_f64.sqrt() - 1.0);
        let at = |log_floor: f64| (log_floor, self.log(scale, log_floor.exp()));
        let (mut low, mut high) = ((0.1 * size).ln(), (1.1 * size).ln());
        let (mut a, mut b) = (at(high - ratio * (high - low)), at(low + ratio * (high - low)));
        for _ in 0..14 {
            // One of the two points is one of the next two.
            if a.1 > b.1 {
                (high, b) = (b.0, a);
                a = at(high - ratio * (high - low));
            } else {
                (low, a) = (a.0, b);
                b = at(low + ratio * (high - low));
            }
        }
        (0.5 * (low + high)).exp()
    }
}

fn judge(
    name: &str,
    parameter: &str,
    unit: &str,
    bounds: (f64, f64),
    train: &Sensitivity,
    test: &Sensitivity,
    place: &str,
) -> Option<ReadingEffect> {
    // A rate is the square of its scale.
    let scale = |value: f64| if name == "drops" { value.sqrt() } else { value };
    let plain = train.floor(0.0);
    let null = train.log(0.0, plain);
    // The scale at which it would double the variance, and a factor of a hundred on both sides.
    let natural = plain / root_mean_square(&train.size);
    let natural_value = if name == "drops" { natural * natural } else { natural };
    let (low, high) = ((1e-2 * natural_value).max(bounds.0), (1e2 * natural_value).min(bounds.1));
    if low >= high {
        return None;
    }
    let at = peak(low, high, |value| train.log(scale(value), train.floor(scale(value))) - null);
    let floor = train.floor(scale(at.value));
    let count = test.innovations.len() as f64;
    let constant = 0.5 * std::f64::consts::TAU.ln();
    let without = test.log(0.0, plain) / count - constant;
    let with = test.log(scale(at.value), floor) / count - constant;
    let density = LogDensity { without, with, best: with.max(without) };
    let value = Value { value: at.value, std: at.std, unit: unit.into() };
    // What wants to be larger than it can be is something else.
    let inside = at.value < 0.95 * bounds.1;
    let notable = inside && train.is_white() && scale(at.value) > NOTABLE * natural && with > without;
    Some(found(name, place.into(), (parameter, value), -2.0 * at.log_evidence, notable, density))
}
