//! The innovation likelihood: an extended Kalman filter along the log, with derivatives by the parameters.
//!
//! Each reading is predicted from the earlier ones; the difference is the innovation. Process noise enters as white
//! acceleration of unknown intensity, so that a model that is wrong is corrected by the readings and charged for it,
//! instead of drifting away (Kristensen, Madsen & Jørgensen 2004, "Parameter estimation in stochastic grey-box
//! models"). Derivatives of the innovations hold the gain fixed: the recursion of the prediction-error method
//! (Ljung, "System Identification", section 11.3).

//!
//! Stretches of the log are walked side by side, one on each lane.

mod censored;
mod chain;
mod found;
mod lanes;
mod likelihood;
mod mend;
mod random;
mod refit;
mod uncertainty;

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::Local;
use parallax_model::lanes::{F64x16, Level};

use crate::lockstep::{self, Lockstep, Stretch};
use crate::simulator::{Gradient, LANES, Motion, Run, wrapped};
use censored::{Beyond, UNKNOWN, variance_of};
use chain::Probe;
pub(crate) use chain::{Chain, Link};
use found::Found;
use lanes::{Covariance, Pattern, Read};
use likelihood::Likelihood;
pub use uncertainty::Uncertainty;

/// Noise intensities.
#[derive(Clone, Debug, PartialEq)]
pub struct Noise {
    /// Natural logarithm of the process noise, a variance per second in units of each state's `scale` squared.
    pub log_process: f64,
    /// Natural logarithm of the variance of each output's noise.
    pub log_output: Vec<f64>,
}

/// A stretch to walk, and what is known of the state before its first reading.
#[derive(Clone, Debug)]
pub struct Start {
    /// Index of the first event of the stretch.
    pub first: usize,
    /// Index after the last event of the stretch.
    pub end: usize,
    /// Stamp of the first reading that is looked at (s), whatever happens earlier.
    pub from: f64,
    /// Stamp of the first reading that is a part of the walk (s); earlier ones only tell the state.
    pub counts_from: f64,
    /// Stamp of the first reading that the likelihood is of (s), given all earlier ones.
    pub weighs_from: f64,
    /// End of the stamps that belong to the stretch (s): later readings that happen in between are not looked at.
    pub to: f64,
    /// The state guessed at the first event.
    pub state: Vec<f64>,
    /// Its standard deviation; large where nothing is known.
    pub std: Vec<f64>,
}

/// The walk of a filter along a log, linearised. Readings are in the order of the stretches.
#[derive(Clone, Debug, Default)]
pub struct Pass {
    states: usize,
    parameters: usize,
    /// Innovations, reading by reading.
    pub innovation: Vec<f64>,
    /// Their predicted variances.
    pub variance: Vec<f64>,
    /// ∂innovation/∂θ, readings × parameters.
    pub by_parameter: Vec<f64>,
    /// Output of each reading.
    pub output: Vec<usize>,
    /// Stamp of each reading (s).
    pub stamp: Vec<f64>,
    /// Event index of each reading.
    pub event: Vec<usize>,
    /// State after each reading, readings × states.
    pub state: Vec<f64>,
    /// Which readings the likelihood is of; the others are given.
    weighs: Vec<bool>,
    /// What the −2 log likelihood of each reading is more than that of its innovation: zero but for readings at a limit of their sensor
    /// that only show the state beyond it.
    beyond: Vec<f64>,
    tapes: Vec<Tape>,
}

/// The steps of as many stretches as there are lanes, kept to evaluate other noise intensities without the model.
#[derive(Clone, Debug, Default)]
struct Tape {
    ticks: Vec<Tick>,
    start_variance: Vec<F64x16>,
    /// Transitions, states × states each; gradients of readings and gains, one per state each.
    numbers: Vec<F64x16>,
    /// Which entries of transitions can differ from zero.
    patterns: Vec<Pattern>,
    /// Which states readings depend on, reading after reading.
    seen: Vec<usize>,
}

/// One step of a tape; offsets point into its numbers.
#[derive(Clone, Debug)]
enum Tick {
    Advance {
        dt: F64x16,
        by_state: usize,
        pattern: usize,
    },
    Read {
        by_state: usize,
        seen: Range<usize>,
        gain: usize,
        innovation: F64x16,
        output: [u8; LANES],
        weighs: F64x16,
        /// The variance of its noise in lanes where that is not its output's, otherwise zero; nothing where no lane has one.
        own: Option<Box<F64x16>>,
    },
}

/// Blocks of readings whose scores count as independent.
const BLOCKS: usize = 60;

/// A lane that reads nothing.
const NOTHING: u8 = u8::MAX;

