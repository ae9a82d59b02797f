//! Messages of ROS 2, decoded by the definition that the bag holds.
//!
//! The language of definitions: docs.ros.org, "Interfaces"; how they stand together in one text: the MCAP registry,
//! `ros2msg`.

use std::collections::HashMap;
use std::rc::Rc;

use super::value::Value;
use crate::recording::cdr::{CdrError, CdrReader};

/// The definition of a message and of all that is in it.
#[derive(Debug)]
pub(super) struct Definition {
    types: Vec<Vec<Field>>,
}

#[derive(Debug)]
struct Field {
    name: Rc<str>,
    kind: Kind,
    many: Many,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
    Text,
    /// A stamp, which is a message of two numbers.
    Moment,
    /// A duration, which is one as well, in seconds.
    Duration,
    Message(usize),
}

#[derive(Clone, Copy, Debug)]
enum Many {
    One,
    Fixed(usize),
    Any,
}

/// Definitions are not deeper than this; one that holds itself is.
const DEEPEST: usize = 24;

impl Definition {
    /// Reads a definition of a message type such as `sensor_msgs/msg/Imu`.
    ///
    /// # Errors
    ///
    /// What is wrong, in words.
    pub(super) fn parse(name: &str, text: &str) -> Result<Self, String> {
        let mut names: Vec<String> = vec![short(name)];
        let mut texts: Vec<Vec<&str>> = vec![Vec::new()];
        let mut lines = text.lines().peekable();
        while let Some(line) = lines.next() {
            let mark = line.trim().len() > 9 && line.trim().bytes().all(|byte| byte == b'=');
            if let Some(next) = lines.next_if(|next| mark && next.trim().starts_with("MSG:")) {
                names.push(short(next.trim().trim_start_matches("MSG:").trim()));
                texts.push(Vec::new());
            } else if let Some(text) = texts.last_mut() {
                text.push(line);
            }
        }
        let index: HashMap<&str, usize> =
            names.iter().enumerate().rev().map(|(index, name)| (name.as_str(), index)).collect();
        let mut types = Vec::with_capacity(texts.len());
        for (name, lines) in names.iter().zip(&texts) {
            let fields: Result<Vec<Option<Field>>, String> =
                lines.iter().map(|line| field(line, name, &index)).collect();
            types.push(fields?.into_iter().flatten().collect());
        }
        let definition = Self { types };
        definition.check(0, 0)?;
        Ok(definition)
    }

    /// That no type holds itself.
    fn check(&self, index: usize, depth: usize) -> Result<(), String> {
        if depth > DEEPEST {
            return Err("a type of it holds itself".into());
        }
        for field in &self.types[index] {
            if let Kind::Message(inner) = field.kind {
                self.check(inner, depth + 1)?;
            }
        }
        Ok(())
    }

    /// Decodes a message.
    ///
    /// # Errors
    ///
    /// [`CdrError`]: the bytes are not those of such a message.
    pub(super) fn decode(&self, bytes: &[u8]) -> Result<Value, CdrError> {
        self.message(0, &mut CdrReader::new(bytes)?)
    }

    fn message(&self, index: usize, cdr: &mut CdrReader<'_>) -> Result<Value, CdrError> {
        let fields = &self.types[index];
        if fields.is_empty() {
            // ROS 2 has no message without a member.
            cdr.number::<1>()?;
        }
        let mut values = Vec::with_capacity(fields.len());
        for field in fields {
            let value = match field.many {
                Many::One => self.one(field.kind, cdr)?,
                Many::Fixed(count) => self.list(field.kind, count, cdr)?,
                Many::Any => {
                    let count = cdr.length(self.smallest(field.kind))?;
                    self.list(field.kind, count, cdr)?
                }
            };
            values.push((field.name.clone(), value));
        }
        Ok(Value::Fields(values))
    }

    fn list(&self, kind: Kind, count: usize, cdr: &mut CdrReader<'_>) -> Result<Value, CdrError> {
        if matches!(kind, Kind::U8 | Kind::I8) && count > 16 {
            cdr.skip(count)?;
            return Ok(Value::Opaque);
        }
        let items: Result<Vec<Value>, CdrError> = (0..count).map(|_| self.one(kind, cdr)).collect();
        items.map(Value::List)
    }

    /// Bytes that an element takes at least.
    fn smallest(&self, kind: Kind) -> usize {
        match kind {
            Kind::Bool | Kind::I8 | Kind::U8 | Kind::Message(_) => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::I32 | Kind::U32 | Kind::F32 | Kind::Text => 4,
            Kind::I64 | Kind::U64 | Kind::F64 | Kind::Moment | Kind::Duration => 8,
        }
    }

    fn one(&self, kind: Kind, cdr: &mut CdrReader<'_>) -> Result<Value, CdrError> {
        Ok(Value::Number(match kind {
            // Some writers put other numbers into a flag.
            Kind::Bool => f64::from(cdr.number::<1>()? != [0]),
            Kind::I8 => f64::from(i8::from_le_bytes(cdr.number()?)),
            Kind::U8 => f64::from(u8::from_le_bytes(cdr.number()?)),
            Kind::I16 => f64::from(i16::from_le_bytes(cdr.number()?)),
            Kind::U16 => f64::from(u16::from_le_bytes(cdr.number()?)),
            Kind::I32 => f64::from(i32::from_le_bytes(cdr.number()?)),
            Kind::U32 => f64::from(cdr.u32()?),
            Kind::I64 => cdr.i64()? as f64,
            Kind::U64 => cdr.u64()? as f64,
            Kind::F32 => f64::from(f32::from_le_bytes(cdr.number()?)),
            Kind::F64 => cdr.f64()?,
            Kind::Text => return Ok(Value::Text(cdr.text()?.to_owned())),
            Kind::Message(index) => return self.message(index, cdr),
            Kind::Moment | Kind::Duration => {
                let seconds = i64::from(i32::from_le_bytes(cdr.number()?));
                let nanoseconds = seconds * 1_000_000_000 + i64::from(cdr.u32()?);
                if kind == Kind::Moment {
                    return Ok(Value::Moment(nanoseconds));
                }
                nanoseconds as f64 * 1e-9
            }
        }))
    }
}

