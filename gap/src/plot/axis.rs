//! Axes: ticks at 1, 2 or 5 times a power of ten, and a time axis that leaves out what was not recorded.

use std::ops::Range;

use super::format;

/// Multiples of a step from one number to another, in order; none where they would be more than a thousand.
pub fn multiples(low: f64, high: f64, step: f64) -> Vec<f64> {
    let (first, last) = ((low / step).ceil(), (high / step + 1e-9).floor());
    if !(first.is_finite() && last.is_finite()) || last < first || last - first > 1000.0 {
        return Vec::new();
    }
    // Counting from the first multiple ends even where the numbers are too large to be told from the next one; and a
    // multiple is exact to the last bit where a running sum is not.
    (0..=(last - first) as i64).map(|i| (first + i as f64) * step).collect()
}

/// The next of 1, 2, 5 times a power of ten: `multiples` of `step(span / count)` are at most about `count`.
pub fn step(least: f64) -> f64 {
    if !(least.is_finite() && least > 0.0) {
        return 1.0;
    }
    let unit = 10f64.powi(format::exponent(least));
    [1.0, 2.0, 5.0, 10.0].iter().map(|m| m * unit).find(|s| *s >= least * (1.0 - 1e-9)).unwrap_or(unit * 10.0)
}

/// A vertical axis with its labels.
#[derive(Debug, Clone)]
pub struct Scale {
    /// Value at the bottom.
    pub low: f64,
    /// Value at the top.
    pub high: f64,
    /// Ticks with their labels.
    pub ticks: Vec<(f64, String)>,
    /// Power of ten by which the labels are to be multiplied.
    pub exponent: i32,
}

impl Scale {
    /// A scale that shows `low..high` with a little room. Both ends must be finite and below 1e290.
    pub fn new(low: f64, high: f64, count: f64) -> Self {
        let middle = (low + high) / 2.0;
        let least = (middle.abs() * 1e-9).max(1e-290);
        let room = ((high - low) * 0.05).max(least);
        let (low, high) = (low - room, high + room);
        let step = step((high - low) / count.max(1.0));
        let ticks = multiples(low, high, step);
        let top = format::exponent(low.abs().max(high.abs()));
        let exponent = if (-2..5).contains(&top) { 0 } else { top.div_euclid(3) * 3 };
        let decimals = usize::try_from((exponent - format::exponent(step)).clamp(0, 9)).unwrap_or(0);
        let label = |tick: f64| {
            let scaled = tick / 10f64.powi(exponent / 2) / 10f64.powi(exponent - exponent / 2);
            let zero = tick.abs() < step / 2.0;
            format!("{:.decimals$}", if zero { 0.0 } else { scaled })
        };
        let ticks = ticks.into_iter().map(|tick| (tick, label(tick))).collect();
        Self { low, high, ticks, exponent }
    }

    /// Position of a value between the bottom and the top of a panel, kept close to it.
    pub fn y(&self, value: f64, top: f64, height: f64) -> f64 {
        let part = ((value - self.low) / (self.high - self.low)).clamp(-2.0, 3.0);
        top + height * (1.0 - part)
    }
}

/// A stretch of samples drawn on one unbroken piece of the time axis.
#[derive(Debug, Clone)]
pub struct Stretch {
    /// The samples.
    pub samples: Range<usize>,
    /// Time at its start and end (s).
    pub time: (f64, f64),
    /// Where these lie (px).
    pub x: (f64, f64),
}

impl Stretch {
    /// Position of a time (px).
    pub fn x(&self, time: f64) -> f64 {
        let span = self.time.1 - self.time.0;
        let part = if span > 0.0 { (time - self.time.0) / span } else { 0.5 };
        self.x.0 + (self.x.1 - self.x.0) * part.clamp(0.0, 1.0)
    }
}

/// Lays pieces of samples side by side between `left` and `right`; times that no piece covers are left out where
/// they are long, or where time runs backwards because another recording begins.
pub fn stretches(stamp: &[f64], pieces: &[Range<usize>], left: f64, right: f64) -> Vec<Stretch> {
    let span = |range: &Range<usize>| (stamp[range.start], stamp[range.end - 1]);
    let covered: f64 = pieces.iter().map(|piece| span(piece).1 - span(piece).0).sum();
    let mut joined: Vec<Range<usize>> = Vec::new();
    for piece in pieces.iter().filter(|piece| !piece.is_empty()) {
        match joined.last_mut() {
            Some(last) if (0.0..=covered * 0.04).contains(&(stamp[piece.start] - stamp[last.end - 1])) => {
                last.end = piece.end;
            }
            _ => joined.push(piece.clone()),
        }
    }
    let total: f64 = joined.iter().map(|range| span(range).1 - span(range).0).sum();
    let gaps = joined.len().saturating_sub(1) as f64;
    let gap = if gaps > 0.0 { ((right - left) * 0.15 / gaps).min(14.0) } else { 0.0 };
    let width = right - left - gap * gaps;
    let equal = 1.0 / joined.len().max(1) as f64;
    let mut x = left;
    joined
        .into_iter()
        .map(|samples| {
            let time = span(&samples);
            let part = if total > 0.0 { (time.1 - time.0) / total } else { equal };
            let start = x;
            x += width * part + gap;
            Stretch { samples, time, x: (start, start + width * part) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_nice_and_inside() {
        assert_eq!(multiples(-0.1, 10.0, step(10.0 / 5.0)), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        for (low, high) in [(-1e280, 1e280), (0.0, 1e-280), (1e9, 1e9 + 1e-3)] {
            let step = step((high - low) / 5.0);
            let ticks = multiples(low, high, step);
            assert!((2..=7).contains(&ticks.len()), "{low} to {high}: {ticks:?}");
            assert!(ticks.windows(2).all(|pair| pair[1] > pair[0]));
            assert!(format!("{step:e}").starts_with(['1', '2', '5']), "{step:e}");
        }
        assert!(multiples(1e9, 1e9 + 1e-6, 1e-9).len() <= 1001);
        assert!(multiples(0.3, 0.7, 1.0).is_empty());
    }

    #[test]
    fn labels_share_a_power_of_ten() {
        let scale = Scale::new(0.0, 4e-6, 4.0);
        assert_eq!(scale.exponent, -6);
        let labels: Vec<&str> = scale.ticks.iter().map(|(_, label)| label.as_str()).collect();
        assert_eq!(labels, ["0", "2", "4"]);
        assert!(Scale::new(5.0, 5.0, 4.0).ticks.len() < 8);
    }

    #[test]
    fn long_gaps_are_left_out_and_short_ones_kept() {
        let stamp = [0.0, 1.0, 2.0, 2.1, 3.0, 50.0, 51.0, 0.5, 1.5];
        let stretches = stretches(&stamp, &[0..3, 3..5, 5..7, 7..9], 0.0, 100.0);
        let samples: Vec<_> = stretches.iter().map(|stretch| stretch.samples.clone()).collect();
        assert_eq!(samples, [0..5, 5..7, 7..9]);
        assert!((stretches[2].x.1 - 100.0).abs() < 1e-9);
        assert!(stretches[0].x.1 < stretches[1].x.0);
    }
}
