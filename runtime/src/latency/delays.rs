//! Many delays, as a histogram of high dynamic range.

use hdrhistogram::Histogram;
use serde::{Serialize, Serializer};

use crate::time::Nanos;

/// The longest delay that is told apart from longer ones: a minute.
const LONGEST: u64 = 60_000_000_000;

/// Delays in nanoseconds, each known to within a thousandth.
#[derive(Debug, Clone)]
pub struct Delays {
    histogram: Histogram<u64>,
    /// By turn, for those that were [added by turns](Self::add_turn): each delay in nanoseconds, and how often it occurred.
    turns: Vec<Vec<(u64, u64)>>,
}

/// One point of a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Percentile {
    /// Share of the delays that are not longer, in per cent.
    pub percent: f64,
    /// The delay in nanoseconds.
    pub ns: u64,
}

impl Default for Delays {
    fn default() -> Self {
        Self::new()
    }
}

impl Delays {
    /// No delays yet.
    pub fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, LONGEST, 3);
        Self {
            histogram: histogram.expect("bounds and digits are what the histogram allows"),
            turns: Vec::new(),
        }
    }

    /// Counts a delay. One below a nanosecond counts as one nanosecond, one above a minute as a minute.
    pub fn add(&mut self, delay: Nanos) {
        self.histogram.saturating_record(u64::try_from(delay).unwrap_or(0).max(1));
    }

    /// Counts all of them.
    pub fn extend(&mut self, delays: impl IntoIterator<Item = Nanos>) {
        delays.into_iter().for_each(|delay| self.add(delay));
    }

    /// Counts delays of a sender that sends every `period`, but waits for each answer first. Those messages that it would
    /// have sent meanwhile, and that would have waited too, are counted with it: else one long interruption would count
    /// once here, and many times where nobody waits.
    pub fn extend_paced(&mut self, delays: impl IntoIterator<Item = Nanos>, period: Nanos) {
        let period = u64::try_from(period).unwrap_or(0);
        for delay in delays {
            let delay = u64::try_from(delay).unwrap_or(0).clamp(1, LONGEST);
            // Within the histogram's bounds nothing is refused.
            let _ = self.histogram.record_correct(delay, period);
        }
    }

    /// Counts what one turn of a measurement gave.
    pub fn add_turn(&mut self, turn: &Self) {
        // Both have the same bounds.
        let _ = self.histogram.add(&turn.histogram);
        let counts = turn.histogram.iter_recorded();
        self.turns.push(counts.map(|value| (value.value_iterated_to(), value.count_at_value())).collect());
    }

    /// What each turn gave.
    pub(super) fn turns(&self) -> &[Vec<(u64, u64)>] {
        &self.turns
    }

    /// How many there are.
    pub fn len(&self) -> u64 {
        self.histogram.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.histogram.is_empty()
    }

    /// The delay that so many per cent do not exceed, in nanoseconds. `None` where fewer than one delay lies beyond: so
    /// few samples cannot show it.
    pub fn at(&self, percent: f64) -> Option<u64> {
        let beyond = self.len() as f64 * (1.0 - percent / 100.0);
        (beyond >= 0.999).then(|| self.histogram.value_at_percentile(percent))
    }

    /// The shortest and the longest, in nanoseconds.
    pub fn range(&self) -> (u64, u64) {
        (self.histogram.min(), self.histogram.max())
    }

    /// The distribution, in steps that become finer towards the longest delays.
    pub fn curve(&self) -> Vec<Percentile> {
        let points = self.histogram.iter_quantiles(8).map(|value| Percentile {
            percent: 100.0 * value.quantile_iterated_to(),
            ns: value.value_iterated_to(),
        });
        // The last point stands for 100 %, which a logarithmic axis does not have.
        points.filter(|point| self.at(point.percent).is_some()).collect()
    }
}

impl Serialize for Delays {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Shown {
            count: u64,
            min_ns: u64,
            p50_ns: Option<u64>,
            p90_ns: Option<u64>,
            p99_ns: Option<u64>,
            p99_9_ns: Option<u64>,
            p99_99_ns: Option<u64>,
            max_ns: u64,
            distribution: Vec<Percentile>,
        }
        let (min_ns, max_ns) = self.range();
        let shown = Shown {
            count: self.len(),
            min_ns,
            p50_ns: self.at(50.0),
            p90_ns: self.at(90.0),
            p99_ns: self.at(99.0),
            p99_9_ns: self.at(99.9),
            p99_99_ns: self.at(99.99),
            max_ns,
            distribution: self.curve(),
        };
        shown.serialize(serializer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_samples_and_no_finer() {
        let mut delays = Delays::new();
        assert!(delays.is_empty() && delays.at(50.0).is_none());
        delays.extend(1..=1000);
        assert_eq!((delays.len(), delays.range()), (1000, (1, 1000)));
        let near = |percent: f64, ns: u64| delays.at(percent).unwrap().abs_diff(ns) <= 1 + ns / 1000;
        assert!(near(50.0, 500) && near(99.0, 990) && near(99.9, 999));
        assert_eq!(delays.at(99.99), None, "a thousand samples do not show one in ten thousand");
        let curve = delays.curve();
        assert!(curve.windows(2).all(|pair| pair[0].percent <= pair[1].percent && pair[0].ns <= pair[1].ns));
        delays.add(-5);
        assert_eq!(delays.range().0, 1);
        delays.add(Nanos::MAX);
        assert!(delays.range().1 <= LONGEST + LONGEST / 500);

        // One interruption of 1 ms, in which ten messages would have been sent.
        let mut paced = Delays::new();
        paced.extend_paced([1_000, 1_000_000, 1_000], 100_000);
        assert_eq!(paced.len(), 2 + 10);
    }
}
