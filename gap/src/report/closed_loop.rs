//! The closed-loop score, in words.

use super::format;
use crate::closed_loop::{ClosedLoop, LoopScore};
use crate::report::Interval;

/// Share of the difference from the recorded score from which an effect is said to close it.
const MOST: f64 = 0.5;
/// Share of the recorded score by which a prediction may miss it without being wrong in practice.
const LITTLE: f64 = 0.02;
/// How far a controller may miss the recorded commands, over their deviation, before its scores are doubted.
const MISSES: f64 = 0.1;

/// The rows of the table: name, score and what is said of it.
pub(super) fn rows(closed_loop: &ClosedLoop) -> Vec<(&'static str, String, String)> {
    let mut rows = vec![("recorded", score(&closed_loop.recorded), String::new())];
    let simulated = [
        ("nominal", Some(&closed_loop.nominal)),
        ("refitted", Some(&closed_loop.refitted)),
        ("+ effect", closed_loop.with_effect.as_ref()),
    ];
    for (name, row) in simulated {
        let Some(row) = row else { continue };
        let value = row.score.as_ref().map_or_else(|| format::UNKNOWN.to_owned(), score);
        rows.push((name, value, remark(row, &closed_loop.recorded)));
    }
    rows
}

/// `0.0121 (0.0115 to 0.0127)`.
fn score(interval: &Interval) -> String {
    let digits = digits(interval);
    let text = |value: f64| format::number(value, digits);
    if interval.low == interval.high {
        return text(interval.value);
    }
    format!("{} ({} to {})", text(interval.value), text(interval.low), text(interval.high))
}

/// As many digits as the interval's width leaves, from three to five.
fn digits(interval: &Interval) -> i32 {
    let width = interval.high - interval.low;
    if width > 0.0 && interval.value != 0.0 {
        (format::exponent(interval.value.abs()) - format::exponent(width) + 2).clamp(3, 5)
    } else {
        3
    }
}

/// `-12 % (-19 to -6 %)` of the recorded score, and what was lost.
fn remark(row: &LoopScore, recorded: &Interval) -> String {
    let lost = match row.lost {
        0 => String::new(),
        lost if lost == row.of => return format!("unstable: all {lost} runs left all bounds"),
        lost => format!("unstable: {lost} of {} runs left all bounds; the others ", row.of),
    };
    let Some(Interval { value, low, high }) = &row.difference else { return lost };
    let size = recorded.value.abs().max(1e-300);
    let share = Interval { value: value / size, low: low / size, high: high / size };
    let (value, ends) = format::interval(&share);
    format!("{lost}{value}{}", ends.map_or(String::new(), |ends| format!(" ({ends})")))
}

/// What the scores say of the effect, in a sentence or two.
pub(super) fn sentence(closed_loop: &ClosedLoop) -> String {
    let unit = format::unit(&closed_loop.unit);
    let number = |interval: &Interval| format!("{}{unit}", format::number(interval.value, 3));
    let predicted = |row: &LoopScore| match (&row.score, row.lost) {
        (None, _) => "nothing: every run is unstable".to_owned(),
        (Some(score), 0) => number(score),
        (Some(score), lost) => format!("{} ({lost} of {} runs unstable)", number(score), row.of),
    };
    let recorded = number(&closed_loop.recorded);
    let without = &closed_loop.refitted;
    let said = match &closed_loop.with_effect {
        None => {
            let verdict = if without.agrees { ", as recorded" } else { "" };
            format!(
                "The task costs {recorded}; the simulator, which has no effect added, predicts {}{verdict}.",
                predicted(without)
            )
        }
        Some(with) => format!(
            "The task costs {recorded}; the simulator predicts {} without the effect and {} with it: {}.",
            predicted(without),
            predicted(with),
            verdict(closed_loop, with)
        ),
    };
    match closed_loop.miss {
        Some(miss) if miss > MISSES => format!(
            "{said} The controller of the task file misses the recorded commands by {} of their deviation on the recorded \
             readings: it may not be the one that ran.",
            format::share(miss)
        ),
        _ => said,
    }
}

/// Whether the effect matters for the task.
fn verdict(closed_loop: &ClosedLoop, with: &LoopScore) -> &'static str {
    let without = &closed_loop.refitted;
    let closed = closed_loop.closed.as_ref();
    let near = |row: &LoopScore| {
        let little = LITTLE * closed_loop.recorded.value.abs();
        row.lost == 0 && row.difference.as_ref().is_some_and(|difference| difference.value.abs() <= little)
    };
    if near(without) && near(with) {
        "it hardly matters for this task"
    } else if without.lost > with.lost {
        "the effect matters for this task"
    } else if with.lost > without.lost {
        "with the effect the simulated loop is less stable than the recorded one"
    } else if without.agrees && with.agrees && closed.is_none_or(|closed| closed.low < MOST) {
        "these scores do not tell whether it matters for this task"
    } else if with.agrees || near(with) {
        "the effect matters for this task"
    } else if closed.is_some_and(|closed| closed.value >= MOST) {
        "the effect matters for this task, and is most of what does"
    } else if without.agrees {
        "for this task it makes the prediction worse"
    } else {
        "what matters for this task lies elsewhere"
    }
}

/// How the scores were made.
pub(super) fn made(closed_loop: &ClosedLoop) -> String {
    let horizon = format::number(closed_loop.horizon_s, 3);
    let episodes = match closed_loop.episodes {
        1 => format!("one episode of {horizon} s"),
        many => format!("{many} episodes of {horizon} s"),
    };
    format!("mean of {} over {episodes}, each simulated {} times", closed_loop.cost, closed_loop.runs)
}
