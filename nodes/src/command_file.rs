//! Command files: what to command when, for [`crate::playback`] and for other programs.
//!
//! A command file is CSV: a header line with `time` and the names of the signals, then one line per stamp, in seconds
//! since the start. A value holds from its stamp until the next one. Lines before the header that start with `#` hold
//! TOML: `format = 1`, a `title`, and `units` by signal.
//!
//! ```
//! use parallax_nodes::command_file::CommandFile;
//!
//! let text = r#"# format = 1
//! ## title = "a step"
//! ## units = { "motor.voltage" = "V" }
//! time,motor.voltage
//! 0,0
//! 0.5,2.5
//! "#;
//! let file = CommandFile::parse(text, "step.csv")?;
//! assert_eq!(file.at("motor.voltage", 0.75), Some(2.5));
//! assert_eq!(CommandFile::parse(&file.to_string(), "again.csv")?, file);
//! # Ok::<(), parallax_nodes::command_file::CommandFileError>(())
//! ```

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

/// Commands over time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CommandFile {
    /// What it is for; may be empty.
    pub title: String,
    /// Units of the signals, labels.
    pub units: BTreeMap<String, String>,
    /// Stamps in seconds since the start, increasing.
    pub times: Vec<f64>,
    /// The signals in the order of the file: name, and one value per stamp.
    pub signals: Vec<(String, Vec<f64>)>,
}

/// Why a command file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CommandFileError {
    /// It cannot be read.
    #[error("{file} cannot be read; give a command file, such as `parallax experiment` writes")]
    Read {
        /// The file.
        file: String,
        /// Why.
        source: std::io::Error,
    },
    /// The lines that start with `#` are no TOML, or not what belongs there.
    #[error(
        "{file}: the lines that start with `#` must be TOML with `format = 1`, `title` and `units`: {problem}"
    )]
    Header {
        /// The file.
        file: String,
        /// What is wrong.
        problem: String,
    },
    /// A line is not what it must be.
    #[error("{file}, line {line}: {problem}")]
    Line {
        /// The file.
        file: String,
        /// The line, from 1.
        line: usize,
        /// What is wrong, and what to do.
        problem: String,
    },
}

/// What stands in the lines that start with `#`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    format: u32,
    #[serde(default)]
    title: String,
    #[serde(default)]
    units: BTreeMap<String, String>,
}

impl CommandFile {
    /// Reads the file at `path`.
    ///
    /// # Errors
    ///
    /// [`CommandFileError`] when it cannot be read or is no command file.
    pub fn read(path: &Path) -> Result<Self, CommandFileError> {
        let file = path.display().to_string();
        match std::fs::read_to_string(path) {
            Ok(text) => Self::parse(&text, &file),
            Err(source) => Err(CommandFileError::Read { file, source }),
        }
    }

    /// Reads the text of a command file; `file` is its name for messages.
    ///
    /// # Errors
    ///
    /// [`CommandFileError`] with file and line.
    pub fn parse(text: &str, file: &str) -> Result<Self, CommandFileError> {
        let fail = |line: usize, problem: String| CommandFileError::Line { file: file.into(), line, problem };
        let wrong = |problem: String| CommandFileError::Header { file: file.into(), problem };
        let comment =
            |line: &str| line.strip_prefix('#').map(|rest| rest.strip_prefix(' ').unwrap_or(rest).to_owned());
        let notes: Vec<String> = text.lines().map_while(comment).collect();
        let mut out = CommandFile::default();
        if !notes.is_empty() {
            let header: Header =
                toml::from_str(&notes.join("\n")).map_err(|error| wrong(error.message().to_owned()))?;
            if header.format != 1 {
                return Err(wrong(format!("`format` is {}; this version reads 1", header.format)));
            }
            (out.title, out.units) = (header.title, header.units);
        }
        let mut lines = text.lines().enumerate().skip(notes.len()).map(|(at, line)| (at + 1, line.trim()));
        let (line, names) = lines.next().unwrap_or((notes.len() + 1, ""));
        let mut columns = names.split(',').map(str::trim);
        if columns.next() != Some("time") {
            return Err(fail(
                line,
                "the header must begin with `time`, then name the signals: time,motor.voltage".into(),
            ));
        }
        for name in columns {
            if name.is_empty() || out.signals.iter().any(|(other, _)| other == name) {
                return Err(fail(line, format!("every column needs a name of its own; `{name}` is none")));
            }
            out.signals.push((name.into(), Vec::new()));
        }
        if out.signals.is_empty() {
            return Err(fail(
                line,
                "the header names no signal; it must read like time,motor.voltage".into(),
            ));
        }
        for (line, row) in lines.filter(|(_, row)| !row.is_empty()) {
            let mut cells = Vec::with_capacity(out.signals.len() + 1);
            for cell in row.split(',').map(str::trim) {
                let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
                cells.push(value.ok_or_else(|| fail(line, format!("`{cell}` must be a finite number")))?);
            }
            if cells.len() != out.signals.len() + 1 {
                let (found, needed) = (cells.len(), out.signals.len() + 1);
                return Err(fail(line, format!("{found} columns where the header has {needed}")));
            }
            if out.times.last().map_or(cells[0] < 0.0, |last| cells[0] <= *last) {
                return Err(fail(
                    line,
                    format!("the time {} does not come after the one before it", cells[0]),
                ));
            }
            out.times.push(cells[0]);
            for ((_, values), value) in out.signals.iter_mut().zip(&cells[1..]) {
                values.push(*value);
            }
        }
        if out.times.is_empty() {
            return Err(fail(line, "no line with a time and its values follows the header".into()));
        }
        Ok(out)
    }

