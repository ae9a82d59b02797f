//! What was chosen becomes a log.

use std::collections::BTreeSet;

use parallax_model::system::Suggestion;

use super::plan::{Choice, Plan};
use super::units::{alternatives, conversion};
use super::{Clock, Conversion, ForeignError, Found, Group, Series, TimeUnit};
use crate::recording::log::{Log, Signal, Source};

/// Rows that lie before what came earlier: more of them in a row are no messages that overtook each other.
const OVERTAKEN: usize = 20;

/// Times beyond this, in nanoseconds, count from somewhere that means nothing in a log.
const FAR: i64 = 1_000_000_000_000_000;

/// A log, and what was done to what it was made of.
#[derive(Clone, Debug, PartialEq)]
pub struct Converted {
    /// The log; its [notes](Log::notes) say what was left out.
    pub log: Log,
    /// What time 0 of the log is in the times of the source, in nanoseconds; 0 where times stay as they are.
    pub origin: i64,
    /// For each signal of the log, what was done to its values; empty where that is nothing.
    pub changed: Vec<String>,
}

/// Makes the log that `plan` asks for.
///
/// # Errors
///
/// [`ForeignError`]: a name that nothing has, a time that cannot be understood, values that cannot be converted.
pub fn convert(found: &[Found], plan: &Plan) -> Result<Converted, ForeignError> {
    if plan.choices.is_empty() {
        return Err(ForeignError::NothingChosen);
    }
    let (mut names, mut sources) = (BTreeSet::new(), BTreeSet::new());
    let mut log = Log { title: plan.title.clone(), ..Log::default() };
    let mut changed = Vec::with_capacity(plan.choices.len());
    for choice in &plan.choices {
        if !names.insert(&choice.name) || !sources.insert(&choice.series) {
            return Err(ForeignError::Twice { name: choice.name.clone() });
        }
        let (file, group, series) = find(found, &choice.series)?;
        let stamps = stamps(file, group, series, plan)?;
        let (Conversion { factor, offset }, unit) = convert_unit(choice, series)?;
        let rows = rows(plan, group.rows);
        let samples = rows.filter(|row| !series.values[*row].is_nan()).filter_map(|row| {
            Some((Some(stamps[row]?), series.values[row] * choice.scale * factor + offset))
        });
        let signal = Signal {
            name: choice.name.clone(),
            role: choice.role,
            unit,
            times: vec![],
            values: vec![],
            source: Source {
                file: file.path.display().to_string(),
                column: if group.name.is_empty() {
                    series.column.clone()
                } else {
                    format!("{} {}", group.name, series.column).trim_end().to_owned()
                },
            },
        };
        log.add(signal, samples);
        if log.signals.last().is_none_or(|signal| signal.values.is_empty()) {
            return Err(ForeignError::NoValues { name: choice.name.clone() });
        }
        changed.push(what_changed(choice.scale * factor, offset));
    }
    let origin = log.span().map_or(0, |(first, _)| if first.abs() > FAR { first } else { 0 });
    for signal in &mut log.signals {
        for time in &mut signal.times {
            *time -= origin;
        }
    }
    Ok(Converted { log, origin, changed })
}

fn what_changed(factor: f64, offset: f64) -> String {
    match (factor == 1.0, offset == 0.0) {
        (true, true) => String::new(),
        (false, true) => format!("times {factor}"),
        (true, false) => format!("plus {offset}"),
        (false, false) => format!("times {factor}, plus {offset}"),
    }
}

/// The series of this name, or of this column where only one has it.
///
/// # Errors
///
/// [`ForeignError::UnknownSeries`], with the names there are.
pub fn series<'a>(found: &'a [Found], name: &str) -> Result<&'a Series, ForeignError> {
    find(found, name).map(|(_, _, series)| series)
}

