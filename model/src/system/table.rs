//! Reads TOML tables with the line of everything, and complains precisely.

use toml_edit::{Item, TableLike, Value};

use super::error::{Location, Suggestion, SystemError};
use super::expression::Expression;

/// The text of a file.
pub(super) struct Source<'a> {
    pub(super) text: &'a str,
    pub(super) file: &'a str,
}

impl Source<'_> {
    /// The line that holds a byte of the text.
    pub(super) fn at(&self, byte: Option<usize>) -> Location {
        let line = byte.map_or(0, |byte| {
            let end = byte.min(self.text.len());
            self.text.as_bytes()[..end].iter().filter(|b| **b == b'\n').count() + 1
        });
        Location::new(self.file, line)
    }
}

/// A table and what it is, such as "parameter `M`".
pub(super) struct Table<'a> {
    pub(super) source: &'a Source<'a>,
    pub(super) entries: &'a dyn TableLike,
    pub(super) what: String,
    pub(super) at: Location,
}

/// One key of a table and its value.
pub(super) struct Field<'a> {
    source: &'a Source<'a>,
    pub(super) key: &'a str,
    pub(super) item: &'a Item,
    /// The whole name for messages, such as "`value` of parameter `M`".
    what: String,
    /// The key's line.
    pub(super) at: Location,
}

impl<'a> Table<'a> {
    /// The fields in the order of the file.
    pub(super) fn fields(&self) -> Vec<Field<'a>> {
        self.entries.iter().filter_map(|(key, _)| self.field(key)).collect()
    }

    /// A field that may be absent.
    pub(super) fn field(&self, key: &str) -> Option<Field<'a>> {
        let (key, item) = self.entries.get_key_value(key).filter(|(_, item)| !item.is_none())?;
        Some(Field {
            source: self.source,
            key: key.get(),
            item,
            what: format!("`{}` of {}", key.get(), self.what),
            at: self.source.at(key.span().or_else(|| item.span()).map(|span| span.start)),
        })
    }

    /// A field that must be there; `remedy` completes "…; ".
    pub(super) fn needed(&self, key: &str, remedy: &str) -> Result<Field<'a>, SystemError> {
        self.field(key).ok_or_else(|| SystemError::MissingField {
            at: self.at.clone(),
            field: key.into(),
            within: self.what.as_str().into(),
            remedy: remedy.into(),
        })
    }

    /// Complains of a key that is not among `known`.
    pub(super) fn only(&self, known: &[&str]) -> Result<(), SystemError> {
        match self.fields().into_iter().find(|field| !known.contains(&field.key)) {
            None => Ok(()),
            Some(field) => Err(SystemError::UnknownField {
                at: field.at,
                field: field.key.into(),
                within: self.what.as_str().into(),
                suggestion: Suggestion::nearest(field.key, known.iter().copied()),
                known: known.join(", ").into(),
            }),
        }
    }

    /// A number above zero.
    pub(super) fn positive(&self, key: &str) -> Result<Option<f64>, SystemError> {
        let Some(field) = self.field(key) else { return Ok(None) };
        match field.number()? {
            value if value > 0.0 => Ok(Some(value)),
            value => Err(field.bad(&format!("{value} is not above zero"))),
        }
    }

    pub(super) fn string(&self, key: &str) -> Result<Option<&'a str>, SystemError> {
        self.field(key).map(|field| field.string()).transpose()
    }

    pub(super) fn expression(&self, key: &str) -> Result<Option<Expression>, SystemError> {
        self.field(key).map(|field| field.expression()).transpose()
    }
}

impl<'a> Field<'a> {
    /// The same field under another name for messages.
    pub(super) fn called(self, what: String) -> Self {
        Self { what, ..self }
    }

    /// Where the value starts.
    pub(super) fn value_at(&self) -> Location {
        match self.item.span() {
            Some(span) => self.source.at(Some(span.start)),
            None => self.at.clone(),
        }
    }

    pub(super) fn bad(&self, problem: &str) -> SystemError {
        SystemError::BadValue {
            at: self.value_at(),
            field: self.what.as_str().into(),
            problem: problem.into(),
        }
    }