    /// The value of a signal at a time (s): the last one stamped at or before it, the first one before that. `None` for
    /// a signal that the file does not have.
    #[must_use]
    pub fn at(&self, signal: &str, time: f64) -> Option<f64> {
        let (_, values) = self.signals.iter().find(|(name, _)| name == signal)?;
        values.get(index_at(&self.times, time)).copied()
    }

    /// The last stamp (s).
    #[must_use]
    pub fn duration(&self) -> f64 {
        self.times.last().copied().unwrap_or(0.0)
    }
}

/// Which of the stamps holds at a time.
pub(crate) fn index_at(times: &[f64], time: f64) -> usize {
    times.partition_point(|stamp| *stamp <= time).saturating_sub(1)
}

impl fmt::Display for CommandFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let header = Header { format: 1, title: self.title.clone(), units: self.units.clone() };
        for line in toml::to_string(&header).map_err(|_| fmt::Error)?.lines() {
            writeln!(f, "# {line}")?;
        }
        f.write_str("time")?;
        for (name, _) in &self.signals {
            write!(f, ",{name}")?;
        }
        f.write_str("\n")?;
        for (at, time) in self.times.iter().enumerate() {
            write!(f, "{time}")?;
            for (_, values) in &self.signals {
                write!(f, ",{}", values[at])?;
            }
            f.write_str("\n")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str, parts: &[&str]) {
        let error = CommandFile::parse(text, "c.csv").expect_err("it is refused").to_string();
        for part in parts {
            assert!(error.contains(part), "`{error}` lacks `{part}`");
        }
    }

    #[test]
    fn what_is_wrong_is_named_by_line() {
        refused("", &["c.csv", "line 1", "time"]);
        refused("t,u\n0,1\n", &["line 1", "begin with `time`"]);
        refused("time\n0\n", &["line 1", "names no signal"]);
        refused("time,u\n", &["no line"]);
        refused("time,u\n0,1\n0,2\n", &["line 3", "does not come after"]);
        refused("time,u\n-1,1\n", &["line 2"]);
        refused("time,u\n0,NaN\n", &["line 2", "`NaN`", "finite"]);
        refused("time,u\n0,1,2\n", &["line 2", "3 columns"]);
        refused("time,u,u\n0,1,2\n", &["`u`"]);
        refused("# format = 2\ntime,u\n0,1\n", &["`format` is 2"]);
        refused("# speed = 2\ntime,u\n0,1\n", &["speed"]);
    }

    #[test]
    fn values_hold_from_their_stamps() {
        let file = CommandFile::parse("time,a,b\n0.5,1,-1\n1,2,-2\n", "c.csv").unwrap();
        let at = |time| (file.at("a", time).unwrap(), file.at("b", time).unwrap());
        assert_eq!(
            [at(0.0), at(0.5), at(0.99), at(1.0), at(9.0)],
            [(1.0, -1.0), (1.0, -1.0), (1.0, -1.0), (2.0, -2.0), (2.0, -2.0)]
        );
        assert_eq!(file.at("c", 1.0), None);
    }

    #[test]
    fn what_is_written_reads_back_bit_for_bit() {
        let values = vec![0.1 + 0.2, -1e-17, 3.0e20];
        let file = CommandFile {
            title: "a \"title\"".into(),
            units: [("m.u".to_owned(), "V".to_owned())].into(),
            times: vec![0.0, 1.0 / 3.0, 1e3],
            signals: vec![("m.u".into(), values)],
        };
        assert_eq!(CommandFile::parse(&file.to_string(), "c.csv").unwrap(), file);
    }
}
