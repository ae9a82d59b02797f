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
    /// A state that does not depend on θ.
    pub(super) fn new(x: Vec<f64>, parameters: usize) -> Self {
        Along { by: vec![0.0; x.len() * parameters], x, parameters, transition: Transition::default() }
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
        let mut next = self.transition.by_parameter.clone();
        for (row, slopes) in next.chunks_mut(self.parameters.max(1)).zip(self.transition.by_state.chunks(n)) {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry += (0..n).map(|i| slopes[i] * self.by[i * self.parameters + j]).sum::<f64>();
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
