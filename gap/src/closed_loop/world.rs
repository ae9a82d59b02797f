//! The machine in a simulated closed loop: it takes commands as they are sent and gives readings as they are asked for.
//!
//! Effects act as the diagnosis has them act along a recording ([`commands`](crate::commands)), one command at a time: a
//! delay moves a command, what has a memory acts by its mean over half an integration step, a late sensor shows the past.
//! What moves single messages by chance (noise, jitter, lost commands, ...) is drawn.

use std::collections::VecDeque;
use std::sync::Arc;

use parallax_model::effect::{Effect, PlaceKind, sag};
use parallax_model::plant::Plant;
use parallax_model::program::{Program, Workspace};
use parallax_runtime::random::{Purpose, stream};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::commands::Clock;
use crate::experiment::{Experiment, SupplyVoltage};

/// For how long before it starts commands are followed, so that what remembers them has settled (s).
const SETTLING: f64 = 3.0;

/// A reading so many times as large as all that were recorded is none of a machine that works.
const BEYOND: f64 = 1000.0;

/// An effect with the values of its parameters.
type Acting = (Effect, Vec<f64>);

/// A machine under one system, ready to be simulated from many starts.
#[derive(Clone, Debug)]
pub(super) struct Machine {
    plant: Plant,
    parameters: Vec<f64>,
    derivative: Program,
    outputs: Vec<Program>,
    /// Longest integration step (s).
    step: f64,
    /// Per input.
    on_commands: Vec<Vec<Acting>>,
    supplies: Vec<Option<SupplyVoltage>>,
    /// Per output.
    on_readings: Vec<Vec<Acting>>,
    clocks: Vec<Clock<0>>,
    sensors: Vec<Sensor>,
    /// How long the past is remembered for late sensors (s).
    past: f64,
}

/// What is known of the readings of an output besides its equation.
#[derive(Clone, Debug)]
pub(super) struct Sensor {
    /// Standard deviation of its noise.
    noise: f64,
    /// Smallest and largest recorded reading.
    range: (f64, f64),
    /// Period and lower end of the readings of an angle.
    wrap: Option<(f64, f64)>,
}

impl Sensor {
    /// An output as `experiment` shows it, with noise of standard deviation `noise`.
    pub(super) fn of(experiment: &Experiment, output: usize, noise: f64) -> Self {
        let (_, values) = experiment.output(output);
        let (low, high) = values
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
        // Readings that go further than one turn were unwound, and stay so.
        let wrap = experiment.wraps[output].and_then(|period| {
            let slack = 0.01 * period;
            [-0.5 * period, 0.0]
                .into_iter()
                .find(|begin| low >= begin - slack && high <= begin + period + slack)
                .map(|begin| (period, begin))
        });
        Self { noise, range: (low, high), wrap }
    }

    fn shown(&self, value: f64) -> f64 {
        match self.wrap {
            Some((period, begin)) => value - period * ((value - begin) / period).floor(),
            None => value,
        }
    }

    fn is_beyond(&self, value: f64) -> bool {
        let (low, high) = self.range;
        let size = (high - low).max(high.abs()).max(low.abs());
        !value.is_finite() || (size > 0.0 && value.abs() > BEYOND * size)
    }
}

