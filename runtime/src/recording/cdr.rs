//! Common Data Representation, little-endian: how ROS 2 lays the bytes of a message out.
//!
//! A message begins with four bytes that name the encoding; after them every number stands at a multiple of
//! its own size, counted from the end of those four bytes (OMG, *DDS Interoperability Wire Protocol* 2.5,
//! section 10, and *CORBA* 3.3, section 9.3: "plain CDR, version 1").

/// Plain CDR, little-endian, no options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Bytes of a message that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The first four bytes name an encoding that this reader does not know.
    #[error("the encoding {0:02x?} is not plain little-endian CDR")]
    Encoding(Vec<u8>),
    /// The message ends inside a value.
    #[error("the message ends at byte {length} inside a value of {wanted} bytes")]
    Short {
        /// Length of the message in bytes.
        length: usize,
        /// Bytes of the value that did not fit.
        wanted: usize,
    },
    /// A text is not UTF-8 or does not end with a zero.
    #[error("the text at byte {at} is not zero-terminated UTF-8")]
    Text {
        /// Offset of the text.
        at: usize,
    },
    /// A flag is neither 0 nor 1.
    #[error("the flag at byte {at} is neither 0 nor 1")]
    Flag {
        /// Offset of the flag.
        at: usize,
    },
    /// The message goes on after its last field.
    #[error("{extra} bytes follow the last field")]
    Long {
        /// Bytes too many.
        extra: usize,
    },
}

/// Writes one message after another into the same buffer.
#[derive(Debug, Default)]
pub struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    /// Begins a new message and forgets the last.
    pub fn begin(&mut self) -> &mut Self {
        self.bytes.clear();
        self.bytes.extend_from_slice(&ENCAPSULATION);
        self
    }

    /// The message so far.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    fn align(&mut self, size: usize) {
        let position = self.bytes.len() - ENCAPSULATION.len();
        self.bytes.resize(ENCAPSULATION.len() + position.next_multiple_of(size), 0);
    }

    /// A `float64`.
    pub fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// A `uint64`.
    pub fn u64(&mut self, value: u64) {
        self.align(8);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// An `int64`.
    pub fn i64(&mut self, value: i64) {
        self.align(8);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// A `uint32`.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// A `bool`.
    pub fn flag(&mut self, value: bool) {
        self.bytes.push(u8::from(value));
    }

    /// The length of a sequence, to be followed by its elements.
    pub fn length(&mut self, length: usize) {
        self.align(4);
        // A sequence of more than four thousand million elements cannot be in memory: each takes a byte.
        self.bytes.extend_from_slice(&u32::try_from(length).unwrap_or(u32::MAX).to_le_bytes());
    }

    /// A `uint8[]`.
    pub fn blob(&mut self, bytes: &[u8]) {
        self.length(bytes.len());
        self.bytes.extend_from_slice(bytes);
    }

    /// A `string`.
    pub fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.bytes.extend_from_slice(text.as_bytes());
        self.bytes.push(0);
    }
}

