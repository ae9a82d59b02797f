//! Times, and the exact grid of a node's ticks.
//!
//! Inside, every time is a whole number of nanoseconds since the run's common start ([`Nanos`]); people read and
//! write seconds. A rate is the exact rational number that its `f64` is, so tick one billion lies where it should and
//! not where a billion rounded additions would have put it.

/// Nanoseconds since the run's common start; negative before it. Spans are counted in the same type.
pub type Nanos = i64;

/// One second.
pub const SECOND: Nanos = 1_000_000_000;

/// Seconds as nanoseconds, rounded to the nearest; what does not fit becomes the nearest time that does, NaN becomes 0.
///
/// ```
/// assert_eq!(parallax_runtime::time::from_seconds(0.0105), 10_500_000);
/// ```
#[inline]
pub fn from_seconds(seconds: f64) -> Nanos {
    // `as` saturates and maps NaN to 0, which is what the documentation promises.
    (seconds * SECOND as f64).round() as Nanos
}

/// Nanoseconds as seconds.
#[inline]
pub fn to_seconds(time: Nanos) -> f64 {
    time as f64 / SECOND as f64
}

/// The slowest rate a node may have, in Hz.
pub const MIN_RATE: f64 = 1e-3;
/// The fastest rate a node may have, in Hz: beyond it a period has too few nanoseconds to be kept.
pub const MAX_RATE: f64 = 1e6;

/// The ticks of a node: tick `k` lies at `phase + k / rate`, rounded to the nearest nanosecond (halves up).
///
/// `1e9 / rate` is kept as a fraction, so no tick drifts.
///
/// ```
/// use parallax_runtime::time::Grid;
/// let camera = Grid::new(0, 30.0).unwrap();
/// assert_eq!(camera.time(1), 33_333_333);
/// assert_eq!(camera.time(3_000_000_000), 100_000_000_000_000_000);
/// assert_eq!(camera.count_until(66_666_667), 3);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    phase: Nanos,
    /// A period is `numerator / denominator` nanoseconds; the denominator stays below 2^53.
    numerator: u128,
    denominator: u64,
}

impl Grid {
    /// The grid that starts at `phase` and has `rate` ticks a second. `None` when the rate is not a number between
    /// [`MIN_RATE`] and [`MAX_RATE`].
    pub fn new(phase: Nanos, rate: f64) -> Option<Self> {
        if !(MIN_RATE..=MAX_RATE).contains(&rate) {
            return None;
        }
        // rate = mantissa * 2^exponent, exactly.
        let bits = rate.to_bits();
        let mut mantissa = (bits & ((1 << 52) - 1)) | (1 << 52);
        let mut exponent = ((bits >> 52) & 0x7ff) as i32 - 1075;
        let zeros = mantissa.trailing_zeros();
        mantissa >>= zeros;
        exponent += zeros as i32;
        let second = SECOND as u128;
        let (numerator, denominator) =
            if exponent >= 0 { (second, mantissa << exponent) } else { (second << -exponent, mantissa) };
        let divisor = gcd(numerator, u128::from(denominator));
        Some(Self { phase, numerator: numerator / divisor, denominator: denominator / divisor as u64 })
    }

    /// Where tick 0 lies.
    pub fn phase(&self) -> Nanos {
        self.phase
    }

    /// The same ticks, starting at another phase.
    pub fn with_phase(self, phase: Nanos) -> Self {
        Self { phase, ..self }
    }

    /// The time between two ticks, rounded to the nearest nanosecond.
    pub fn period(&self) -> Nanos {
        self.offset(1)
    }

    /// The time of tick `k`; the last representable time for ticks beyond it (292 years).
    pub fn time(&self, k: u64) -> Nanos {
        self.phase.saturating_add(self.offset(k))
    }

    fn offset(&self, k: u64) -> Nanos {
        let denominator = u128::from(self.denominator);
        let Some(doubled) = self.numerator.checked_mul(2 * u128::from(k)) else { return Nanos::MAX };
        let Some(rounded) = doubled.checked_add(denominator) else { return Nanos::MAX };
        Nanos::try_from(rounded / (2 * denominator)).unwrap_or(Nanos::MAX)
    }

