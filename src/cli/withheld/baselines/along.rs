//! Derivatives of a state by θ along a run.

use parallax_gap::simulator::{Run, Transition};

/// A state with its derivatives by θ.
pub(super) struct Along {
    /// The state.
    pub(super) x: Vec<f64>,
    /// Its derivatives, states × parameters.
    by: Vec<f64>,
    parameters: usize,
    transition: Transition,
}

impl Along {
    /// A state that does not depend on the model's `parameters`. Its first `free` entries are parameters themselves, after
    /// those of the model.
    pub(super) fn new(x: Vec<f64>, parameters: usize, free: usize) -> Self {
        let all = parameters + free;
        let mut by = vec![0.0; x.len() * all];
        for state in 0..free {
            by[state * all + parameters + state] = 1.0;
        }
        Along { by, x, parameters: all, transition: Transition::default() }
    }

    /// Puts the first states where they were measured to be.
    pub(super) fn set(&mut self, measured: &[f64]) {
        self.x[..measured.len()].copy_from_slice(measured);
        self.by[..measured.len() * self.parameters].fill(0.0);
    }

    /// Takes the state from event `index` to the next one.
    pub(super) fn advance(&mut self, run: &mut dyn Run, index: usize) {
        let n = self.x.len();
        run.advance(index, &mut self.x, &mut self.transition);
        let own = self.transition.by_parameter.len() / n.max(1);
        let mut next = vec![0.0; self.by.len()];
        for (state, row) in next.chunks_mut(self.parameters.max(1)).enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                let direct = if j < own { self.transition.by_parameter[state * own + j] } else { 0.0 };
                *entry = direct + self.through(&self.transition.by_state[state * n..(state + 1) * n], j);
            }
        }
        self.by = next;
    }

    /// The derivative by θ of what depends on the state by `slopes`; not finite where a run has gone astray.
    pub(super) fn through(&self, slopes: &[f64], parameter: usize) -> f64 {
        slopes.iter().enumerate().map(|(i, s)| s * self.by[i * self.parameters + parameter]).sum()
    }

    /// The derivative of one state by θ.
    pub(super) fn slope(&self, state: usize, parameter: usize) -> f64 {
        self.by[state * self.parameters + parameter]
    }
}
