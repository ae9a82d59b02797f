//! A system described by equations as a process of a filter.

use super::{Process, Work};
use crate::plant::Plant;
use crate::program::Program;
use crate::scalar::Scalar;
use crate::trace::{Traced, trace_fn};

/// The equations of a `system.toml`, with the effects that it states: one step of the classical Runge–Kutta method for each
/// [`advance`](Process::advance), as [`Plant::tick_program`] has it. States are those of the system, then those that its effects
/// bring, then what they remember of commands.
#[derive(Debug, Clone)]
pub struct PlantProcess {
    parameters: usize,
    states: Vec<String>,
    inputs: usize,
    outputs: usize,
    advance: Program,
    observe: Program,
}

impl PlantProcess {
    /// Of a plant that [stands alone](Plant::alone).
    #[must_use]
    pub fn new(plant: &Plant) -> Self {
        let system = plant.equations().system();
        let (parameters, inputs, outputs) =
            (system.parameters.len(), system.inputs.len(), system.outputs.len());
        let states: Vec<String> = plant.state_names().into_iter().chain(plant.memory_names()).collect();
        let (tick, rates) = (plant.tick_program(), plant.rate_program());
        // Each program with what it is for alone; what nothing needs is left out of a trace.
        let only = |program: &Program, name: &str, from: usize, count: usize| {
            let names = &program.outputs()[from..from + count];
            trace_fn(name, program.inputs(), names, |all| {
                let mut values = vec![Traced::constant(0.0); program.outputs().len()];
                program.evaluate(all, &mut Default::default(), &mut values);
                values[from..from + count].to_vec()
            })
        };
        let advance = only(&tick, "advance", 0, states.len());
        let observe = only(&rates, "observe", plant.states(), outputs);
        Self { parameters, states, inputs, outputs, advance, observe }
    }

    /// The names of the states.
    pub fn state_names(&self) -> &[String] {
        &self.states
    }

    /// Writes what both programs begin with into the memory, and gives how much that is.
    fn fill<T: Scalar>(&self, params: &[T], state: &[T], inputs: &[T], time: T, values: &mut [T]) -> usize {
        let mut at = 0;
        for part in [&params[..self.parameters], state, inputs, &[time]] {
            values[at..at + part.len()].copy_from_slice(part);
            at += part.len();
        }
        at
    }
}

impl Process for PlantProcess {
    fn params(&self) -> usize {
        self.parameters
    }

    fn states(&self) -> usize {
        self.states.len()
    }

    fn outputs(&self) -> usize {
        self.outputs
    }

    fn room(&self) -> usize {
        self.parameters + self.states.len() + self.inputs + 3
    }

    fn advance<T: Scalar>(
        &self,
        params: &[T],
        state: &[T],
        inputs: &[T],
        [time, dt]: [T; 2],
        work: &mut Work<'_, T>,
        next: &mut [T],
    ) {
        let at = self.fill(params, state, inputs, time, work.values);
        // A filter begins in the middle of things: nothing has just settled.
        work.values[at..at + 2].copy_from_slice(&[dt, T::constant(0.0)]);
        self.advance.evaluate(&work.values[..at + 2], work.workspace, next);
    }

    fn observe<T: Scalar>(
        &self,
        params: &[T],
        state: &[T],
        inputs: &[T],
        time: T,
        work: &mut Work<'_, T>,
        readings: &mut [T],
    ) {
        let at = self.fill(params, state, inputs, time, work.values);
        self.observe.evaluate(&work.values[..at], work.workspace, readings);
    }
}
