//! The report's own numbers: estimates with their uncertainty, shares with their interval.

use super::{Interval, Value};
pub(super) use crate::plot::format::*;
use crate::whiteness::Whiteness;

/// `0.0410 ± 0.0012 s`: the uncertainty to one significant digit (two where the first is 1), the value to the
/// same place. A value that the data do not tell is said to be so.
pub(super) fn uncertain(value: &Value) -> String {
    let untold = if value.std == f64::INFINITY { " (not told by these data)" } else { "" };
    format!("{}{}{untold}", plus_minus(value.value, value.std), unit(&value.unit))
}

/// A share and its interval, to the digits that the interval's width leaves: `99.6 %`, `99.2 to 99.8 %`.
pub(super) fn interval(interval: &Interval) -> (String, Option<String>) {
    let Interval { value, low, high } = *interval;
    if !value.is_finite() {
        return (UNKNOWN.to_owned(), None);
    }
    let width = (high - low) * 100.0;
    if !width.is_finite() || [value, low, high].iter().any(|x| x.abs() >= 100.0) {
        let ends =
            (low.is_finite() && high.is_finite()).then(|| format!("{} to {}", share(low), share(high)));
        return (share(value), ends);
    }
    let decimals = if width > 0.0 { (-exponent(width / 2.0)).clamp(0, 4) } else { 1 };
    let text = |x: f64| fixed(x * 100.0, decimals);
    if text(low) == text(high) {
        // Narrower than what is shown: an interval of one number says nothing, nor do zeros.
        return (share(value), None);
    }
    (format!("{} %", text(value)), Some(format!("{} to {} %", text(low), text(high))))
}

/// Whether innovations look like chance, and why.
pub(super) fn innovations(innovations: &Whiteness) -> String {
    let verdict = if innovations.is_chance() { "looks like chance" } else { "is not chance" };
    let times = |ratio: f64| format!("{} times", number(ratio, 2));
    let (slow, uneven) = (times(innovations.slow), times(innovations.uneven));
    format!("{verdict}: innovations {slow} as slow and {uneven} as uneven as white ones")
}

/// That so long (s) nothing happened, which is not looked at.
pub(super) fn rests(seconds: f64) -> String {
    format!("{} s in which no command and no reading changed are left out", number(seconds, 3))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(value: f64, std: f64, unit: &str) -> String {
        uncertain(&Value { value, std, unit: unit.to_owned() })
    }

    #[test]
    fn uncertainty_decides_the_digits() {
        assert_eq!(value(0.041_23, 0.001_2, "s"), "0.0412 ± 0.0012 s");
        assert_eq!(value(20.394, 0.31, "N"), "20.4 ± 0.3 N");
        assert_eq!(value(12_345.0, 210.0, ""), "12300 ± 200");
        assert_eq!(value(95.109, 0.0, "kg"), "95.11 kg");
        assert_eq!(value(0.0, 0.02, "1"), "0.00 ± 0.02");
        assert_eq!(value(-0.001, 0.5, "N"), "0.0 ± 0.5 N");
        assert_eq!(value(3.141_592e-7, 2e-9, "m"), "(3.14 ± 0.02)×10⁻⁷ m");
        assert_eq!(value(1e308, 1e306, "N"), "(1.000 ± 0.010)×10³⁰⁸ N");
        assert_eq!(value(1.0, f64::NAN, "N"), "1 N");
        assert_eq!(value(1.0, f64::INFINITY, "N"), "1 N (not told by these data)");
        assert_eq!(value(f64::NAN, 1.0, "N"), "– N");
        assert_eq!(value(1.0, 1e-14, "s"), "1 ± 10⁻¹⁴ s");
    }

    #[test]
    fn shares_follow_their_interval() {
        let of = |value, low, high| interval(&Interval { value, low, high });
        assert_eq!(of(0.9957, 0.992, 0.998), ("99.6 %".to_owned(), Some("99.2 to 99.8 %".to_owned())));
        assert_eq!(of(0.9992, 0.9989, 0.9994), ("99.92 %".to_owned(), Some("99.89 to 99.94 %".to_owned())));
        assert_eq!(of(0.4, 0.1, 0.6), ("40 %".to_owned(), Some("10 to 60 %".to_owned())));
        assert_eq!(of(f64::NAN, 0.0, 1.0), (UNKNOWN.to_owned(), None));
        assert_eq!(of(0.5, f64::NAN, 1.0), ("50 %".to_owned(), None));
        assert_eq!(of(0.999_999_96, 0.999_999_9, 0.999_999_98), ("100 %".to_owned(), None));
        assert_eq!(of(0.0, 0.0, 0.0), ("0 %".to_owned(), None));
        assert_eq!(of(-2e6, -3e6, 0.5).0, "-2×10⁸ %");
    }
}
