//! Delays that are chosen at run time.

use parallax_runtime::time::Nanos;

use super::candidates::Reach;

/// How payloads follow from a trainable delay.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Interpolation {
    /// A message holds until the next one has arrived.
    #[default]
    Hold,
    /// The payload at `start − delay` lies on a line between the two messages around it; it holds at the ends.
    Linear,
}

/// A delay `min + alpha (max − min)` whose `alpha`, from 0 to 1, is given at run time (van der Heijden et al., "REX",
/// section 3.3, hidden delays).
///
/// The step at `start` sees the `window` newest candidates with `sent + delay <= start` (with `skip`: `<`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TrainableDelay {
    /// The shortest, ns.
    pub min: Nanos,
    /// The longest, ns.
    pub max: Nanos,
    /// How payloads follow.
    pub interpolation: Interpolation,
    /// Whether a message that arrives exactly at the start is left for the next step.
    pub skip: bool,
}

/// A connection and its trainable delay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TrainableConnection {
    /// The connection, by its place in the graph.
    pub connection: usize,
    /// The shortest delay, ns.
    pub min: Nanos,
    /// The longest delay, ns.
    pub max: Nanos,
    /// How payloads follow from the delay.
    pub interpolation: Interpolation,
}

impl TrainableDelay {
    pub(super) fn reach(&self) -> Reach {
        // The neighbour on the other side of `start − delay`.
        let neighbour = self.interpolation == Interpolation::Linear;
        Reach { min: self.min, max: self.max, skip: self.skip, neighbour }
    }
}
