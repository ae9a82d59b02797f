//! One tick of a plant that stands alone: from the commands as they are sent to the next states.
//!
//! As along a recording, a command is held until the next tick. What has a memory of it (a lag, a limited rate) acts by its
//! mean over halves of the tick, exactly integrated; the equations take one step of the classical Runge–Kutta method over
//! each.

use super::{BoundEffect, Plant, SHORTEST};
use crate::Scalar;
use crate::effect::{Effect, PlaceKind};
use crate::program::{Program, Workspace};
use crate::system::Point;
use crate::trace::{Traced, trace_fn};

impl Plant {
    /// The effects on commands that remember: the input's index, the effect, and where its numbers begin.
    fn remembering(&self) -> Vec<(usize, &BoundEffect, usize)> {
        let inputs = self.equations.system().inputs.len();
        let all =
            (0..inputs).flat_map(|i| self.effects_at(PlaceKind::Input, i).into_iter().map(move |b| (i, b)));
        let mut first = 0;
        all.filter(|(_, bound)| bound.effect.has_memory())
            .map(|(input, bound)| {
                let at = first;
                first += bound.effect.memory();
                (input, bound, at)
            })
            .collect()
    }

    /// Names of what the effects on commands remember, in the order in which [`Plant::tick_program`] takes it.
    #[must_use]
    pub fn memory_names(&self) -> Vec<String> {
        let system = self.equations.system();
        let names = self.remembering().into_iter().flat_map(|(input, bound, _)| {
            let (input, effect) = (&system.inputs[input].name, bound.effect.name());
            (0..bound.effect.memory()).map(move |k| match k {
                0 => format!("{input}_{effect}"),
                _ => format!("{input}_{effect}_rate"),
            })
        });
        names.collect()
    }

    /// The commands as they reach the equations while they are held for `dt` seconds; the memory goes on. Where `first`
    /// is above zero, the commands have always been these.
    fn acting<T: Scalar>(&self, commands: &[T], memory: &mut [T], extra: &[T], dt: T, first: T) -> Vec<T> {
        let mut acting = commands.to_vec();
        let remembering = self.remembering();
        let settles = first.gt(T::constant(0.0));
        for (input, value) in acting.iter_mut().enumerate() {
            for bound in self.effects_at(PlaceKind::Input, input) {
                let place = remembering.iter().find(|(_, other, _)| std::ptr::eq(*other, bound));
                let own = match place {
                    Some((_, _, at)) => &mut memory[*at..*at + bound.effect.memory()],
                    None => &mut [],
                };
                for (k, number) in own.iter_mut().enumerate() {
                    *number = T::select(settles, if k == 0 { *value } else { T::constant(0.0) }, *number);
                }
                *value = bound.effect.held(&self.own(bound, extra), own, *value, dt);
            }
        }
        acting
    }

    /// The commands as they reach the equations at this instant, with what is remembered of them.
    fn acting_now<T: Scalar>(&self, commands: &[T], memory: &[T], extra: &[T]) -> Vec<T> {
        let mut rest = memory;
        let mut acting = commands.to_vec();
        for (input, value) in acting.iter_mut().enumerate() {
            for bound in self.effects_at(PlaceKind::Input, input) {
                let (own, others) = rest.split_at(bound.effect.memory());
                rest = others;
                *value = match bound.effect {
                    // What follows a command is where it has come to.
                    Effect::Lag | Effect::LagSecondOrder | Effect::RateLimit => own[0],
                    effect => {
                        let zero = T::constant(0.0);
                        effect.held(&self.own(bound, extra), &mut own.to_vec(), *value, zero)
                    }
                };
            }
        }
        acting
    }

    /// This instant as a program: from the system's parameters, all states, the memory of commands, the commands as they
    /// are sent, and the time (s), to the rates of change of the states (per second) and the readings.
    #[must_use]
    pub fn rate_program(&self) -> Program {
        let system = self.equations.system();
        let (parameters, states) = (system.parameters.len(), self.states());
        let memory = self.memory_names().len();
        let mut inputs = self.tick_inputs();
        inputs.truncate(inputs.len() - 2);
        let mut outputs: Vec<String> = self.state_names().iter().map(|s| format!("d_{s}")).collect();
        outputs.extend(system.outputs.iter().map(|o| format!("y_{}", o.name)));
        trace_fn(&system.name, &inputs, &outputs, |all| {
            let (parameters, rest) = all.split_at(parameters);
            let (states, rest) = rest.split_at(states);
            let (memory, rest) = rest.split_at(memory);
            let (commands, time) = rest.split_at(system.inputs.len());
            let extra = [Traced::constant(SHORTEST)];
            let acting = self.acting_now(commands, memory, &extra);
            let point = Point { parameters, states, inputs: &acting, time: time[0] };
            let mut values = self.derivatives(&point, &extra);
            values.extend((0..system.outputs.len()).map(|output| self.output(output, &point, &extra)));
            values
        })
    }

