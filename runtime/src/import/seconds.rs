//! Decimal seconds to whole nanoseconds, without a detour through floating point.

/// Why a text is no time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NotATime {
    /// Not a decimal number.
    Unreadable,
    /// NaN or infinity.
    NotFinite,
    /// Beyond ±292 years.
    OutOfRange,
}

/// Nanoseconds of a decimal number of seconds such as `12.5`, `-0.001` or `5.8e-06`, rounded to the nearest,
/// halves away from zero.
pub(super) fn nanoseconds(text: &str) -> Result<i64, NotATime> {
    scaled(text, 9)
}

/// The whole number nearest to a decimal number times ten to the `power`, which is 9 at most.
pub(super) fn scaled(text: &str, power: i32) -> Result<i64, NotATime> {
    let (negative, rest) = match text.as_bytes() {
        [b'-', ..] => (true, &text[1..]),
        [b'+', ..] => (false, &text[1..]),
        _ => (false, text),
    };
    let (digits, exponent) = match rest.find(['e', 'E']) {
        Some(at) => (&rest[..at], rest[at + 1..].parse::<i32>().map_err(|_| unreadable(text))?),
        None => (rest, 0),
    };
    let mut mantissa: i128 = 0;
    let mut scale = exponent.clamp(-1_000_000, 1_000_000) + power;
    let (mut seen, mut fraction) = (0, false);
    for byte in digits.bytes() {
        match byte {
            b'0'..=b'9' => {
                seen += 1;
                // Digits beyond the 30th are far below a nanosecond or far beyond the range.
                if mantissa < 10_i128.pow(30) {
                    mantissa = mantissa * 10 + i128::from(byte - b'0');
                    scale -= i32::from(fraction);
                } else {
                    scale += i32::from(!fraction);
                }
            }
            b'.' if !fraction => fraction = true,
            _ => return Err(unreadable(text)),
        }
    }
    if seen == 0 {
        return Err(unreadable(text));
    }
    let nanos = match scale {
        _ if mantissa == 0 => 0,
        0..=18 => mantissa.checked_mul(10_i128.pow(scale.unsigned_abs())).ok_or(NotATime::OutOfRange)?,
        -38..=-1 => {
            let unit = 10_i128.pow(scale.unsigned_abs());
            mantissa / unit + i128::from(mantissa % unit >= unit - mantissa % unit)
        }
        19.. => return Err(NotATime::OutOfRange),
        ..-38 => 0,
    };
    i64::try_from(if negative { -nanos } else { nanos }).map_err(|_| NotATime::OutOfRange)
}

fn unreadable(text: &str) -> NotATime {
    match text.parse::<f64>() {
        Ok(value) if !value.is_finite() => NotATime::NotFinite,
        _ => NotATime::Unreadable,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn decimal_seconds_are_exact() {
        for (text, expected) in [
            ("0", 0),
            ("12.5", 12_500_000_000),
            ("-0.001", -1_000_000),
            ("5.79899643e-06", 5_799),
            ("0.00100002406", 1_000_024),
            ("+1e0", 1_000_000_000),
            ("1.", 1_000_000_000),
            (".5", 500_000_000),
            ("0.0000000005", 1),
            ("0.00000000049999", 0),
            ("1700000000.123456789", 1_700_000_000_123_456_789),
            ("0.1000000000000000000000000000000000000000000000001", 100_000_000),
            ("1e-400", 0),
        ] {
            assert_eq!(nanoseconds(text), Ok(expected), "{text}");
        }
    }

    #[test]
    fn what_is_no_time_says_why() {
        for text in ["", "-", ".", "1.2.3", "1e", "one", "1 2", "--1", "0x10"] {
            assert_eq!(nanoseconds(text), Err(NotATime::Unreadable), "{text}");
        }
        for text in ["nan", "NaN", "inf", "-inf", "Infinity"] {
            assert_eq!(nanoseconds(text), Err(NotATime::NotFinite), "{text}");
        }
        for text in
            ["1e11", "1700000000123456789", "1e400", "99999999999999999999999999999999999999999999999"]
        {
            assert_eq!(nanoseconds(text), Err(NotATime::OutOfRange), "{text}");
        }
    }

    proptest! {
        #[test]
        fn whole_nanoseconds_survive(nanos in any::<i64>()) {
            let magnitude = nanos.unsigned_abs();
            let sign = if nanos < 0 { "-" } else { "" };
            let text = format!("{sign}{}.{:09}", magnitude / 1_000_000_000, magnitude % 1_000_000_000);
            prop_assert_eq!(nanoseconds(&text), Ok(nanos));
        }

        #[test]
        fn any_text_is_a_time_or_an_error(text in ".{0,20}") {
            let _ = nanoseconds(&text);
        }

        #[test]
        fn it_agrees_with_floating_point(value in -1e6_f64..1e6) {
            let nanos = nanoseconds(&format!("{value:e}")).unwrap();
            prop_assert!((nanos as f64 - value * 1e9).abs() <= 1.0);
        }
    }
}
