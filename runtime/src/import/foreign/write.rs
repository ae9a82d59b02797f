//! A log becomes a folder: `recording.toml`, and CSV files beside it.

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;

use super::header::clean;
use super::{Converted, ForeignError};
use crate::import::{MANIFEST, folder};
use crate::recording::log::{Log, Signal};

/// Writes the folder `out`, which must not exist, or be empty. The signals that share their stamps share a file. What was
/// written is read back and compared before the folder appears.
///
/// # Errors
///
/// [`ForeignError::Exists`], [`ForeignError::Write`].
pub fn write_folder(out: &Path, converted: &Converted) -> Result<(), ForeignError> {
    let failed = |path: &Path| {
        let path = path.to_path_buf();
        move |source| ForeignError::Write { path, source }
    };
    let occupied = match out.read_dir() {
        Ok(mut entries) => entries.next().is_some(),
        Err(_) => out.exists(),
    };
    if occupied {
        return Err(ForeignError::Exists { path: out.into() });
    }
    let parent = match out.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    fs::create_dir_all(parent).map_err(failed(parent))?;
    // Whoever is interrupted leaves no half of a log under its name.
    let name = out.file_name().unwrap_or_default().to_string_lossy();
    let making = parent.join(format!(".{name}.{}", std::process::id()));
    fs::create_dir(&making).map_err(failed(&making))?;
    let written = files(&making, converted).and_then(|()| check(&making, &converted.log));
    let moved = written.and_then(|()| {
        if out.exists() {
            fs::remove_dir(out).map_err(failed(out))?;
        }
        fs::rename(&making, out).map_err(failed(out))
    });
    if moved.is_err() {
        let _ = fs::remove_dir_all(&making);
    }
    moved
}

fn files(folder: &Path, converted: &Converted) -> Result<(), ForeignError> {
    let signals = &converted.log.signals;
    // Signals of the same stamps, in the order of the first of each.
    let mut tables: Vec<Vec<usize>> = Vec::new();
    for (index, signal) in signals.iter().enumerate() {
        let same = |table: &&mut Vec<usize>| signals[table[0]].times == signal.times;
        match tables.iter_mut().find(same) {
            Some(table) => table.push(index),
            None => tables.push(vec![index]),
        }
    }
    let one = tables.len() == 1;
    let mut file_of = vec![String::new(); signals.len()];
    for (number, table) in tables.iter().enumerate() {
        let first = clean(&signals[table[0]].name);
        let file = if one { "log.csv".into() } else { format!("{:02}_{first}.csv", number + 1) };
        let path = folder.join(&file);
        let columns: Vec<&Signal> = table.iter().map(|index| &signals[*index]).collect();
        csv(&path, &columns).map_err(|source| ForeignError::Write { path: path.clone(), source })?;
        for index in table {
            file_of[*index].clone_from(&file);
        }
    }
    let path = folder.join(MANIFEST);
    fs::write(&path, manifest(converted, &file_of)).map_err(|source| ForeignError::Write { path, source })
}

fn csv(path: &Path, signals: &[&Signal]) -> std::io::Result<()> {
    let mut writer = csv::Writer::from_path(path)?;
    let names = signals.iter().map(|signal| signal.name.as_str());
    writer.write_record(std::iter::once(TIME).chain(names))?;
    let mut row = Vec::with_capacity(signals.len() + 1);
    for (index, time) in signals[0].times.iter().enumerate() {
        row.clear();
        row.push(decimal(*time));
        row.extend(signals.iter().map(|signal| signal.values[index].to_string()));
        writer.write_record(&row)?;
    }
    writer.into_inner().map_err(|error| error.into_error())?.flush()
}

/// The column of the stamps.
const TIME: &str = "time [s]";

/// Nanoseconds as seconds, exactly.
fn decimal(nanos: i64) -> String {
    let (sign, size) = (if nanos < 0 { "-" } else { "" }, nanos.unsigned_abs());
    let text = format!("{sign}{}.{:09}", size / 1_000_000_000, size % 1_000_000_000);
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

fn manifest(converted: &Converted, file_of: &[String]) -> String {
    let Converted { log, origin, changed } = converted;
    let mut text = format!("format = 1\ntitle = {}\n", quoted(&log.title));
    if *origin != 0 {
        let when = chrono::DateTime::from_timestamp_nanos(*origin).format("%Y-%m-%d %H:%M:%S%.9f UTC");
        let _ = writeln!(
            text,
            "# Time 0 is {} s in the source: {when}, if that counts from 1970.",
            decimal(*origin)
        );
    }
    for note in &log.notes {
        let _ = writeln!(text, "# {}", note.replace(['\n', '\r'], " "));
    }
    for ((signal, file), changed) in log.signals.iter().zip(file_of).zip(changed) {
        let changed = if changed.is_empty() { String::new() } else { format!(", {changed}") };
        let source = format!("{}{changed}", signal.source).replace(['\n', '\r'], " ");
        let _ = write!(
            text,
            "\n[[signal]]             # {source}\nname = {}\nrole = \"{}\"\nunit = {}\nfile = {}\ntime = {}\nvalue = {}\n",
            quoted(&signal.name),
            signal.role,
            quoted(&signal.unit),
            quoted(file),
            quoted(TIME),
            quoted(&signal.name),
        );
    }
    text
}

/// What was written is what was meant.
fn check(path: &Path, meant: &Log) -> Result<(), ForeignError> {
    let read = folder(path)?;
    let fields = |signal: &Signal| (signal.name.clone(), signal.role, signal.unit.clone());
    let differs = |what: String| Err(ForeignError::ReadBack { path: path.into(), what });
    if read.signals.len() != meant.signals.len() {
        return differs("the number of signals".into());
    }
    for (read, meant) in read.signals.iter().zip(&meant.signals) {
        if fields(read) != fields(meant) || read.times != meant.times || read.values != meant.values {
            return differs(format!("signal `{}`", meant.name));
        }
    }
    Ok(())
}