fn find<'a>(found: &'a [Found], name: &str) -> Result<(&'a Found, &'a Group, &'a Series), ForeignError> {
    let all =
        || found.iter().flat_map(|file| file.series().map(move |(group, series)| (file, group, series)));
    // A column may be named as the file has it, too, if it is the only one.
    let by_column: Vec<_> = all().filter(|(_, _, series)| series.column == name).collect();
    all()
        .find(|(_, _, series)| series.name == name)
        .or(match by_column.as_slice() {
            [only] => Some(*only),
            _ => None,
        })
        .ok_or_else(|| ForeignError::UnknownSeries {
            name: name.into(),
            suggestion: Suggestion::nearest(name, all().map(|(_, _, series)| series.name.as_str())),
            available: some(&all().map(|(_, _, series)| series.name.as_str()).collect::<Vec<_>>()),
        })
}

/// Names, as many as a person reads.
fn some(names: &[&str]) -> String {
    const MANY: usize = 24;
    match names.len().checked_sub(MANY) {
        None | Some(0) => names.join(", "),
        Some(more) => format!("{} and {more} more, which --list shows", names[..MANY].join(", ")),
    }
}

/// The rows that are wanted, from 0.
fn rows(plan: &Plan, rows: usize) -> std::ops::Range<usize> {
    plan.rows.map_or(0..rows, |(first, last)| first.saturating_sub(1).min(rows)..last.min(rows))
}

/// The stamps of a series.
fn stamps(
    file: &Found,
    group: &Group,
    series: &Series,
    plan: &Plan,
) -> Result<Vec<Option<i64>>, ForeignError> {
    let own = plan.clocks.iter().find(|(of, _)| of.as_deref() == Some(&series.name));
    let named = own.or_else(|| plan.clocks.iter().find(|(of, _)| of.is_none())).map(|(_, clock)| clock);
    let clock = match named {
        Some(name) => Some(group.clocks.iter().find(|clock| clock.name == *name).ok_or_else(|| {
            ForeignError::UnknownClock {
                name: name.clone(),
                suggestion: Suggestion::nearest(name, group.clock_names()),
                available: group.clock_names().join(", "),
            }
        })?),
        None => group.clocks.get(series.clock),
    };
    let mut stamps = match (plan.rate, clock) {
        (Some(rate), _) => {
            (0..group.rows).map(|row| Some((row as f64 / rate * 1e9).round() as i64)).collect()
        }
        (None, Some(clock)) => read(file, group, clock, plan)?,
        (None, None) => {
            let columns: Vec<&str> = group.series.iter().map(|series| series.column.as_str()).collect();
            let columns = columns.join(", ");
            return Err(ForeignError::NoClock {
                path: file.path.clone(),
                group: group.name.clone(),
                columns,
            });
        }
    };
    let wanted = rows(plan, group.rows);
    if let Some(clock) = clock.filter(|_| plan.rate.is_none()) {
        set_back(file, clock, &stamps, wanted.clone())?;
    }
    if plan.spread {
        spread(&mut stamps[wanted]);
    }
    Ok(stamps)
}

fn read(file: &Found, group: &Group, clock: &Clock, plan: &Plan) -> Result<Vec<Option<i64>>, ForeignError> {
    let path = || file.path.clone();
    let unit = unit(clock, plan).ok_or_else(|| ForeignError::NoTimeUnit {
        path: path(),
        column: clock.name.clone(),
        step: clock.step(),
    })?;
    clock.stamps(unit).map_err(|(row, text)| ForeignError::NotATime {
        path: path(),
        line: group.first_line + row,
        column: clock.name.clone(),
        text,
        unit: unit.to_string(),
    })
}

/// The unit that a clock is read in; `None` when nothing says it.
pub(super) fn unit(clock: &Clock, plan: &Plan) -> Option<TimeUnit> {
    plan.time_unit.filter(|_| clock.is_numeric()).or(clock.unit.map(|(unit, _)| unit))
}

