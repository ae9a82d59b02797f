//! One integration step of a plant's equations, on dual numbers.

use parallax_model::Dual;
use parallax_model::program::{Program, Workspace};

/// The programs' inputs (parameters, extra parameters, states, commands, time) and scratch space.
pub struct Machine<const N: usize> {
    inputs: Vec<Dual<N>>,
    states: usize,
    commands: usize,
    workspace: Workspace<Dual<N>>,
}

impl<const N: usize> Machine<N> {
    /// A machine whose parameters are set; states, commands and time are zero.
    #[must_use]
    pub fn new(parameters: &[Dual<N>], extra: &[Dual<N>], states: usize, commands: usize) -> Self {
        let mut inputs = parameters.to_vec();
        inputs.extend_from_slice(extra);
        let first = inputs.len();
        inputs.resize(first + states + commands + 1, Dual::from_value(0.0));
        Machine { inputs, states: first, commands: first + states, workspace: Workspace::new() }
    }

    /// Sets one command.
    pub fn set_command(&mut self, command: usize, value: Dual<N>) {
        self.inputs[self.commands + command] = value;
    }

    /// Writes the program's outputs at the states and the time.
    pub fn evaluate(&mut self, program: &Program, states: &[Dual<N>], time: Dual<N>, out: &mut [Dual<N>]) {
        self.inputs[self.states..self.states + states.len()].copy_from_slice(states);
        if let Some(last) = self.inputs.last_mut() {
            *last = time;
        }
        program.evaluate(&self.inputs, &mut self.workspace, out);
    }

    /// One step of the classical fourth-order Runge–Kutta method (Hairer, Nørsett & Wanner, "Solving Ordinary
    /// Differential Equations I", section II.1), with held commands.
    pub fn runge_kutta(
        &mut self,
        program: &Program,
        x: &mut [Dual<N>],
        dt: Dual<N>,
        time: Dual<N>,
        stage: &mut Stage<N>,
    ) {
        let half = dt * 0.5;
        let sixth = dt / 6.0;
        stage.from.copy_from_slice(x);
        stage.at.copy_from_slice(x);
        for (fraction, weight) in [(None, 1.0), (Some(half), 2.0), (Some(half), 2.0), (Some(dt), 1.0)] {
            if let Some(h) = fraction {
                for ((at, from), k) in stage.at.iter_mut().zip(&stage.from).zip(&stage.slope) {
                    *at = *from + *k * h;
                }
            }
            self.evaluate(program, &stage.at, fraction.map_or(time, |h| time + h), &mut stage.slope);
            for (x, k) in x.iter_mut().zip(&stage.slope) {
                *x += *k * (sixth * weight);
            }
        }
    }
}

/// Scratch space of an integration step.
pub struct Stage<const N: usize> {
    from: Vec<Dual<N>>,
    at: Vec<Dual<N>>,
    slope: Vec<Dual<N>>,
}

impl<const N: usize> Stage<N> {
    /// Space for this many states.
    #[must_use]
    pub fn new(states: usize) -> Self {
        let zero = vec![Dual::from_value(0.0); states];
        Stage { from: zero.clone(), at: zero.clone(), slope: zero }
    }
}
