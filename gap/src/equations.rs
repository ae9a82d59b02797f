//! Equations as a [`Simulator`]: the plant of a hypothesis along the events of a recording, on dual numbers.
//!
//! Between two events the commands are constant, and so is everything that depends on them alone. A delayed command
//! changes, and a late reading is taken, at a time that carries its derivative by the delay: fractional delays are
//! smooth, and no sample is interpolated.

use parallax_model::Dual;
use parallax_model::effect::{Effect, PlaceKind, lag_step};
use parallax_model::plant::Plant;
use parallax_model::program::Program;

use crate::experiment::Experiment;
use crate::hypothesis::Slot;
use crate::machine::{Machine, Stage};
use crate::simulator::{Event, Prediction, Reading, Run, Simulator, Transition};

/// Most states and fitted parameters together.
pub const MOST_VARIABLES: usize = 128;

/// A plant bound to a recording, with the slots that θ fills.
#[derive(Clone, Debug)]
pub struct EquationsSimulator<'a> {
    plant: Plant,
    slots: Vec<Slot>,
    experiment: &'a Experiment,
    step: f64,
    derivatives: Program,
    outputs: Vec<Program>,
}

impl<'a> EquationsSimulator<'a> {
    /// The plant with the hypothesis' effects, what each entry of θ stands for, the recording, and the longest
    /// integration step (s).
    #[must_use]
    pub fn new(plant: Plant, slots: Vec<Slot>, experiment: &'a Experiment, step: f64) -> Self {
        let derivatives = plant.derivative_program();
        let outputs = (0..experiment.wraps.len()).map(|output| plant.output_program(output)).collect();
        EquationsSimulator { plant, slots, experiment, step, derivatives, outputs }
    }
}

impl Simulator for EquationsSimulator<'_> {
    fn states(&self) -> usize {
        self.plant.equations().system().states.len()
    }

    fn parameters(&self) -> usize {
        self.slots.len()
    }

    fn run<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a> {
        self.walk(theta, self.slots.len())
    }

    fn run_at<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a> {
        self.walk(theta, 0)
    }
}

impl EquationsSimulator<'_> {
    /// A walk with derivatives by the first `variables` entries of θ.
    fn walk<'a>(&'a self, theta: &[f64], variables: usize) -> Box<dyn Run + 'a> {
        // The gradient has a fixed length; the next larger one is taken.
        match self.states() + variables {
            0..=4 => Box::new(EquationsRun::<4>::new(self, theta, variables)),
            5..=8 => Box::new(EquationsRun::<8>::new(self, theta, variables)),
            9..=16 => Box::new(EquationsRun::<16>::new(self, theta, variables)),
            17..=40 => Box::new(EquationsRun::<40>::new(self, theta, variables)),
            41..=64 => Box::new(EquationsRun::<64>::new(self, theta, variables)),
            // [`MOST_VARIABLES`] is checked before any simulator is made.
            _ => Box::new(EquationsRun::<MOST_VARIABLES>::new(self, theta, variables)),
        }
    }
}

/// A command's value from a time on.
#[derive(Clone, Copy)]
struct Change<const N: usize> {
    time: Dual<N>,
    value: Dual<N>,
}

/// A walk with gradients of length `N`: states first, then θ.
struct EquationsRun<'a, const N: usize> {
    simulator: &'a EquationsSimulator<'a>,
    /// How many entries of θ are variables.
    variables: usize,
    extra: Vec<Dual<N>>,
    machine: Machine<N>,
    changes: Vec<Vec<Change<N>>>,
    events: Vec<Event>,
    times: Vec<Dual<N>>,
    /// For each event and input, the index of the change that holds.
    current: Vec<u32>,
}