impl Machine {
    /// The plant, for an integrator of this longest step (s), with the voltages that `experiment` recorded.
    pub(super) fn new(plant: Plant, step: f64, experiment: &Experiment, mut sensors: Vec<Sensor>) -> Self {
        let plant = plant.with_step(step);
        let extra = plant.extra_values();
        let at = |kind: PlaceKind, count: usize| -> Vec<Vec<Acting>> {
            let own = |index: usize| {
                let effects = plant.effects_at(kind, index).into_iter();
                effects.map(|bound| (bound.effect, plant.own(bound, &extra))).collect()
            };
            (0..count).map(own).collect()
        };
        let (inputs, outputs) = (experiment.inputs.len(), experiment.wraps.len());
        let (on_commands, on_readings) = (at(PlaceKind::Input, inputs), at(PlaceKind::Output, outputs));
        for (sensor, effects) in sensors.iter_mut().zip(&on_readings) {
            if let Some((_, own)) = effects.iter().find(|(effect, _)| *effect == Effect::Noise) {
                // It is what the stated noise lacks.
                sensor.noise = sensor.noise.hypot(own[0]);
            }
        }
        let late = |(effect, own): &Acting| match effect {
            Effect::Delay => own[0],
            Effect::ClockSkew => own[0].abs() * experiment.span().1,
            Effect::Jitter => 2.0 * own[0],
            _ => 0.0,
        };
        let past = on_readings.iter().map(|all| all.iter().map(late).sum::<f64>()).fold(0.0, f64::max);
        let mut parameters = plant.equations().nominal();
        parameters.extend(&extra);
        Self {
            parameters,
            derivative: plant.derivative_program(),
            outputs: (0..outputs).map(|output| plant.output_program(output)).collect(),
            step,
            on_commands,
            supplies: (0..inputs).map(|input| experiment.supply(input).cloned()).collect(),
            clocks: (0..outputs)
                .map(|output| {
                    let extra: Vec<_> = extra.iter().copied().map(parallax_model::Dual::from_value).collect();
                    Clock::new(&plant, &extra, output)
                })
                .collect(),
            on_readings,
            sensors,
            past,
            plant,
        }
    }

    /// Whether a reading of an output shows a command at once.
    pub(super) fn shows_command(&self, output: usize) -> bool {
        self.plant.equations().system().shows_command(output)
    }
}

/// A machine on its way.
#[derive(Clone, Debug)]
pub(super) struct World {
    machine: Arc<Machine>,
    /// When its states begin to move (s).
    begin: f64,
    now: f64,
    state: Vec<f64>,
    channels: Vec<Channel>,
    /// What was, for late sensors: time, states and commands.
    past: VecDeque<(f64, Vec<f64>, Vec<f64>)>,
    shown: Vec<Option<f64>>,
    random: ChaCha8Rng,
    slopes: Slopes,
}

/// The commands at one input.
#[derive(Clone, Debug)]
struct Channel {
    /// Those that were sent and do not act yet: when they will, and their values.
    pending: VecDeque<(f64, f64)>,
    last: f64,
    /// The one that acts.
    value: f64,
    /// What effects remember of it, one after the other.
    memory: Vec<f64>,
}

/// Space for the integrator.
#[derive(Clone, Debug, Default)]
struct Slopes {
    given: Vec<f64>,
    workspace: Workspace<f64>,
}

impl World {
    /// A machine in `state` at `begin` (s), with the commands that `experiment` recorded before then on their way.
    pub(super) fn new(
        machine: &Arc<Machine>,
        experiment: &Experiment,
        begin: f64,
        state: Vec<f64>,
        seed: u64,
    ) -> Self {
        let early = begin - SETTLING;
        let mut channels: Vec<Channel> = experiment
            .inputs
            .iter()
            .map(|held| Channel {
                pending: VecDeque::new(),
                last: f64::NEG_INFINITY,
                value: held.at(early),
                memory: Vec::new(),
            })
            .collect();
        for (channel, effects) in channels.iter_mut().zip(&machine.on_commands) {
            let mut value = channel.value;
            for (effect, own) in effects {
                let mut memory = vec![0.0; effect.memory()];
                if let Some(first) = memory.first_mut() {
                    *first = value;
                }
                value = effect.held(own, &mut memory, value, machine.step);
                channel.memory.extend(memory);
            }
        }
        let shown = vec![None; machine.outputs.len()];
        let mut world = Self {
            machine: Arc::clone(machine),
            begin,
            now: early,
            state,
            channels,
            past: VecDeque::new(),
            shown,
            random: stream(seed, Purpose::Node, "machine"),
            slopes: Slopes::default(),
        };
        for (input, held) in experiment.inputs.iter().enumerate() {
            let recent = held.times.iter().zip(&held.values);
            for (time, value) in recent.filter(|(t, _)| **t > early && **t < begin) {
                world.command(input, *time, *value);
            }
        }
        world.advance(begin);
        world
    }

    /// When its states begin to move (s).
    pub(super) fn begin(&self) -> f64 {
        self.begin
    }

