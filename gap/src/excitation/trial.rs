//! An experiment that was not made yet: what each candidate would show, and how far the others are from it.
//!
//! One candidate is taken as the truth and simulated without noise. Another's filter then walks along these readings,
//! with the noise that was fitted to the log, so that what feedback or process noise would forgive is forgiven. Its
//! parameters may follow: what its sensitivities and what the log says of them allow is taken out. What is left, in
//! noise units, is the separation δ of the two; δ²/2 is the log evidence to be expected against the other.
//!
//! A machine with dry friction stands where it sticks, and its smoothed model creeps: such a truth is simulated
//! [more finely](Trial::simulate_finely) than the filter's model of it, and its distance from that is the distance at which
//! nothing is told.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use parallax_model::system::Point;

use crate::experiment::{Experiment, Held, Sample, SupplyVoltage};
use crate::filter::Noise;
use crate::guess::Guess;
use crate::hypothesis::Hypothesis;
use crate::innovation::{Segment, walk};
use crate::library;
use crate::noise::unwrapped;
use crate::search::{Fit, HALVINGS};
use crate::setup::Setup;
use crate::simulator::{Simulator, Trajectory};
use crate::statistics::median;

/// A setup around an experiment that is yet to be made. The readings are empty until a candidate is simulated.
#[derive(Clone, Debug)]
pub struct Trial {
    setup: Setup,
    state: Vec<f64>,
    std: Vec<f64>,
    duration: f64,
}

/// Readings that one candidate predicts, and how far each output would go.
#[derive(Clone, Debug)]
pub struct Shown {
    values: Vec<f64>,
    /// Where the states are along the way.
    guess: Arc<Guess>,
    /// Smallest and largest value of each output, angles followed across their wraps.
    pub reach: Vec<(f64, f64)>,
}

impl Trial {
    /// The setup's system and sensors over `duration` seconds from the state `state`; readings at their usual periods.
    #[must_use]
    pub fn new(setup: &Setup, state: &[f64], duration: f64) -> Self {
        let mut setup = setup.clone();
        let old = &setup.experiment;
        let outputs = old.wraps.len();
        let mut samples: Vec<Sample> = Vec::new();
        for output in 0..outputs {
            let period =
                Some(old.period(output)).filter(|p| p.is_finite() && *p > 0.0).unwrap_or(setup.period);
            let count = (duration / period).floor() as usize + 1;
            samples.extend((0..count).map(|k| Sample { stamp: k as f64 * period, output, value: 0.0 }));
        }
        samples.sort_by(|a, b| a.stamp.total_cmp(&b.stamp).then(a.output.cmp(&b.output)));
        let inputs = old.inputs.iter().map(|held| constant(median(&mut held.values.clone()))).collect();
        let supplies = old.supplies.iter().map(|supply| {
            let supply = supply.as_ref()?;
            let usual = median(&mut supply.voltage.values.clone());
            Some(SupplyVoltage { voltage: constant(usual), nominal: supply.nominal })
        });
        setup.experiment = Experiment {
            inputs,
            supplies: supplies.collect(),
            samples,
            given: old.given.clone(),
            input_units: old.input_units.clone(),
            wraps: old.wraps.clone(),
            ..Experiment::default()
        };
        let std = setup.train.first().map_or_else(|| vec![1.0; state.len()], |s| s.guess.std().to_vec());
        Trial { setup, state: state.to_vec(), std, duration }
    }

    /// The same with these commands on some of the inputs.
    #[must_use]
    pub fn with_commands(&self, commands: &[(usize, Held)]) -> Self {
        let mut trial = self.clone();
        for (input, held) in commands {
            trial.setup.experiment.inputs[*input] = held.clone();
        }
        trial
    }

    /// The system, its sensors and what is commanded.
    #[must_use]
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// The same with another setup: this one's, with an output more, which is read every `period` seconds.
    #[must_use]
    pub fn with_setup(&self, mut setup: Setup, period: f64) -> Self {
        let output = setup.experiment.wraps.len() - 1;
        let count = (self.duration / period).floor() as usize + 1;
        let stamps = (0..count).map(|k| k as f64 * period);
        setup.experiment.samples.extend(stamps.map(|stamp| Sample { stamp, output, value: 0.0 }));
        setup.experiment.samples.sort_by(|a, b| a.stamp.total_cmp(&b.stamp).then(a.output.cmp(&b.output)));
        Trial { setup, ..self.clone() }
    }

    /// What the candidate shows under the trial's commands. `None` when it gives numbers that are not finite.
    #[must_use]
    pub fn simulate(&self, fit: &Fit) -> Option<Shown> {
        self.simulate_as(&fit.hypothesis, fit)
    }

    /// The same in steps that are as much shorter as its dry friction is steeper: nearer to a machine, which stands where it sticks.
    #[must_use]
    pub fn simulate_finely(&self, fit: &Fit) -> Option<Shown> {
        self.simulate_as(&Hypothesis { halvings: HALVINGS, ..fit.hypothesis.clone() }, fit)
    }

