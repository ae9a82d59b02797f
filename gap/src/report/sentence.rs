//! The one sentence on top of a report.

use parallax_model::effect::Effect;

use super::{Report, format};

/// Where the gap lies, what causes it and how far that closes it, in one sentence.
#[must_use]
pub fn summary(report: &Report) -> String {
    let score = format::number(report.gap.score, 3);
    if !report.gap.detected {
        return format!(
            "No gap: after calibration the simulator predicts {} s ahead with an error of {score} times the sensor noise, and no effect improves on that.",
            format::number(report.how_far.horizon_s, 2)
        );
    }
    let leader = report.which.iter().find(|w| !w.effects.is_empty());
    let Some((leader, effect)) = leader.and_then(|w| Some((w, w.effects.first()?))) else {
        return format!("There is a gap of {score} times the sensor noise, and no effect could be tested.");
    };
    if report.unexplained.probability > leader.probability {
        return format!(
            "There is a gap of {score} times the sensor noise, and none of the named effects describes it (probability {} %).",
            format::number(100.0 * report.unexplained.probability, 2)
        );
    }
    let what = Effect::from_name(&effect.name).map_or("departs from the model", Effect::sentence);
    let parameters: Vec<String> = effect
        .parameters
        .iter()
        .map(|(name, value)| format!("{name} {}", format::uncertain(value)))
        .collect();
    let closed = report.how_far.closed_by_effect.value;
    let closes = if closed > 0.0 {
        format!("adding this closes {} % of it on held-out time", format::number(100.0 * closed, 3))
    } else {
        "but adding this closes nothing of it on held-out time".to_owned()
    };
    let unsure = if leader.probability < 0.9 {
        format!(" (probability {} %)", format::number(100.0 * leader.probability, 2))
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
        "The gap lies at {}, which {what} ({}, {}){unsure}; {closes}{rest}{others}.",
        effect.place,
        effect.name,
        parameters.join(", ")
    )
}
