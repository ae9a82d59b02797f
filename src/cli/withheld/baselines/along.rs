//! Derivatives of a state by θ along a run.

use parallax_gap::simulator::{At, Gradient, LANES, Motion, Run};
use parallax_model::lanes::F64x16;

/// A state with its derivatives by θ, on the first lane.
pub(super) struct Along {
    motion: Motion,
    gradient: Gradient,
    /// How many of θ are the model's own; those after them are where the run began.
    own: usize,
}

impl Along {
    /// A state that does not depend on the model's `parameters`. Its first `free` entries are parameters themselves, after
    /// those of the model.
    pub(super) fn new(x: &[f64], parameters: usize, free: usize) -> Self {
        let mut motion = Motion::new(x.len(), free, parameters);
        for (lanes, value) in motion.x.iter_mut().zip(x) {
            *lanes = F64x16::splat(*value);
        }
        motion.seed();
        Along { motion, gradient: Gradient::default(), own: parameters }
    }

    /// Puts the first states where they were measured to be.
    pub(super) fn set(&mut self, measured: &[f64]) {
        let columns = self.motion.columns;
        for (state, value) in measured.iter().enumerate() {
            self.motion.x[state] = F64x16::splat(*value);
            self.motion.by[state * columns..(state + 1) * columns].fill(F64x16::splat(0.0));
            self.motion.live[state] = Default::default();
        }
    }

    /// Takes the state from event `index` to the next one.
    pub(super) fn advance(&mut self, run: &mut dyn Run, index: usize) {
        run.advance_lanes(&only(index), &mut self.motion);
    }

    /// A state.
    pub(super) fn state(&self, state: usize) -> f64 {
        self.motion.x[state][0]
    }

    /// The derivative of a state by one of θ; not finite where a run has gone astray.
    pub(super) fn slope(&self, state: usize, parameter: usize) -> f64 {
        self.motion.by[state * self.motion.columns + self.column(parameter)][0]
    }

    /// What the reading of event `index` is predicted to be; its derivatives are [`Along::of_reading`] then.
    pub(super) fn read(&mut self, run: &mut dyn Run, index: usize) -> f64 {
        run.observe_lanes(&only(index), &self.motion, &mut self.gradient)[0]
    }

    /// The derivative of what was read last by one of θ.
    pub(super) fn of_reading(&self, parameter: usize) -> f64 {
        self.gradient.by.get(self.column(parameter)).map_or(0.0, |by| by[0])
    }

    /// Where a walk has the derivatives by one of θ: those by its beginning come first.
    fn column(&self, parameter: usize) -> usize {
        let seeds = self.motion.seeds;
        if parameter < self.own { seeds + parameter } else { parameter - self.own }
    }
}

fn only(index: usize) -> At {
    let mut at = [None; LANES];
    at[0] = Some(index);
    at
}
