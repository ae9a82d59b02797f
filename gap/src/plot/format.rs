//! Numbers and words as people read them: digits by uncertainty, shares in per cent, lines of a given width.

/// Shown where a number is missing or cannot be given.
pub const UNKNOWN: &str = "–";

/// A power of ten as it is written after a mantissa: `×10⁻⁶`.
fn power(exponent: i32) -> String {
    format!("×{}", power_of_ten(exponent))
}

/// `10⁻⁶`.
pub fn power_of_ten(exponent: i32) -> String {
    let digits = exponent.to_string();
    let superscript = digits.chars().map(|digit| match digit {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32(0x2070 + digit.to_digit(10).unwrap_or(0)).unwrap_or(digit),
    });
    format!("10{}", superscript.collect::<String>())
}

/// The exponent of a number's leading digit; 0 for zero and for what is not finite.
pub fn exponent(value: f64) -> i32 {
    if value == 0.0 || !value.is_finite() {
        return 0;
    }
    // Formatting is exact where a logarithm may fall on the wrong side of a power of ten.
    let text = format!("{value:e}");
    text.split_once('e').and_then(|(_, exponent)| exponent.parse().ok()).unwrap_or(0)
}

/// Rounds to `decimals` places after the point, which may be negative, and writes exactly these.
pub fn fixed(value: f64, decimals: i32) -> String {
    let value = if decimals < 0 {
        let unit = 10f64.powi(-decimals);
        (value / unit).round() * unit
    } else {
        value
    };
    let text = format!("{value:.*}", usize::try_from(decimals.clamp(0, 15)).unwrap_or(0));
    // A small negative number rounds to "-0.00"; the sign would say something that the digits do not.
    match text.strip_prefix('-') {
        Some(digits) if digits.chars().all(|c| matches!(c, '0' | '.')) => digits.to_owned(),
        _ => text,
    }
}

/// A number to so many significant digits, without trailing zeros.
pub fn number(value: f64, digits: i32) -> String {
    if value.is_nan() {
        return UNKNOWN.to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { "∞" } else { "-∞" }.to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let text = format!("{value:.*e}", usize::try_from(digits - 1).unwrap_or(0));
    let (mantissa, exponent) = text.split_once('e').unwrap_or((&text, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if (-4..6).contains(&exponent) {
        let decimals = digits - 1 - exponent;
        return trimmed(&fixed(value, decimals));
    }
    match trimmed(mantissa).as_str() {
        "1" => power_of_ten(exponent),
        "-1" => format!("-{}", power_of_ten(exponent)),
        mantissa => format!("{mantissa}{}", power(exponent)),
    }
}

fn trimmed(text: &str) -> String {
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text.to_owned()
    }
}

/// A unit with the space before it; nothing for a pure number.
pub fn unit(unit: &str) -> String {
    match unit.trim() {
        "" | "1" => String::new(),
        unit => format!(" {unit}"),
    }
}

/// `0.0410 ± 0.0012`: the uncertainty to one significant digit (two where the first is 1), the value to the same
/// place.
pub fn plus_minus(value: f64, std: f64) -> String {
    if !(value.is_finite() && std.is_finite() && std > 0.0) {
        return number(value, 4);
    }
    let mut place = exponent(std);
    if std / 10f64.powi(place) < 1.95 {
        place -= 1;
    }
    let top = exponent(value).max(exponent(std));
    let top = if value == 0.0 { exponent(std) } else { top };
    if top - place > 9 {
        return format!("{} ± {}", number(value, 9), number(std, 2));
    }
    if (-3..6).contains(&top) {
        return format!("{} ± {}", fixed(value, -place), fixed(std, -place));
    }
    // Numbers near the ends of the range overflow a single factor of ten.
    let scale = |x: f64| x / 10f64.powi(top / 2) / 10f64.powi(top - top / 2);
    format!("({} ± {}){}", fixed(scale(value), top - place), fixed(scale(std), top - place), power(top))
}

/// A probability in per cent; never exactly 0 or 100, which no data proves.
pub fn probability(p: f64) -> String {
    match p {
        p if !p.is_finite() => UNKNOWN.to_owned(),
        p if p >= 0.9995 => ">99.9 %".to_owned(),
        p if p < 0.0005 => "<0.1 %".to_owned(),
        p if !(0.0095..=0.9905).contains(&p) => format!("{} %", fixed(p * 100.0, 1)),
        p => format!("{} %", fixed(p * 100.0, 0)),
    }
}

/// A share in per cent, which may be negative.
pub fn share(share: f64) -> String {
    if !share.is_finite() {
        return UNKNOWN.to_owned();
    }
    let percent = share * 100.0;
    if percent.abs() >= 1e4 {
        return format!("{} %", number(percent, 2));
    }
    let decimals = i32::from(percent.abs() < 9.95 || (percent > 90.0 && percent < 99.95));
    format!("{} %", trimmed(&fixed(percent, decimals)))
}

/// `p = 0.03`, `p = 10⁻¹²`, `p < 10⁻³⁰⁰`.
pub fn p_value(p: f64) -> String {
    match p {
        p if !p.is_finite() => "p not known".to_owned(),
        p if p < 1e-300 => format!("p < {}", power_of_ten(-300)),
        p if p < 1e-3 => format!("p = {}", number(p, 1)),
        p => format!("p = {}", number(p, 2)),
    }
}

/// Breaks text into lines of at most `columns` characters, at spaces; a longer word has a line of its own.
pub fn wrap(text: &str, columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Cuts text to `columns` characters, with an ellipsis where something is left out.
pub fn clip(text: &str, columns: usize) -> String {
    if text.chars().count() <= columns {
        return text.to_owned();
    }
    let kept: String = text.chars().take(columns.saturating_sub(1)).collect();
    format!("{}…", kept.trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_carry_the_digits_asked_for() {
        assert_eq!(number(0.0, 3), "0");
        assert_eq!(number(14.2, 3), "14.2");
        assert_eq!(number(1.0, 3), "1");
        assert_eq!(number(-0.012_345, 3), "-0.0123");
        assert_eq!(number(9.999, 3), "10");
        assert_eq!(number(123_456.0, 3), "123000");
        assert_eq!(number(1.5e8, 3), "1.5×10⁸");
        assert_eq!(number(1e-12, 1), "10⁻¹²");
        assert_eq!(number(f64::NAN, 3), UNKNOWN);
        assert_eq!(number(f64::NEG_INFINITY, 3), "-∞");
        assert_eq!(number(1e308, 3), "10³⁰⁸");
    }

    #[test]
    fn probabilities_are_never_certain() {
        assert_eq!(probability(1.0), ">99.9 %");
        assert_eq!(probability(0.0), "<0.1 %");
        assert_eq!(probability(0.97), "97 %");
        assert_eq!(probability(0.996), "99.6 %");
        assert_eq!(probability(0.004), "0.4 %");
        assert_eq!(probability(f64::NAN), UNKNOWN);
    }

    #[test]
    fn p_values_say_when_they_are_too_small_to_write() {
        assert_eq!(p_value(0.034), "p = 0.034");
        assert_eq!(p_value(1e-12), "p = 10⁻¹²");
        assert_eq!(p_value(0.0), "p < 10⁻³⁰⁰");
    }

    #[test]
    fn lines_are_wrapped_at_spaces() {
        assert_eq!(wrap("one two three", 7), ["one two", "three"]);
        assert_eq!(wrap("", 7), Vec::<String>::new());
        assert_eq!(clip("friction", 5), "fric…");
    }
}
