//! Bars: errors of prediction on a logarithmic scale, and shares between nothing and everything.

use super::HowFar;
use super::draw::{self, Anchor, Pen};
use super::format;

/// The rows of the table of errors, by name, with the class of their bars.
pub(super) fn rows(how_far: &HowFar) -> [(&'static str, f64, &'static str); 5] {
    [
        ("nominal", how_far.nominal, "bar-plain"),
        ("refitted", how_far.refitted, "bar-before"),
        ("+ effect", how_far.with_effect, "bar-after"),
        ("+ black box", how_far.black_box, "bar-plain"),
        ("noise floor", how_far.noise_floor, "bar-plain"),
    ]
}

/// Height of the picture that `how_far` draws (px).
pub(super) const HOW_FAR_HEIGHT: f64 = 5.0 * ROW + 38.0;
const ROW: f64 = 24.0;

/// Draws the errors as bars that start at the noise floor: their lengths are the factors by which it is exceeded.
pub(super) fn how_far(pen: &mut Pen, how_far: &HowFar, corner: (f64, f64), width: f64) {
    let rows = rows(how_far);
    let usable = |value: f64| value.is_finite() && value > 1e-280 && value < 1e280;
    let known: Vec<f64> = rows.iter().map(|row| row.1).filter(|v| usable(*v)).collect();
    let least = known.iter().copied().fold(f64::INFINITY, f64::min);
    let most = known.iter().copied().fold(0.0, f64::max);
    let floor = if usable(how_far.noise_floor) { how_far.noise_floor } else { least };
    let (left, right) = (corner.0 + 82.0, corner.0 + width - 52.0);
    // One empty decade around equal numbers, so that a bar always has a scale.
    let (low, high) =
        if known.is_empty() { (0.1, 10.0) } else { (least / 1.25, (most * 1.1).max(least * 3.0)) };
    let x = |value: f64| {
        left + (right - left) * ((value.ln() - low.ln()) / (high.ln() - low.ln())).clamp(0.0, 1.0)
    };
    let bottom = corner.1 + 5.0 * ROW;
    for tick in decades(low, high, right - left) {
        pen.line("grid", (x(tick), corner.1), (x(tick), bottom));
        let power = high / low >= 3e4;
        let label =
            if power { format::power_of_ten(format::exponent(tick)) } else { format::number(tick, 2) };
        let label = draw::typeset(&label);
        pen.text("tick", (x(tick), bottom + 14.0), Anchor::Middle, &label);
    }
    for (i, (name, value, class)) in rows.into_iter().enumerate() {
        let y = corner.1 + ROW * (i as f64 + 0.5);
        let weight = if class == "bar-after" { "strong" } else { "plain" };
        pen.text(weight, (left - 8.0, y + 4.0), Anchor::End, name);
        let end = if usable(value) { x(value) } else { left };
        if usable(value) {
            let from = x(floor);
            pen.rect(class, (from.min(end), y - 6.0), ((end - from).abs(), 12.0));
            if name == "noise floor" {
                pen.dot(class, (end, y), 4.0);
            }
        }
        let end = if usable(value) { end.max(x(floor)) } else { end };
        let text = draw::typeset(&format::number(value, 3));
        pen.text(weight, (end + 7.0, y + 4.0), Anchor::Start, &text);
    }
    if !known.is_empty() {
        pen.line("floor", (x(floor), corner.1), (x(floor), bottom));
    }
    let unit = "root mean square error (noise units, log scale)";
    let unit = if draw::width(unit, 11.0) > width - 90.0 { "RMS (noise units, log)" } else { unit };
    pen.text("tick", (right, bottom + 30.0), Anchor::End, unit);
}

/// Ticks of a logarithmic axis so many pixels wide: 1, 2, 5 where there is room, else 1 and 3, else powers of ten
/// some decades apart.
fn decades(low: f64, high: f64, width: f64) -> Vec<f64> {
    let decade = width / (high.log10() - low.log10());
    // A label needs some 30 px; the closest pair of ticks decides.
    let few = high / low < 3e4;
    let (mantissas, apart): (&[f64], i32) = match decade {
        decade if few && decade * 2f64.log10() > 26.0 => (&[1.0, 2.0, 5.0], 1),
        decade if few && decade * 3f64.log10() > 26.0 => (&[1.0, 3.0], 1),
        decade => (&[1.0], (36.0 / decade).ceil() as i32),
    };
    (format::exponent(low)..=format::exponent(high))
        .filter(|exponent| exponent.rem_euclid(apart) == 0)
        .flat_map(|exponent| mantissas.iter().map(move |m| m * 10f64.powi(exponent)))
        .filter(|tick| (low..=high).contains(tick))
        .collect()
}

/// A bar of a share as an element that fills the width it is given, for use in tables; with a whisker where the
/// share has an interval.
pub(super) fn share(share: f64, class: &str, whisker: Option<(f64, f64)>) -> String {
    let part = |share: f64| draw::px(if share.is_finite() { (share * 100.0).clamp(0.0, 100.0) } else { 0.0 });
    let mut bar = format!(
        "<svg class=\"share\" width=\"100%\" height=\"12\" aria-hidden=\"true\"><rect class=\"bar-track\" \
         width=\"100%\" height=\"8\" y=\"2\" rx=\"1\"/><rect class=\"{class}\" width=\"{}%\" height=\"8\" y=\"2\" \
         rx=\"1\"/>",
        part(share)
    );
    if let Some((low, high)) = whisker.filter(|(low, high)| low.is_finite() && high.is_finite()) {
        let (low, high) = (part(low), part(high));
        bar.push_str(&format!("<line class=\"axis\" x1=\"{low}%\" x2=\"{high}%\" y1=\"6\" y2=\"6\"/>"));
        for end in [low, high] {
            bar.push_str(&format!("<line class=\"axis\" x1=\"{end}%\" x2=\"{end}%\" y1=\"1\" y2=\"11\"/>"));
        }
    }
    bar.push_str("</svg>");
    bar
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithmic_ticks_fit_their_room() {
        assert_eq!(decades(0.8, 16.0, 200.0), [1.0, 2.0, 5.0, 10.0]);
        assert_eq!(decades(0.8, 160.0, 140.0), [1.0, 3.0, 10.0, 30.0, 100.0]);
        assert_eq!(decades(0.8, 3e6, 160.0), [1.0, 100.0, 1e4, 1e6]);
        assert!((2..=10).contains(&decades(1e-270, 1e270, 300.0).len()));
    }
}