    fn simulate_as(&self, hypothesis: &Hypothesis, fit: &Fit) -> Option<Shown> {
        let simulator = library::simulator(&self.setup, hypothesis, Vec::new());
        let outputs = self.setup.experiment.wraps.len();
        let mut found: Vec<Vec<f64>> = vec![Vec::new(); outputs];
        let mut run = simulator.run_at(fit.theta());
        let (start, _) = simulator.start(&self.state, &self.std, 0.0);
        let mut trajectory = Trajectory::from(start.as_slice());
        let (mut stamps, mut states) = (Vec::new(), Vec::new());
        for index in 0..run.events().len() {
            let event = run.events()[index];
            stamps.push(event.time);
            states.extend(trajectory.state().take(self.state.len()));
            if let Some(reading) = event.reading {
                found[reading.output].push(trajectory.observe(&mut *run, index));
            }
            if index + 1 < run.events().len() {
                trajectory.advance(&mut *run, index);
            }
        }
        let last: Vec<f64> = trajectory.state().collect();
        if found.iter().flatten().chain(&last).any(|v| !v.is_finite() || v.abs() > 1e12) {
            return None;
        }
        let wraps = &self.setup.experiment.wraps;
        let reach = found.iter().zip(wraps).map(|(values, wrap)| {
            let values = unwrapped(values, *wrap);
            let low = values.iter().copied().fold(f64::INFINITY, f64::min);
            (low, values.iter().copied().fold(f64::NEG_INFINITY, f64::max))
        });
        let reach = reach.collect();
        // The readings of one output keep their order, however late they are.
        let mut next = vec![0_usize; outputs];
        let mut values = Vec::with_capacity(self.setup.experiment.samples.len());
        for sample in &self.setup.experiment.samples {
            values.push(*found[sample.output].get(next[sample.output])?);
            next[sample.output] += 1;
        }
        let guess = Guess::constant(self.state.clone(), self.std.clone());
        let guess = Arc::new(guess.with_states(stamps, states, 2.0 * self.setup.period));
        Some(Shown { values, guess, reach })
    }

    /// How far `other` stays from these readings after its parameters have followed: the separation δ, in noise units.
    /// `noise` is the noise under the other candidate.
    #[must_use]
    pub fn separation(&self, shown: &Shown, other: &Fit, noise: &Noise) -> f64 {
        let mut setup = self.setup.clone();
        for (sample, value) in setup.experiment.samples.iter_mut().zip(&shown.values) {
            sample.value = *value;
        }
        let segment = Segment { from: 0.0, to: self.duration + 1e-6, guess: shown.guess.clone() };
        let simulator = library::simulator(&setup, &other.hypothesis, Vec::new());
        let pass = walk(&simulator, &[segment], &setup.noise, noise, other.theta());
        let innovations = DVector::from_vec(pass.whitened());
        let p = other.hypothesis.fitted.len();
        if p == 0 {
            return innovations.norm();
        }
        let by = DMatrix::from_row_slice(pass.readings(), p, &pass.whitened_by_parameter());
        let slope = by.tr_mul(&innovations);
        let known = &other.innovation.minimum.information;
        let mut information = by.tr_mul(&by);
        if known.shape() == information.shape() {
            information += known;
        }
        // In natural units, so that the smallest of them is no rounding error of the largest.
        let scale: Vec<f64> = other.hypothesis.fitted.iter().map(|f| f.scale).collect();
        for i in 0..p {
            for j in 0..p {
                information[(i, j)] *= scale[i] * scale[j];
            }
            information[(i, i)] *= 1.0 + 1e-9;
            information[(i, i)] += 1e-12;
        }
        let slope = DVector::from_iterator(p, slope.iter().zip(&scale).map(|(g, s)| g * s));
        let Some(cholesky) = information.cholesky() else { return 0.0 };
        let followed = slope.dot(&cholesky.solve(&slope));
        (innovations.norm_squared() - followed).max(0.0).sqrt()
    }
}

fn constant(value: f64) -> Held {
    Held { times: vec![0.0], values: vec![value] }
}

/// The state nearest to rest that the log has seen, with the commands at rest.
#[must_use]
pub fn calm(setup: &Setup, null: &Fit, rest: &[f64]) -> Vec<f64> {
    let n = setup.equations.system().states.len();
    let pass = &null.innovation.pass;
    let stride = pass.state.len() / pass.readings().max(1);
    let fallback = setup.train.first().map_or_else(|| vec![0.0; n], |s| s.guess.state(s.from).to_vec());
    if stride < n || pass.readings() == 0 {
        return fallback;
    }
    let parameters = setup.equations.nominal();
    let rates: Vec<Vec<f64>> = (0..pass.readings())
        .map(|k| {
            let states = &pass.state[k * stride..k * stride + n];
            let point = Point { parameters: &parameters, states, inputs: rest, time: pass.stamp[k] };
            setup.equations.values(&point, &[]).derivatives
        })
        .collect();
    let size: Vec<f64> = (0..n).map(|i| rates.iter().map(|r| r[i] * r[i]).sum::<f64>().max(1e-300)).collect();
    let motion = |k: usize| rates[k].iter().zip(&size).map(|(r, s)| r * r / s).sum::<f64>();
    // The filter has settled by then.
    let settled = (pass.readings() / 20).min(20);
    let best = (settled..pass.readings()).min_by(|a, b| motion(*a).total_cmp(&motion(*b)));
    best.map_or(fallback, |k| pass.state[k * stride..k * stride + n].to_vec())
}