/// `package/Name`, of `package/msg/Name`.
fn short(name: &str) -> String {
    name.replace("/msg/", "/")
}

/// The field on a line; `None` on a line without one.
fn field(line: &str, owner: &str, index: &HashMap<&str, usize>) -> Result<Option<Field>, String> {
    let line = line.split('#').next().unwrap_or("").trim();
    let mut words = line.split_whitespace();
    let (Some(kind), Some(name)) = (words.next(), words.next()) else {
        return if line.is_empty() { Ok(None) } else { Err(format!("its definition has a line `{line}`")) };
    };
    // A constant has a value after its name; a default has none of these signs before it.
    if name.contains('=') || words.next().is_some_and(|word| word.starts_with('=')) {
        return Ok(None);
    }
    let (kind, many) = match kind.strip_suffix(']').and_then(|rest| rest.rsplit_once('[')) {
        None => (kind, Many::One),
        Some((kind, "")) => (kind, Many::Any),
        Some((kind, count)) if count.starts_with("<=") => (kind, Many::Any),
        Some((kind, count)) => {
            let count = count.parse().map_err(|_| format!("its definition has a line `{line}`"))?;
            (kind, Many::Fixed(count))
        }
    };
    let base = kind.split("<=").next().unwrap_or(kind);
    let kind = match base {
        "bool" => Kind::Bool,
        "int8" => Kind::I8,
        "uint8" | "byte" | "char" => Kind::U8,
        "int16" => Kind::I16,
        "uint16" => Kind::U16,
        "int32" => Kind::I32,
        "uint32" => Kind::U32,
        "int64" => Kind::I64,
        "uint64" => Kind::U64,
        "float32" => Kind::F32,
        "float64" => Kind::F64,
        "string" => Kind::Text,
        "time" | "builtin_interfaces/Time" | "builtin_interfaces/msg/Time" => Kind::Moment,
        "duration" | "builtin_interfaces/Duration" | "builtin_interfaces/msg/Duration" => Kind::Duration,
        "wstring" => return Err(format!("its field `{name}` is a wstring")),
        other => {
            let package = owner.split('/').next().unwrap_or("");
            let full = if other == "Header" {
                "std_msgs/Header".into()
            } else if other.contains('/') {
                short(other)
            } else {
                format!("{package}/{other}")
            };
            let found = index.get(full.as_str());
            Kind::Message(
                *found.ok_or_else(|| format!("the definition of `{full}`, which is in it, is missing"))?,
            )
        }
    };
    Ok(Some(Field { name: name.into(), kind, many }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::cdr::CdrWriter;

    const IMU: &str = "# An inertial unit\nstd_msgs/Header header\nint8 OK=1\nstring NAME = \"imu\"\nfloat64 rate 100.0\n\
        Vector[<=3] gyro\nfloat32[2] pair\nbool on\n\
        ================================================================================\nMSG: std_msgs/Header\n\
        builtin_interfaces/Time stamp\nstring frame_id\n\
        ================================================================================\nMSG: builtin_interfaces/Time\n\
        int32 sec\nuint32 nanosec\n\
        ================================================================================\nMSG: my_msgs/Vector\nfloat64 x\n";

    fn message() -> CdrWriter {
        let mut cdr = CdrWriter::default();
        cdr.begin();
        cdr.u32(3);
        cdr.u32(500);
        cdr.text("base");
        cdr.f64(200.0);
        cdr.length(2);
        cdr.f64(1.0);
        cdr.f64(2.0);
        cdr.u32(1.5_f32.to_bits());
        cdr.u32((-2.0_f32).to_bits());
        cdr.flag(true);
        cdr
    }

    #[test]
    fn a_message_is_decoded_by_its_definition() {
        let definition = Definition::parse("my_msgs/msg/Imu", IMU).unwrap();
        let decoded = definition.decode(message().bytes()).unwrap();
        assert_eq!(super::super::value::stamp(&decoded), Some(3_000_000_500));
        let mut numbers = super::super::value::Numbers::default();
        numbers.push(&decoded);
        assert_eq!(numbers.paths, ["rate", "gyro[0].x", "gyro[1].x", "pair[0]", "pair[1]", "on"]);
        assert_eq!(numbers.columns.concat(), [200.0, 1.0, 2.0, 1.5, -2.0, 1.0]);
    }

    #[test]
    fn a_message_that_is_cut_is_an_error() {
        let definition = Definition::parse("my_msgs/msg/Imu", IMU).unwrap();
        let writer = message();
        for end in 0..writer.bytes().len() {
            assert!(definition.decode(&writer.bytes()[..end]).is_err(), "{end}");
        }
    }

    #[test]
    fn definitions_that_cannot_be_followed_say_why() {
        let fails = |text: &str| Definition::parse("a/msg/B", text).unwrap_err();
        assert!(fails("other/Thing thing\n").contains("other/Thing"));
        assert!(fails("B inner\n").contains("holds itself"));
        assert!(fails("wstring text\n").contains("wstring"));
        assert!(fails("float64[x] bad\n").contains("float64[x]"));
        assert!(fails("float64\n").contains("float64"));
    }
}
