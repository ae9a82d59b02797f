//! Fits by innovation likelihood: the filter, its noise re-estimated, under one hypothesis.

use std::cell::Cell;
use std::sync::Arc;

use crate::filter::{Noise, Pass, Start, filter};
use crate::fit::{Local, Minimum, minimise, prior_cost};
use crate::guess::Guess;
use crate::hypothesis::Hypothesis;
use crate::limit::AT_LIMIT;
use crate::shooting::{lateness, locate};
use crate::simulator::{LANES, Reading, Run, Simulator};

/// A stretch of a recording, and the states guessed at its start.
#[derive(Clone, Debug)]
pub struct Segment {
    /// First stamp (s).
    pub from: f64,
    /// End (s), not included.
    pub to: f64,
    /// Where the state may be before its readings tell it.
    pub guess: Arc<Guess>,
}

/// Bounds and scales of the noise, the same for every hypothesis.
#[derive(Clone, Debug)]
pub struct NoiseModel {
    /// Size of the process noise per state, zero for one that only integrates another.
    pub scale: Vec<f64>,
    /// Bounds of each output's log variance.
    pub limits: Vec<(f64, f64)>,
    /// Lower bound of the process noise.
    pub process_floor: f64,
    /// Where to start.
    pub initial: Noise,
    /// Levels at which each output's readings rest, as those of a sensor do at its limits: at their lower end and at their upper one.
    pub resting: Vec<[Option<f64>; 2]>,
}

impl NoiseModel {
    /// Whether several states share the process noise.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        self.scale.iter().filter(|scale| **scale > 0.0).count() > 1
    }

    /// Whether readings, each with its output, tell hardly anything of the state because a sensor is at its limit.
    #[must_use]
    pub fn is_blind(&self, readings: impl Iterator<Item = (usize, f64)> + Clone) -> bool {
        self.resting.iter().enumerate().filter(|(_, levels)| levels.iter().any(Option::is_some)).any(
            |(output, levels)| {
                let noise = (0.5 * self.initial.log_output[output]).exp();
                let rests = |value: f64| {
                    levels.iter().flatten().any(|level| (value - level).abs() <= AT_LIMIT * noise)
                };
                let shows = readings.clone().filter(|(of, value)| *of == output && !rests(*value));
                shows.count() < SETTLING_READINGS
            },
        )
    }
}

/// A hypothesis fitted by innovation likelihood.
#[derive(Clone, Debug)]
pub struct InnovationFit {
    /// Parameters, cost and curvature.
    pub minimum: Minimum,
    /// The noise under this hypothesis.
    pub noise: Noise,
    /// The filter's walk at the minimum.
    pub pass: Pass,
    /// −2 log evidence.
    pub evidence_cost: f64,
}

impl InnovationFit {
    /// Standard deviations by the sandwich H⁻¹ (Σ g gᵀ) H⁻¹ over blocks of readings, as those of the windows, but no
    /// smaller than the curvature alone gives: what a model lacks leaves innovations that resemble their neighbours.
    #[must_use]
    pub fn std(&self) -> Vec<f64> {
        let plain = self.minimum.std();
        let Some(inverse) = self.minimum.covariance() else { return plain };
        let sandwich = &inverse * self.pass.spread() * &inverse;
        plain.iter().enumerate().map(|(i, std)| sandwich[(i, i)].max(0.0).sqrt().max(*std)).collect()
    }
}

/// Readings of each output from which a filter that starts in the middle of a segment learns the state.
pub const SETTLING_READINGS: usize = 8;

/// How many times that pass before readings count: a hypothesis with a state of its own must not pay for what is not
/// known of it in every stretch.
const SETTLED: usize = 4;

/// Standard deviations from where it has no effect within which a limit may be one that nothing has reached, and the loss of −2 log
/// likelihood up to which it is: then it has none on what it is asked for later, either.
const UNREACHED: f64 = 3.0;
const SAME: f64 = 0.1;

