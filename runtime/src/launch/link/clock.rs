//! What another machine's clock shows: its offset and its skew against this one's, with bounds that hold.
//!
//! An exchange gives four readings: sent here, arrived there, answered there, arrived back here. Whatever the network does,
//! the offset lies between "the way there took no time" and "the way back took no time". Of each second the exchange with
//! the shortest round trip is kept; the line of offset over time that fits the middles best is the estimate, and the lines that pass
//! through all the intervals bound it. As long as the skew stays the same over the window, nothing but the intervals is
//! believed: neither that the two ways take equally long, nor anything about the distribution of delays.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::time::{Nanos, SECOND};

/// Of so much time the exchange with the shortest round trip is kept.
const BLOCK: Nanos = SECOND;
/// Blocks that an estimate looks back on: a crystal's rate holds for so long.
const BLOCKS: usize = 60;
/// No clock of a running system is steered faster than this (adjtimex(2)); it bounds the skew where nothing else does yet.
const FASTEST: f64 = 500e-6;

/// One exchange: readings of this machine's monotonic clock and of the other one's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Exchange {
    /// The question left here.
    pub(super) asked: Nanos,
    /// It arrived there.
    pub(super) heard: Nanos,
    /// The answer left there.
    pub(super) answered: Nanos,
    /// It arrived here.
    pub(super) back: Nanos,
}

impl Exchange {
    /// What the network took, both ways together; `None` for readings that cannot be.
    fn round_trip(&self) -> Option<Nanos> {
        let trip = self.back.checked_sub(self.asked)?.checked_sub(self.answered.checked_sub(self.heard)?)?;
        (trip >= 0 && self.answered >= self.heard).then_some(trip)
    }
}

/// How another clock stands to this one at one time. `other = here + offset`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Estimate {
    /// The reading of this clock for which the offset holds, ns.
    pub(crate) at: Nanos,
    /// Offset, ns.
    pub(crate) offset: Nanos,
    /// The offset is no further from the truth than this, ns.
    pub(crate) bound: Nanos,
    /// How much faster the other clock runs: seconds per second.
    pub(crate) skew: f64,
    /// The skew is no further from the truth than this.
    pub(crate) skew_bound: f64,
    /// The shortest round trip in the window, ns.
    pub(crate) round_trip: Nanos,
    /// Exchanges so far.
    pub(crate) exchanges: u64,
}

/// What the intervals of one block say of the offset.
#[derive(Debug, Clone, Copy)]
struct Kept {
    /// The middle of the exchange, on this clock.
    at: Nanos,
    low: Nanos,
    high: Nanos,
}

impl Kept {
    fn width(self) -> Nanos {
        self.high - self.low
    }
}

/// Learns from exchanges how another clock stands to this one.
#[derive(Debug, Default)]
pub(super) struct Offsets {
    kept: VecDeque<Kept>,
    /// Where the newest block began.
    block: Nanos,
    exchanges: u64,
}

impl Offsets {
    /// Takes in an exchange. Readings that no pair of clocks can give are left out.
    pub(super) fn add(&mut self, exchange: &Exchange) {
        let Some(trip) = exchange.round_trip() else { return };
        let Some(low) = exchange.answered.checked_sub(exchange.back) else { return };
        self.exchanges += 1;
        let at = exchange.asked + (exchange.back - exchange.asked) / 2;
        let new = Kept { at, low, high: low + trip };
        match self.kept.back_mut() {
            Some(newest) if at - self.block < BLOCK => {
                if new.width() < newest.width() {
                    *newest = new;
                }
            }
            _ => {
                self.block = at;
                self.kept.push_back(new);
                if self.kept.len() > BLOCKS {
                    self.kept.pop_front();
                }
            }
        }
    }

    /// How many exchanges there were.
    pub(super) fn exchanges(&self) -> u64 {
        self.exchanges
    }

