//! The columns of a table become clocks and series.

use std::collections::BTreeSet;

use super::clock::{Clock, TimeUnit, is_date, is_day};
use super::header::{self, clean};
use super::{Group, Series};
use crate::recording::ros2msg::distinct;

/// A column as it was read.
#[derive(Debug)]
pub(super) struct Column {
    /// Its header.
    pub(super) header: String,
    /// The header without the unit.
    pub(super) name: String,
    pub(super) unit: String,
    pub(super) cells: Cells,
}

#[derive(Debug)]
pub(super) enum Cells {
    /// NaN where there is none.
    Numbers(Vec<f64>),
    /// As they are written; empty where there is none. Only of what may be a time.
    Texts(Vec<Box<str>>),
    /// Stamps that are known to be such.
    Clock(Clock),
}

/// Whether a column may be a time: by its name, or by its first cell.
pub(super) fn may_be_time(name: &str, first: &str) -> bool {
    header::is_time(name) || is_date(first) || is_day(first)
}

/// The group that the columns of a table are. Each series goes by the nearest clock to its left, or by the first one.
pub(super) fn group(columns: Vec<Column>, first_line: usize, rows: usize, notes: &mut Vec<String>) -> Group {
    let mut clocks: Vec<(usize, Clock)> = Vec::new();
    let mut series: Vec<(usize, Series)> = Vec::new();
    let mut taken = BTreeSet::new();
    for (index, column) in joined(columns).into_iter().enumerate() {
        let Column { header, name, unit, cells } = column;
        let values = match cells {
            Cells::Clock(clock) => {
                clocks.push((index, clock));
                continue;
            }
            Cells::Numbers(values) => values,
            Cells::Texts(texts) => {
                let numbers: Option<Vec<f64>> = texts
                    .iter()
                    .map(|text| if text.is_empty() { Some(f64::NAN) } else { text.parse().ok() })
                    .collect();
                match (Clock::of_texts(&header, header::time_unit(&header), texts), numbers) {
                    (Some(clock), _) => {
                        clocks.push((index, clock));
                        continue;
                    }
                    (None, Some(numbers)) => numbers,
                    (None, None) => {
                        notes.push(format!(
                            "column `{header}` holds text, or dates that can be read in several ways"
                        ));
                        continue;
                    }
                }
            }
        };
        if values.iter().all(|value| value.is_nan()) {
            notes.push(format!("column `{header}` has no values"));
            continue;
        }
        let name = distinct(clean(&name), &mut taken);
        series.push((index, Series { name, column: header, unit, values, clock: 0, role: None }));
    }
    for (index, series) in &mut series {
        series.clock = clocks.iter().rposition(|(at, _)| at < index).unwrap_or(0);
    }
    Group {
        name: String::new(),
        kind: String::new(),
        clocks: clocks.into_iter().map(|(_, clock)| clock).collect(),
        series: series.into_iter().map(|(_, series)| series).collect(),
        rows,
        first_line,
    }
}

/// Seconds and nanoseconds in two columns are one time, and so are a day and a time of day.
fn joined(columns: Vec<Column>) -> Vec<Column> {
    let mut joined: Vec<Column> = Vec::with_capacity(columns.len());
    for column in columns {
        if let Some(before) = joined.last_mut().filter(|before| belong(before, &column))
            && let (Cells::Texts(above), Cells::Texts(below)) = (&mut before.cells, &column.cells)
        {
            let nanoseconds = is_nanoseconds(&column.header);
            for (text, tail) in above.iter_mut().zip(below) {
                *text = match (text.is_empty() || tail.is_empty(), nanoseconds) {
                    (true, _) => "".into(),
                    (false, true) => format!("{text}.{tail:0>9}").into(),
                    (false, false) => format!("{text} {tail}").into(),
                };
            }
            before.header = format!("{} + {}", before.header, column.header);
            if nanoseconds {
                let texts = std::mem::take(above);
                before.cells = match Clock::of_texts(&before.header, Some(TimeUnit::S), texts.clone()) {
                    Some(clock) => Cells::Clock(clock),
                    None => Cells::Texts(texts),
                };
            }
            continue;
        }
        joined.push(column);
    }
    joined
}

fn is_nanoseconds(header: &str) -> bool {
    matches!(
        header::words(header).last().map(String::as_str),
        Some("nsec" | "nsecs" | "nanosec" | "nanosecs")
    )
}

fn belong(above: &Column, below: &Column) -> bool {
    let (Cells::Texts(upper), Cells::Texts(lower)) = (&above.cells, &below.cells) else { return false };
    let first = |texts: &[Box<str>]| texts.iter().find(|text| !text.is_empty()).cloned().unwrap_or_default();
    let (words, tail) = (header::words(&above.header), header::words(&below.header));
    let seconds = matches!(words.last().map(String::as_str), Some("sec" | "secs"));
    let same = words.len() == tail.len()
        && words[..words.len().saturating_sub(1)] == tail[..tail.len().saturating_sub(1)];
    let whole = |texts: &[Box<str>]| texts.iter().all(|text| text.bytes().all(|byte| byte.is_ascii_digit()));
    if seconds && same && is_nanoseconds(&below.header) {
        return whole(upper) && whole(lower) && lower.iter().all(|text| text.len() <= 9);
    }
    is_day(&first(upper)) && is_date(&first(lower)) && !is_day(&first(lower))
}
