//! What can be wrong with a folder of logs.

use std::path::PathBuf;

use parallax_model::system::{Suggestion, SystemError};

use crate::recording::log::UnknownRole;

/// Why a recording's folder or a system's file cannot be read. Lines count from 1, the header of a CSV file being 1.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// Nothing at the path.
    #[error("{} does not exist; check the path", path.display())]
    Missing {
        /// The path.
        path: PathBuf,
    },
    /// A file where a folder should be.
    #[error("{} is not a folder; give the folder that holds recording.toml and its CSV files", path.display())]
    NotAFolder {
        /// The path.
        path: PathBuf,
    },
    /// A folder without `recording.toml`.
    #[error("{} has no recording.toml; write one that names the CSV files' columns as signals", folder.display())]
    NoManifest {
        /// The folder.
        folder: PathBuf,
    },
    /// The operating system refuses.
    #[error("{} cannot be read", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// A file of no bytes, or of blanks.
    #[error("{file} is empty; {remedy}")]
    Empty {
        /// The file.
        file: String,
        /// What should be in it.
        remedy: &'static str,
    },
    /// A `recording.toml` that cannot be understood: its syntax, an unknown or missing field, a wrong type.
    #[error("{file}:{line}: {message}")]
    Toml {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// What the reader says.
        message: String,
    },
    /// No `format`.
    #[error("{file}: `format` is missing; write `format = 1` at the top")]
    MissingFormat {
        /// The file.
        file: String,
    },
    /// A version that this build cannot read.
    #[error("{file}:{line}: format {found} is not supported; this version reads format 1")]
    UnsupportedFormat {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// The version the file states.
        found: String,
    },
    /// No `[[signal]]`.
    #[error("{file} names no signals; add a [[signal]] with name, role, unit, file, time and value")]
    NoSignals {
        /// The file.
        file: String,
    },
    /// Two signals of one name.
    #[error("{file}:{line}: the signal `{name}` is already defined at line {first_line}; rename one of them")]
    DuplicateSignal {
        /// The file.
        file: String,
        /// Line of the second.
        line: usize,
        /// The name.
        name: String,
        /// Line of the first.
        first_line: usize,
    },
    /// A role that does not exist.
    #[error("{file}:{line}: signal `{signal}`: {problem}")]
    Role {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// The signal.
        signal: String,
        /// What is wrong.
        problem: UnknownRole,
    },
    /// A constant that is no finite number.
    #[error("{file}:{line}: the constant `{name}` must be a finite number")]
    BadConstant {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// The constant.
        name: String,
    },
    /// A CSV file that is not there.
    #[error(
        "{manifest}:{line}: signal `{signal}` is in the file `{csv}`, which does not exist in that folder"
    )]
    MissingCsv {
        /// The `recording.toml`.
        manifest: String,
        /// Line of the signal.
        line: usize,
        /// The signal.
        signal: String,
        /// The file's name.
        csv: String,
    },
    /// A column that is not there.
    #[error(
        "{csv} has no column `{column}`, which signal `{signal}` ({stated}) names{suggestion} (it has: {available}){hint}"
    )]
    MissingColumn {
        /// The CSV file.
        csv: Box<str>,
        /// The column.
        column: Box<str>,
        /// The signal.
        signal: Box<str>,
        /// The `recording.toml` and the line that names it.
        stated: Box<str>,
        /// The nearest column.
        suggestion: Suggestion,
        /// All columns.
        available: Box<str>,
        /// What else may be wrong with the file.
        hint: &'static str,
    },
    /// Two columns of one name.
    #[error("{csv}:1: the column `{column}` appears twice; rename one of them")]
    DuplicateColumn {
        /// The CSV file.
        csv: String,
        /// The column.
        column: String,
    },
    /// A header without rows.
    #[error("{csv} has a header but no data; a recording needs at least one row")]
    NoRows {
        /// The CSV file.
        csv: String,
    },
    /// A row with more or fewer cells than the header.
    #[error("{csv}:{line}: the row has {found} cells, the header {expected}; the file may be cut off here")]
    RowLength {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// Cells of the row.
        found: u64,
        /// Cells of the header.
        expected: u64,
    },
    /// A cell that is no number.
    #[error("{csv}:{line}: column `{column}`: {} is not a number; correct the cell or leave the row out",
        if text.is_empty() { "an empty cell".into() } else { format!("`{text}`") })]
    NotANumber {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The cell.
        text: String,
    },
    /// NaN or infinity.
    #[error(
        "{csv}:{line}: column `{column}`: `{text}` is not finite; leave the row out, or give this signal a file of its own"
    )]
    NotFinite {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The cell.
        text: String,
    },
    /// A time that does not fit.
    #[error("{csv}:{line}: column `{column}`: the time `{text}` is out of range; times are in seconds")]
    TimeRange {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The cell.
        text: String,
    },
    /// A time before the one above it.
    #[error(
        "{csv}:{line}: column `{column}`: time runs backwards, from {previous} s to {time} s; sort the rows, or cut the file where the clock was set"
    )]
    Backwards {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The time, in seconds as written.
        time: String,
        /// The time of the row above, in seconds.
        previous: f64,
    },
    /// The same time twice.
    #[error(
        "{csv}:{line}: column `{column}`: the time {time} s repeats that of the row above (times are kept to 1 ns); leave one of the rows out"
    )]
    Repeated {
        /// The CSV file.
        csv: String,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The time, in seconds as written.
        time: String,
    },
    /// A CSV file that is not CSV.
    #[error("{csv} is not a CSV file that can be read")]
    Csv {
        /// The CSV file.
        csv: String,
        /// What the reader says.
        source: csv::Error,
    },
    /// Something wrong inside a `system.toml`.
    #[error(transparent)]
    System(#[from] SystemError),
}
