//! Times that scatter, and commands that are lost: what they leave in the innovations of a fitted model.
//!
//! A reading taken at another time is wrong by its rate times the difference. A command that acts at another time, or is
//! lost, kicks the plant ([`super::kicks`]). Either way the innovation's variance grows with the square of that size,
//! reading by reading. A wrong mean leaves innovations that resemble their neighbours instead, so only white ones are
//! judged.

use parallax_model::effect::{Place, PlaceKind};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::kicks::Kicks;
use super::lost::{self, FEWEST, RAREST};
use super::peak::peak;
use super::sensitivity::{Sensitivity, densities};
use super::{LogDensity, ReadingEffect, TRACE, found};
use crate::experiment::Held;
use crate::filter::{Noise, Pass};
use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::quantify;
use crate::report::Value;
use crate::search::{Fit, INEXACT};
use crate::setup::Setup;
use crate::simulator::wrapped;
use crate::statistics::root_mean_square;

/// Disturbed runs over which errors over the horizon are averaged.
const HORIZON_RUNS: u64 = 4;

/// Readings on each side from which the rate of an output is taken.
const RATE: usize = 2;

/// Share of the innovations' size that a scatter must make up to be named.
const NOTABLE: f64 = 0.2;

/// Log evidence for late commands from which they are there, whatever the sizes of single innovations say, under a model
/// that leaves nothing else: many small responses tell what no single one does.
const CERTAIN: f64 = 20.0;

/// Log density of a held-out reading that scatter of commands may cost where their responses say that it is there: the
/// density knows nothing of how long each lasts (nats).
const LOST_DENSITY: f64 = 1e-3;

/// Share of what times of readings that scatter explain of the time that is fitted, reading by reading, that they may cost on held-out
/// time: where these readings are fast may be elsewhere.
const LOST_SHARE: f64 = 0.1;

/// How far a declared noise may be exceeded, as the logarithm of its variance.
const OPEN: f64 = 12.0;

/// Periods of a command by which its times may scatter: beyond that it would be another command.
pub(super) const MOST_PERIODS: f64 = 5.0;

/// Smallest spread of times that is looked for (s).
const LEAST_SPREAD: f64 = 1e-6;

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
        let [Some(train), Some(test)] = passes.each_ref().map(|p| of_reading(setup, p, &noise, o)) else {
            continue;
        };
        effects.extend(judge_times(&train, &test, &place));
    }
    let of_inputs: Vec<Vec<ReadingEffect>> =
        (0..system.inputs.len()).into_par_iter().map(|input| at_input(setup, fit, &noise, input)).collect();
    effects.extend(of_inputs.into_iter().flatten());
    let best = |all: &mut dyn Iterator<Item = &ReadingEffect>| all.map(|e| e.evidence).fold(0.0, f64::min);
    let strongest = best(&mut effects.iter());
    let here: Vec<f64> = effects
        .iter()
        .map(|e| best(&mut effects.iter().filter(|o| o.place == e.place && o.significant)))
        .collect();
    for (effect, here) in effects.iter_mut().zip(here) {
        effect.significant &= effect.evidence <= here && effect.evidence < TRACE * strongest;
    }
    effects
}

/// Commands of one input that come late by chance, or not at all.
fn at_input(setup: &Setup, fit: &Fit, noise: &Noise, input: usize) -> Vec<ReadingEffect> {
    let mut effects = Vec::new();
    let place = Place::new(PlaceKind::Input, setup.equations.system().inputs[input].name.clone()).to_string();
    let Some(losses) = Kicks::new(setup, fit, noise, input, f64::INFINITY) else { return Vec::new() };
    let period = losses.lateness();
    // What is late by less than a reading's period has its own shape where commands come more rarely.
    let short = (period > setup.period).then(|| Kicks::new(setup, fit, noise, input, setup.period)).flatten();
    let delays = short.as_ref().unwrap_or(&losses);
    let late = delays.late(MOST_PERIODS * period);
    let lost = lost::look(setup, fit, noise, input);
    // A mean lateness is another effect.
    let of_mean = (late.gain - late.log_evidence).max(0.0);
    // Which of the two it is, the commands' own sizes say.
    let times = lost.as_ref().is_none_or(|lost| late.log_evidence >= lost.gain - of_mean);
    let exact = fit.shooting_error <= INEXACT;
    // On held-out time, parameters that were fitted elsewhere leave errors that pass for late commands.
    let trained = |stamp: f64| setup.train.iter().any(|s| (s.from..s.to).contains(&stamp));
    let told = delays.part(trained).late(MOST_PERIODS * period).log_evidence.min(late.log_evidence);
    let jitter = Judged {
        name: "jitter",
        parameter: "spread",
        value: Value { value: late.spread, std: late.std, unit: "s".into() },
        scale: late.spread / delays.lateness(),
        evidence: -2.0 * told,
        likelier: times,
        certain: exact && told > CERTAIN && delays.go_with_changes(&late, MOST_PERIODS * period),
    };
    // What wants to be larger than it can be is something else.
    if late.spread < 0.95 * MOST_PERIODS * period {
        effects.extend(jitter.against(setup, delays, &place));
    }
    if let Some(lost) = lost {
        let count = lost.lost.iter().filter(|lost| **lost).count();
        let drops = Judged {
            name: "drops",
            parameter: "rate",
            value: Value { value: lost.rate, std: (lost.rate / lost.of as f64).sqrt(), unit: String::new() },
            // The variance grows with the rate.
            scale: lost.rate.sqrt(),
            evidence: -2.0 * (lost.gain - of_mean),
            likelier: !times && (count >= FEWEST || lost.rate >= RAREST),
            certain: false,
        };
        effects.extend(drops.against(setup, &losses, &place));
    }
    effects
}

