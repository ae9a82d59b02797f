//! What a diagnosis knows before it fits anything: segments, noise, natural sizes.

mod segments;

use std::sync::Arc;

use parallax_model::plant::Plant;
use parallax_model::system::{Equations, Point};

use crate::equations::EquationsSimulator;
use crate::experiment::Experiment;
use crate::filter::{Noise, Pass};
use crate::guess::{Guess, kinematic};
use crate::innovation::{NoiseModel, Segment, walk};
use crate::limit::limit;
use crate::noise;
use crate::simulator::Simulator;
use crate::spectrum;
use crate::statistics::{root_mean_square, standard_deviation};
use crate::stop::Stop;

pub use segments::HELD_OUT;
use segments::{GAP, segments};

/// A system bound to a recording, with everything that is the same for every hypothesis.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The nominal equations.
    pub equations: Equations,
    /// The recording.
    pub experiment: Experiment,
    /// Model-free noise of each output: standard deviation.
    pub output_noise: Vec<f64>,
    /// Noise bounds and scales.
    pub noise: NoiseModel,
    /// Stretches that are fitted.
    pub train: Vec<Segment>,
    /// Stretches that are held out.
    pub test: Vec<Segment>,
    /// Which of every three blocks, or recordings, these are.
    pub held_out: usize,
    /// Length of the short windows and of the predictions that are scored (s).
    pub horizon: f64,
    /// Longest integration step (s).
    pub step: f64,
    /// Median time between readings of the fastest output (s).
    pub period: f64,
    /// Natural sizes of each joint.
    pub joints: Vec<JointScale>,
    /// Standard deviation of each output's readings.
    pub output_scale: Vec<f64>,
    /// How fast each nominal state typically changes, in its unit per second: root mean square; zero for a state that only
    /// integrates another one.
    pub state_rate: Vec<f64>,
    /// Smallest and largest value of each command, and its deviation.
    pub input_range: Vec<Range>,
    /// The same of each output's readings.
    pub output_range: Vec<Range>,
    /// The same of each nominal state, as a filter found it.
    pub state_range: Vec<Range>,
    /// Frequencies that stand out of the nominal model's innovations (Hz), the strongest first.
    pub frequencies: Vec<f64>,
    /// Whether to end early.
    pub stop: Stop,
}

/// How far a quantity went.
#[derive(Clone, Copy, Debug)]
pub struct Range {
    /// Smallest value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
    /// Standard deviation over time.
    pub std: f64,
}

impl Range {
    /// Of these values.
    #[must_use]
    pub fn of(values: &[f64]) -> Self {
        Range {
            low: values.iter().copied().fold(f64::INFINITY, f64::min),
            high: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            std: standard_deviation(values),
        }
    }

    /// From the smallest to the largest value.
    #[must_use]
    pub fn width(&self) -> f64 {
        self.high - self.low
    }

    /// Halfway between them.
    #[must_use]
    pub fn middle(&self) -> f64 {
        0.5 * (self.low + self.high)
    }
}

/// How fast, how far and how hard a joint moved.
#[derive(Clone, Debug)]
pub struct JointScale {
    /// Root mean square speed.
    pub speed: f64,
    /// Root mean square of the driving force, or of inertia times acceleration where no drive is stated.
    pub force: f64,
    /// Speed within which the direction of motion is smoothed.
    pub smoothing: f64,
    /// Where it went.
    pub position: Range,
    /// Smallest and largest speed.
    pub velocity: Range,
    /// What forces work against: as stated, or force by acceleration.
    pub inertia: f64,
    /// Waves per unit of position, times 2π, that stand out of the nominal model's innovations, the strongest first.
    pub wavenumbers: Vec<f64>,
}

/// Readings of each output in a window.
const READINGS_PER_WINDOW: f64 = 25.0;

/// The horizon where none is asked for (s), from the time between readings: a quarter of a second where sampling allows, else
/// enough readings to see a state. A slow process is sampled many times within each of its time constants, and shows what
/// goes on between hidden states in windows of as many readings as a robot's.
fn default_horizon(period: f64) -> f64 {
    if period > SLOW { READINGS_PER_WINDOW * period } else { (10.0 * period).max(0.25) }
}

/// The median time between readings of the fastest output (s).
fn fastest_period(experiment: &Experiment) -> f64 {
    let period = (0..experiment.wraps.len())
        .filter(|o| experiment.output(*o).0.len() > 2)
        .map(|o| experiment.period(o))
        .fold(f64::INFINITY, f64::min);
    if period.is_finite() && period > 0.0 { period } else { 0.01 }
}

