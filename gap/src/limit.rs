//! Limits at which the readings of a clipped sensor would rest.

/// Standard deviations of noise within which readings of one level lie: of the noise as it is stated, which may be twice what
/// it is.
const RESTING: [f64; 2] = [6.0, 3.0];

/// How many times as far below readings are counted to compare with. At the top of a smooth motion readings lie as
/// densely within the first interval as between its end and four times as far: depth goes with the square of time. They are those
/// of the swings that reach the top: where others turn around below it, they lie densely as well.
const BELOW: f64 = 4.0;

/// How many times denser than at the top of a smooth motion readings that rest are.
const DENSER: f64 = 2.0;

/// Fewest readings at a limit.
const FEWEST: usize = 10;

/// Share of readings that may lie beyond a limit: outliers.
const BEYOND: f64 = 0.002;

/// Standard deviations of noise within which a reading is at a limit.
pub(crate) const AT_LIMIT: f64 = 4.0;

/// Where the limit of a clipped sensor can be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limit {
    /// Smallest value.
    pub(crate) low: f64,
    /// Largest value.
    pub(crate) high: f64,
    /// The level at which readings rest; none if they rest nowhere.
    pub(crate) level: Option<f64>,
}

/// Where a limit can be at the upper end of an output's readings (`upper`) or at the lower one: around the level at which
/// they rest there, or near their extreme where they rest nowhere.
pub(crate) fn limit(readings: &[f64], noise: f64, upper: bool) -> Limit {
    let sign = if upper { 1.0 } else { -1.0 };
    let signed: Vec<f64> = readings.iter().map(|y| sign * y).collect();
    let mut sorted = signed.clone();
    sorted.sort_by(|a, b| b.total_cmp(a));
    let extreme = sorted.first().copied().unwrap_or(0.0);
    let found = |inner: f64, level: Option<f64>| {
        let (a, b) = (sign * inner, sign * extreme);
        Limit { low: a.min(b), high: a.max(b), level: level.map(|level| sign * level) }
    };
    let skipped = (BEYOND * sorted.len() as f64) as usize;
    for depth in RESTING {
        for (beyond, top) in sorted.iter().enumerate().take(skipped + 1) {
            let (resting, below) = swings(&signed, *top, depth * noise);
            if resting >= FEWEST && resting as f64 > DENSER * below as f64 {
                let level = sorted[beyond + resting / 2];
                return found(level - noise, Some(level));
            }
        }
    }
    found(extreme - RESTING[0] * noise, None)
}

/// How many readings of the swings that come within `depth` of `top` do so, and how many lie up to [`BELOW`] times as far below it.
fn swings(readings: &[f64], top: f64, depth: f64) -> (usize, usize) {
    let (mut resting, mut below) = (0, 0);
    for swing in readings.split(|y| *y < top - BELOW * depth) {
        let at_top = swing.iter().filter(|y| **y >= top - depth && **y <= top).count();
        if at_top > 0 {
            resting += at_top;
            below += swing.iter().filter(|y| **y < top - depth).count();
        }
    }
    (resting, below)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A swing with some noise, clipped at `high`.
    fn swing(high: f64) -> Vec<f64> {
        let noise = |k: usize| 0.001 * ((k * 7919 % 1000) as f64 / 1000.0 - 0.5) * 3.46;
        (0..2000).map(|k| (k as f64 * 0.01).sin().min(high) + noise(k)).collect()
    }

    #[test]
    fn readings_rest_where_they_are_clipped_and_nowhere_else() {
        let level = |readings: &[f64], upper: bool| limit(readings, 0.001, upper).level;
        assert!(level(&swing(0.7), true).is_some_and(|level| (level - 0.7).abs() < 0.001));
        assert_eq!(level(&swing(0.7), false), None);
        assert_eq!(level(&swing(2.0), true), None);
        let mirrored: Vec<f64> = swing(0.7).iter().map(|y| -y).collect();
        assert!(level(&mirrored, false).is_some_and(|level| (level + 0.7).abs() < 0.001));
    }

    #[test]
    fn a_noise_that_is_half_of_what_is_stated_hides_no_limit() {
        // So often far below the limit that readings within six times the stated noise are no denser than further down.
        let mut readings = swing(0.9);
        readings.iter_mut().skip(1000).for_each(|y| *y *= 0.95);
        assert!(
            limit(&readings, 0.0025, true).level.is_some_and(|level| (level - 0.9).abs() < 0.001),
            "{:?}",
            limit(&readings, 0.0025, true)
        );
        assert_eq!(limit(&readings, 0.0025, false).level, None);
    }

    #[test]
    fn swings_that_turn_around_a_little_below_do_not_hide_it() {
        let below = swing(2.0).into_iter().map(|y| 0.893 * y);
        let readings: Vec<f64> = swing(0.9)[..628]
            .iter()
            .copied()
            .chain(below.clone())
            .chain(below.clone())
            .chain(below)
            .collect();
        let found = limit(&readings, 0.0006, true);
        assert!(found.level.is_some_and(|level| (level - 0.9).abs() < 0.001), "{found:?}");
        assert_eq!(limit(&readings[628..], 0.0006, true).level, None);
    }

    #[test]
    fn a_few_outliers_do_not_hide_it() {
        let mut readings = swing(0.7);
        (readings[100], readings[900]) = (3.0, 2.0);
        let found = limit(&readings, 0.001, true);
        assert!(
            found.level.is_some_and(|level| (level - 0.7).abs() < 0.001) && found.high == 3.0,
            "{found:?}"
        );
    }
}
