//! Logs that others wrote: a folder with a `recording.toml` and CSV files, and, through [`foreign`], whatever their programs
//! write. Also reads a `system.toml` from disk.
//!
//! ```no_run
//! use std::path::Path;
//!
//! let log = parallax_runtime::import::folder(Path::new("../shared/data/emps/estimation"))?;
//! let voltage = log.signal("voltage")?;
//! println!("{} samples of {} in {}", voltage.values.len(), voltage.name, voltage.unit);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
pub mod foreign;
mod manifest;
mod seconds;
mod table;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use parallax_model::system::System;

pub use error::ImportError;

use crate::recording::log::{Log, Signal, Source};
use manifest::SignalEntry;

/// The name of the file that describes a folder's signals.
pub const MANIFEST: &str = "recording.toml";

/// Whether a path is that of a log's folder, or of the `recording.toml` in it.
#[must_use]
pub fn is_folder(path: &Path) -> bool {
    path.is_dir() || path.file_name().is_some_and(|name| name == MANIFEST)
}

/// Reads the folder at `path`, or the one of the `recording.toml` at `path`: its `recording.toml` and the CSV files that it names, each once.
///
/// # Errors
///
/// An [`ImportError`] for the first thing that is wrong, with file, line and column.
pub fn folder(path: &Path) -> Result<Log, ImportError> {
    if !path.exists() {
        return Err(ImportError::Missing { path: path.into() });
    }
    let path = match path.parent() {
        // The parent of a bare file name is empty.
        Some(parent) if !path.is_dir() && is_folder(path) => {
            if parent.as_os_str().is_empty() {
                Path::new(".")
            } else {
                parent
            }
        }
        _ => path,
    };
    if !path.is_dir() {
        return Err(ImportError::NotAFolder { path: path.into() });
    }
    let manifest_path = path.join(MANIFEST);
    if !manifest_path.exists() {
        return Err(ImportError::NoManifest { folder: path.into() });
    }
    let manifest_name = manifest_path.display().to_string();
    let manifest = manifest::read(&text(&manifest_path)?, &manifest_name)?;

    let mut by_file: BTreeMap<&str, Vec<&SignalEntry>> = BTreeMap::new();
    for signal in &manifest.signals {
        by_file.entry(&signal.file).or_default().push(signal);
    }
    let mut signals: BTreeMap<&str, Signal> = BTreeMap::new();
    for (file, entries) in by_file {
        let csv = path.join(file);
        let columns = table::read(&csv, &entries, &manifest_name)?;
        for entry in entries {
            let signal = Signal {
                name: entry.name.clone(),
                role: entry.role,
                unit: entry.unit.clone(),
                times: columns.times[&entry.time].clone(),
                values: columns.values[&entry.value].clone(),
                source: Source { file: csv.display().to_string(), column: entry.value.clone() },
            };
            signals.insert(&entry.name, signal);
        }
    }
    let signals = manifest.signals.iter().filter_map(|entry| signals.remove(entry.name.as_str())).collect();
    let title = if manifest.title.is_empty() { path.display().to_string() } else { manifest.title };
    Ok(Log { title, license: manifest.license, constants: manifest.constants, signals, notes: Vec::new() })
}

/// Reads the `system.toml` at `path`, or in the folder at `path`.
///
/// # Errors
///
/// [`ImportError::Missing`], [`ImportError::Io`], or [`ImportError::System`] with file, line and expression.
pub fn read_system(path: &Path) -> Result<System, ImportError> {
    let (_, system) = read_system_text(path)?;
    Ok(system)
}

/// Like [`read_system`], with the text that a corrected file is made from.
///
/// # Errors
///
/// As [`read_system`].
pub fn read_system_text(path: &Path) -> Result<(String, System), ImportError> {
    let path: PathBuf = if path.is_dir() { path.join("system.toml") } else { path.into() };
    if !path.exists() {
        return Err(ImportError::Missing { path });
    }
    let text = text(&path)?;
    let system = System::parse(&text, &path.display().to_string())?;
    Ok((text, system))
}

fn text(path: &Path) -> Result<String, ImportError> {
    std::fs::read_to_string(path).map_err(|source| ImportError::Io { path: path.into(), source })
}
