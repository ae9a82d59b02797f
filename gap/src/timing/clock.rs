//! Two clocks, from one-way delays.

use serde::{Deserialize, Serialize};

use super::ENOUGH;
use crate::statistics::standard_deviation;

/// Blocks that are left out in turn to learn how certain a skew is.
const BLOCKS: usize = 10;

/// Drift over the whole run below which a skew counts for nothing (s), and in standard deviations of the delays: the
/// shortest delays of a run scatter too.
const NOTHING: (f64, f64) = (1e-5, 2.0);

/// How much faster the receiver's clock runs than the sender's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Skew {
    /// Seconds gained for each second.
    pub skew: f64,
    /// Its standard deviation.
    pub std: f64,
    /// The shortest delay at the start of the run, on the two clocks (s).
    pub shortest: f64,
    /// Whether it differs from zero.
    pub significant: bool,
}

/// The skew from when messages were sent and received (s), in the order in which they were sent; absent with too few.
///
/// The lower convex hull of the delays over time bounds what both clocks and the shortest way allow; its edge under the
/// middle of the run is the line below all delays that lies nearest to them (Moon, Skelly & Towsley 1999, "Estimation
/// and removal of clock skew from network delay measurements").
#[must_use]
pub fn skew(travelled: &[(f64, f64)]) -> Option<Skew> {
    let delays: Vec<(f64, f64)> = travelled.iter().map(|(sent, received)| (*sent, received - sent)).collect();
    if delays.len() < BLOCKS * ENOUGH {
        return None;
    }
    let (slope, level) = under(&delays)?;
    let n = delays.len();
    // The jackknife over blocks of time.
    let slopes: Vec<f64> = (0..BLOCKS)
        .filter_map(|b| {
            let left = [&delays[..b * n / BLOCKS], &delays[(b + 1) * n / BLOCKS..]].concat();
            under(&left).map(|found| found.0)
        })
        .collect();
    let mean = slopes.iter().sum::<f64>() / slopes.len() as f64;
    let spread: f64 = slopes.iter().map(|s| (s - mean).powi(2)).sum();
    let count = slopes.len() as f64;
    let std = ((count - 1.0) / count * spread).sqrt();
    let span = delays[n - 1].0 - delays[0].0;
    let level_delays: Vec<f64> = delays.iter().map(|(t, d)| d - slope * t).collect();
    let least = NOTHING.0.max(NOTHING.1 * standard_deviation(&level_delays));
    let significant = slope.abs() > 3.3 * std && slope.abs() * span > least;
    Some(Skew { skew: slope, std, shortest: level + slope * delays[0].0, significant })
}

/// Slope and level of the hull's edge under the mean time.
fn under(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for &(t, d) in points {
        if hull.last().is_some_and(|last| t <= last.0) {
            continue;
        }
        while let [.., a, b] = hull[..] {
            // The last corner goes unless the way turns upwards there.
            if (b.0 - a.0) * (d - a.1) <= (t - a.0) * (b.1 - a.1) {
                hull.pop();
            } else {
                break;
            }
        }
        hull.push((t, d));
    }
    let mean = points.iter().map(|p| p.0).sum::<f64>() / points.len() as f64;
    let edge = hull.windows(2).find(|w| w[0].0 <= mean && mean <= w[1].0)?;
    let slope = (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0);
    Some((slope, edge[0].1 - slope * edge[0].0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    fn travelled(skew: f64) -> Vec<(f64, f64)> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        (0..3000)
            .map(|k| {
                let sent = 0.01 * f64::from(k);
                let delay = 2e-3 - 5e-4 * random.random_range(1e-9..1.0_f64).ln();
                (sent, (sent + delay) * (1.0 + skew) + 0.5)
            })
            .collect()
    }

    #[test]
    fn a_clock_that_runs_fast_is_found_under_the_jitter() {
        let found = skew(&travelled(1e-4)).expect("there are enough");
        assert!(found.significant, "{found:?}");
        assert!((found.skew - 1e-4).abs() < 2e-6_f64.max(3.3 * found.std), "{found:?}");
        assert!((found.shortest - 0.502).abs() < 1e-4, "{found:?}");
    }

    #[test]
    fn equal_clocks_are_equal() {
        let found = skew(&travelled(0.0)).expect("there are enough");
        assert!(!found.significant, "{found:?}");
    }
}