    /// The estimate for the time `now` of this clock; `None` before the first exchange.
    pub(super) fn estimate(&mut self, now: Nanos) -> Option<Estimate> {
        // A clock that was steered meanwhile follows no one line: what is older than that says nothing any more.
        let (slowest, fastest) = loop {
            let (slowest, fastest) = self.slopes();
            if slowest <= fastest {
                break (slowest, fastest);
            }
            self.kept.pop_front();
        };
        let newest = *self.kept.back()?;
        // A line through all intervals has these slopes at least and at most; from each interval it goes on with one of them.
        let reach = |kept: &Kept, slope: f64| ((now - kept.at) as f64 * slope).round() as Nanos;
        let steep = |kept: &Kept, up: bool| if (now >= kept.at) == up { fastest } else { slowest };
        let high = self.kept.iter().map(|kept| kept.high + reach(kept, steep(kept, true))).min()?;
        let low = self.kept.iter().map(|kept| kept.low + reach(kept, steep(kept, false))).max()?;
        let (skew, middle) = self.fit(newest.at, now);
        let skew = skew.clamp(slowest, fastest);
        let (low, high) = (low.min(high), high.max(low));
        let offset = (newest.low + (middle.round() as Nanos)).clamp(low, high);
        Some(Estimate {
            at: now,
            offset,
            bound: (high - offset).max(offset - low),
            skew,
            skew_bound: (fastest - skew).max(skew - slowest),
            round_trip: self.kept.iter().map(|kept| kept.width()).min()?,
            exchanges: self.exchanges,
        })
    }

    /// The smallest and the largest slope of a line that passes through every interval.
    fn slopes(&self) -> (f64, f64) {
        let (mut slowest, mut fastest) = (-FASTEST, FASTEST);
        for (index, early) in self.kept.iter().enumerate() {
            for late in self.kept.iter().skip(index + 1) {
                let time = (late.at - early.at) as f64;
                if time > 0.0 {
                    fastest = f64::min(fastest, (late.high - early.low) as f64 / time);
                    slowest = f64::max(slowest, (late.low - early.high) as f64 / time);
                }
            }
        }
        (slowest, fastest)
    }

    /// The line that fits the middles best, an interval counting the more the narrower it is: its slope, and its height at
    /// `now` above the low end of the newest interval.
    fn fit(&self, origin: Nanos, now: Nanos) -> (f64, f64) {
        let base = self.kept.back().map_or(0, |kept| kept.low);
        let (mut weights, mut time, mut height) = (0.0, 0.0, 0.0);
        let point = |kept: &Kept| {
            let weight = 1.0 / (kept.width().max(1) as f64).powi(2);
            let middle = (kept.low - base) as f64 + kept.width() as f64 / 2.0;
            (weight, (kept.at - origin) as f64, middle)
        };
        for kept in &self.kept {
            let (weight, at, middle) = point(kept);
            weights += weight;
            time += weight * at;
            height += weight * middle;
        }
        let (time, height) = (time / weights, height / weights);
        let (mut square, mut product) = (0.0, 0.0);
        for kept in &self.kept {
            let (weight, at, middle) = point(kept);
            square += weight * (at - time).powi(2);
            product += weight * (at - time) * (middle - height);
        }
        let slope = if square > 0.0 { product / square } else { 0.0 };
        (slope, height + slope * ((now - origin) as f64 - time))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use rand::SeedableRng;

    /// A clock that stands `offset` before ours and runs faster by `skew`.
    struct Other {
        offset: Nanos,
        skew: f64,
    }

    impl Other {
        fn offset(&self, here: Nanos) -> Nanos {
            self.offset + (here as f64 * self.skew) as Nanos
        }
    }

    /// Exchanges over a network whose ways take at least `least` and in most cases longer, not equally there and back.
    fn exchanges(other: &Other, seconds: i64, least: [Nanos; 2], seed: u64) -> Vec<Exchange> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let mut way = |least: Nanos| {
            let burst = if random.random_bool(0.1) { 5_000_000.0 } else { 150_000.0 };
            least + (-random.random::<f64>().max(1e-12).ln() * burst) as Nanos
        };
        (0..seconds * 10)
            .map(|number| {
                let asked = number * SECOND / 10;
                let there = asked + way(least[0]);
                let heard = there + other.offset(there);
                let leaves = there + 20_000;
                let answered = leaves + other.offset(leaves);
                Exchange { asked, heard, answered, back: leaves + way(least[1]) }
            })
            .collect()
    }