/// The recording without the long rests of its machine ([`Experiment::leave_out_rests`]), by the horizon that is asked for or the usual one.
#[must_use]
pub(crate) fn without_rests(mut experiment: Experiment, horizon: Option<f64>) -> Experiment {
    let horizon = horizon.unwrap_or_else(|| default_horizon(fastest_period(&experiment)));
    experiment.leave_out_rests(horizon);
    experiment
}

/// Time between readings of a process that is no robot's (s).
const SLOW: f64 = 0.2;

/// Changes of a command between two readings, at most.
const COMMANDS_PER_READING: f64 = 3.0;

impl Setup {
    /// Looks at the data once, without judging it.
    #[must_use]
    pub fn new(equations: Equations, experiment: Experiment, horizon: Option<f64>) -> Self {
        let least = vec![0.0; experiment.wraps.len()];
        Self::with_noise(equations, experiment, horizon, &least)
    }

    /// The same, with each output's noise at least so large (standard deviations), whatever the system declares.
    #[must_use]
    pub fn with_noise(
        equations: Equations,
        mut experiment: Experiment,
        horizon: Option<f64>,
        least: &[f64],
    ) -> Self {
        let outputs = experiment.wraps.len();
        let period = fastest_period(&experiment);
        let horizon = horizon.unwrap_or_else(|| default_horizon(period));
        let output_noise: Vec<f64> = (0..outputs)
            .map(|o| {
                equations.system().outputs[o]
                    .noise
                    .unwrap_or_else(|| noise::model_free(&experiment.output(o).1, experiment.wraps[o]))
                    .max(least[o])
            })
            .collect();
        let output_scale: Vec<f64> = (0..outputs)
            .map(|o| standard_deviation(&noise::unwrapped(&experiment.output(o).1, experiment.wraps[o])))
            .collect();
        // A window is described by a few dozen readings. Faster ones would weigh what happens between two samples,
        // such as vibration and quantisation, above what the simulator is asked for.
        let thin = ((horizon / READINGS_PER_WINDOW / period) + 1e-6).floor().max(1.0) as usize;
        experiment.thin(thin);
        let period = period * thin as f64;
        experiment.average_commands(period / COMMANDS_PER_READING);
        for supply in experiment.supplies.iter_mut().flatten() {
            supply.voltage = supply.voltage.averaged(period);
        }
        let guess = Arc::new(Guess::of(&equations, &experiment, &output_scale, period));
        let (train, test) = segments(&experiment, horizon, period, &guess, HELD_OUT);
        let scale: Vec<f64> = (0..equations.system().states.len())
            .map(|i| f64::from(u8::from(!kinematic(&equations, i))))
            .collect();
        let limits = (0..outputs)
            .map(|o| {
                let log = 2.0 * output_noise[o].ln();
                match equations.system().outputs[o].noise {
                    Some(_) => (log, log),
                    None => (log - 3.0, log + 18.0),
                }
            })
            .collect();
        let initial =
            Noise { log_process: 0.0, log_output: output_noise.iter().map(|s| 2.0 * s.ln()).collect() };
        let resting = (0..outputs)
            .map(|o| {
                let readings = experiment.output(o).1;
                let at = |upper| limit(&readings, output_noise[o], upper).level;
                if experiment.wraps[o].is_some() { [None; 2] } else { [at(false), at(true)] }
            })
            .collect();
        let noise = NoiseModel { scale, limits, process_floor: -60.0, initial, resting };
        let input_range = experiment.inputs.iter().map(|h| Range::of(&h.values)).collect();
        let output_range = (0..outputs)
            .map(|o| Range::of(&noise::unwrapped(&experiment.output(o).1, experiment.wraps[o])))
            .collect();
        // Steps end at every change of a command; half its period is a start that is refined below.
        let step = experiment
            .inputs
            .iter()
            .map(|h| {
                crate::statistics::median(&mut h.times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>())
            })
            .filter(|p| *p > 0.0)
            .fold(period, f64::min)
            * 0.5;
        let mut setup = Setup {
            equations,
            experiment,
            output_noise,
            noise,
            train,
            test,
            held_out: HELD_OUT,
            horizon,
            step,
            period,
            joints: Vec::new(),
            output_scale,
            state_rate: Vec::new(),
            input_range,
            output_range,
            state_range: Vec::new(),
            frequencies: Vec::new(),
            stop: Stop::default(),
        };
        setup.measure();
        setup
    }

