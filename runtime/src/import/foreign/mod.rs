//! Logs as other programs wrote them: CSV of any dialect, Parquet, and ROS 2 bags.
//!
//! [`read`] says what is in a file, before anybody has said what it means: [`Found`]. A [`Plan`] says which of its series
//! are wanted, in which role and unit; [`convert`] makes a [`Log`](crate::recording::log::Log) of them. The file itself
//! is only read.
//!
//! ```no_run
//! use std::path::Path;
//! use parallax_runtime::import::foreign::{convert, read, Plan};
//!
//! let found = read(Path::new("bench.csv"), &Default::default(), &mut |_| {})?;
//! let plan = Plan::suggested(&[found.clone()]);
//! let converted = convert(&[found], &plan)?;
//! println!("{} signals", converted.log.signals.len());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod bag;
mod clock;
mod columns;
mod convert;
mod csv;
mod database;
#[cfg(feature = "rosbag2")]
mod definitions;
mod dialect;
mod error;
mod header;
#[cfg(feature = "parquet")]
mod parquet;
mod plan;
mod ros;
mod run;
mod suggest;
mod units;
mod value;
mod write;

use std::path::{Path, PathBuf};

pub use clock::{Clock, TimeUnit, UnitFrom};
pub use convert::{Converted, convert, series};
pub use dialect::Dialect;
pub use error::ForeignError;
pub use plan::{Choice, Plan, qualify};
pub use run::Run;
pub use units::{Conversion, conversion};
pub use write::write_folder;

use crate::recording::log::Role;

/// What is in one file, or in one bag.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Where it was read.
    pub path: PathBuf,
    /// What it is, for people: `CSV, columns separated by ;, decimal comma`.
    pub form: String,
    /// Series that share their rows: the columns of a table, or the numbers in the messages of one topic.
    pub groups: Vec<Group>,
    /// What was left out, and why.
    pub notes: Vec<String>,
}

/// Series that share their rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// A topic; empty for a table.
    pub name: String,
    /// The type of its messages; empty for a table.
    pub kind: String,
    /// What may say when a row was true; empty where nothing does.
    pub clocks: Vec<Clock>,
    /// Its numbers.
    pub series: Vec<Series>,
    /// How many rows there are.
    pub rows: usize,
    /// The line of the first row in a text file; 1 elsewhere.
    pub first_line: usize,
}

/// One number in every row.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// A name that is unique among all series of the file.
    pub name: String,
    /// The header of its column, or its path within the message.
    pub column: String,
    /// What the file, or the definition of its type, says of the unit; empty when nothing is said.
    pub unit: String,
    /// One value a row; NaN where there is none.
    pub values: Vec<f64>,
    /// Which of the group's clocks says when.
    pub clock: usize,
    /// What it looks like; `None` when it looks like nothing that a diagnosis reads.
    pub role: Option<Role>,
}

impl Found {
    /// All series, with the group of each.
    pub fn series(&self) -> impl Iterator<Item = (&Group, &Series)> {
        self.groups.iter().flat_map(|group| group.series.iter().map(move |series| (group, series)))
    }
}

impl Group {
    /// The clocks' names.
    fn clock_names(&self) -> Vec<&str> {
        self.clocks.iter().map(|clock| clock.name.as_str()).collect()
    }
}

/// What a path of somebody's log is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Csv,
    Parquet,
    Mcap,
    Sqlite,
}

