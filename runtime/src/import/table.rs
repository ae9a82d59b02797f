//! Reads the columns that signals need from a CSV file, once.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use csv::{ByteRecord, ReaderBuilder, Trim};
use parallax_model::system::Suggestion;

use super::error::ImportError;
use super::manifest::SignalEntry;
use super::seconds::{NotATime, nanoseconds};

/// The wanted columns of one file, by name.
#[derive(Debug, Default)]
pub(super) struct Columns {
    /// Nanoseconds, strictly increasing.
    pub(super) times: BTreeMap<String, Vec<i64>>,
    /// Finite numbers.
    pub(super) values: BTreeMap<String, Vec<f64>>,
}

/// Reads what `signals`, all of the file at `path`, need; `manifest` is named in messages.
pub(super) fn read(path: &Path, signals: &[&SignalEntry], manifest: &str) -> Result<Columns, ImportError> {
    let csv = path.display().to_string();
    let broken = |source: csv::Error| broken(&csv, source);
    let file = File::open(path).map_err(|source| match (source.kind(), signals.first()) {
        (std::io::ErrorKind::NotFound, Some(signal)) => ImportError::MissingCsv {
            manifest: manifest.into(),
            line: signal.line,
            signal: signal.name.clone(),
            csv: signal.file.clone(),
        },
        _ => ImportError::Io { path: path.into(), source },
    })?;
    let mut reader = ReaderBuilder::new().trim(Trim::All).buffer_capacity(1 << 18).from_reader(file);
    let header: Vec<String> = reader
        .byte_headers()
        .map_err(broken)?
        .iter()
        .map(|cell| String::from_utf8_lossy(cell).into())
        .collect();
    if header.iter().all(String::is_empty) {
        return Err(ImportError::Empty { file: csv, remedy: "it should have a header and rows of numbers" });
    }

    let mut times: Vec<Column<i64>> = Vec::new();
    let mut values: Vec<Column<f64>> = Vec::new();
    for signal in signals {
        let find = |name: &str| find(&header, name, signal, &csv, manifest);
        if !times.iter().any(|column| column.name == signal.time) {
            times.push(Column::new(&signal.time, find(&signal.time)?));
        }
        if !values.iter().any(|column| column.name == signal.value) {
            values.push(Column::new(&signal.value, find(&signal.value)?));
        }
    }

    let mut record = ByteRecord::new();
    while reader.read_byte_record(&mut record).map_err(broken)? {
        let line = record.position().map_or(0, csv::Position::line);
        for column in &mut times {
            let time = time(&record[column.index], &csv, line, &column.name, column.numbers.last().copied())?;
            column.numbers.push(time);
        }
        for column in &mut values {
            let value = value(&record[column.index], &csv, line, &column.name)?;
            column.numbers.push(value);
        }
    }
    if times.iter().any(|column| column.numbers.is_empty()) {
        return Err(ImportError::NoRows { csv });
    }
    Ok(Columns {
        times: times.into_iter().map(|column| (column.name, column.numbers)).collect(),
        values: values.into_iter().map(|column| (column.name, column.numbers)).collect(),
    })
}

struct Column<N> {
    name: String,
    index: usize,
    numbers: Vec<N>,
}

impl<N> Column<N> {
    fn new(name: &str, index: usize) -> Self {
        Self { name: name.into(), index, numbers: Vec::new() }
    }
}

fn find(
    header: &[String],
    name: &str,
    signal: &SignalEntry,
    csv: &str,
    manifest: &str,
) -> Result<usize, ImportError> {
    let mut found = header.iter().enumerate().filter(|(_, column)| *column == name).map(|(index, _)| index);
    match (found.next(), found.next()) {
        (Some(index), None) => Ok(index),
        (Some(_), Some(_)) => Err(ImportError::DuplicateColumn { csv: csv.into(), column: name.into() }),
        (None, _) => {
            let hint = match header {
                [only] if only.contains([';', '\t']) => "; separate the columns by commas",
                [first, ..] if first.parse::<f64>().is_ok() => {
                    "; the first line must hold the columns' names"
                }
                _ => "",
            };
            Err(ImportError::MissingColumn {
                csv: csv.into(),
                column: name.into(),
                signal: signal.name.as_str().into(),
                stated: format!("{manifest}:{}", signal.line).into(),
                suggestion: Suggestion::nearest(name, header.iter().map(String::as_str)),
                available: header.join(", ").into(),
                hint,
            })
        }
    }
}

fn time(cell: &[u8], csv: &str, line: u64, column: &str, previous: Option<i64>) -> Result<i64, ImportError> {
    let (csv, column, text) = (csv.into(), column.into(), String::from_utf8_lossy(cell));
    let time = match nanoseconds(&text) {
        Ok(time) => time,
        Err(NotATime::Unreadable) => {
            return Err(ImportError::NotANumber { csv, line, column, text: text.into() });
        }
        Err(NotATime::NotFinite) => {
            return Err(ImportError::NotFinite { csv, line, column, text: text.into() });
        }
        Err(NotATime::OutOfRange) => {
            return Err(ImportError::TimeRange { csv, line, column, text: text.into() });
        }
    };
    match previous {
        Some(previous) if time < previous => Err(ImportError::Backwards {
            csv,
            line,
            column,
            time: text.into(),
            previous: previous as f64 * 1e-9,
        }),
        Some(previous) if time == previous => {
            Err(ImportError::Repeated { csv, line, column, time: text.into() })
        }
        _ => Ok(time),
    }
}

fn value(cell: &[u8], csv: &str, line: u64, column: &str) -> Result<f64, ImportError> {
    let text = || String::from_utf8_lossy(cell).into_owned();
    match std::str::from_utf8(cell).ok().and_then(|text| text.parse::<f64>().ok()) {
        Some(value) if value.is_finite() => Ok(value),
        Some(_) => Err(ImportError::NotFinite { csv: csv.into(), line, column: column.into(), text: text() }),
        None => Err(ImportError::NotANumber { csv: csv.into(), line, column: column.into(), text: text() }),
    }
}

fn broken(csv: &str, source: csv::Error) -> ImportError {
    match source.kind() {
        csv::ErrorKind::UnequalLengths { pos, expected_len, len } => ImportError::RowLength {
            csv: csv.into(),
            line: pos.as_ref().map_or(0, csv::Position::line),
            found: *len,
            expected: *expected_len,
        },
        _ => ImportError::Csv { csv: csv.into(), source },
    }
}