    pub(super) fn wrong(&self, expected: &str) -> SystemError {
        SystemError::WrongType {
            at: self.value_at(),
            field: self.what.as_str().into(),
            expected: expected.into(),
            found: self.item.type_name().into(),
        }
    }

    /// A finite number; a whole one may be written without a point.
    pub(super) fn number(&self) -> Result<f64, SystemError> {
        number(self.item.as_value())
            .ok_or_else(|| self.wrong("a number"))?
            .map_err(|problem| self.bad(problem))
    }

    pub(super) fn string(&self) -> Result<&'a str, SystemError> {
        match self.item.as_str() {
            Some("") => Err(self.bad("the string is empty")),
            Some(string) => Ok(string),
            None => Err(self.wrong("a string")),
        }
    }

    /// A list of strings that are not empty.
    pub(super) fn strings(&self) -> Result<Vec<String>, SystemError> {
        let list = self.item.as_array().ok_or_else(|| self.wrong("a list of strings"))?;
        let string = |item: &toml_edit::Value| {
            let string = item.as_str().filter(|string| !string.is_empty());
            string.map(str::to_owned).ok_or_else(|| self.wrong("a list of strings that are not empty"))
        };
        list.iter().map(string).collect()
    }

    /// An expression in a string, or a plain number.
    pub(super) fn expression(&self) -> Result<Expression, SystemError> {
        let at = self.value_at();
        if let Some(text) = self.item.as_str() {
            return Expression::parse(text, self.source.file, at.line, &self.what);
        }
        match number(self.item.as_value()) {
            Some(Ok(value)) => {
                Expression::parse(&format!("{value:?}"), self.source.file, at.line, &self.what)
            }
            Some(Err(problem)) => Err(self.bad(problem)),
            None => Err(self.wrong("an expression in quotes, or a number")),
        }
    }

    /// `[low, high]` with low below high.
    pub(super) fn bounds(&self) -> Result<[f64; 2], SystemError> {
        let expected = "a pair of numbers such as [0.0, 1.0]";
        let array = self.item.as_array().ok_or_else(|| self.wrong(expected))?;
        let numbers: Vec<f64> = array
            .iter()
            .map(|value| number(Some(value)).ok_or_else(|| self.wrong(expected))?.map_err(|p| self.bad(p)))
            .collect::<Result<_, _>>()?;
        match numbers[..] {
            [low, high] if low < high => Ok([low, high]),
            [low, high] => {
                Err(self.bad(&format!("the lower bound {low} is not below the upper bound {high}")))
            }
            _ => Err(self.wrong(expected)),
        }
    }

    pub(super) fn table(&self) -> Result<Table<'a>, SystemError> {
        let entries = self.item.as_table_like().ok_or_else(|| self.wrong("a table"))?;
        Ok(Table { source: self.source, entries, what: self.what.clone(), at: self.at.clone() })
    }

    /// The tables of `[[key]]`, or of an array of inline tables.
    pub(super) fn tables(&self) -> Result<Vec<Table<'a>>, SystemError> {
        let entries: Vec<(&'a dyn TableLike, Option<usize>)> = match self.item {
            Item::ArrayOfTables(array) => {
                array.iter().map(|t| (t as &dyn TableLike, t.span().map(|s| s.start))).collect()
            }
            Item::Value(Value::Array(array)) => array
                .iter()
                .map(|v| v.as_inline_table().map(|t| (t as &dyn TableLike, t.span().map(|s| s.start))))
                .collect::<Option<_>>()
                .ok_or_else(|| self.wrong("an array of tables"))?,
            _ => return Err(self.wrong("an array of tables, written `[[...]]`")),
        };
        let number = |(index, (entries, byte)): (usize, (&'a dyn TableLike, Option<usize>))| Table {
            source: self.source,
            entries,
            what: format!("[[{}]] number {}", self.key, index + 1),
            at: self.source.at(byte),
        };
        Ok(entries.into_iter().enumerate().map(number).collect())
    }
}

/// `None` where the value is no number, an error where it is one that is not finite.
fn number(value: Option<&Value>) -> Option<Result<f64, &'static str>> {
    let value = match value? {
        Value::Integer(whole) => *whole.value() as f64,
        Value::Float(float) => *float.value(),
        _ => return None,
    };
    Some(if value.is_finite() { Ok(value) } else { Err("the number must be finite") })
}
