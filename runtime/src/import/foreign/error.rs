//! What can be wrong with a log that somebody else wrote.

use std::path::PathBuf;

use parallax_model::system::Suggestion;

use crate::import::ImportError;

/// Why a foreign log cannot be read or converted. Lines count from 1.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ForeignError {
    /// Nothing at the path.
    #[error("{} does not exist; check the path", path.display())]
    Missing {
        /// The path.
        path: PathBuf,
    },
    /// The operating system refuses.
    #[error("{} cannot be read", path.display())]
    Io {
        /// The path.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// The operating system refuses to write.
    #[error("{} cannot be written", path.display())]
    Write {
        /// The path.
        path: PathBuf,
        /// What the operating system says.
        source: std::io::Error,
    },
    /// A file of no bytes.
    #[error("{} is empty; was the logger stopped before it wrote?", path.display())]
    Empty {
        /// The path.
        path: PathBuf,
    },
    /// A form that is known and not read.
    #[error("{} is {what}; {remedy}", path.display())]
    NotReadHere {
        /// The path.
        path: PathBuf,
        /// What it is.
        what: &'static str,
        /// What to do.
        remedy: &'static str,
    },
    /// A Parquet file, and a program without that feature.
    #[error("{} is a Parquet file, and this program was built without the feature `parquet`", path.display())]
    NoParquet {
        /// The path.
        path: PathBuf,
    },
    /// A bag in SQLite, and a program without that feature.
    #[error("{} is a ROS 2 bag in SQLite, and this program was built without the feature `rosbag2`", path.display())]
    NoSqlite {
        /// The path.
        path: PathBuf,
    },
    /// SQLite refuses.
    #[cfg(feature = "rosbag2")]
    #[error("{} cannot be read as a ROS 2 bag in SQLite; is it a bag, and whole?", path.display())]
    Database {
        /// The path.
        path: PathBuf,
        /// What SQLite says.
        source: rusqlite::Error,
    },
    /// A folder that is no bag.
    #[error(
        "{} holds no MCAP or SQLite file (.mcap, .db3); give the folder of a ROS 2 bag, a folder with recording.toml, or the files themselves",
        path.display()
    )]
    NotABag {
        /// The path.
        path: PathBuf,
    },
    /// A recording of Parallax.
    #[error("{} is a recording of Parallax already; `parallax info`, `diagnose` and `replay` read it as it is", path.display())]
    Ours {
        /// The path.
        path: PathBuf,
    },
    /// A file in which no number varies with time.
    #[error("{} has no series of numbers{}", path.display(), if notes.is_empty() { String::new() } else { format!(": {notes}") })]
    NoSeries {
        /// The path.
        path: PathBuf,
        /// What was left out.
        notes: String,
    },
    /// A row with more or fewer cells than the header.
    #[error("{}:{line}: the row has {found} cells, the header {expected}; correct or remove the line", path.display())]
    RowLength {
        /// The file.
        path: PathBuf,
        /// The line.
        line: u64,
        /// Cells of the row.
        found: usize,
        /// Cells of the header.
        expected: usize,
    },
    /// A cell that is no number, in a column of numbers.
    #[error(
        "{}:{line}: column `{column}`: `{text}` is not a number; correct the cell, or say that it stands for a missing \
         value: --missing '{text}'",
        path.display()
    )]
    NotANumber {
        /// The file.
        path: PathBuf,
        /// The line.
        line: u64,
        /// The column.
        column: String,
        /// The cell.
        text: String,
    },
    /// A stamp that cannot be read.
    #[error("{}:{line}: column `{column}`: `{text}` is no time in {unit}; correct the cell, or choose another clock", path.display())]
    NotATime {
        /// The file.
        path: PathBuf,
        /// The line, or the row.
        line: usize,
        /// The column.
        column: String,
        /// The cell.
        text: String,
        /// The unit it was read in.
        unit: String,
    },
    /// A file that is not of its form.
    #[error("{}{}: {reason}", path.display(), if *at == 0 { String::new() } else { format!(" at byte {at}") })]
    Damaged {
        /// The path.
        path: PathBuf,
        /// Where, if that is known.
        at: u64,
        /// What is wrong.
        reason: String,
    },
    /// No column looks like a time.
    #[error(
        "{}{} has no column that looks like a time (it has: {columns}); name one with --time COLUMN, or, if the rows are \
         evenly spaced, say --rate HZ",
        path.display(), group_name(group)
    )]
    NoClock {
        /// The path.
        path: PathBuf,
        /// The topic; empty for a table.
        group: String,
        /// All columns.
        columns: String,
    },
    /// A time without a unit.
    #[error(
        "{}: column `{column}` says no unit, and its steps of {step} could be any; say --time-unit s, ms, us or ns",
        path.display()
    )]
    NoTimeUnit {
        /// The path.
        path: PathBuf,
        /// The column.
        column: String,
        /// The median step.
        step: f64,
    },
    /// A clock that was set back.
    #[error(
        "{}: the time in `{clock}` goes back from {from} s to {to} s at row {row} and goes on from there for {overlap} rows: \
         the clock was set, or two runs lie in one file; import one part at a time: --rows {parts}",
        path.display()
    )]
    SetBack {
        /// The path.
        path: PathBuf,
        /// The clock.
        clock: String,
        /// The first row of the later part, from 1.
        row: usize,
        /// The time before, in seconds.
        from: f64,
        /// The time after, in seconds.
        to: f64,
        /// How many rows lie before what came earlier.
        overlap: usize,
        /// The parts.
        parts: String,
    },
    /// A series that is not there.
    #[error("there is no signal `{name}`{suggestion} (there are: {available})")]
    UnknownSeries {
        /// The name asked for.
        name: String,
        /// The nearest.
        suggestion: Suggestion,
        /// All names.
        available: String,
    },
    /// A clock that is not there.
    #[error("there is no time `{name}`{suggestion} (there are: {available})")]
    UnknownClock {
        /// The name asked for.
        name: String,
        /// The nearest.
        suggestion: Suggestion,
        /// All names.
        available: String,
    },
    /// A signal of two roles, or of one name with another.
    #[error("`{name}` is chosen twice; leave one out, or rename one with --rename OLD=NEW")]
    Twice {
        /// The name.
        name: String,
    },
    /// Units that have nothing to do with each other.
    #[error("`{name}` is in `{from}`, which is not converted to `{to}`{known}")]
    NoConversion {
        /// The signal.
        name: String,
        /// The unit it is in.
        from: String,
        /// The unit asked for.
        to: String,
        /// What it could be converted to.
        known: String,
    },
    /// A series without a value in the rows that are wanted.
    #[error("`{name}` has no value in the rows that are wanted; leave it out, or choose other rows")]
    NoValues {
        /// The signal.
        name: String,
    },
    /// Nothing was chosen.
    #[error(
        "no signal is chosen; say which are which, with --command, --measurement, --context and --reference"
    )]
    NothingChosen,
    /// Something is at the place to write to.
    #[error("{} exists already, and nothing in it is overwritten; choose another place with --out", path.display())]
    Exists {
        /// The path.
        path: PathBuf,
    },
    /// What was written reads back as something else.
    #[error("{}: what was written reads back as something else ({what}); this is a defect of Parallax", path.display())]
    ReadBack {
        /// The path.
        path: PathBuf,
        /// What differs.
        what: String,
    },
    /// What was written cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
}

fn group_name(group: &str) -> String {
    if group.is_empty() { String::new() } else { format!(" ({group})") }
}