    #[test]
    fn the_truth_lies_within_the_bounds_at_every_time_and_they_shrink() {
        for (seed, skew) in [(1, 80e-6), (2, -35e-6), (3, 0.0), (4, 400e-6)] {
            let other = Other { offset: 5_000 * SECOND, skew };
            let mut offsets = Offsets::default();
            let mut first = None;
            let mut last = None;
            for exchange in exchanges(&other, 100, [60_000, 180_000], seed) {
                offsets.add(&exchange);
                let now = exchange.back;
                let estimate = offsets.estimate(now).unwrap();
                let error = (estimate.offset - other.offset(now)).abs();
                assert!(error <= estimate.bound, "seed {seed}: {error} ns, {estimate:?}");
                assert!(
                    (estimate.skew - skew).abs() <= estimate.skew_bound + 1e-12,
                    "seed {seed}: {estimate:?}"
                );
                first.get_or_insert(estimate);
                last = Some((estimate, error));
            }
            let (last, error) = last.unwrap();
            assert!(last.skew_bound < 10e-6, "seed {seed}: {last:?}");
            assert!(last.bound <= first.unwrap().bound && last.bound < 250_000, "seed {seed}: {last:?}");
            assert!(error < 150_000, "seed {seed}: {error}");
        }
    }

    #[test]
    fn a_clock_that_was_steered_is_followed_and_impossible_readings_are_left_out() {
        let (before, after) = (Other { offset: 0, skew: 200e-6 }, Other { offset: 4_000_000, skew: -200e-6 });
        let mut offsets = Offsets::default();
        offsets.add(&Exchange { asked: 10, heard: 5, answered: 4, back: 12 });
        offsets.add(&Exchange { asked: 10, heard: 5, answered: 900, back: 12 });
        offsets.add(&Exchange { asked: i64::MIN, heard: 5, answered: 6, back: i64::MAX });
        assert_eq!(offsets.estimate(0), None);
        for exchange in exchanges(&before, 10, [50_000, 50_000], 7) {
            offsets.add(&exchange);
        }
        for mut exchange in exchanges(&after, 60, [50_000, 50_000], 8) {
            let turn = |other: &Other, here: Nanos| other.offset(here);
            // From 10 s on the other clock runs slower; the offset goes on from where it was.
            let shift = turn(&before, 10 * SECOND) - turn(&after, 10 * SECOND);
            if exchange.asked < 10 * SECOND {
                continue;
            }
            exchange.heard += shift;
            exchange.answered += shift;
            offsets.add(&exchange);
            offsets.estimate(exchange.back);
        }
        let now = 60 * SECOND;
        let truth = after.offset(now) + before.offset(10 * SECOND) - after.offset(10 * SECOND);
        let estimate = offsets.estimate(now).unwrap();
        assert!((estimate.offset - truth).abs() < 300_000, "{truth} {estimate:?}");
        assert!((estimate.skew + 200e-6).abs() < 30e-6, "{estimate:?}");
    }

    #[test]
    fn a_silence_widens_the_bounds() {
        let other = Other { offset: -SECOND, skew: 20e-6 };
        let mut offsets = Offsets::default();
        exchanges(&other, 3, [50_000, 50_000], 9).iter().for_each(|exchange| offsets.add(exchange));
        let (near, far) = (offsets.estimate(3 * SECOND).unwrap(), offsets.estimate(30 * SECOND).unwrap());
        assert!(far.bound > near.bound);
        assert!((far.offset - other.offset(30 * SECOND)).abs() <= far.bound);
        assert_eq!(offsets.exchanges(), 30);
    }
}