    /// Takes the command `value` of an input, sent at `time` (s).
    pub(super) fn command(&mut self, input: usize, time: f64, value: f64) {
        let machine = Arc::clone(&self.machine);
        let mut arrival = time;
        for (effect, own) in &machine.on_commands[input] {
            match effect {
                Effect::Delay => arrival += own[0],
                Effect::ClockSkew => arrival += own[0] * time,
                Effect::Jitter => arrival += self.scattered(own[0]),
                Effect::Drops if self.random.random::<f64>() < own[0] => return,
                _ => {}
            }
        }
        let channel = &mut self.channels[input];
        // Nothing acts before it is sent, and commands do not overtake each other.
        channel.last = arrival.max(channel.last).max(time);
        channel.pending.push_back((channel.last, value));
    }

    /// A time that scatters evenly around zero with this standard deviation (s).
    fn scattered(&mut self, spread: f64) -> f64 {
        3.0_f64.sqrt() * spread * (2.0 * self.random.random::<f64>() - 1.0)
    }

    /// What an output reads, stamped `stamp` (s); `None` where the reading is lost.
    pub(super) fn read(&mut self, output: usize, stamp: f64) -> Option<f64> {
        let machine = Arc::clone(&self.machine);
        let mut taken = machine.clocks[output].taken(stamp).value;
        for (effect, own) in &machine.on_readings[output] {
            match effect {
                Effect::Jitter => taken += self.scattered(own[0]),
                Effect::Drops if self.random.random::<f64>() < own[0] => return None,
                _ => {}
            }
        }
        // What is read at a stamp has happened by then.
        let taken = taken.min(stamp);
        self.advance(stamp);
        let commands = self.acting_now();
        let (state, commands) = self.at(taken, commands);
        let clean = {
            let given = &mut self.slopes.given;
            given.clear();
            given.extend(machine.parameters.iter().chain(&state).chain(&commands));
            given.push(taken);
            let mut value = [0.0];
            machine.outputs[output].evaluate(given, &mut self.slopes.workspace, &mut value);
            value[0]
        };
        let value = self.by_chance(output, clean);
        self.shown[output] = Some(value);
        Some(value)
    }

    /// A reading as the sensor shows it.
    fn by_chance(&mut self, output: usize, clean: f64) -> f64 {
        let machine = Arc::clone(&self.machine);
        let sensor = &machine.sensors[output];
        let noise: f64 = StandardNormal.sample(&mut self.random);
        let mut value = clean + sensor.noise * noise;
        for (effect, own) in &machine.on_readings[output] {
            match effect {
                Effect::SensorSaturation => value = value.clamp(own[0].min(own[1]), own[1].max(own[0])),
                Effect::Quantization if own[0] > 0.0 => value = own[0] * (value / own[0]).round(),
                Effect::Outliers if self.random.random::<f64>() < own[0] => {
                    // How large they are is not known: anywhere in what was recorded.
                    value = sensor.range.0 + (sensor.range.1 - sensor.range.0) * self.random.random::<f64>();
                }
                Effect::Stuck if self.random.random::<f64>() < own[0] => {
                    value = self.shown[output].unwrap_or(value);
                }
                _ => {}
            }
        }
        sensor.shown(value)
    }

    /// Whether it has left all bounds: a state that is no number, or a reading far beyond every recorded one.
    pub(super) fn is_lost(&self) -> bool {
        let beyond =
            |(sensor, shown): (&Sensor, &Option<f64>)| shown.is_some_and(|value| sensor.is_beyond(value));
        self.state.iter().any(|x| !x.is_finite()) || self.machine.sensors.iter().zip(&self.shown).any(beyond)
    }

