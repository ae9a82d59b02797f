//! CSV files of any dialect.

use std::path::Path;

use ::csv::{ByteRecord, ReaderBuilder, Trim};

use super::columns::{Cells, Column, group, may_be_time};
use super::dialect::{self, Dialect, Written, is_comment, is_missing, labels, number, split, trimmed};
use super::{ForeignError, Found};

/// Reads the file at `path`.
pub(super) fn read(
    path: &Path,
    known: &Dialect,
    progress: &mut dyn FnMut(u64),
) -> Result<Found, ForeignError> {
    let bytes = std::fs::read(path).map_err(|source| ForeignError::Io { path: path.into(), source })?;
    let text = dialect::decode(bytes);
    let written = dialect::find(&text, known).ok_or_else(|| ForeignError::Damaged {
        path: path.into(),
        at: 0,
        reason: "no line of it looks like a row of numbers; if it is CSV, say how it is written: --delimiter, --decimal, --header"
            .into(),
    })?;
    let mut table = Table::new(path, known, &written);
    rows(&text[written.offset..], &written, |line, cells, offset| {
        if line % 4096 == 0 {
            progress((written.offset + offset) as u64);
        }
        table.row(written.first_line as u64 + line, cells)
    })?;
    let (columns, mut notes, count) = table.finish()?;
    let group = group(columns, written.first_line, count, &mut notes);
    Ok(Found { path: path.into(), form: written.form(), groups: vec![group], notes })
}

/// Gives every row: its line from 0, its cells, and its offset.
fn rows(
    text: &str,
    written: &Written,
    mut row: impl FnMut(u64, &[&str], usize) -> Result<(), ForeignError>,
) -> Result<(), ForeignError> {
    if written.delimiter == ' ' {
        let mut offset = 0;
        for (line, content) in text.split_inclusive('\n').enumerate() {
            if !is_comment(content) {
                row(line as u64, &split(content, ' '), offset)?;
            }
            offset += content.len();
        }
        return Ok(());
    }
    let mut reader = ReaderBuilder::new()
        .delimiter(u8::try_from(written.delimiter).unwrap_or(b','))
        .trim(Trim::All)
        .flexible(true)
        .has_headers(false)
        .comment(Some(b'#'))
        .from_reader(text.as_bytes());
    let mut record = ByteRecord::new();
    // The text is UTF-8, and so is every part between delimiters.
    while reader.read_byte_record(&mut record).is_ok_and(|more| more) {
        let (line, at) = record.position().map_or((0, 0), |at| (at.line() - 1, at.byte() as usize));
        let cells: Vec<&str> =
            record.iter().map(|cell| std::str::from_utf8(cell).unwrap_or("").trim()).collect();
        if cells.iter().any(|cell| !cell.is_empty()) {
            row(line, &cells, at)?;
        }
    }
    Ok(())
}

struct Table<'a> {
    path: &'a Path,
    known: &'a Dialect,
    written: &'a Written,
    columns: Vec<Growing>,
    rows: usize,
    /// A row of another length: only the last one may be cut off.
    odd: Option<(u64, usize)>,
    started: bool,
}

/// A column while it is read.
struct Growing {
    name: String,
    unit: String,
    time: bool,
    /// Whether its cells are lists, such as `[0.1, 0.2]`; the elements are then in `lists`.
    list: bool,
    lists: Vec<Vec<f64>>,
    numbers: Vec<f64>,
    texts: Vec<Box<str>>,
    /// Cells that are no numbers: how many, and the first.
    strange: usize,
    first_strange: Option<(u64, String)>,
}

/// Lists of more elements are no signals.
const LONGEST: usize = 64;

impl Growing {
    /// Takes a cell of a column of lists.
    fn list(&mut self, rows: usize, line: u64, cell: &str, missing: bool) {
        let inside = cell.trim_matches(['[', ']', '(', ')']);
        let numbers: Option<Vec<f64>> = inside
            .split(|c: char| c == ',' || c == ';' || c.is_whitespace())
            .filter(|part| !part.is_empty())
            .map(|part| if is_missing(part, &[]) { Some(f64::NAN) } else { number(part, false) })
            .collect();
        match numbers.filter(|numbers| numbers.len() <= LONGEST) {
            Some(numbers) => {
                for (element, value) in numbers.into_iter().enumerate() {
                    if self.lists.len() <= element {
                        self.lists.push(Vec::new());
                    }
                    self.lists[element].resize(rows - 1, f64::NAN);
                    self.lists[element].push(value);
                }
            }
            None if missing => {}
            None => {
                self.strange += 1;
                self.first_strange.get_or_insert_with(|| (line, cell.chars().take(40).collect()));
            }
        }
    }

