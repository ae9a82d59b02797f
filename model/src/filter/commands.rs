//! Commands in flight: what acts on a system when.

use crate::scalar::Scalar;

/// A time after everything, s.
const FAR: f64 = 1e15;

/// Where an input comes from: one leaf of what one actuator was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Source {
    /// Index of the actuator.
    pub actuator: usize,
    /// Index of the leaf.
    pub leaf: usize,
}

/// The commands that are known, each with the time from which on it acts. A command holds until the next.
#[derive(Clone, Copy)]
pub struct Commands<'a, T> {
    /// For every input, what it is the mean of.
    pub inputs: &'a [Vec<Source>],
    /// For every actuator, how many leaves its commands have.
    pub leaves: &'a [usize],
    /// How many commands of an actuator are known.
    pub windows: &'a dyn Fn(usize) -> usize,
    /// Actuator by actuator, command by command, the oldest first: the time from which on it acts (s), and its leaves.
    pub values: &'a [T],
}

impl<T> std::fmt::Debug for Commands<'_, T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Commands")
            .field("inputs", &self.inputs)
            .field("leaves", &self.leaves)
            .finish_non_exhaustive()
    }
}

impl<'a, T: Scalar> Commands<'a, T> {
    /// The commands of one actuator, each a time and its leaves.
    #[inline(always)]
    fn of(&self, actuator: usize) -> std::slice::ChunksExact<'a, T> {
        let size = |actuator: usize| (self.windows)(actuator) * (1 + self.leaves[actuator]);
        let first: usize = (0..actuator).map(size).sum();
        self.values[first..first + size(actuator)].chunks_exact(1 + self.leaves[actuator])
    }

    /// The inputs that act at `time` (s). Before the oldest command, that one.
    #[inline(always)]
    pub(super) fn at(&self, time: T, inputs: &mut [T]) {
        for (input, sources) in inputs.iter_mut().zip(self.inputs) {
            let mut sum = T::constant(0.0);
            for source in sources {
                let mut held = T::constant(0.0);
                for (index, command) in self.of(source.actuator).enumerate() {
                    let value = command[1 + source.leaf];
                    held = if index == 0 { value } else { T::select(command[0].le(time), value, held) };
                }
                sum += held;
            }
            *input = if sources.len() > 1 { sum / sources.len() as f64 } else { sum };
        }
    }

    /// When the next command begins to act after `time` (s).
    #[inline(always)]
    pub(super) fn next(&self, time: T) -> T {
        let mut next = T::constant(FAR);
        for actuator in 0..self.leaves.len() {
            for command in self.of(actuator) {
                let begins = command[0];
                next = T::select(time.lt(begins) & begins.lt(next), begins, next);
            }
        }
        next
    }

    /// From when on (s) all commands are known.
    pub(super) fn known_from(&self) -> T {
        let mut from = T::constant(-FAR);
        for actuator in 0..self.leaves.len() {
            if let Some(oldest) = self.of(actuator).next() {
                from = from.max(oldest[0]);
            }
        }
        from
    }
}