    /// Goes on to `to` (s).
    fn advance(&mut self, to: f64) {
        let machine = Arc::clone(&self.machine);
        let remembers = machine.on_commands.iter().flatten().any(|(effect, _)| effect.has_memory());
        let longest = if remembers { 0.5 * machine.step } else { f64::INFINITY };
        while self.now < to {
            let mut next = to.min(self.now + longest);
            for channel in &mut self.channels {
                while channel.pending.front().is_some_and(|(time, _)| *time <= self.now + 1e-12) {
                    channel.value = channel.pending.pop_front().map_or(channel.value, |(_, value)| value);
                }
                next = channel.pending.front().map_or(next, |(time, _)| next.min(*time));
            }
            if self.now < self.begin {
                next = next.min(self.begin);
            }
            let commands = self.acting(next - self.now);
            if self.now >= self.begin {
                let steps = ((next - self.now) / machine.step - 1e-6).ceil().max(1.0);
                let dt = (next - self.now) / steps;
                for k in 0..steps as usize {
                    let time = self.now + dt * k as f64;
                    if machine.past > 0.0 {
                        self.past.push_back((time, self.state.clone(), commands.clone()));
                    }
                    self.slopes.step(&machine, &mut self.state, &commands, time, dt);
                }
            }
            self.now = next;
            while self.past.len() > 2 && self.past[1].0 < self.now - machine.past - 0.1 {
                self.past.pop_front();
            }
        }
        for channel in &mut self.channels {
            while channel.pending.front().is_some_and(|(time, _)| *time <= self.now + 1e-12) {
                channel.value = channel.pending.pop_front().map_or(channel.value, |(_, value)| value);
            }
        }
    }

    /// The commands as they reach the equations over the next `dt` seconds.
    fn acting(&mut self, dt: f64) -> Vec<f64> {
        let now = self.now;
        let machine = &self.machine;
        let each = self.channels.iter_mut().zip(&machine.on_commands).zip(&machine.supplies);
        each.map(|((channel, effects), supply)| {
            let mut at = 0;
            effects.iter().fold(channel.value, |value, (effect, own)| {
                let memory = &mut channel.memory[at..at + effect.memory()];
                at += effect.memory();
                match (effect, supply) {
                    (Effect::SupplySag, Some(supply)) => sag(own[0], supply.ratio(now), value),
                    (effect, _) => effect.held(own, memory, value, dt),
                }
            })
        })
        .collect()
    }

    /// The commands as they reach the equations at this instant.
    fn acting_now(&mut self) -> Vec<f64> {
        let kept: Vec<Vec<f64>> = self.channels.iter().map(|channel| channel.memory.clone()).collect();
        let commands = self.acting(1e-12);
        for (channel, memory) in self.channels.iter_mut().zip(kept) {
            channel.memory = memory;
        }
        commands
    }

    /// States and commands at a time that is not after now; `commands` are those of now.
    fn at(&self, time: f64, commands: Vec<f64>) -> (Vec<f64>, Vec<f64>) {
        let after = self.past.partition_point(|(t, _, _)| *t <= time);
        let present = (self.now, &self.state, &commands);
        if time >= self.now - 1e-12 || self.past.is_empty() {
            return (self.state.clone(), commands);
        }
        let Some((t0, x0, u0)) = after.checked_sub(1).map(|k| &self.past[k]) else {
            // Before it began to move.
            let (_, state, commands) = &self.past[0];
            return (state.clone(), commands.clone());
        };
        let (t1, x1) = self.past.get(after).map_or((present.0, present.1), |(t, x, _)| (*t, x));
        let share = if t1 > *t0 { (time - t0) / (t1 - t0) } else { 0.0 };
        (x0.iter().zip(x1).map(|(a, b)| a + (b - a) * share).collect(), u0.clone())
    }
}

impl Slopes {
    /// One step of the classical Runge–Kutta method (Hairer, Nørsett & Wanner, "Solving Ordinary Differential Equations I",
    /// section II.1) with held commands.
    fn step(&mut self, machine: &Machine, state: &mut [f64], commands: &[f64], time: f64, dt: f64) {
        let first = machine.parameters.len();
        let n = state.len();
        let given = &mut self.given;
        given.clear();
        given.extend(machine.parameters.iter().chain(&*state).chain(commands));
        given.push(time);
        let last = given.len() - 1;
        let mut slope = vec![0.0; n];
        let mut sum = state.to_vec();
        for (reach, weight) in [(0.5, 1.0 / 6.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 6.0)] {
            machine.derivative.evaluate(given, &mut self.workspace, &mut slope);
            for i in 0..n {
                sum[i] += slope[i] * dt * weight;
                given[first + i] = state[i] + slope[i] * dt * reach;
            }
            given[last] = time + dt * reach;
        }
        state.copy_from_slice(&sum);
    }
}
