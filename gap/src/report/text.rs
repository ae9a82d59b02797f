//! The short answer for a terminal.

use super::answer::{Answer, answers};
use super::{Calibration, Interrupted, Report, bars, format, recorded};

/// Widest line.
const COLUMNS: usize = 100;
/// What an interrupted diagnosis left out is named up to so many.
const NOT_TRIED: usize = 8;
/// Where the second column begins.
const INDENT: usize = 15;

/// Says in some twenty lines of at most 100 columns what a diagnosis found; ends with a line break.
#[must_use]
pub fn summary(report: &Report) -> String {
    let mut lines = Lines(format::wrap(&report.summary, COLUMNS));
    lines.0.push(String::new());
    interrupted(&mut lines, report);
    gap(&mut lines, report);
    for (i, place) in report.where_.iter().take(3).enumerate() {
        let text = format!(
            "{:>7}  {}, best effect there closes {}",
            format::probability(place.probability),
            place.place,
            format::share(place.share)
        );
        lines.put(if i == 0 { "where" } else { "" }, 9, &text);
    }
    let mut before = "";
    for (label, text) in recorded::lines(report) {
        lines.put(if label == before { "" } else { label }, 2, &text);
        before = label;
    }
    which(&mut lines, report);
    how_far(&mut lines, report);
    closed_loop(&mut lines, report);
    calibration(&mut lines, report);
    let unexplained = &report.unexplained;
    let text = format!(
        "{} that no named effect is the cause; {} of the gap remains beyond the best one",
        format::probability(unexplained.probability),
        format::share(unexplained.share)
    );
    let text = if report.tried_the_unknown() { text } else { "not tried".into() };
    lines.put("unexplained", 0, &text);
    if let Some(hint) = &unexplained.hint {
        lines.put("", 2, hint);
    }
    if let Some(innovations) = &unexplained.innovations {
        lines.put("", 2, &format!("what the best one leaves {}", format::innovations(innovations)));
    }
    for (i, confusable) in report.confusable.iter().take(3).enumerate() {
        let text = format!("{}: {}", confusable.effects.join(" or "), confusable.separate_by);
        lines.put(if i == 0 { "to separate" } else { "" }, 2, &text);
    }
    if report.confusable.len() > 3 {
        lines.put("", 0, &format!("and {} more in the report", report.confusable.len() - 3));
    }
    if let Some(path) = &report.corrected_system {
        lines.put("corrected", 0, path);
    }
    lines.0.iter().map(|line| format!("{}\n", line.trim_end())).collect()
}

/// Lines with a label in the first column.
struct Lines(Vec<String>);

impl Lines {
    /// Adds text in the second column; what does not fit follows below, `hang` columns further in.
    fn put(&mut self, label: &str, hang: usize, text: &str) {
        // Wrapping joins words by single spaces; what stands before the first word is kept.
        let start = text.len() - text.trim_start().len();
        let wrapped = format::wrap(text, COLUMNS - INDENT - hang.max(start));
        for (i, line) in wrapped.iter().enumerate() {
            let (label, inner) = if i == 0 { (label, start) } else { ("", hang) };
            self.0.push(format!("{label:INDENT$}{:inner$}{line}", ""));
        }
    }
}

fn interrupted(lines: &mut Lines, report: &Report) {
    let Some(Interrupted { not_tried }) = &report.interrupted else { return };
    let more = match not_tried.len().saturating_sub(NOT_TRIED) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    let named = not_tried.iter().take(NOT_TRIED).cloned().collect::<Vec<_>>().join(", ");
    lines.put("not tried", 0, &format!("{named}{more}; probabilities are among what was tried"));
}

fn gap(lines: &mut Lines, report: &Report) {
    let gap = &report.gap;
    let found = if gap.detected { "detected" } else { "none detected" };
    let score = format::number(gap.score, 3);
    let text = format!("{found} ({}), {score} noise units after calibration", format::p_value(gap.p_value));
    lines.put("gap", 0, &text);
    if let Some(rests) = report.rests_s {
        lines.put("at rest", 0, &format::rests(rests));
    }
}

fn which(lines: &mut Lines, report: &Report) {
    let answers = answers(report);
    let shown = |answer: &Answer<'_>| answer.probability >= 0.0005;
    let mut label = "which";
    for (i, answer) in answers.iter().enumerate().filter(|(i, answer)| *i == 0 || (*i < 4 && shown(answer))) {
        let name = answer.name();
        let parameters = answer.parameters();
        let comma = if parameters.is_empty() { "" } else { ": " };
        let text =
            format!("{:>7}  {name}{comma}{}", format::probability(answer.probability), parameters.join(", "));
        lines.put(label, 9, &text);
        if i == 0 && !answer.alike.is_empty() {
            lines.put("", 9, &format!("{:9}alike in this data: {}", "", answer.alike.join(", ")));
        }
        label = "";
    }
}

fn how_far(lines: &mut Lines, report: &Report) {
    let how_far = &report.how_far;
    let horizon = format::number(how_far.horizon_s, 3);
    lines.put("how far", 0, &format!("RMS error {horizon} s ahead on held-out time, in noise units:"));
    let rows = bars::rows(how_far).map(|(name, value, _)| format!("{name} {}", format::number(value, 3)));
    lines.put("", 2, &format!("  {}", rows.join(" | ")));
    let closed = |interval| match format::interval(interval) {
        (value, Some(ends)) => format!("{value} ({ends})"),
        (value, None) => value,
    };
    let mut text = format!("  closed {} in all", closed(&how_far.closed_total));
    if how_far.closed_by_effect.value.is_finite() {
        text.push_str(&format!(", {} by the effect", closed(&how_far.closed_by_effect)));
    }
    lines.put("", 2, &text);
    if !how_far.split.is_empty() {
        let parts: Vec<String> = how_far
            .split
            .iter()
            .map(|part| format!("{} {}", part.effect, format::share(part.share)))
            .collect();
        lines.put("", 2, &format!("  of that {}", parts.join(", ")));
    }
}

fn closed_loop(lines: &mut Lines, report: &Report) {
    let Some(scores) = &report.closed_loop else { return };
    lines.put("closed loop", 0, &super::closed_loop::sentence(scores));
    let rows = super::closed_loop::rows(scores);
    let width = rows.iter().map(|(_, score, _)| score.chars().count()).max().unwrap_or(0);
    for (name, score, remark) in rows {
        lines.0.push(format!("{:INDENT$}  {name:9} {score:width$}  {remark}", ""));
    }
    lines.put("", 2, &format!("  {}", super::closed_loop::made(scores)));
}

/// Parameters that moved first; the rest as far as six lines go.
fn calibration(lines: &mut Lines, report: &Report) {
    let mut rows: Vec<&Calibration> = report.calibration.iter().collect();
    rows.sort_by_key(|row| !row.significant);
    let width = rows.iter().take(6).map(|row| row.name.chars().count()).max().unwrap_or(0);
    for (i, row) in rows.iter().take(6).enumerate() {
        let text = format!(
            "{:width$}  {} -> {}{}{}{}",
            row.name,
            format::number(row.nominal, 5),
            format::plus_minus(row.value, row.std),
            format::unit(&row.unit),
            if row.significant { "  moved" } else { "" },
            if row.at_bound { ", at its bound: widen `calibrate`?" } else { "" }
        );
        lines.0.push(format!(
            "{:INDENT$}{}",
            if i == 0 { "calibration" } else { "" },
            format::clip(&text, 85)
        ));
    }
    if rows.len() > 6 {
        lines.put("", 0, &format!("and {} more in the report", rows.len() - 6));
    }
}