/// Runs the filter over the stretches at the run's parameters.
///
/// `scale` gives the size of the process noise per state, zero for a state that only integrates another one.
pub fn filter(
    run: &mut dyn Run,
    starts: &[Start],
    states: usize,
    parameters: usize,
    scale: &[f64],
    noise: &Noise,
) -> Pass {
    let mut pass = Pass { states, parameters, ..Pass::default() };
    for group in starts.chunks(LANES) {
        walk_group(run, group, scale, noise, &mut pass, None);
    }
    pass
}

/// What small deviations from the filter's walk over each of the stretches become, and what the commands of `other`, a run of the
/// same events, would add to them.
pub(crate) fn chains(
    run: &mut dyn Run,
    other: &mut dyn Run,
    starts: &[Start],
    states: usize,
    scale: &[f64],
    noise: &Noise,
) -> Vec<Chain> {
    let mut found = Vec::with_capacity(starts.len());
    for group in starts.chunks(LANES) {
        let mut probe = Probe::new(other, states, group.len());
        let mut pass = Pass { states, ..Pass::default() };
        walk_group(run, group, scale, noise, &mut pass, Some(&mut probe));
        found.extend(probe.chains);
    }
    found
}

fn walk_group(
    run: &mut dyn Run,
    group: &[Start],
    scale: &[f64],
    noise: &Noise,
    pass: &mut Pass,
    mut probe: Option<&mut Probe<'_>>,
) {
    let (n, p) = (pass.states, pass.parameters);
    let zero = F64x16::splat(0.0);
    let intensity = intensities(scale, noise, n);
    let output_variance: Vec<f64> = noise.log_output.iter().map(|r| r.exp()).collect();
    let mut tape = Tape::default();
    let mut motion = Motion::new(n, n, p);
    let mut variance = vec![zero; n];
    for (lane, start) in group.iter().enumerate() {
        for (x, value) in motion.x.iter_mut().zip(&start.state) {
            x[lane] = *value;
        }
        for (variance, std) in variance.iter_mut().zip(&start.std) {
            variance[lane] = std * std;
        }
    }
    motion.seed();
    let mut covariance = vec![zero; n * n];
    for i in 0..n {
        covariance[i * n + i] = variance[i];
    }
    tape.start_variance = variance;
    // Room for all readings at once: growing copies everything again and again.
    let longest = group.iter().map(|s| s.end - s.first).max().unwrap_or(0);
    let outputs = noise.log_output.len().max(1);
    tape.numbers.reserve(longest * (2 * n + n * n / outputs));
    tape.ticks.reserve(longest);
    let mut found: Vec<Found> = group.iter().map(|s| Found::with_room(s.end - s.first, n, p)).collect();
    let (mut row, mut gain, mut scratch) = (Gradient::default(), vec![zero; n], vec![zero; 2 * n * n]);
    let stretch = |s: &Start| Stretch { first: s.first, end: s.end, from: s.from, to: s.to };
    let mut lanes = Lockstep::new(group.iter().map(stretch));
    while let Some(tick) = lanes.next(run) {
        if let lockstep::Tick::Read(reads) = tick {
            let value = run.compare_lanes(&reads, &motion, &mut row);
            if let Some(probe) = &mut probe {
                probe.compare(&reads, &motion, &value);
            }
            let (mut innovation, mut noise, mut active, mut weighs) = (zero, zero, zero, zero);
            let mut output = [NOTHING; LANES];
            let (mut own, mut beyond) = (zero, [None; LANES]);
            let seen = tape.seen.len();
            tape.seen.extend(row.live.iter().take_while(|state| *state < n));
            let seen = seen..tape.seen.len();
            let at_limits = run.at_limits();
            for (lane, start) in group.iter().enumerate() {
                let Some(reading) = reads[lane].and_then(|index| run.events()[index].reading) else {
                    continue;
                };
                innovation[lane] = wrapped(reading.value - value[lane], run.wrap(reading.output));
                noise[lane] = output_variance[reading.output];
                active[lane] = 1.0;
                weighs[lane] = f64::from(u8::from(reading.stamp >= start.weighs_from));
                output[lane] = reading.output as u8;
                let Some(limit) = at_limits[lane] else { continue };
                let states = &tape.seen[seen.clone()];
                let known = variance_of(states, &row, lane, |i, j| covariance[i * n + j][lane]);
                let ignorance = |i: usize, j: usize| if i == j { tape.start_variance[i][lane] } else { 0.0 };
                let rest = reading.value - limit.level;
                let short = (limit.level - value[lane]) * limit.side;
                let Some(mut found) = Beyond::of(short, known, noise[lane]) else { continue };
                if known > UNKNOWN * variance_of(states, &row, lane, ignorance) {
                    found = found.at_the_limit(short, known);
                }
                beyond[lane] = Some(found.cost + rest * rest / noise[lane] + noise[lane].ln());
                innovation[lane] = found.innovation * limit.side;
                (noise[lane], own[lane], weighs[lane]) = (found.noise, found.noise, 0.0);
                if let Some(column) = limit.column {
                    row.by[n + column][lane] -= 1.0;
                }
            }
            let spread = Level::widest().run(Read {
                row: &row,
                seen: &tape.seen[seen.clone()],
                innovation: &innovation,
                noise: &noise,
                active: &active,
                motion: &mut motion,
                covariance: &mut covariance,
                gain: &mut gain,
            });
            for ((lane, found), start) in found.iter_mut().enumerate().zip(group) {
                let Some((index, reading)) = reads[lane].and_then(|i| Some((i, run.events()[i].reading?)))
                else {
                    continue;
                };
                if reading.stamp < start.counts_from {
                    continue;
                }
                let of_innovation = || innovation[lane] * innovation[lane] / spread[lane] + spread[lane].ln();
                found.weighs.push(reading.stamp >= start.weighs_from);
                found.beyond.push(beyond[lane].map_or(0.0, |cost| cost - of_innovation()));
                found.innovation.push(innovation[lane]);
                found.variance.push(spread[lane]);
                found.by_parameter.extend(row.by[n..].iter().map(|d| -d[lane]));
                found.output.push(reading.output);
                found.stamp.push(reading.stamp);
                found.event.push(index);
                found.state.extend(motion.x.iter().map(|x| x[lane]));
            }
            if let Some(probe) = &mut probe {
                probe.read(&reads, run.events(), (&row.by[..n], &gain), (&innovation, &spread));
            }
            let by_state = tape.numbers.len();
            tape.numbers.extend_from_slice(&row.by[..n]);
            tape.numbers.extend_from_slice(&gain);
            tape.ticks.push(Tick::Read {
                by_state,
                seen,
                gain: by_state + n,
                innovation,
                output,
                weighs,
                own: beyond.iter().any(Option::is_some).then(|| Box::new(own)),
            });
        }
        if let lockstep::Tick::Advance(steps) = tick {
            let mut dt = zero;
            for (lane, index) in steps.iter().enumerate() {
                let Some(index) = *index else { continue };
                dt[lane] = run.events()[index + 1].time - run.events()[index].time;
            }
            if let Some(probe) = &mut probe {
                probe.advance(&steps, &motion);
            }
            run.advance_lanes(&steps, &mut motion);
            if let Some(probe) = &mut probe {
                probe.advanced(&steps, &motion);
            }
            let by_state = tape.numbers.len();
            for i in 0..n {
                tape.numbers.extend_from_slice(&motion.by[i * (n + p)..i * (n + p) + n]);
            }
            let pattern = match tape.patterns.iter().position(|pattern| pattern.fits(&motion.live)) {
                Some(known) => known,
                None => {
                    tape.patterns.push(Pattern::new(&motion.live));
                    tape.patterns.len() - 1
                }
            };
            Level::widest().run(Covariance {
                pattern: &tape.patterns[pattern],
                by_state: &tape.numbers[by_state..],
                dt: &dt,
                intensity: &intensity,
                covariance: &mut covariance,
                scratch: &mut scratch,
            });
            tape.ticks.push(Tick::Advance { dt, by_state, pattern });
            motion.reseed();
        }
    }
    for found in found {
        let mut found = found.in_order();
        pass.innovation.append(&mut found.innovation);
        pass.variance.append(&mut found.variance);
        pass.by_parameter.append(&mut found.by_parameter);
        pass.output.append(&mut found.output);
        pass.stamp.append(&mut found.stamp);
        pass.event.append(&mut found.event);
        pass.state.append(&mut found.state);
        pass.weighs.append(&mut found.weighs);
        pass.beyond.append(&mut found.beyond);
    }
    pass.tapes.push(tape);
}

