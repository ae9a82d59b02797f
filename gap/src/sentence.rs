//! The one sentence on top of a report.

use parallax_model::effect::Effect;

use crate::report::{Report, Value};

/// Where the gap lies, what causes it and how far that closes it, in one sentence.
#[must_use]
pub fn summary(report: &Report) -> String {
    let score = significant(report.gap.score, 2);
    if !report.gap.detected {
        return format!(
            "No gap: after calibration the simulator predicts {} s ahead with an error of {score} times the sensor noise, and no effect improves on that.",
            significant(report.how_far.horizon_s, 2)
        );
    }
    let leader = report.which.iter().find(|w| !w.effects.is_empty());
    let Some((leader, effect)) = leader.and_then(|w| Some((w, w.effects.first()?))) else {
        return format!("There is a gap of {score} times the sensor noise, and no effect could be tested.");
    };
    if report.unexplained.probability > leader.probability {
        return format!(
            "There is a gap of {score} times the sensor noise, and none of the named effects describes it (probability {} %).",
            significant(100.0 * report.unexplained.probability, 2)
        );
    }
    let what = Effect::from_name(&effect.name).map_or("departs from the model", Effect::sentence);
    let parameters: Vec<String> =
        effect.parameters.iter().map(|(name, value)| format!("{name} {}", with_uncertainty(value))).collect();
    let share = significant(100.0 * report.how_far.closed_by_effect.value, 3);
    let unsure = if leader.probability < 0.9 {
        format!(" (probability {} %)", significant(100.0 * leader.probability, 2))
    } else {
        String::new()
    };
    let others = match leader.class.get(1..) {
        Some([other]) => format!("; this data cannot tell it from {other}"),
        Some([_, _, ..]) => format!("; this data cannot tell it from {} others", leader.class.len() - 1),
        _ => String::new(),
    };
    let rest = if report.unexplained.share > 0.1 { "; more remains" } else { "" };
    format!(
        "The gap lies at {}, which {what} ({}, {}){unsure}; adding this closes {share} % of it on held-out time{rest}{others}.",
        effect.place,
        effect.name,
        parameters.join(", ")
    )
}

/// `0.0413 ± 0.0012 s`: as many digits as the deviation supports.
#[must_use]
pub fn with_uncertainty(value: &Value) -> String {
    let unit = if value.unit.is_empty() { String::new() } else { format!(" {}", value.unit) };
    if !(value.std.is_finite() && value.std > 0.0) {
        return format!("{}{unit}", significant(value.value, 4));
    }
    let decimals = (1.0 - value.std.log10().floor()).clamp(0.0, 12.0) as usize;
    format!("{:.decimals$} ± {:.decimals$}{unit}", value.value, value.std)
}

/// A number with this many significant digits, without an exponent where that reads well.
#[must_use]
pub fn significant(value: f64, digits: i32) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let magnitude = value.abs().log10().floor() as i32;
    if !(-5..=6).contains(&magnitude) {
        return format!("{value:.*e}", (digits - 1).max(0) as usize);
    }
    let decimals = (digits - 1 - magnitude).max(0) as usize;
    format!("{value:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!(significant(0.041_3, 2), "0.041");
        assert_eq!(significant(1234.5, 3), "1234");
        assert_eq!(significant(1e-9, 2), "1.0e-9");
        let value = Value { value: 0.041_31, std: 0.001_2, unit: "s".into() };
        assert_eq!(with_uncertainty(&value), "0.0413 ± 0.0012 s");
        let large = Value { value: 203.5, std: 12.0, unit: String::new() };
        assert_eq!(with_uncertainty(&large), "204 ± 12");
    }
}