    /// A column of lists as a column for each element.
    fn elements(self, header: &str, rows: usize) -> Vec<Column> {
        let elements = self.lists.into_iter().enumerate();
        elements
            .map(|(element, mut values)| {
                values.resize(rows, f64::NAN);
                Column {
                    header: format!("{header}[{element}]"),
                    name: format!("{}[{element}]", self.name),
                    unit: self.unit.clone(),
                    cells: Cells::Numbers(values),
                }
            })
            .collect()
    }
}

impl<'a> Table<'a> {
    fn new(path: &'a Path, known: &'a Dialect, written: &'a Written) -> Self {
        let columns = labels(written)
            .into_iter()
            .map(|(name, unit)| Growing {
                name,
                unit,
                time: false,
                list: false,
                lists: vec![],
                numbers: vec![],
                texts: vec![],
                strange: 0,
                first_strange: None,
            })
            .collect();
        Self { path, known, written, columns, rows: 0, odd: None, started: false }
    }

    fn row(&mut self, line: u64, cells: &[&str]) -> Result<(), ForeignError> {
        let width = self.columns.len();
        if let Some((line, found)) = self.odd {
            return Err(ForeignError::RowLength { path: self.path.into(), line, found, expected: width });
        }
        let cells = trimmed(cells.to_vec(), width);
        if cells.len() != width {
            self.odd = Some((line, cells.len()));
            return Ok(());
        }
        if !self.started {
            self.started = true;
            for (column, cell) in self.columns.iter_mut().zip(&cells) {
                column.time = may_be_time(&column.name, cell);
                column.list = dialect::is_list(cell);
            }
        }
        self.rows += 1;
        for (column, cell) in self.columns.iter_mut().zip(cells) {
            let missing = is_missing(cell, &self.known.missing);
            if column.list {
                column.list(self.rows, line, cell, missing);
                continue;
            }
            if column.time {
                let comma = self.written.decimal_comma && number(cell, true).is_some();
                let text = match (missing, comma) {
                    (true, _) => "".into(),
                    (false, true) => cell.replacen(',', ".", 1).into(),
                    (false, false) => cell.into(),
                };
                column.texts.push(text);
                continue;
            }
            let value = if missing { None } else { number(cell, self.written.decimal_comma) };
            column.numbers.push(value.unwrap_or(f64::NAN));
            if value.is_none() && !missing {
                column.strange += 1;
                column.first_strange.get_or_insert_with(|| (line, cell.to_owned()));
            }
        }
        Ok(())
    }

    fn finish(self) -> Result<(Vec<Column>, Vec<String>, usize), ForeignError> {
        let (path, mut notes) = (self.path, Vec::new());
        if let Some((line, found)) = self.odd {
            let width = self.columns.len();
            notes.push(format!("line {line} is cut off ({found} of {width} cells) and left out"));
        }
        let mut columns = Vec::with_capacity(self.columns.len());
        for (column, header) in self.columns.into_iter().zip(&self.written.names) {
            let cells = if column.time {
                Cells::Texts(column.texts)
            } else if column.list {
                if let Some((line, text)) = &column.first_strange {
                    notes.push(format!("column `{header}` holds lists that are too long, or no numbers: `{text}` in line {line}"));
                } else {
                    columns.extend(column.elements(header, self.rows));
                }
                continue;
            } else {
                let known = column.numbers.iter().filter(|number| !number.is_nan()).count();
                if let Some((line, text)) = column.first_strange {
                    if known > column.strange {
                        let column = header.clone();
                        return Err(ForeignError::NotANumber { path: path.into(), line, column, text });
                    }
                    notes.push(format!("column `{header}` holds text, such as `{text}` in line {line}"));
                    continue;
                }
                Cells::Numbers(column.numbers)
            };
            columns.push(Column { header: header.clone(), name: column.name, unit: column.unit, cells });
        }
        Ok((columns, notes, self.rows))
    }
}
