//! A distribution for measured delays.

use parallax_runtime::delay::Delay;
use parallax_runtime::time::{Nanos, to_seconds};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::Serialize;

use super::cells::Cells;
use super::collect::{LeftOut, Measured, Place};
use super::correlation::{Correlation, correlation};
use super::mixture;

/// The most components that a fit may have.
pub const MOST_COMPONENTS: usize = 5;
/// Beyond this many delays a fit reads a random choice of so many, the same for the same delays.
pub const ENOUGH: usize = 5000;

/// What was measured at one place, and the distribution that describes it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DelayFit {
    /// Whose delay.
    #[serde(flatten)]
    pub place: Place,
    /// How many delays were measured.
    pub samples: usize,
    /// What the recording holds beside them.
    pub left_out: LeftOut,
    /// Mean of all samples, s.
    pub mean_s: f64,
    /// Standard deviation of all samples, s.
    pub std_s: f64,
    /// Shortest, s.
    pub min_s: f64,
    /// Longest, s.
    pub max_s: f64,
    /// The step of the clock that stamped them, s.
    pub resolution_s: f64,
    /// Samples that were taken for outliers: they are not part of the fit.
    pub outliers: usize,
    /// How successive samples resemble each other.
    pub correlation: Correlation,
    /// The distribution of the rest: a constant, a normal distribution or a mixture; correlated where that is
    /// significant.
    pub fit: Delay,
    /// The distribution of a sample by itself has so many components; 0 where it is constant.
    pub components: usize,
    /// Kolmogorov's distance: the largest difference between the share of samples (outliers aside) up to a delay and its
    /// probability under the fit.
    pub distance: f64,
}

/// Fits a distribution to the delays of one place; `None` when there are none.
///
/// Deterministic: the same delays give the same fit. How the number of components is chosen and what an outlier is:
/// [the module](super).
pub fn fit(measured: &Measured) -> Option<DelayFit> {
    let Measured { place, delays, successive, left_out } = measured;
    if delays.is_empty() {
        return None;
    }
    let cells = Cells::new(&chosen(delays));
    let found = mixture::find(&cells, MOST_COMPONENTS);
    let bounds = kept_ranges(&cells, &found.kept);
    let is_kept = |delay: Nanos| {
        let x = (delay as f64 - cells.centre) / cells.scale;
        let place = bounds.partition_point(|(_, high, _)| *high < x);
        bounds.get(place).or(bounds.last()).is_none_or(|(.., kept)| *kept)
    };
    let kept: Vec<bool> = delays.iter().map(|&delay| is_kept(delay)).collect();

    let components: Vec<(f64, f64, f64)> = found
        .components
        .iter()
        .map(|c| match c.cell(&cells) {
            // What lies in one cell is always the same.
            Some(x) => (c.weight, cells.seconds(x), 0.0),
            None => (c.weight, cells.seconds(c.mean), c.std * cells.scale * 1e-9),
        })
        .collect();
    let single = match components[..] {
        [(_, mean, 0.0)] => Delay::constant(to_seconds((mean * 1e9).round() as Nanos).max(0.0)),
        [(_, mean, std)] => Delay::Normal { mean, std },
        _ => Delay::Mixture {
            weights: components.iter().map(|c| c.0).collect(),
            means: components.iter().map(|c| c.1).collect(),
            stds: components.iter().map(|c| c.2).collect(),
        },
    };
    let correlation = correlation(delays, successive, &kept);
    let count = delays.len() as f64;
    let sum: i128 = delays.iter().map(|&delay| i128::from(delay)).sum();
    let mean = sum as f64 / count * 1e-9;
    let variance = delays.iter().map(|&delay| (delay as f64 * 1e-9 - mean).powi(2)).sum::<f64>() / count;
    let constant = matches!(single, Delay::Constant { .. });
    Some(DelayFit {
        place: place.clone(),
        samples: delays.len(),
        left_out: *left_out,
        mean_s: mean,
        std_s: variance.sqrt(),
        min_s: to_seconds(delays.iter().copied().min().unwrap_or(0)),
        max_s: to_seconds(delays.iter().copied().max().unwrap_or(0)),
        resolution_s: to_seconds(cells.step),
        outliers: kept.iter().filter(|kept| !**kept).count(),
        distance: distance(&single, delays, &kept, to_seconds(cells.step)),
        components: if constant { 0 } else { components.len() },
        fit: if correlation.significant && !constant {
            Delay::Correlated { correlation: correlation.value, of: Box::new(single) }
        } else {
            single
        },
        correlation,
    })
}

/// The delays, or a random choice where there are very many.
fn chosen(delays: &[Nanos]) -> Vec<Nanos> {
    if delays.len() <= ENOUGH {
        return delays.to_vec();
    }
    // A choice at equal steps would meet a periodic delay always at the same phase.
    let mut random = ChaCha8Rng::seed_from_u64(delays.len() as u64);
    let mut delays = delays.to_vec();
    for place in 0..ENOUGH {
        let rest = (delays.len() - place) as u128;
        let other = place + ((u128::from(random.next_u64()) * rest) >> 64) as usize;
        delays.swap(place, other);
    }
    delays.truncate(ENOUGH);
    delays
}

/// Stretches of cells that are kept, or not: first and last position, and which. A delay that is not among the cells
/// belongs to the stretch that ends next.
fn kept_ranges(cells: &Cells, kept: &[bool]) -> Vec<(f64, f64, bool)> {
    let mut ranges: Vec<(f64, f64, bool)> = Vec::new();
    for (&x, &kept) in cells.x.iter().zip(kept) {
        match ranges.last_mut() {
            Some((_, high, same)) if *same == kept => *high = x,
            _ => ranges.push((x, x, kept)),
        }
    }
    ranges
}

fn distance(delay: &Delay, delays: &[Nanos], kept: &[bool], step: f64) -> f64 {
    let mut sorted: Vec<Nanos> =
        delays.iter().zip(kept).filter(|(_, kept)| **kept).map(|(d, _)| *d).collect();
    sorted.sort_unstable();
    let probability = |x: f64| delay.cdf(x).unwrap_or(0.0);
    let (mut largest, mut start): (f64, usize) = (0.0, 0);
    while start < sorted.len() {
        let end = start + sorted[start..].partition_point(|delay| *delay == sorted[start]);
        let x = to_seconds(sorted[start]);
        let share = |count: usize| count as f64 / sorted.len() as f64;
        // A stamp stands for all times that the clock rounds to it.
        let above = (share(end) - probability(x + 0.5 * step)).abs();
        let below = (share(start) - probability(x - 0.5 * step)).abs();
        largest = largest.max(above).max(below);
        start = end;
    }
    largest
}