    /// Whether an output shows this state itself.
    #[must_use]
    pub fn is_shown(&self, state: usize) -> bool {
        let system = self.equations.system();
        system.shown_as(&system.states[state].name).is_some()
    }

    /// Takes each state's share of the process noise from the innovations of a walk of the nominal model, its `pass` with its
    /// `noise`. Gives whether that changed any.
    pub fn share_noise(&mut self, pass: &Pass, noise: &Noise) -> bool {
        let model = &mut self.noise;
        let found = pass.refit_scale(&self.state_rate, noise, &model.limits, model.process_floor);
        let other = found != model.scale;
        model.scale = found;
        other
    }

    /// Holds out another of every three blocks, or recordings.
    pub fn hold_out(&mut self, which: usize) {
        let Some(guess) = self.train.first().map(|segment| segment.guess.clone()) else { return };
        self.held_out = which % 3;
        (self.train, self.test) =
            segments(&self.experiment, self.horizon, self.period, &guess, self.held_out);
    }

    /// Runs the nominal model once, corrected by the readings, to see how large its motions are.
    fn measure(&mut self) {
        let joints = self.equations.system().joints.len();
        let plant = Plant::new(self.equations.clone(), &[], Vec::new(), vec![1.0; joints]);
        let simulator = EquationsSimulator::new(plant, Vec::new(), &self.experiment, self.step);
        let (n, width) = (self.equations.system().states.len(), simulator.states());
        let mut all: Vec<Segment> = self.train.iter().chain(&self.test).cloned().collect();
        // Start from a process noise that lets the readings lead, then let the likelihood choose.
        let mut noise = self.noise.initial.clone();
        noise.log_process = 2.0 * self.typical_rate().max(1e-12).ln();
        let pass = walk(&simulator, &all, &self.noise, &noise, &[]);
        let reach = GAP.0 * self.horizon;
        if let Some(first) = all.first() {
            let guess = Arc::new(first.guess.informed(&self.equations, &pass, reach));
            all.iter_mut().for_each(|segment| segment.guess = guess.clone());
        }
        let pass = walk(&simulator, &all, &self.noise, &noise, &[]);
        noise = pass.refit_noise(&self.noise.scale, &noise, &self.noise.limits, self.noise.process_floor);
        let pass = walk(&simulator, &all, &self.noise, &noise, &[]);
        if let Some(first) = all.first() {
            let guess = Arc::new(first.guess.informed(&self.equations, &pass, reach));
            self.train.iter_mut().chain(&mut self.test).for_each(|segment| segment.guess = guess.clone());
        }
        let parameters = self.equations.nominal();
        let mut rates = vec![Vec::new(); n];
        let mut speeds = vec![Vec::new(); joints];
        let mut positions = vec![Vec::new(); joints];
        let mut accelerations = vec![Vec::new(); joints];
        let mut states = vec![Vec::new(); n];
        let mut forces = vec![Vec::new(); joints];
        let mut inertias = vec![Vec::new(); joints];
        for (k, stamp) in pass.stamp.iter().enumerate() {
            let found = &pass.state[k * width..k * width + n];
            for (all, value) in states.iter_mut().zip(found) {
                all.push(*value);
            }
            let inputs: Vec<f64> = self.experiment.inputs.iter().map(|h| h.at(*stamp)).collect();
            let point = Point { parameters: &parameters, states: found, inputs: &inputs, time: *stamp };
            let values = self.equations.values(&point, &[]);
            for (rate, value) in rates.iter_mut().zip(&values.derivatives) {
                rate.push(*value);
            }
            for j in 0..joints {
                let joint = self.equations.joint(j, &point, &values.lets);
                speeds[j].push(joint.velocity);
                positions[j].push(joint.position);
                let accelerated = self.equations.system().joints[j].velocity_state;
                accelerations[j].extend(accelerated.map(|state| values.derivatives[state]));
                inertias[j].extend(joint.inertia);
                let inertial = || {
                    let state = self.equations.system().joints[j].velocity_state?;
                    Some(joint.inertia? * values.derivatives[state])
                };
                if let Some(force) = joint.drive.or_else(inertial).or(joint.force) {
                    forces[j].push(force);
                }
            }
        }
        for (scale, rate) in self.noise.scale.iter_mut().zip(&rates) {
            let size = root_mean_square(rate);
            if *scale > 0.0 && size.is_finite() && size > 0.0 {
                *scale = size;
            }
        }
        self.state_rate.clone_from(&self.noise.scale);
        // In units of these scales the intensities are ratios; the search starts from a hundredth.
        self.noise.initial =
            Noise { log_process: (1e-4_f64 * self.period).ln(), log_output: noise.log_output };
        let whitened = pass.whitened();
        self.joints = (0..joints)
            .map(|j| {
                let speed = root_mean_square(&speeds[j]).max(1e-12);
                let force = root_mean_square(&forces[j]).max(1e-12);
                let inertia = crate::statistics::median(&mut inertias[j]);
                // Steep enough to be dry friction at working speeds; no steeper than the integrator stands: a
                // friction of a quarter of the driving force may change the speed by half this in one step. What
                // motion shows of the inertia is of a whole machine; one joint of it may move far more easily.
                let moved = root_mean_square(&accelerations[j]);
                let by_motion = force / moved.max(1e-12);
                let carried = if inertia > 0.0 { inertia } else { by_motion / LIGHTER };
                let stable = if inertia > 0.0 || moved > 0.0 {
                    0.125 * force * self.step / carried
                } else {
                    UNKNOWN_SMOOTHING * speed
                };
                let smoothing = (0.002 * speed).max(stable);
                let inertia = if inertia > 0.0 { inertia } else { by_motion };
                let (position, velocity) = (Range::of(&positions[j]), Range::of(&speeds[j]));
                let wavenumbers = spectrum::wavenumbers(&positions[j], &whitened);
                JointScale { speed, force, smoothing, position, velocity, inertia, wavenumbers }
            })
            .collect();
        self.state_range = states.iter().map(|values| Range::of(values)).collect();
        self.frequencies = spectrum::frequencies(&pass.stamp, &whitened, self.period);
    }