/// Reads one message, front to back.
#[derive(Debug)]
pub struct CdrReader<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> CdrReader<'a> {
    /// A reader of this message.
    ///
    /// # Errors
    ///
    /// [`CdrError::Encoding`] when it is not plain little-endian CDR.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        // The last two bytes are options, which plain CDR ignores.
        if bytes.len() < 4 || bytes[..2] != ENCAPSULATION[..2] {
            return Err(CdrError::Encoding(bytes[..bytes.len().min(4)].to_vec()));
        }
        Ok(Self { bytes: &bytes[4..], position: 0 })
    }

    fn take(&mut self, size: usize, align: usize) -> Result<&'a [u8], CdrError> {
        let start = self.position.next_multiple_of(align);
        let end = start.checked_add(size).filter(|end| *end <= self.bytes.len());
        let end = end.ok_or(CdrError::Short { length: self.bytes.len() + 4, wanted: size })?;
        self.position = end;
        Ok(&self.bytes[start..end])
    }

    /// The bytes of a number of `N` bytes.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let mut value = [0; N];
        value.copy_from_slice(self.take(N, N)?);
        Ok(value)
    }

    /// Goes on after so many bytes.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn skip(&mut self, length: usize) -> Result<(), CdrError> {
        self.take(length, 1).map(|_| ())
    }

    /// A `float64`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`], as for all that follow.
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        self.number().map(f64::from_le_bytes)
    }

    /// A `uint64`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn u64(&mut self) -> Result<u64, CdrError> {
        self.number().map(u64::from_le_bytes)
    }

    /// An `int64`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn i64(&mut self) -> Result<i64, CdrError> {
        self.number().map(i64::from_le_bytes)
    }

    /// A `uint32`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        self.number().map(u32::from_le_bytes)
    }

    /// A `bool`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`] or [`CdrError::Flag`].
    pub fn flag(&mut self) -> Result<bool, CdrError> {
        match self.take(1, 1)?[0] {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(CdrError::Flag { at: self.position + 3 }),
        }
    }

    /// The length of a sequence, of which every element takes at least `smallest` bytes: a length that the
    /// rest of the message cannot hold is refused before anybody reserves memory for it.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn length(&mut self, smallest: usize) -> Result<usize, CdrError> {
        let length = self.u32()? as usize;
        let wanted = length.saturating_mul(smallest);
        if wanted > self.bytes.len() - self.position {
            return Err(CdrError::Short { length: self.bytes.len() + 4, wanted });
        }
        Ok(length)
    }

    /// A `uint8[]`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`].
    pub fn blob(&mut self) -> Result<&'a [u8], CdrError> {
        let length = self.length(1)?;
        self.take(length, 1)
    }

    /// A `string`.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`] or [`CdrError::Text`].
    pub fn text(&mut self) -> Result<&'a str, CdrError> {
        let length = self.length(1)?;
        let at = self.position + 4;
        match self.take(length, 1)? {
            // Some writers give the empty text no terminator.
            [] => Ok(""),
            [text @ .., 0] => std::str::from_utf8(text).map_err(|_| CdrError::Text { at }),
            _ => Err(CdrError::Text { at }),
        }
    }

    /// Checks that the message ends here. Padding up to the next multiple of four is allowed.
    ///
    /// # Errors
    ///
    /// [`CdrError::Long`].
    pub fn end(self) -> Result<(), CdrError> {
        let extra = self.bytes.len() - self.position;
        if extra > 3 || self.bytes[self.position..].iter().any(|byte| *byte != 0) {
            return Err(CdrError::Long { extra });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Debug, Clone, PartialEq)]
    enum Value {
        F(u64),
        U(u64),
        I(i64),
        B(bool),
        T(String),
    }

    fn value() -> impl Strategy<Value = Value> {
        prop_oneof![
            any::<u64>().prop_map(Value::F),
            any::<u64>().prop_map(Value::U),
            any::<i64>().prop_map(Value::I),
            any::<bool>().prop_map(Value::B),
            "[a-zé]{0,9}".prop_map(Value::T),
        ]
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(values in prop::collection::vec(value(), 0..20), cut in any::<prop::sample::Index>()) {
            let mut writer = CdrWriter::default();
            writer.begin();
            for value in &values {
                match value {
                    Value::F(bits) => writer.f64(f64::from_bits(*bits)),
                    Value::U(x) => writer.u64(*x),
                    Value::I(x) => writer.i64(*x),
                    Value::B(x) => writer.flag(*x),
                    Value::T(x) => writer.text(x),
                }
            }
            let read = |bytes: &[u8]| -> Result<Vec<Value>, CdrError> {
                let mut reader = CdrReader::new(bytes)?;
                let mut got = Vec::new();
                for value in &values {
                    got.push(match value {
                        Value::F(_) => Value::F(reader.f64()?.to_bits()),
                        Value::U(_) => Value::U(reader.u64()?),
                        Value::I(_) => Value::I(reader.i64()?),
                        Value::B(_) => Value::B(reader.flag()?),
                        Value::T(_) => Value::T(reader.text()?.to_owned()),
                    });
                }
                reader.end()?;
                Ok(got)
            };
            prop_assert_eq!(read(writer.bytes()).unwrap(), values.clone());
            if !values.is_empty() {
                let cut = cut.index(writer.bytes().len());
                prop_assert!(read(&writer.bytes()[..cut]).is_err());
            }
        }
    }

    #[test]
    fn the_bytes_are_those_of_the_standard() {
        let mut writer = CdrWriter::default();
        writer.begin();
        writer.flag(true);
        writer.text("ab");
        writer.u64(2);
        // Flag, padding to 4, length 3 with the terminator, text, padding to 8 (from 11 to 16), number.
        let expected =
            [&[0, 1, 0, 0][..], &[1, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0], &[0; 5], &[2], &[0; 7]].concat();
        assert_eq!(writer.bytes(), expected);
    }
}