impl<'a, const N: usize> EquationsRun<'a, N> {
    fn new(simulator: &'a EquationsSimulator<'a>, theta: &[f64], variables: usize) -> Self {
        let n = simulator.states();
        let mut parameters: Vec<Dual<N>> =
            simulator.plant.equations().nominal().into_iter().map(Dual::from_value).collect();
        let mut extra = vec![Dual::from_value(0.0); simulator.plant.extra_parameters()];
        let first_weight: usize = simulator.plant.effects().iter().map(|b| b.effect.parameters().len()).sum();
        for (j, (slot, value)) in simulator.slots.iter().zip(theta).enumerate() {
            let variable =
                if j < variables { Dual::variable(*value, n + j) } else { Dual::from_value(*value) };
            match *slot {
                Slot::Nominal(index) => parameters[index] = variable,
                Slot::Effect { effect, parameter } => {
                    extra[simulator.plant.effects()[effect].first + parameter] = variable;
                }
                Slot::Weight(index) => extra[first_weight + index] = variable,
            }
        }
        let inputs = simulator.experiment.inputs.len();
        let changes: Vec<Vec<Change<N>>> = (0..inputs).map(|i| changes(simulator, &extra, i)).collect();
        let machine = Machine::new(&parameters, &extra, n, inputs);
        let mut run = EquationsRun {
            simulator,
            variables,
            extra,
            machine,
            changes,
            events: Vec::new(),
            times: Vec::new(),
            current: Vec::new(),
        };
        run.merge();
        run
    }

    /// Puts changes and readings in the order of time; at equal times a command comes before a reading.
    fn merge(&mut self) {
        let experiment = self.simulator.experiment;
        let late: Vec<Option<Dual<N>>> = (0..experiment.wraps.len())
            .map(|output| self.effect(Effect::Delay, PlaceKind::Output, output).map(|p| p[0]))
            .collect();
        enum What {
            Change,
            Reading(Reading),
        }
        let mut all: Vec<(Dual<N>, What)> =
            Vec::with_capacity(experiment.samples.len() + self.changes.iter().map(Vec::len).sum::<usize>());
        for channel in &self.changes {
            all.extend(channel.iter().map(|c| (c.time, What::Change)));
        }
        for sample in &experiment.samples {
            let stamp = Dual::from_value(sample.stamp);
            let time = late[sample.output].map_or(stamp, |delay| stamp - delay);
            let reading = Reading { output: sample.output, value: sample.value, stamp: sample.stamp };
            all.push((time, What::Reading(reading)));
        }
        // The sort is stable, and changes were put in first.
        all.sort_by(|a, b| a.0.value.total_cmp(&b.0.value));
        let m = self.changes.len();
        let mut current = vec![0_u32; m];
        for (time, what) in all {
            for (input, channel) in self.changes.iter().enumerate() {
                let mut at = current[input] as usize;
                while at + 1 < channel.len() && channel[at + 1].time.value <= time.value {
                    at += 1;
                }
                current[input] = at as u32;
            }
            self.current.extend_from_slice(&current);
            let reading = match what {
                What::Change => None,
                What::Reading(reading) => Some(reading),
            };
            self.events.push(Event { time: time.value, reading });
            self.times.push(time);
        }
    }

    fn effect(&self, effect: Effect, kind: PlaceKind, index: usize) -> Option<&[Dual<N>]> {
        find(&self.simulator.plant, &self.extra, effect, kind, index)
    }

    fn load_commands(&mut self, index: usize) {
        let m = self.changes.len();
        for input in 0..m {
            let at = self.current[index * m + input] as usize;
            let value = self.changes[input].get(at).map_or(Dual::from_value(0.0), |c| c.value);
            self.machine.set_command(input, value);
        }
    }
}

fn find<'e, T>(
    plant: &Plant,
    extra: &'e [T],
    effect: Effect,
    kind: PlaceKind,
    index: usize,
) -> Option<&'e [T]> {
    let bound = plant.effects().iter().find(|b| b.effect == effect && b.kind == kind && b.index == index)?;
    Some(&extra[bound.first..bound.first + effect.parameters().len()])
}