    /// What [`Plant::tick_program`] takes.
    fn tick_inputs(&self) -> Vec<String> {
        let system = self.equations.system();
        let mut inputs: Vec<String> = system.parameters.iter().map(|p| format!("p_{}", p.name)).collect();
        inputs.extend(self.state_names().iter().map(|s| format!("x_{s}")));
        inputs.extend(self.memory_names().iter().map(|m| format!("m_{m}")));
        inputs.extend(system.inputs.iter().map(|i| format!("u_{}", i.name)));
        inputs.extend(["time", "period", "first"].map(str::to_owned));
        inputs
    }

    /// One tick as a program: from the system's parameters, all states, the memory of commands, the commands as they are
    /// sent, the time (s), the period (s), and one at the first tick or else zero, to the next states, the next memory, and
    /// the readings at the tick's beginning.
    #[must_use]
    pub fn tick_program(&self) -> Program {
        let system = self.equations.system();
        let memory_names = self.memory_names();
        let (parameters, states, memory) = (system.parameters.len(), self.states(), memory_names.len());
        let inputs = self.tick_inputs();
        let mut outputs: Vec<String> = self.state_names().iter().map(|s| format!("state.{s}")).collect();
        outputs.extend(memory_names.iter().map(|m| format!("memory.{m}")));
        outputs.extend(system.outputs.iter().map(|o| format!("output.{}", o.name)));

        let rates = self.derivative_program();
        let readings: Vec<Program> = (0..system.outputs.len()).map(|o| self.output_program(o)).collect();
        let pieces =
            if self.remembering().iter().any(|(_, b, _)| b.effect != Effect::Backlash) { 2 } else { 1 };
        trace_fn(&system.name, &inputs, &outputs, |all| {
            let (own, rest) = all.split_at(parameters);
            let (x, rest) = rest.split_at(states);
            let (remembered, rest) = rest.split_at(memory);
            let (commands, rest) = rest.split_at(system.inputs.len());
            let (time, period, first) = (rest[0], rest[1], rest[2]);
            let point = |x: &[Traced], acting: &[Traced], time: Traced| {
                let mut point = own.to_vec();
                // The plant's only extra parameter.
                point.push(period);
                point.extend(x);
                point.extend(acting);
                point.push(time);
                point
            };
            let evaluate = |name: &str, program: &Program, point: &[Traced]| {
                let mut values = vec![Traced::constant(0.0); program.outputs().len()];
                Traced::call_values(name, point, &mut values, |point, values| {
                    program.evaluate(point, &mut Workspace::new(), values);
                });
                values
            };
            let dt = if pieces == 1 { period } else { period * (1.0 / f64::from(pieces)) };
            let (mut x, mut remembered) = (x.to_vec(), remembered.to_vec());
            let mut shown = Vec::new();
            for piece in 0..pieces {
                let begin = if piece == 0 { time } else { time + dt * f64::from(piece) };
                let first = if piece == 0 { first } else { Traced::constant(0.0) };
                let acting = self.acting(commands, &mut remembered, &[period], dt, first);
                if piece == 0 {
                    for (output, program) in readings.iter().enumerate() {
                        shown.extend(evaluate(
                            &format!("reading_{output}"),
                            program,
                            &point(&x, &acting, begin),
                        ));
                    }
                }
                let slope = |x: &[Traced], time: Traced| evaluate("rates", &rates, &point(x, &acting, time));
                let along = |slope: &[Traced], dt: Traced| -> Vec<Traced> {
                    x.iter().zip(slope).map(|(x, slope)| *x + *slope * dt).collect()
                };
                let half = dt * 0.5;
                let k1 = slope(&x, begin);
                let k2 = slope(&along(&k1, half), begin + half);
                let k3 = slope(&along(&k2, half), begin + half);
                let k4 = slope(&along(&k3, dt), begin + dt);
                x = (0..states)
                    .map(|i| x[i] + (k1[i] + k4[i] + (k2[i] + k3[i]) * 2.0) * (dt / 6.0))
                    .collect();
            }
            x.extend(remembered);
            x.extend(shown);
            x
        })
    }
}
