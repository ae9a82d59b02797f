//! The estimator's step: from messages to readings and commands, and from a belief to a message.

use parallax_model::filter::{Commands, Compensator, Constants, Given, Process, UNKNOWN};
use parallax_model::node_model::{FlatModel, NodeStep, Scratch};
use parallax_model::{Inlined, Scalar};
use parallax_runtime::model_node::{ModelKind, ModelStart};
use parallax_runtime::node::{Layout, NodeContext};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;

/// A node that the estimator listens to.
#[derive(Debug, Clone)]
pub(crate) struct Listened {
    /// The port, which has the node's name.
    pub(crate) port: String,
    /// The leaf that says when a message was true (s); absent: when it was sent.
    pub(crate) stamp: Option<usize>,
    /// The leaves that count: those of a sensor in the order of its readings, those of an actuator all.
    pub(crate) leaves: Vec<usize>,
}

/// A leaf of the estimator's message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shown {
    /// The estimate of a state.
    State(usize),
    /// Its standard deviation.
    Std(usize),
    /// The time that the estimate is for, s.
    Stamp,
    /// The last normalised innovation squared.
    Nis,
    /// The lower end of the band in which 95 % of such numbers lie.
    NisLow,
    /// The upper end.
    NisHigh,
    /// A count, by its place behind the number of updates' own.
    Count(Count),
}

/// What the estimator counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Count {
    Updates,
    Outside,
    Late,
    Blind,
    Repaired,
}

/// A [`Compensator`] between ports and a message.
#[derive(Debug, Clone)]
pub(crate) struct Estimator<P> {
    pub(crate) name: String,
    pub(crate) compensator: Compensator<P>,
    /// Names of the process's parameters, states and readings.
    pub(crate) parameters: Vec<String>,
    pub(crate) states: Vec<String>,
    pub(crate) readings: Vec<String>,
    pub(crate) sensors: Vec<Listened>,
    pub(crate) actuators: Vec<Listened>,
    /// Whether it tells where the system will be, or where it was when the newest reading was taken.
    pub(crate) predicts: bool,
    /// The message.
    pub(crate) message: Vec<(String, Shown)>,
}

impl<P: Process> Estimator<P> {
    /// The names of all parameters: those of the process, `noise.READING`, `disturbance.STATE`, `delay.NODE` (s) and `ahead` (s).
    fn names(&self) -> Vec<String> {
        let noise = self.readings.iter().map(|reading| format!("noise.{reading}"));
        let disturbed = self.compensator.filter().disturbed().iter();
        let disturbance = disturbed.map(|state| format!("disturbance.{}", self.states[*state]));
        let delays = self.sensors.iter().chain(&self.actuators).map(|node| format!("delay.{}", node.port));
        let own = self.parameters.iter().cloned().chain(noise).chain(disturbance).chain(delays);
        own.chain(["ahead".to_owned()]).collect()
    }

    /// What it remembers at first.
    pub(crate) fn start(&self) -> Vec<f64> {
        let mut start = self.compensator.start();
        start.resize(start.len() + self.sensors.len(), -1.0);
        start
    }

    /// A kind of this estimator, which sends messages of this layout and starts with these parameters; without its inputs.
    pub(crate) fn kind(self, layout: Layout, params: Vec<f64>) -> NodeKind {
        let state = self.start();
        let how = self.compensator.how();
        // Before the first step it shows what is believed beforehand.
        let initial = self.message.iter().map(|(_, shown)| match shown {
            Shown::State(state) => {
                let mean = how.mean[*state];
                how.circular[*state].map_or(mean, |period| mean - (mean / period + 0.5).floor() * period)
            }
            Shown::Std(state) => how.std[*state],
            _ => 0.0,
        });
        let initial: Vec<f64> = initial.collect();
        let settable: Vec<Parameter> = self.names().iter().map(|name| settable(name)).collect();
        let start = move |_: &NodeContext| Ok(ModelStart { params: params.clone(), state: state.clone() });
        let model = settable.into_iter().fold(ModelKind::flat(self, start), ModelKind::with_settable);
        NodeKind::from_model(layout, initial, model)
    }

    /// Where something stands in the compensator's memory.
    fn place(&self, name: &str) -> usize {
        let belief = self.compensator.filter().belief();
        let counts = ["repaired", "updates", "nis", "values", "outside", "late", "blind"];
        1 + belief + counts.iter().position(|count| *count == name).unwrap_or(0)
    }
}

/// A parameter that may be set while the estimator runs.
fn settable(name: &str) -> Parameter {
    if name.starts_with("delay.") || name == "ahead" {
        Parameter::new(name, "s").at_least(0.0)
    } else if name.starts_with("noise.") {
        Parameter::new(name, "").positive()
    } else if name.starts_with("disturbance.") {
        Parameter::new(name, "").at_least(0.0)
    } else {
        Parameter::new(name, "")
    }
}

impl<P: Process> FlatModel for Estimator<P> {
    fn name(&self) -> &str {
        &self.name
    }
    fn params(&self) -> Vec<String> {
        self.names()
    }
    fn state(&self) -> Vec<String> {
        let seen = self.sensors.iter().map(|sensor| format!("seen.{}", sensor.port));
        self.compensator.memory(&self.states).into_iter().chain(seen).collect()
    }
    fn output(&self) -> Vec<String> {
        self.message.iter().map(|(name, _)| name.clone()).collect()
    }
    fn prepared(&self) -> usize {
        self.compensator.filter().process().prepared()
    }
    fn prepare<T: Scalar>(&self, params: &[T], prepared: &mut [T]) {
        self.compensator.filter().process().prepare(&params[..self.parameters.len()], prepared);
    }