/// Cuts segments into stretches that can be walked side by side. A filter forgets where it began; the first readings of
/// each stretch, which the one before it has counted already, tell it the state.
fn stretches(
    simulator: &dyn Simulator,
    run: &dyn Run,
    segments: &[Segment],
    model: &NoiseModel,
) -> Vec<Start> {
    let outputs = model.limits.len();
    let late = lateness(run.events());
    let found: Vec<(&Segment, usize, usize)> = segments
        .iter()
        .filter_map(|s| {
            let (first, end) = locate(run.events(), late, s.from, s.to)?;
            Some((s, first, end))
        })
        .collect();
    let readings: Vec<Vec<Reading>> = found
        .iter()
        .map(|(segment, first, end)| {
            let readings = run.events()[*first..*end].iter().filter_map(|e| e.reading);
            // A late sensor shows others in between.
            readings.filter(|r| (segment.from..segment.to).contains(&r.stamp)).collect()
        })
        .collect();
    let settling = SETTLED * SETTLING_READINGS * outputs;
    let total: usize = readings.iter().map(Vec::len).sum();
    let mut starts = Vec::new();
    for ((segment, first, end), mut readings) in found.into_iter().zip(readings) {
        // In the order of stamps, not of events: the cuts must not depend on a delay under trial.
        readings.sort_by(|a, b| a.stamp.total_cmp(&b.stamp));
        let stamps: Vec<f64> = readings.iter().map(|r| r.stamp).collect();
        let lanes = LANES * segments.len().div_ceil(LANES);
        let spare = lanes.saturating_sub(segments.len());
        let pieces = (1 + spare * stamps.len() / total.max(1)).min(stamps.len() / (3 * settling)).max(1);
        let mut cuts: Vec<usize> = (0..=pieces).map(|piece| stamps.len() * piece / pieces).collect();
        // Readings at a sensor's limit do not tell the state.
        cuts.retain(|at| {
            let told = at.checked_sub(settling).map(|from| &readings[from..*at]);
            *at == stamps.len()
                || told.is_none_or(|told| !model.is_blind(told.iter().map(|r| (r.output, r.value))))
        });
        let pieces = cuts.len() - 1;
        for piece in 0..pieces {
            let (at, next) = (cuts[piece], cuts[piece + 1]);
            let counts_from = if piece == 0 { segment.from } else { stamps[at] };
            // What a segment's first readings tell is the state, whatever states a hypothesis has.
            let told = settling.min(stamps.len() / 4);
            let weighs_from =
                if piece == 0 { stamps.get(told).copied().unwrap_or(segment.from) } else { stamps[at] };
            let from = if piece == 0 { segment.from } else { stamps[at - settling] };
            let to = if piece + 1 == pieces { segment.to } else { stamps[next] };
            let place = if pieces == 1 { Some((first, end)) } else { locate(run.events(), late, from, to) };
            let Some((first, end)) = place else { continue };
            let guess = &segment.guess;
            let (state, std) = simulator.start(guess.state(from), guess.std(), run.events()[first].time);
            starts.push(Start { first, end, from, counts_from, weighs_from, to, state, std });
        }
    }
    starts
}

/// The filter's walk of `simulator` over the segments at θ.
pub fn walk(
    simulator: &dyn Simulator,
    segments: &[Segment],
    model: &NoiseModel,
    noise: &Noise,
    theta: &[f64],
) -> Pass {
    walk_along(simulator, &mut *simulator.run(theta), segments, model, noise)
}

/// The same walk without derivatives by θ, which are most of the work.
pub fn walk_plain(
    simulator: &dyn Simulator,
    segments: &[Segment],
    model: &NoiseModel,
    noise: &Noise,
    theta: &[f64],
) -> Pass {
    walk_along(simulator, &mut *simulator.run_at(theta), segments, model, noise)
}

fn walk_along(
    simulator: &dyn Simulator,
    run: &mut dyn Run,
    segments: &[Segment],
    model: &NoiseModel,
    noise: &Noise,
) -> Pass {
    let starts = stretches(simulator, run, segments, model);
    let parameters = run.parameters();
    filter(run, &starts, simulator.states(), parameters, &model.scale, noise)
}

