//! The closed-loop score, in words.

use super::format;
use crate::closed_loop::{ClosedLoop, LoopScore};
use crate::report::Interval;

/// Share of the difference from the recorded score from which an effect is said to close it.
const MOST: f64 = 0.5;
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
    let recorded = number(&closed_loop.recorded);
    let predicted = |row: &LoopScore| row.score.as_ref().map_or("no score".to_owned(), number);
    let without = &closed_loop.refitted;
    let said = match &closed_loop.with_effect {
        None if without.agrees => {
            format!("The task costs {recorded}, and the system without any effect predicts that.")
        }
        None => format!(
            "The task costs {recorded}; the system without any effect predicts {}.",
            predicted(without)
        ),
        Some(with) if without.agrees && with.agrees => format!(
            "The task costs {recorded}, as predicted with the effect and without: it does not tell them apart."
        ),
        Some(with) => {
            let closed = closed_loop.closed.as_ref().map_or(0.0, |closed| closed.value);
            let verdict = if with.agrees {
                "the effect matters for this task"
            } else if without.agrees {
                "for this task the effect makes the prediction worse"
            } else if without.lost > with.lost {
                "the effect matters for this task, and more than it does"
            } else if closed >= MOST {
                "the effect matters for this task, and it is most of what does"
            } else {
                "what matters for this task lies elsewhere"
            };
            let unstable = match without.lost {
                0 => String::new(),
                lost => format!(" ({lost} of {} runs unstable)", without.of),
            };
            format!(
                "The task costs {recorded}; without the effect the simulator predicts {}{unstable}, with it {}: {verdict}.",
                predicted(without),
                predicted(with)
            )
        }
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

/// How the scores were made.
pub(super) fn made(closed_loop: &ClosedLoop) -> String {
    let horizon = format::number(closed_loop.horizon_s, 3);
    let episodes = match closed_loop.episodes {
        1 => format!("one episode of {horizon} s"),
        many => format!("{many} episodes of {horizon} s"),
    };
    format!("mean of {} over {episodes}, each simulated {} times", closed_loop.cost, closed_loop.runs)
}