/// Reads the log at `path`: a CSV or Parquet file, an MCAP or SQLite file of a ROS 2 bag, or its folder. `dialect` says what is known
/// of a CSV file; what it leaves open is found out. `progress` hears how many bytes have been read.
///
/// # Errors
///
/// [`ForeignError`], with file, line and what to do.
pub fn read(path: &Path, dialect: &Dialect, progress: &mut dyn FnMut(u64)) -> Result<Found, ForeignError> {
    if !path.exists() {
        return Err(ForeignError::Missing { path: path.into() });
    }
    let mut found = if path.is_dir() {
        bag::folder(path, progress)?
    } else {
        match kind(path)? {
            Kind::Csv => csv::read(path, dialect, progress)?,
            Kind::Mcap => bag::file(path, false, progress)?,
            Kind::Sqlite => bag::file(path, true, progress)?,
            #[cfg(feature = "parquet")]
            Kind::Parquet => parquet::read(path, progress)?,
            #[cfg(not(feature = "parquet"))]
            Kind::Parquet => return Err(ForeignError::NoParquet { path: path.into() }),
        }
    };
    if found.series().next().is_none() {
        return Err(ForeignError::NoSeries { path: path.into(), notes: found.notes.join("; ") });
    }
    suggest::roles(&mut found);
    Ok(found)
}

/// The bytes of all files that [`read`] will read: what `progress` counts up to.
pub fn size(path: &Path) -> u64 {
    let length = |path: &Path| path.metadata().map_or(0, |metadata| metadata.len());
    match path.read_dir() {
        Ok(entries) => entries.flatten().map(|entry| length(&entry.path())).sum(),
        Err(_) => length(path),
    }
}

/// What a file is, by its first bytes, and by its name where they say nothing.
fn kind(path: &Path) -> Result<Kind, ForeignError> {
    use std::io::Read;
    let io = |source| ForeignError::Io { path: path.into(), source };
    let mut head = Vec::new();
    std::fs::File::open(path).map_err(io)?.take(16).read_to_end(&mut head).map_err(io)?;
    let what = |what: &'static str, remedy: &'static str| ForeignError::NotReadHere {
        path: path.into(),
        what,
        remedy,
    };
    if head.is_empty() {
        return Err(ForeignError::Empty { path: path.into() });
    } else if head.starts_with(mcap::MAGIC) {
        return Ok(Kind::Mcap);
    } else if head.starts_with(b"PAR1") {
        return Ok(Kind::Parquet);
    } else if head.starts_with(b"SQLite format 3") {
        return Ok(Kind::Sqlite);
    } else if head.starts_with(b"#ROSBAG V2") {
        return Err(what(
            "a ROS 1 bag",
            "convert it to MCAP: `pip install rosbags`, then `rosbags-convert --src FILE.bag --dst BAG_mcap \
             --dst-storage mcap`",
        ));
    } else if head.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]) {
        return Err(what("compressed by zstd as a whole", "unpack it first: `zstd -d FILE`"));
    } else if head.starts_with(&[0x1f, 0x8b]) {
        return Err(what("compressed by gzip", "unpack it first: `gunzip -k FILE`"));
    } else if head.starts_with(b"PK\x03\x04") {
        return Err(what("a ZIP file or a spreadsheet", "unpack it, or save the sheet as CSV"));
    } else if head.starts_with(b"\x89HDF") {
        return Err(what(
            "an HDF5 or MATLAB 7.3 file",
            "write the columns as CSV or Parquet, in Python with `h5py` and `pandas`",
        ));
    } else if head.starts_with(b"MATLAB 5.0") {
        return Err(what(
            "a MATLAB file",
            "write the columns as CSV: `writetable` in MATLAB, or `scipy.io.loadmat` and `pandas` in Python",
        ));
    } else if head.starts_with(b"ULog\x01\x12\x35") {
        return Err(what("a PX4 log", "convert it to CSV: `pip install pyulog`, then `ulog2csv FILE`"));
    }
    // UTF-16 has zeros, and a mark.
    let utf16 = head.starts_with(&[0xff, 0xfe]) || head.starts_with(&[0xfe, 0xff]);
    if head.contains(&0) && !utf16 {
        return Err(what(
            "of a form that is not known here",
            "give CSV, Parquet, or a ROS 2 bag in MCAP; most programs export one of them",
        ));
    }
    Ok(Kind::Csv)
}
