//! How far a comparison of percentiles can be trusted.
//!
//! Cases take turns, and what disturbs the machine for a while disturbs some turns of all of them. So whole turns are drawn
//! anew, the same ones of both sides, and the ratio is formed again each time (a paired block bootstrap: Künsch, *The
//! jackknife and the bootstrap for general stationary observations*, Annals of Statistics 17, 1989). The middle 95 % of these
//! ratios is the interval in which the ratio lies, as far as these turns can tell.

use rand_chacha::rand_core::Rng;

use super::Delays;
use crate::random::{Purpose, stream};

/// Fewer turns say nothing of how turns differ.
const FEWEST: usize = 8;
/// How often turns are drawn anew.
const DRAWS: usize = 1000;

/// The delays of all turns of one case, in order.
struct Sorted {
    /// Delay in nanoseconds, turn, count.
    counts: Vec<(u64, u32, u64)>,
    /// How many there are, by turn.
    lengths: Vec<u64>,
}

impl Sorted {
    fn new(delays: &Delays) -> Self {
        let turns = delays.turns();
        let entries = turns
            .iter()
            .zip(0..)
            .flat_map(|(turn, number)| turn.iter().map(move |&(delay, count)| (delay, number, count)));
        let mut counts: Vec<_> = entries.collect();
        counts.sort_unstable();
        let lengths = turns.iter().map(|turn| turn.iter().map(|(_, count)| count).sum()).collect();
        Self { counts, lengths }
    }

    /// The percentile when each turn counts so many times; `None` where too few delays lie beyond it.
    fn at(&self, percent: f64, weights: &[u64]) -> Option<f64> {
        let total: u64 = self.lengths.iter().zip(weights).map(|(length, weight)| length * weight).sum();
        let beyond = total as f64 * (1.0 - percent / 100.0);
        if beyond < 0.999 {
            return None;
        }
        let mut left = beyond as u64;
        for &(delay, turn, count) in self.counts.iter().rev() {
            let count = count * weights[turn as usize];
            if count > left {
                return Some(delay as f64);
            }
            left -= count;
        }
        None
    }
}

/// The interval of `measured / (floor * factor + add)` at a percentile. `None` where there are too few turns, or where the two
/// did not take the same ones.
pub(super) fn interval(
    measured: &Delays,
    floor: &Delays,
    percent: f64,
    limit: impl Fn(f64) -> f64,
) -> Option<(f64, f64)> {
    let turns = measured.turns().len();
    if turns < FEWEST || floor.turns().len() != turns {
        return None;
    }
    let (measured, floor) = (Sorted::new(measured), Sorted::new(floor));
    // What is measured says which numbers are drawn: nobody chooses among answers.
    let mut random = stream(turns as u64, Purpose::Seed, "turns");
    let mut weights = vec![0; turns];
    let mut ratios = Vec::with_capacity(DRAWS);
    for _ in 0..DRAWS {
        weights.fill(0);
        for _ in 0..turns {
            weights[(random.next_u64() % turns as u64) as usize] += 1;
        }
        ratios.push(measured.at(percent, &weights)? / limit(floor.at(percent, &weights)?));
    }
    ratios.sort_unstable_by(f64::total_cmp);
    Some((ratios[DRAWS / 40], ratios[DRAWS - 1 - DRAWS / 40]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `turns` turns of 200 delays about `delay`; every so many of them is disturbed and ten times as long.
    fn delays(turns: u64, delay: u64, disturbed: u64) -> Delays {
        let mut all = Delays::new();
        for turn in 0..turns {
            let mut one = Delays::new();
            let factor = if turn % disturbed == disturbed - 1 { 10 } else { 1 };
            one.extend((0..200).map(|k| ((delay + k) * factor) as i64));
            all.add_turn(&one);
        }
        all
    }

    #[test]
    fn a_ratio_is_known_where_turns_agree_and_not_where_they_do_not() {
        let (low, high) =
            interval(&delays(40, 2000, 100), &delays(40, 1000, 100), 50.0, |floor| floor * 1.3).unwrap();
        let truth = 2100.0 / (1100.0 * 1.3);
        assert!(low <= truth * 1.002 && high >= truth * 0.998 && high - low < 0.02, "{low} {high}");
        // Both are disturbed in the same turns: their ratio is known.
        let (low, high) =
            interval(&delays(40, 2000, 20), &delays(40, 1000, 20), 99.0, |floor| floor * 1.3).unwrap();
        assert!(high / low < 1.3, "{low} {high}");
        // One is, here and there: whether its 99th percentile is a disturbance nobody knows.
        let (low, high) =
            interval(&delays(40, 2000, 40), &delays(40, 2000, 1000), 99.0, |floor| floor).unwrap();
        assert!(low < 1.1 && high > 5.0, "{low} {high}");
        assert_eq!(interval(&delays(7, 1, 9), &delays(7, 1, 9), 50.0, |floor| floor), None, "too few turns");
    }
}