/// Whether the times of one output's readings scatter under a fitted model of the mean.
pub(super) fn times_scatter(setup: &Setup, fit: &Fit, output: usize) -> bool {
    let noise = open_noise(setup, fit);
    let parts =
        [&setup.train, &setup.test].map(|s| of_reading(setup, &pass(setup, fit, &noise, s), &noise, output));
    match parts {
        [Some(train), Some(test)] => judge_times(&train, &test, "").is_some_and(|jitter| jitter.significant),
        _ => false,
    }
}

/// The noise of one output's readings (standard deviation) where their times scatter by `spread` (s): what scatter leaves
/// of the innovations, of which it has the share that it was thought to have without.
pub(crate) fn noise_beside(setup: &Setup, fit: &Fit, output: usize, spread: f64) -> Option<f64> {
    let noise = open_noise(setup, fit);
    let pass = pass(setup, fit, &noise, &setup.train);
    let floor = of_reading(setup, &pass, &noise, output)?.floor(spread);
    Some(floor * (0.5 * noise.log_output[output]).exp())
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

/// What readings that are taken so much earlier or later are off by on held-out time: the mean square over all outputs, in
/// noise units squared. Nothing for other effects.
#[must_use]
pub fn over_readings(setup: &Setup, effect: &ReadingEffect) -> Option<f64> {
    let outputs = &setup.equations.system().outputs;
    let output = outputs.iter().position(|o| effect.place == format!("output:{}", o.name))?;
    let spread = effect.parameters.get("spread").filter(|_| effect.name == "jitter")?.value;
    let held_out = |stamp: f64| setup.test.iter().any(|s| (s.from..s.to).contains(&stamp));
    let (stamp, _) = setup.experiment.output(output);
    let rates = (0..stamp.len()).filter(|k| held_out(stamp[*k])).filter_map(|k| rate(setup, output, k));
    let noise = setup.output_noise[output];
    let (sum, count) =
        rates.fold((0.0, 0.0), |(sum, count), r| (sum + (r * spread / noise).powi(2), count + 1.0));
    // The error over the horizon is the mean over all outputs.
    (count > 0.0).then(|| sum / count / outputs.len() as f64)
}

/// The rate of reading `k` of an output, from its neighbours.
fn rate(setup: &Setup, output: usize, k: usize) -> Option<f64> {
    let (stamp, value) = setup.experiment.output(output);
    let wrap = setup.experiment.wraps.get(output).copied().flatten();
    let (before, after) = (k.saturating_sub(RATE), (k + RATE).min(stamp.len() - 1));
    let span = stamp[after] - stamp[before];
    (span > 0.0).then(|| wrapped(value[after] - value[before], wrap) / span)
}

/// The noise of one output's readings (standard deviation) that a fit asks for, where it may exceed what is declared.
pub(super) fn noise_of_readings(setup: &Setup, fit: &Fit, output: usize) -> f64 {
    (0.5 * open_noise(setup, fit).log_output[output]).exp()
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

/// What a second of lateness changes in each innovation of one output: the predicted reading's rate. The readings before
/// were late as well, by other times, and the prediction follows them: an innovation has of either as much as of noise.
fn of_reading(setup: &Setup, pass: &Pass, noise: &Noise, output: usize) -> Option<Sensitivity> {
    let (stamp, _) = setup.experiment.output(output);
    let own = noise.log_output[output].exp();
    let mut found = Sensitivity { innovations: Vec::new(), size: Vec::new() };
    for k in (0..pass.readings()).filter(|k| pass.output[*k] == output && pass.weighs(*k)) {
        let at = stamp.partition_point(|s| *s < pass.stamp[k]);
        if let Some(rate) = rate(setup, output, at) {
            found.innovations.push(pass.innovation[k] / pass.variance[k].sqrt());
            found.size.push(rate.abs() / own.min(pass.variance[k]).sqrt());
        }
    }
    found.usable()
}

/// The size of what shares of unit variance of all commands leave in each innovation, on time that is fitted and on time
/// that is held out.
fn of_commands(setup: &Setup, kicks: &Kicks) -> Option<Parts> {
    let held_out = |k: &usize| setup.test.iter().any(|s| (s.from..s.to).contains(&kicks.stamp[*k]));
    let (test, train): (Vec<usize>, Vec<usize>) = (0..kicks.stamp.len()).partition(held_out);
    let squares = kicks.squares();
    let of = |own: &[usize]| {
        let innovations = own.iter().map(|&k| kicks.whitened[k]).collect();
        Sensitivity { innovations, size: own.iter().map(|&k| squares[k].sqrt()).collect() }.usable()
    };
    Some(Parts { train: of(&train)?, test: of(&test)? })
}

/// Sensitivities on time that is fitted and on time that is held out.
struct Parts {
    train: Sensitivity,
    test: Sensitivity,
}

/// Log evidence for innovations that are larger where the commands' own changes are, over what they show of kicks as large as those of
/// other commands: a machine that sometimes rests shows such while it moves. None where kicks that are all alike, as a force that
/// scatters leaves them, say more.
fn by_changes(setup: &Setup, kicks: &Kicks, own: &Sensitivity) -> f64 {
    let of = |others: Kicks| of_commands(setup, &others).map_or(0.0, |parts| parts.train.by_size());
    let own = own.by_size();
    if own > of(kicks.even()) { own - of(kicks.exchanged()).max(0.0) } else { 0.0 }
}

/// Log predictive densities of held-out readings without and with commands that come `late` (s), or not at all, by shares of
/// this size.
pub(super) fn density_at_input(
    setup: &Setup,
    fit: &Fit,
    input: usize,
    (late, share): (f64, f64),
) -> Option<LogDensity> {
    let kicks = Kicks::new(setup, fit, &open_noise(setup, fit), input, late)?;
    let Parts { train, test } = of_commands(setup, &kicks)?;
    Some(densities(&train, &test, share))
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

/// What was found of one effect at an input.
struct Judged {
    name: &'static str,
    parameter: &'static str,
    value: Value,
    /// Size of the shares of the commands that it leaves.
    scale: f64,
    evidence: f64,
    /// Whether it is the likelier of the two.
    likelier: bool,
    /// Whether it is there even if single innovations are too small to show it.
    certain: bool,
}

impl Judged {
    fn against(self, setup: &Setup, kicks: &Kicks, place: &str) -> Option<ReadingEffect> {
        let Parts { train, test } = of_commands(setup, kicks)?;
        let density = densities(&train, &test, self.scale);
        // A wrong mean lies along the kicks as well; chance alone makes innovations large where kicks are.
        let natural = train.floor(0.0) / root_mean_square(&train.size);
        let told = if self.certain { f64::INFINITY } else { by_changes(setup, kicks, &train) };
        let evidence = self.evidence.max(-2.0 * told);
        let predicts = density.with > density.without - LOST_DENSITY;
        let large = self.certain || self.scale > NOTABLE * natural;
        let notable = self.likelier && train.is_white() && large && predicts;
        Some(found(self.name, place.into(), (self.parameter, self.value), evidence, notable, density))
    }
}

/// Times of readings that scatter.
fn judge_times(train: &Sensitivity, test: &Sensitivity, place: &str) -> Option<ReadingEffect> {
    let plain = train.floor(0.0);
    let null = train.log(0.0, plain);
    // The spread at which it would double the variance, and a factor of a hundred on both sides.
    let natural = plain / root_mean_square(&train.size);
    let (low, high) = ((1e-2 * natural).max(LEAST_SPREAD), 1e2 * natural);
    if low >= high {
        return None;
    }
    let at = peak(low, high, |spread| train.log(spread, train.floor(spread)) - null);
    let density = densities(train, test, at.value);
    let value = Value { value: at.value, std: at.std, unit: "s".into() };
    let large = at.value > NOTABLE * natural && !train.is_of_one_stretch(at.value);
    let gain = at.log_evidence / train.innovations.len() as f64;
    let predicts = density.with > density.without - LOST_SHARE * gain;
    let notable = train.is_white() && large && predicts;
    Some(found("jitter", place.into(), ("spread", value), -2.0 * at.log_evidence, notable, density))
}