/// The command as it reaches the plant: late, changed in value, smoothed.
fn changes<const N: usize>(
    simulator: &EquationsSimulator<'_>,
    extra: &[Dual<N>],
    input: usize,
) -> Vec<Change<N>> {
    let plant = &simulator.plant;
    let held = &simulator.experiment.inputs[input];
    let delay = find(plant, extra, Effect::Delay, PlaceKind::Input, input).map(|p| p[0]);
    let lag = find(plant, extra, Effect::Lag, PlaceKind::Input, input).map(|p| p[0]);
    let late = |time: f64| delay.map_or(Dual::from_value(time), |d| d + time);
    let mut out = Vec::with_capacity(held.times.len());
    let mut smooth: Option<Dual<N>> = None;
    for (k, (&time, &value)) in held.times.iter().zip(&held.values).enumerate() {
        let value = plant.command(input, extra, Dual::from_value(value));
        let Some(tau) = lag else {
            out.push(Change { time: late(time), value });
            continue;
        };
        let state = smooth.get_or_insert(value);
        // After the last command the smoothed one keeps settling; five time constants are enough.
        let until = held.times.get(k + 1).copied().unwrap_or(time + 5.0 * tau.value + simulator.step);
        // The mean of a smoothed command stands for it over a piece, so pieces are shorter than steps.
        let pieces = (2.0 * (until - time) / simulator.step - 1e-6).ceil().max(1.0);
        let dt = (until - time) / pieces;
        for piece in 0..pieces as usize {
            let (mean, end) = lag_step(tau, *state, value, Dual::from_value(dt));
            out.push(Change { time: late(time + dt * piece as f64), value: mean });
            *state = end;
        }
    }
    out
}

impl<const N: usize> Run for EquationsRun<'_, N> {
    fn events(&self) -> &[Event] {
        &self.events
    }

    fn advance(&mut self, index: usize, state: &mut [f64], transition: &mut Transition) {
        let n = state.len();
        let p = self.variables;
        self.load_commands(index);
        let mut time = self.times[index];
        let span = self.times[index + 1] - time;
        let mut x: Vec<Dual<N>> = state.iter().enumerate().map(|(i, v)| Dual::variable(*v, i)).collect();
        let still = span.value == 0.0 && span.gradient.iter().all(|g| *g == 0.0);
        if !still {
            // A rounding excess must not double the work of a step that just fits.
            let steps = (span.value / self.simulator.step - 1e-6).ceil().max(1.0);
            let dt = span / steps;
            let mut stage = Stage::new(n);
            for _ in 0..steps as usize {
                self.machine.runge_kutta(&self.simulator.derivatives, &mut x, dt, time, &mut stage);
                time += dt;
            }
        }
        transition.by_state.clear();
        transition.by_parameter.clear();
        for (value, dual) in state.iter_mut().zip(&x) {
            *value = dual.value;
            transition.by_state.extend_from_slice(&dual.gradient[..n]);
            transition.by_parameter.extend_from_slice(&dual.gradient[n..n + p]);
        }
    }

    fn observe(&mut self, index: usize, state: &[f64], prediction: &mut Prediction) {
        let n = state.len();
        let p = self.variables;
        self.load_commands(index);
        let x: Vec<Dual<N>> = state.iter().enumerate().map(|(i, v)| Dual::variable(*v, i)).collect();
        let output = self.events[index].reading.map_or(0, |r| r.output);
        let mut y = [Dual::from_value(0.0)];
        self.machine.evaluate(&self.simulator.outputs[output], &x, self.times[index], &mut y);
        let [y] = y;
        prediction.value = y.value;
        prediction.by_state.clear();
        prediction.by_state.extend_from_slice(&y.gradient[..n]);
        prediction.by_parameter.clear();
        prediction.by_parameter.extend_from_slice(&y.gradient[n..n + p]);
    }

    fn wrap(&self, output: usize) -> Option<f64> {
        self.simulator.experiment.wraps[output]
    }
}