/// Process noise of each state; states beyond the nominal ones get none.
fn intensities(scale: &[f64], noise: &Noise, states: usize) -> Vec<f64> {
    let mut intensity: Vec<f64> = scale.iter().map(|s| s * s * noise.log_process.exp()).collect();
    intensity.resize(states, 0.0);
    intensity
}

impl Pass {
    /// Whether the likelihood is of reading `k`; earlier ones of a stretch only tell the state. It is of all of a walk that does not say.
    #[must_use]
    pub fn weighs(&self, k: usize) -> bool {
        self.weighs.get(k).copied().unwrap_or(true)
    }

    /// How many states the walk had.
    #[must_use]
    pub fn states(&self) -> usize {
        self.states
    }

    /// −2 log of the likelihood, up to a constant that is the same for every hypothesis on these readings.
    #[must_use]
    pub fn cost(&self) -> f64 {
        (0..self.readings()).filter(|k| self.weighs[*k]).map(|k| self.cost_of(k)).sum()
    }

    /// The same of one reading, whether or not the likelihood is of it.
    #[must_use]
    pub fn cost_of(&self, reading: usize) -> f64 {
        let (e, s) = (self.innovation[reading], self.variance[reading]);
        e * e / s + s.ln() + self.beyond[reading]
    }

    /// How many readings were predicted.
    #[must_use]
    pub fn readings(&self) -> usize {
        self.innovation.len()
    }