/// What is known of the noise where a fit begins.
#[derive(Clone, Copy, Debug)]
pub enum Known<'a> {
    /// Hardly anything: it may be far from this one.
    Nothing(&'a Noise),
    /// It is near this one.
    Roughly(&'a Noise),
    /// It is hardly another one than that of this fit, of a hypothesis that is contained and nearly reaches the sensors' noise.
    Near(&'a InnovationFit),
}

/// Fits a hypothesis from one starting point.
pub fn fit(
    simulator: &dyn Simulator,
    hypothesis: &Hypothesis,
    segments: &[Segment],
    model: &NoiseModel,
    known: Known<'_>,
    start: &[f64],
    iterations: usize,
) -> InnovationFit {
    let outputs = model.limits.len();
    let (first, mut excess) = match known {
        Known::Nothing(noise) | Known::Roughly(noise) => (noise, Vec::new()),
        Known::Near(fit) => (&fit.noise, fit.pass.excess(outputs)),
    };
    let better_noise = |pass: &Pass, noise: &Noise, excess: &[(f64, usize)]| {
        let (scale, limits, floor) = (&model.scale, &model.limits, model.process_floor);
        match known {
            Known::Nothing(_) => pass.refit_noise(scale, noise, limits, floor),
            Known::Roughly(_) | Known::Near(_) => pass.mend_noise(scale, noise, limits, floor, excess),
        }
    };
    let p = simulator.parameters();
    let mut noise = first.clone();
    let mut last: Option<(Vec<f64>, Pass)> = None;
    // A start may be worse than where the noise is known from; after a step it is not.
    let near = matches!(known, Known::Near(_));
    let begun = Cell::new(!near);
    let mut loss = |theta: &[f64], accepted: bool| {
        let known = last.take().filter(|(at, _)| at == theta);
        let mut pass = match known {
            Some((_, pass)) => pass,
            None => walk(simulator, segments, model, &noise, theta),
        };
        if accepted && begun.replace(true) {
            let better = better_noise(&pass, &noise, &excess);
            if better != noise {
                let again = walk(simulator, segments, model, &better, theta);
                // The search is around a linearised walk: it counts only if the walk itself agrees.
                if again.cost() < pass.cost() {
                    (noise, pass) = (better, again);
                    if near {
                        excess = pass.excess(outputs);
                    }
                }
            }
        }
        let mut local = Local { cost: pass.cost(), information: vec![0.0; p * p], gradient: vec![0.0; p] };
        if !local.cost.is_finite() {
            local.cost = f64::INFINITY;
        }
        pass.accumulate(&mut local.information, &mut local.gradient);
        last = Some((theta.to_vec(), pass));
        local
    };
    let mut minimum = minimise(&hypothesis.fitted, start, iterations, &mut loss);
    // A start from which no step leads on has the other hypothesis's noise still.
    if iterations > 0 && !begun.replace(true) {
        minimum = minimise(&hypothesis.fitted, &minimum.theta, iterations, &mut loss);
    }
    for limit in hypothesis.limits() {
        let null = hypothesis.fitted[limit].null;
        let away = (minimum.theta[limit] - null).abs() / minimum.std()[limit];
        if away == 0.0 || away > UNREACHED {
            continue;
        }
        let mut out_of_the_way = minimum.theta.clone();
        out_of_the_way[limit] = null;
        let cost = loss(&out_of_the_way, false).cost + prior_cost(&hypothesis.fitted, &out_of_the_way);
        if cost < minimum.cost + SAME {
            minimum = minimise(&hypothesis.fitted, &out_of_the_way, 0, &mut loss);
        }
    }
    let pass = match last.filter(|(at, _)| *at == minimum.theta) {
        Some((_, pass)) => pass,
        None => walk(simulator, segments, model, &noise, &minimum.theta),
    };
    let evidence_cost = minimum.evidence_cost(&hypothesis.fitted);
    InnovationFit { minimum, noise, pass, evidence_cost }
}
