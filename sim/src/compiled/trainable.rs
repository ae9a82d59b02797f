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
    /// The payload at `start − delay` lies between the two messages around it, bent as the two parabolas through them and one
    /// before or behind them are in the mean; where the newest is older, it goes on along the parabola through the three
    /// newest. For what is smooth between its messages, such as the ticks of a simulator: bends are seen, neither too early
    /// nor too late, and a delay shorter than a tick is felt.
    Smooth,
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
        // The neighbours on the other side of `start − delay`, and one on this side.
        let (behind, before) = match self.interpolation {
            Interpolation::Hold => (0, 0),
            Interpolation::Linear => (1, 0),
            Interpolation::Smooth => (2, 1),
        };
        Reach { min: self.min, max: self.max, skip: self.skip, behind, before }
    }
}