/// That the clock was not set back.
fn set_back(
    file: &Found,
    clock: &Clock,
    stamps: &[Option<i64>],
    rows: std::ops::Range<usize>,
) -> Result<(), ForeignError> {
    let mut latest: Option<i64> = None;
    // The begins of parts, and of the first one how many rows lie below what came before.
    let mut begins: Vec<(usize, i64, i64)> = Vec::new();
    let (mut below, mut overlap) = (0, 0);
    let mut begin = None;
    for row in rows.clone() {
        let Some(stamp) = stamps[row] else { continue };
        match latest {
            Some(before) if stamp < before => {
                below += 1;
                begin.get_or_insert((row, before, stamp));
                if begins.len() <= 1 {
                    overlap = overlap.max(below);
                }
                if below == OVERTAKEN {
                    begins.extend(begin);
                    // What follows is the next part, with a latest stamp of its own.
                    latest = Some(stamp);
                    (below, begin) = (0, None);
                }
            }
            _ => {
                latest = Some(stamp);
                (below, begin) = (0, None);
            }
        }
    }
    let Some((row, from, to)) = begins.first().copied() else { return Ok(()) };
    let edges: Vec<usize> =
        std::iter::once(rows.start).chain(begins.iter().map(|begin| begin.0)).chain([rows.end]).collect();
    let parts: Vec<String> = edges.windows(2).map(|edge| format!("{}:{}", edge[0] + 1, edge[1])).collect();
    let later = stamps[row..rows.end].iter().flatten().take_while(|stamp| **stamp < from).count();
    Err(ForeignError::SetBack {
        path: file.path.clone(),
        clock: clock.name.clone(),
        row: row + 1,
        from: from as f64 / 1e9,
        to: to as f64 / 1e9,
        overlap: later.max(overlap),
        parts: parts.join(" or "),
    })
}

/// Rows of one stamp go evenly over the time up to the next stamp; the last ones as those before them.
fn spread(stamps: &mut [Option<i64>]) {
    let mut start = 0;
    let mut width = 0;
    while start < stamps.len() {
        let stamp = stamps[start];
        let mut end = start + 1;
        while end < stamps.len() && stamps[end] == stamp {
            end += 1;
        }
        if let Some(stamp) = stamp {
            if let Some(next) = stamps[end..].iter().flatten().next().filter(|next| **next > stamp) {
                width = next - stamp;
            }
            let count = (end - start) as i64;
            for (number, place) in stamps[start..end].iter_mut().enumerate() {
                *place = Some(stamp + width * number as i64 / count);
            }
        }
        start = end;
    }
}

fn convert_unit(choice: &Choice, series: &Series) -> Result<(Conversion, String), ForeignError> {
    let same = Conversion { factor: 1.0, offset: 0.0 };
    let Some(wanted) = &choice.unit else { return Ok((same, series.unit.clone())) };
    // A scale that was given says that the result is in the unit that was given.
    if series.unit.is_empty() || series.unit == *wanted || choice.scale != 1.0 {
        return Ok((same, wanted.clone()));
    }
    match conversion(&series.unit, wanted) {
        Some(conversion) => Ok((conversion, wanted.clone())),
        None => {
            let known = alternatives(&series.unit);
            Err(ForeignError::NoConversion {
                name: choice.name.clone(),
                from: series.unit.clone(),
                to: wanted.clone(),
                known: if known.is_empty() {
                    "; give the factor: --scale NAME=FACTOR".into()
                } else {
                    format!("; it can be {}, or give the factor: --scale NAME=FACTOR", known.join(", "))
                },
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_stamps_are_spread() {
        let mut stamps = [0, 0, 10, 10, 10, 10, 20, 20].map(Some);
        spread(&mut stamps);
        assert_eq!(stamps, [0, 5, 10, 12, 15, 17, 20, 25].map(Some));
        let mut stamps = [Some(5), None, Some(5)];
        spread(&mut stamps);
        assert_eq!(stamps, [Some(5), None, Some(5)]);
    }
}