    /// 1 for each reading that the likelihood is of, 0 for one that is given.
    #[must_use]
    pub fn weights(&self) -> Vec<f64> {
        self.weighs.iter().map(|weighs| f64::from(u8::from(*weighs))).collect()
    }

    /// Innovations divided by their predicted standard deviation.
    #[must_use]
    pub fn whitened(&self) -> Vec<f64> {
        self.innovation.iter().zip(&self.variance).map(|(e, s)| e / s.sqrt()).collect()
    }

    /// The rows of ∂(whitened innovation)/∂θ, the gain held fixed; readings × parameters.
    #[must_use]
    pub fn whitened_by_parameter(&self) -> Vec<f64> {
        let p = self.parameters.max(1);
        self.by_parameter
            .chunks(p)
            .zip(&self.variance)
            .flat_map(|(row, s)| row.iter().map(move |d| d / s.sqrt()))
            .collect()
    }

    /// Adds this pass's JᵀJ and Jᵀe of the whitened innovations to `information` (p × p) and `gradient` (p).
    pub fn accumulate(&self, information: &mut [f64], gradient: &mut [f64]) {
        let p = self.parameters;
        if p == 0 {
            return;
        }
        let all = self.by_parameter.chunks(p).zip(&self.innovation).zip(&self.variance).zip(&self.weighs);
        for (((row, e), s), _) in all.filter(|(_, weighs)| **weighs) {
            for i in 0..p {
                gradient[i] += row[i] * e / s;
                for j in 0..=i {
                    information[i * p + j] += row[i] * row[j] / s;
                }
            }
        }
        for i in 0..p {
            for j in 0..i {
                information[j * p + i] = information[i * p + j];
            }
        }
    }

    /// Σ g gᵀ of the scores of successive blocks of readings, p × p: what the information would be if each block's
    /// readings were as independent of each other as the likelihood believes.
    #[must_use]
    pub fn spread(&self) -> DMatrix<f64> {
        let p = self.parameters;
        let mut spread = DMatrix::<f64>::zeros(p, p);
        let length = self.readings().div_ceil(BLOCKS).max(1);
        for first in (0..self.readings()).step_by(length) {
            let mut score = DVector::<f64>::zeros(p);
            for k in (first..self.readings().min(first + length)).filter(|k| self.weighs[*k]) {
                let row = &self.by_parameter[k * p..(k + 1) * p];
                let weight = self.innovation[k] / self.variance[k];
                score.iter_mut().zip(row).for_each(|(g, d)| *g += weight * d);
            }
            spread += &score * score.transpose();
        }
        spread
    }

    /// −2 log likelihood at another noise, around the walk that was linearised. Needs no model evaluation.
    #[must_use]
    pub fn cost_at(&self, scale: &[f64], noise: &Noise) -> f64 {
        self.slope(scale, noise, &[]).cost
    }

    /// The same with derivatives by the logarithms of the variances that are `moving`: of the process noise (none), or of an output.
    /// The Hessian is as it is expected of innovations of these variances.
    #[must_use]
    pub fn slope(&self, scale: &[f64], noise: &Noise, moving: &[Option<usize>]) -> Local {
        let intensity = intensities(scale, noise, self.states);
        let output: Vec<f64> = noise.log_output.iter().map(|r| r.exp()).collect();
        let (states, intensity, output) = (self.states, &intensity[..], &output[..]);
        let mut total = Local::zero(moving.len());
        for tape in &self.tapes {
            let of = Level::widest().run(Likelihood { tape, states, intensity, output, moving });
            total.cost += of.cost;
            total.gradient.iter_mut().zip(of.gradient).for_each(|(sum, own)| *sum += own);
            total.information.iter_mut().zip(of.information).for_each(|(sum, own)| *sum += own);
        }
        total
    }
}