    /// How many ticks lie at or before `time`.
    pub fn count_until(&self, time: Nanos) -> u64 {
        let Some(elapsed) = time.checked_sub(self.phase).and_then(|elapsed| u128::try_from(elapsed).ok())
        else {
            return 0;
        };
        // Tick k counts when floor((2 k n + d) / 2 d) <= elapsed, that is when 2 k n < d (2 elapsed + 1).
        let limit = u128::from(self.denominator) * (2 * elapsed + 1);
        u64::try_from(limit.div_ceil(2 * self.numerator)).unwrap_or(u64::MAX)
    }

    /// A cursor on tick 0.
    pub fn ticks(&self) -> Ticks {
        self.ticks_from(0)
    }

    /// A cursor on tick `k`.
    pub fn ticks_from(&self, k: u64) -> Ticks {
        let doubled = 2 * u128::from(self.denominator);
        // What rounding the time of tick k leaves over; beyond 292 years the time no longer moves, and neither does this.
        let exact = self.numerator.checked_mul(2 * u128::from(k)).unwrap_or(0) + u128::from(self.denominator);
        // Both parts are small: the remainder is below 2^54, a period below 2^40 ns.
        let step = (2 * self.numerator) / doubled;
        let step_remainder = (2 * self.numerator) % doubled;
        Ticks {
            tick: k,
            time: self.time(k),
            remainder: (exact % doubled) as u64,
            step: step as Nanos,
            step_remainder: step_remainder as u64,
            modulus: doubled as u64,
        }
    }
}

/// Walks a [`Grid`] tick by tick with additions only: the same times as [`Grid::time`], without a division.
#[derive(Debug, Clone, Copy)]
pub struct Ticks {
    tick: u64,
    time: Nanos,
    remainder: u64,
    step: Nanos,
    step_remainder: u64,
    modulus: u64,
}

impl Ticks {
    /// The number of the tick that the cursor is on.
    #[inline]
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// The time of the tick that the cursor is on.
    #[inline]
    pub fn time(&self) -> Nanos {
        self.time
    }

    /// Goes on to the next tick.
    #[inline]
    pub fn advance(&mut self) {
        self.tick += 1;
        self.time = self.time.saturating_add(self.step);
        self.remainder += self.step_remainder;
        if self.remainder >= self.modulus {
            self.remainder -= self.modulus;
            self.time = self.time.saturating_add(1);
        }
    }
}

fn gcd(a: u128, b: u128) -> u128 {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn rates_that_cannot_be_have_no_grid() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-4, 2e6] {
            assert!(Grid::new(0, rate).is_none(), "{rate}");
        }
        assert!(Grid::new(0, MIN_RATE).is_some() && Grid::new(0, MAX_RATE).is_some());
    }

    #[test]
    fn far_ticks_are_exact() {
        let grid = Grid::new(5, 3.0).unwrap();
        assert_eq!(grid.time(1), 333_333_338);
        assert_eq!(grid.time(9_000_000_000), 5 + 3_000_000_000 * SECOND);
        assert_eq!(grid.time(u64::MAX), Nanos::MAX);
    }

    #[test]
    fn seconds_saturate() {
        assert_eq!(from_seconds(f64::INFINITY), Nanos::MAX);
        assert_eq!(from_seconds(f64::NAN), 0);
        assert_eq!(to_seconds(from_seconds(-1.25)), -1.25);
    }

    proptest! {
        #[test]
        fn cursor_and_formula_agree(rate in MIN_RATE..MAX_RATE, phase in -SECOND..SECOND, k in 0u64..2000) {
            let grid = Grid::new(phase, rate).unwrap();
            let mut ticks = grid.ticks();
            for _ in 0..k {
                ticks.advance();
            }
            prop_assert_eq!(ticks.tick(), k);
            prop_assert_eq!(ticks.time(), grid.time(k));
            let mut from = grid.ticks_from(k);
            for _ in 0..3 {
                prop_assert_eq!((from.tick(), from.time()), (ticks.tick(), ticks.time()));
                from.advance();
                ticks.advance();
            }
        }

        #[test]
        fn counting_inverts_the_ticks(rate in MIN_RATE..MAX_RATE, phase in -SECOND..SECOND, k in 0u64..1_000_000_000) {
            let grid = Grid::new(phase, rate).unwrap();
            let time = grid.time(k);
            prop_assert_eq!(grid.count_until(time), k + 1);
            prop_assert_eq!(grid.count_until(time - 1), k);
        }
    }
}
