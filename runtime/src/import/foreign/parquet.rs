//! Parquet files.

use std::fs::File;
use std::path::Path;

use ::parquet::basic::{LogicalType, Repetition, TimeUnit as Unit, Type as Physical};
use ::parquet::file::reader::{FileReader, SerializedFileReader};
use ::parquet::record::Field;
use ::parquet::schema::types::Type;

use super::clock::{Clock, UnitFrom};
use super::columns::{Cells, Column, group, may_be_time};
use super::{ForeignError, Found, header};

/// Reads the file at `path`.
pub(super) fn read(path: &Path, progress: &mut dyn FnMut(u64)) -> Result<Found, ForeignError> {
    let damaged = |error: ::parquet::errors::ParquetError| ForeignError::Damaged {
        path: path.into(),
        at: 0,
        reason: error.to_string(),
    };
    let file = File::open(path).map_err(|source| ForeignError::Io { path: path.into(), source })?;
    let size = file.metadata().map_or(0, |metadata| metadata.len());
    let reader = SerializedFileReader::new(file).map_err(damaged)?;
    let metadata = reader.metadata().file_metadata();
    let total = metadata.num_rows().max(1) as u64;
    let schema = metadata.schema().clone();
    let mut columns: Vec<Growing> = schema.get_fields().iter().map(|field| Growing::new(field)).collect();
    let mut rows = 0_usize;
    for row in reader.get_row_iter(None).map_err(damaged)? {
        let row = row.map_err(damaged)?;
        for (column, (_, field)) in columns.iter_mut().zip(row.get_column_iter()) {
            column.push(rows, field);
        }
        rows += 1;
        if rows.is_multiple_of(4096) {
            progress(size * rows as u64 / total);
        }
    }
    let mut notes = Vec::new();
    let columns = columns.into_iter().flat_map(|column| column.finish(rows, &mut notes)).collect();
    let group = group(columns, 1, rows, &mut notes);
    Ok(Found { path: path.into(), form: "Parquet".into(), groups: vec![group], notes })
}

/// A column while it is read: one of numbers, or of lists of numbers.
struct Growing {
    name: String,
    /// By element; a column that is no list has one.
    numbers: Vec<Vec<f64>>,
    /// What may be a time, as it is written.
    texts: Option<Vec<Box<str>>>,
    /// Stamps that the file says are such.
    stamps: Option<Vec<Option<i64>>>,
    /// Nanoseconds since 1970 in whole numbers, which the reader gives as they are.
    nanos: bool,
    list: bool,
    strange: bool,
}

/// Lists of more elements are no signals.
const LONGEST: usize = 64;

impl Growing {
    fn new(field: &Type) -> Self {
        let name = field.name().to_owned();
        let info = field.get_basic_info();
        let logical = info.logical_type_ref();
        let nanos = matches!(logical, Some(LogicalType::Timestamp(stamp)) if stamp.unit == Unit::NANOS);
        let stamped = matches!(logical, Some(LogicalType::Timestamp(_)))
            || format!("{:?}", info.converted_type()).starts_with("TIMESTAMP")
            || (field.is_primitive() && field.get_physical_type() == Physical::INT96);
        let repeated = info.has_repetition() && info.repetition() == Repetition::REPEATED;
        Self {
            texts: (!stamped && header::is_time(&name) && field.is_primitive()).then(Vec::new),
            stamps: stamped.then(Vec::new),
            nanos,
            list: !field.is_primitive() || repeated,
            name,
            numbers: Vec::new(),
            strange: false,
        }
    }

    fn push(&mut self, row: usize, field: &Field) {
        if let Some(stamps) = &mut self.stamps {
            stamps.push(match field {
                Field::TimestampMillis(time) => time.checked_mul(1_000_000),
                Field::TimestampMicros(time) => time.checked_mul(1_000),
                Field::Long(time) if self.nanos => Some(*time),
                _ => None,
            });
            return;
        }
        if let (0, Field::Str(text), None) = (row, field, &self.texts)
            && may_be_time(&self.name, text)
        {
            self.texts = Some(Vec::new());
        }
        if let Some(texts) = &mut self.texts {
            texts.push(match field {
                Field::Null => "".into(),
                Field::Str(text) => text.trim().into(),
                Field::Long(number) => number.to_string().into(),
                Field::ULong(number) => number.to_string().into(),
                Field::Int(number) => number.to_string().into(),
                Field::UInt(number) => number.to_string().into(),
                Field::Double(number) if number.is_finite() => number.to_string().into(),
                Field::Float(number) if number.is_finite() => number.to_string().into(),
                _ => "".into(),
            });
            return;
        }
        match field {
            Field::ListInternal(list) if list.len() <= LONGEST => {
                self.list = true;
                for (index, element) in list.elements().iter().enumerate() {
                    self.set(index, row, element);
                }
            }
            Field::ListInternal(_) => self.strange = true,
            field => self.set(0, row, field),
        }
    }

    fn set(&mut self, element: usize, row: usize, field: &Field) {
        let number = match field {
            Field::Null => f64::NAN,
            Field::Bool(flag) => f64::from(*flag),
            Field::Byte(number) => f64::from(*number),
            Field::Short(number) => f64::from(*number),
            Field::Int(number) => f64::from(*number),
            Field::Long(number) => *number as f64,
            Field::UByte(number) => f64::from(*number),
            Field::UShort(number) => f64::from(*number),
            Field::UInt(number) => f64::from(*number),
            Field::ULong(number) => *number as f64,
            Field::Float16(number) => f64::from(*number),
            Field::Float(number) => f64::from(*number),
            Field::Double(number) => *number,
            _ => {
                self.strange = true;
                return;
            }
        };
        while self.numbers.len() <= element {
            self.numbers.push(Vec::new());
        }
        let column = &mut self.numbers[element];
        column.resize(row, f64::NAN);
        column.push(if number.is_finite() { number } else { f64::NAN });
    }

    fn finish(self, rows: usize, notes: &mut Vec<String>) -> Vec<Column> {
        let (name, unit) = header::split(&self.name);
        let column = |header: &str, name: &str, cells| Column {
            header: header.into(),
            name: name.into(),
            unit: unit.clone(),
            cells,
        };
        if let Some(stamps) = self.stamps {
            return vec![column(
                &self.name,
                &name,
                Cells::Clock(Clock::nanos(&self.name, stamps, UnitFrom::Stated)),
            )];
        }
        if let Some(texts) = self.texts {
            return vec![column(&self.name, &name, Cells::Texts(texts))];
        }
        if self.strange {
            notes.push(format!("column `{}` holds text, nested values or long lists", self.name));
            return Vec::new();
        }
        let padded = |mut values: Vec<f64>| {
            values.resize(rows, f64::NAN);
            Cells::Numbers(values)
        };
        if !self.list {
            let values = self.numbers.into_iter().next().unwrap_or_default();
            return vec![column(&self.name, &name, padded(values))];
        }
        let elements = self.numbers.into_iter().enumerate();
        elements
            .map(|(index, values)| {
                column(&format!("{}[{index}]", self.name), &format!("{name}[{index}]"), padded(values))
            })
            .collect()
    }
}
