//! Delays as counts on the grid of the clock that stamped them.

use parallax_runtime::time::Nanos;

/// Distinct delays with their counts. Positions are centred and scaled, so that fits meet numbers of order one.
#[derive(Debug, Clone)]
pub(super) struct Cells {
    /// Positions, ascending.
    pub(super) x: Vec<f64>,
    /// How many delays lie at each.
    pub(super) count: Vec<f64>,
    /// Sum of the counts.
    pub(super) total: f64,
    /// Half the clock's step.
    pub(super) half: f64,
    /// Whether the first position is zero, at which all that would be negative is gathered.
    pub(super) clipped: bool,
    /// What one unit of a position is, ns.
    pub(super) scale: f64,
    /// Where position 0 lies, ns.
    pub(super) centre: f64,
    /// The clock's step, ns.
    pub(super) step: Nanos,
}

impl Cells {
    /// The cells of at least one delay, none negative.
    pub(super) fn new(delays: &[Nanos]) -> Self {
        let mut sorted = delays.to_vec();
        sorted.sort_unstable();
        let step = step(&sorted);
        // The middle half is not moved by outliers; where it has no width, the whole has one or nothing has.
        let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize] as f64;
        let (middle, whole) = (at(0.75) - at(0.25), at(1.0) - at(0.0));
        let scale = if middle > 0.0 { middle } else { whole.max(1.0) };
        let centre = at(0.5);
        let (mut x, mut count): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
        let mut last = None;
        for &delay in &sorted {
            if last == Some(delay) {
                if let Some(count) = count.last_mut() {
                    *count += 1.0;
                }
            } else {
                x.push((delay as f64 - centre) / scale);
                count.push(1.0);
                last = Some(delay);
            }
        }
        Self {
            x,
            count,
            total: sorted.len() as f64,
            half: 0.5 * step as f64 / scale,
            clipped: sorted[0] <= 0,
            scale,
            centre,
            step,
        }
    }

    /// From the first position to the last, and half a step on either side.
    pub(super) fn range(&self) -> f64 {
        self.x[self.x.len() - 1] - self.x[0] + 2.0 * self.half
    }

    /// A position in seconds.
    pub(super) fn seconds(&self, x: f64) -> f64 {
        (self.centre + self.scale * x) * 1e-9
    }

    /// Neighbours joined at their mean, about `groups` in all: enough to find where a fit has to start.
    pub(super) fn coarse(&self, groups: usize) -> Self {
        let least = self.total / groups as f64;
        let (mut x, mut count): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
        for (index, (&position, &number)) in self.x.iter().zip(&self.count).enumerate() {
            match (x.last_mut(), count.last_mut()) {
                // What stands for everything below zero stays alone.
                (Some(x), Some(count))
                    if *count < least && number < least && !(self.clipped && index == 1) =>
                {
                    *x = (*x * *count + position * number) / (*count + number);
                    *count += number;
                }
                _ => {
                    x.push(position);
                    count.push(number);
                }
            }
        }
        Self { x, count, ..self.clone() }
    }

    /// The cells that are kept; `None` when none is.
    pub(super) fn filtered(&self, keep: &[bool]) -> Option<Self> {
        let pick = |values: &[f64]| -> Vec<f64> {
            values.iter().zip(keep).filter(|(_, keep)| **keep).map(|(value, _)| *value).collect()
        };
        let (x, count) = (pick(&self.x), pick(&self.count));
        let total = count.iter().sum();
        let clipped = self.clipped && keep[0];
        (!x.is_empty()).then(|| Self { x, count, total, clipped, ..self.clone() })
    }
}

/// The largest step of which all delays are multiples, ns: the resolution of the clock, which stamped both ends.
fn step(sorted: &[Nanos]) -> Nanos {
    sorted.iter().copied().fold(0, gcd).max(1)
}

fn gcd(a: Nanos, b: Nanos) -> Nanos {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_s_step_is_found() {
        assert_eq!(Cells::new(&[6_000, 4_000, 14_000, 4_000]).step, 2_000);
        assert_eq!(Cells::new(&[7, 8]).step, 1);
        let cells = Cells::new(&[0, 5, 5, 10]);
        assert_eq!((cells.count.clone(), cells.clipped), (vec![1.0, 2.0, 1.0], true));
        assert!((cells.seconds(cells.x[2]) - 1e-8).abs() < 1e-20);
    }
}
