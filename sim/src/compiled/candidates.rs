//! The messages that a step could see, where their delay is known only at run time.

use parallax_runtime::time::Nanos;

/// A delay that is known only within bounds, counted from a time that is known for every message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Reach {
    /// The shortest delay, ns.
    pub(super) min: Nanos,
    /// The longest, ns.
    pub(super) max: Nanos,
    /// Whether a message that arrives exactly at the start is left for the next step.
    pub(super) skip: bool,
    /// How many messages after the newest that is there belong to the candidates too, where they are sent by then.
    pub(super) behind: usize,
    /// How many messages before the window of the longest delay belong to them.
    pub(super) before: usize,
}

impl Reach {
    /// Whether a message from `origin` is there at `start` under the delay `delay`.
    #[inline]
    fn is_there(&self, origin: Nanos, delay: Nanos, start: Nanos) -> bool {
        let arrival = origin.saturating_add(delay);
        if self.skip { arrival < start } else { arrival <= start }
    }

    /// The first and the last number, exclusive, of the messages that a step at `start` could see under any delay.
    /// `origins` are the times from which the delay of each message counts.
    fn range(&self, origins: &[Nanos], window: usize, start: Nanos) -> (i64, i64) {
        let there = |delay| origins.partition_point(|&origin| self.is_there(origin, delay, start)) as i64;
        let mut last = there(self.min);
        for _ in 0..self.behind {
            let sent = |&origin: &Nanos| self.is_there(origin, 0, start);
            last += i64::from(origins.get(last as usize).is_some_and(sent));
        }
        // What extrapolates needs as many where the window is at the end.
        let before = self.before as i64;
        (there(self.max).min(last - before) - window as i64 - before, last)
    }

    /// The most candidates that any step needs.
    pub(super) fn most(&self, origins: &[Nanos], window: usize, starts: &[Nanos]) -> usize {
        let needed = starts.iter().map(|&start| {
            let (first, last) = self.range(origins, window, start);
            (last - first) as usize
        });
        needed.max().unwrap_or(window).max(window + 2 * self.before)
    }

    /// The candidates of steps that start at `starts`, `[step][candidate]`, −1 for an initial message. A row that needs
    /// fewer than `count` repeats its oldest: it is never among the newest `window` that are there, because as many
    /// newer ones are.
    pub(super) fn candidates(
        &self,
        origins: &[Nanos],
        window: usize,
        count: usize,
        starts: &[Nanos],
    ) -> Vec<i64> {
        let mut seq = Vec::with_capacity(count * starts.len());
        for &start in starts {
            let (first, last) = self.range(origins, window, start);
            seq.extend((last - count as i64..last).map(|number| number.max(first).max(-1)));
        }
        seq
    }
}