    fn step<T: Scalar>(
        &self,
        params: &[T],
        state: &mut [T],
        step: &NodeStep<'_, T>,
        scratch: &mut Scratch<T>,
        output: &mut [T],
    ) {
        T::compiled(Estimate { estimator: self, params, state, step, scratch, output });
    }
}

/// A step, compiled for its numbers.
struct Estimate<'a, 's, P, T: Scalar> {
    estimator: &'a Estimator<P>,
    params: &'a [T],
    state: &'a mut [T],
    step: &'a NodeStep<'s, T>,
    scratch: &'a mut Scratch<T>,
    output: &'a mut [T],
}

impl<P: Process, T: Scalar> Inlined for Estimate<'_, '_, P, T> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        self.estimator.estimate(self.params, self.state, self.step, self.scratch, self.output);
    }
}

impl<P: Process> Estimator<P> {
    #[inline(always)]
    fn estimate<T: Scalar>(
        &self,
        params: &[T],
        state: &mut [T],
        step: &NodeStep<'_, T>,
        scratch: &mut Scratch<T>,
        output: &mut [T],
    ) {
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let disturbed = self.compensator.filter().disturbed().len();
        let (_, rest) = params.split_at(self.parameters.len());
        let (noise, rest) = rest.split_at(self.readings.len());
        let (disturbance, rest) = rest.split_at(disturbed);
        let (sensor_delays, rest) = rest.split_at(self.sensors.len());
        let (actuator_delays, ahead) = rest.split_at(self.actuators.len());
        let remembered = state.len() - self.sensors.len();
        let (memory, seen) = state.split_at_mut(remembered);

        let width = self.compensator.arrival();
        let arrivals: usize = self.sensors.iter().map(|sensor| step.window(&sensor.port) * width).sum();
        let size = |actuator: &Listened| step.window(&actuator.port) * (1 + actuator.leaves.len());
        let commands: usize = self.actuators.iter().map(size).sum();
        let belief = self.compensator.filter().belief();
        let needed = arrivals + commands + belief + self.compensator.room();
        scratch.values.resize(needed, zero);
        let (arrived, rest) = scratch.values.split_at_mut(arrivals);
        let (sent, rest) = rest.split_at_mut(commands);
        let (believed, rest) = rest.split_at_mut(belief);

        let mut rows = arrived.chunks_exact_mut(width);
        for (index, (sensor, delay)) in self.sensors.iter().zip(sensor_delays).enumerate() {
            let mut newest = seen[index];
            for message in 0..step.window(&sensor.port) {
                let Some(row) = rows.next() else { break };
                let ([seq, sent, _], leaves) = step.raw(&sensor.port, message);
                row[0] = T::select(seen[index].lt(seq), one, zero);
                row[1] = sensor.stamp.map_or(sent, |stamp| leaves[stamp]) - *delay;
                row[2] = T::constant(index as f64);
                row[3..].fill(T::constant(f64::NAN));
                for (value, leaf) in row[3..].iter_mut().zip(&sensor.leaves) {
                    *value = leaves[*leaf];
                }
                newest = newest.max(seq);
            }
            seen[index] = newest;
        }
        let mut at = 0;
        for (actuator, delay) in self.actuators.iter().zip(actuator_delays) {
            for message in 0..step.window(&actuator.port) {
                let ([seq, sent_at, _], leaves) = step.raw(&actuator.port, message);
                // What stands in the window before the first command has always been there. A safe output, which has no
                // number either, acts from its time on.
                let always = seq.lt(zero) & sent_at.eq(zero);
                let begins =
                    T::select(seq.lt(zero), sent_at, actuator.stamp.map_or(sent_at, |stamp| leaves[stamp]));
                sent[at] = T::select(always, T::constant(UNKNOWN), begins + *delay);
                for (value, leaf) in sent[at + 1..].iter_mut().zip(&actuator.leaves) {
                    *value = leaves[*leaf];
                }
                at += 1 + actuator.leaves.len();
            }
        }

        let how = self.compensator.how();
        let given = Given {
            constants: Constants { params: step.prepared, noise, disturbance },
            arrivals: arrived,
            commands: Commands {
                inputs: &how.inputs,
                leaves: &how.actuators,
                windows: &|actuator| step.window(&self.actuators[actuator].port),
                values: sent,
            },
            until: if self.predicts { step.start + ahead[0] } else { T::constant(UNKNOWN) },
        };
        let mut room = self.compensator.lend(rest, &mut scratch.workspace);
        let time = self.compensator.step(&given, memory, believed, &mut room);
        let time = T::select(time.le(T::constant(UNKNOWN)), step.start, time);

        let (mean, root) = believed.split_at(self.states.len());
        for (leaf, (_, shown)) in output.iter_mut().zip(&self.message) {
            *leaf = match shown {
                Shown::State(state) => mean[*state],
                Shown::Std(state) => {
                    let first = state * (state + 1) / 2;
                    let row = &root[first..=first + state];
                    row.iter().fold(zero, |sum, value| sum + *value * *value).sqrt()
                }
                Shown::Stamp => time,
                Shown::Nis => memory[self.place("nis")],
                Shown::NisLow | Shown::NisHigh => {
                    let end = usize::from(*shown == Shown::NisHigh);
                    let values = memory[self.place("values")];
                    let mut bound = zero;
                    for (count, band) in (1..).zip(&how.bands) {
                        let is = values.eq(T::constant(f64::from(count)));
                        bound = T::select(is, T::constant(band[end]), bound);
                    }
                    bound
                }
                Shown::Count(count) => {
                    memory[self.place(match count {
                        Count::Updates => "updates",
                        Count::Outside => "outside",
                        Count::Late => "late",
                        Count::Blind => "blind",
                        Count::Repaired => "repaired",
                    })]
                }
            };
        }
    }
}