    /// The same data, with the lines that stand out of what a fit leaves (its `pass`): where the search for a periodic cause beside
    /// what the fit explains starts.
    #[must_use]
    pub fn with_lines_of(&self, pass: &Pass) -> Setup {
        let mut setup = self.clone();
        setup.frequencies = spectrum::frequencies(&pass.stamp, &pass.whitened(), self.period);
        for (joint, wavenumbers) in setup.joints.iter_mut().zip(self.wavenumbers_of(pass)) {
            joint.wavenumbers = wavenumbers;
        }
        setup
    }

    /// The same data, with the lines of a fit beside those that it has.
    #[must_use]
    pub fn with_more_lines_of(mut self, pass: &Pass) -> Setup {
        add_lines(&mut self.frequencies, spectrum::frequencies(&pass.stamp, &pass.whitened(), self.period));
        let wavenumbers = self.wavenumbers_of(pass);
        for (joint, more) in self.joints.iter_mut().zip(wavenumbers) {
            add_lines(&mut joint.wavenumbers, more);
        }
        self
    }

    /// The lines over each joint's position that stand out of what a fit leaves.
    fn wavenumbers_of(&self, pass: &Pass) -> Vec<Vec<f64>> {
        let (whitened, width, n) = (pass.whitened(), pass.states(), self.state_range.len());
        let parameters = self.equations.nominal();
        let position = |joint: usize, k: usize| {
            let (stamp, states) = (pass.stamp[k], &pass.state[k * width..k * width + n]);
            let inputs: Vec<f64> = self.experiment.inputs.iter().map(|h| h.at(stamp)).collect();
            let point = Point { parameters: &parameters, states, inputs: &inputs, time: stamp };
            let values = self.equations.values(&point, &[]);
            self.equations.joint(joint, &point, &values.lets).position
        };
        let of = |joint: usize| {
            let positions: Vec<f64> = (0..pass.stamp.len()).map(|k| position(joint, k)).collect();
            spectrum::wavenumbers(&positions, &whitened)
        };
        (0..self.joints.len()).map(of).collect()
    }

    /// A rate of change of the states that the data suggest: output scale over the horizon.
    fn typical_rate(&self) -> f64 {
        let largest = self.output_scale.iter().copied().fold(0.0, f64::max);
        largest / (self.horizon * self.horizon)
    }
}

/// How much less inertia a joint may have at times than its motion shows on the whole, where it states none.
const LIGHTER: f64 = 4.0;

/// Smoothing of dry friction as a share of the usual speed, where nothing is known of what the joint moves.
const UNKNOWN_SMOOTHING: f64 = 0.02;

/// Share by which two lines differ at most that are one.
const SAME_LINE: f64 = 0.01;

/// Adds those lines that are not there yet.
fn add_lines(known: &mut Vec<f64>, more: Vec<f64>) {
    for line in more {
        if known.iter().all(|known| (line - known).abs() > SAME_LINE * known) {
            known.push(line);
        }
    }
}
