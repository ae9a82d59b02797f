//! The one sentence on top of a report.

use parallax_model::effect::Effect;

use super::{FittedEffect, Report, format};

/// Where the gap lies, what causes it and how far that closes it, in one sentence.
#[must_use]
pub fn summary(report: &Report) -> String {
    let found = found(report);
    match report.interrupted {
        Some(_) => format!("Interrupted before everything was tried. So far: {found}"),
        None => found,
    }
}

fn found(report: &Report) -> String {
    let score = format::number(report.gap.score, 3);
    if !report.gap.detected && report.gap.score > OFF {
        return format!(
            "No cause was found: the time that is fitted shows no gap, though after calibration the simulator predicts held-out time {} s ahead with an error of {score} times the sensor noise.",
            format::number(report.how_far.horizon_s, 2)
        );
    }
    if !report.gap.detected {
        return format!(
            "No gap: after calibration the simulator predicts {} s ahead with an error of {score} times the sensor noise, and no effect improves on that.",
            format::number(report.how_far.horizon_s, 2)
        );
    }
    let leader = report.which.iter().find(|w| !w.effects.is_empty());
    let Some(leader) = leader else {
        return format!("There is a gap of {score} times the sensor noise, and no effect could be tested.");
    };
    if report.unexplained.probability > leader.probability {
        if let Some(hint) = &report.unexplained.hint {
            return format!(
                "There is a gap of {score} times the sensor noise, of a cause outside the library: {hint}."
            );
        }
        let nearest: Vec<String> = leader.effects.iter().map(|e| e.label()).collect();
        return format!(
            "There is a gap of {score} times the sensor noise, and none of the named effects describes it (probability {} %); the nearest is {}.",
            format::number(100.0 * report.unexplained.probability, 2),
            nearest.join(" + ")
        );
    }
    let mut places: Vec<&str> = Vec::new();
    for effect in &leader.effects {
        if !places.contains(&effect.place.as_str()) {
            places.push(&effect.place);
        }
    }
    let causes: Vec<String> = places
        .iter()
        .map(|place| {
            let here = leader.effects.iter().filter(|e| e.place == *place);
            if places.len() > FEW {
                return format!("{place} ({})", here.map(|e| e.name.as_str()).collect::<Vec<_>>().join(", "));
            }
            format!("{place}, which {}", here.map(cause).collect::<Vec<_>>().join(" and "))
        })
        .collect();
    let this = if leader.effects.len() > 1 { "these" } else { "this" };
    let closed = report.how_far.closed_by_effect.value;
    let closes = match of_readings(report, &leader.effects) {
        // Readings that come late by chance are late on average, which a prediction can follow.
        _ if closed > 0.0 => {
            format!("adding {this} closes {} % of it on held-out time", format::number(100.0 * closed, 3))
        }
        Some(Some(share)) => format!(
            "no prediction can follow that, and knowing it gives {} % of what a free density gains on held-out readings",
            format::number(100.0 * share, 3)
        ),
        Some(None) => "no prediction can follow that".to_owned(),
        None => format!("but adding {this} closes nothing of it on held-out time"),
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
    let rest = if report.unexplained.share > MUCH {
        "; more remains"
    } else if closed > 0.0 && report.how_far.with_effect < NEAR * report.how_far.noise_floor {
        "; nothing else is needed"
    } else {
        match report.unexplained.innovations.filter(|_| closed > 0.0) {
            Some(left) if left.is_chance() => "; what remains looks like chance",
            Some(_) => "; what remains is not chance",
            None => "",
        }
    };
    let causes = causes.join(if places.len() > FEW { ", " } else { ", and at " });
    format!("The gap lies at {causes}{unsure}; {closes}{rest}{others}.")
}

/// What the effect that gives least gives of the log predictive density of held-out readings, where all only change how readings
/// scatter: with these no error gets smaller. Nothing within where there is nothing to be gained.
fn of_readings(report: &Report, effects: &[FittedEffect]) -> Option<Option<f64>> {
    let shares: Option<Vec<Option<f64>>> = effects
        .iter()
        .map(|effect| {
            let scatters = Effect::from_name(&effect.name).is_some_and(Effect::statistical);
            let found = report.readings.iter().find(|r| r.name == effect.name && r.place == effect.place)?;
            (scatters && effect.place.starts_with("output:")).then_some(found.share)
        })
        .collect();
    Some(shares?.into_iter().flatten().reduce(f64::min))
}

/// Places of which the sentence says what happens there; of more it only names the effects.
const FEW: usize = 3;
/// Error of predictions, in noise units, beyond which they are off whatever is said of the time that is fitted.
const OFF: f64 = 1.5;
/// Share of the gap beyond the best answer from which the sentence says so.
const MUCH: f64 = 0.1;
/// Error of predictions, over the noise floor, below which nothing is left to explain.
const NEAR: f64 = 1.2;

/// `acts late (delay, delay 0.041 ± 0.001 s)`.
fn cause(effect: &FittedEffect) -> String {
    let early =
        effect.name == Effect::Delay.name() && effect.parameters.values().any(|delay| delay.value < 0.0);
    let parameters: Vec<&str> = effect.parameters.keys().map(String::as_str).collect();
    let form = Effect::with_parameters(&effect.name, &parameters);
    let what = match form.or_else(|| Effect::from_name(&effect.name)) {
        Some(_) if early => "acts before its stamp",
        Some(known) => known.sentence(),
        None => "departs from the model",
    };
    let parameters: Vec<String> = effect
        .parameters
        .iter()
        .map(|(name, value)| format!("{name} {}", format::uncertain(value)))
        .collect();
    format!("{what} ({}, {})", effect.name, parameters.join(", "))
}
