//! Delays that are chosen at run time, and the messages that could be seen under any of them.

use parallax_runtime::time::Nanos;

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
    /// Whether a message sent at `sent` is there at `start` under the delay `delay`.
    #[inline]
    fn is_there(&self, sent: Nanos, delay: Nanos, start: Nanos) -> bool {
        let arrival = sent.saturating_add(delay);
        if self.skip { arrival < start } else { arrival <= start }
    }

    /// The first and the last number, exclusive, of the messages that a step at `start` could see under any delay.
    /// `sent` is when the sender sent each.
    fn range(&self, sent: &[Nanos], window: usize, start: Nanos) -> (i64, i64) {
        let there = |delay| sent.partition_point(|&sent| self.is_there(sent, delay, start)) as i64;
        let mut last = there(self.min);
        // The neighbour on the other side of `start − delay`, where it is sent already.
        if self.interpolation == Interpolation::Linear
            && sent.get(last as usize).is_some_and(|&sent| self.is_there(sent, 0, start))
        {
            last += 1;
        }
        (there(self.max) - window as i64, last)
    }

    /// The most candidates that any step needs.
    pub(super) fn most(&self, sent: &[Nanos], window: usize, starts: &[Nanos]) -> usize {
        let needed = starts.iter().map(|&start| {
            let (first, last) = self.range(sent, window, start);
            (last - first) as usize
        });
        needed.max().unwrap_or(window).max(window)
    }

    /// The candidates of steps that start at `starts`, `[step][candidate]`, −1 for an initial message. A row that needs fewer than `count` repeats its oldest: it is
    /// never among the newest `window` that are there, because as many newer ones are.
    pub(super) fn candidates(
        &self,
        sent: &[Nanos],
        window: usize,
        count: usize,
        starts: &[Nanos],
    ) -> Vec<i64> {
        let mut seq = Vec::with_capacity(count * starts.len());
        for &start in starts {
            let (first, last) = self.range(sent, window, start);
            seq.extend((last - count as i64..last).map(|number| number.max(first).max(-1)));
        }
        seq
    }
}
