//! The records of an MCAP file, read so that a cut or damaged file gives an answer and never a panic.
//!
//! The file is walked from the front and its summary is not needed, because a recorder that was killed never
//! wrote one.

use std::borrow::Cow;
use std::io::Read;

use mcap::records::{ChunkHeader, Record, op};

/// One record of the file, not yet interpreted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Raw<'a> {
    /// Where it begins in the file.
    pub(crate) at: usize,
    pub(crate) opcode: u8,
    pub(crate) body: &'a [u8],
}

/// Walks over records that follow each other: those of a file, or those inside a chunk.
#[derive(Debug)]
pub(crate) struct Walk<'a> {
    bytes: &'a [u8],
    position: usize,
    /// Where `bytes` begins in the file.
    origin: usize,
}

/// The bytes end inside the record that begins here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Cut(pub(crate) usize);

impl<'a> Walk<'a> {
    pub(crate) fn new(bytes: &'a [u8], origin: usize) -> Self {
        Self { bytes, position: 0, origin }
    }

    /// Offset in the file of what comes next.
    pub(crate) fn at(&self) -> usize {
        self.origin + self.position
    }
}

impl<'a> Iterator for Walk<'a> {
    type Item = Result<Raw<'a>, Cut>;

    fn next(&mut self) -> Option<Self::Item> {
        let rest = &self.bytes[self.position..];
        if rest.is_empty() {
            return None;
        }
        let cut = Some(Err(Cut(self.at())));
        let Some((head, rest)) = rest.split_at_checked(9) else {
            self.position = self.bytes.len();
            return cut;
        };
        let mut length = [0; 8];
        length.copy_from_slice(&head[1..]);
        let body = usize::try_from(u64::from_le_bytes(length)).ok().and_then(|length| rest.get(..length));
        let Some(body) = body else {
            self.position = self.bytes.len();
            return cut;
        };
        let raw = Raw { at: self.at(), opcode: head[0], body };
        self.position += 9 + body.len();
        Some(Ok(raw))
    }
}

/// Interprets a record; the error says what is wrong with it.
pub(crate) fn parse<'a>(raw: Raw<'a>) -> Result<Record<'a>, String> {
    if raw.opcode == op::ATTACHMENT && !attachment_fits(raw.body) {
        return Err("the attachment is longer than its record".into());
    }
    mcap::parse_record(raw.opcode, raw.body).map_err(|e| e.to_string())
}

/// Why the records of a chunk cannot be had.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Packed {
    /// Compressed by something that is not known here.
    #[error(
        "its chunks are compressed by `{0}`, which is not read; `mcap compress --compression zstd` writes them anew"
    )]
    Unknown(String),
    /// Not what it says that it is.
    #[error("the chunk cannot be unpacked: {0}")]
    Broken(String),
}

/// The records of a chunk.
pub(crate) fn unpack<'a>(header: &ChunkHeader, data: &'a [u8]) -> Result<Cow<'a, [u8]>, Packed> {
    let broken = |error: std::io::Error| Packed::Broken(error.to_string());
    let records = match header.compression.as_str() {
        "" => Cow::Borrowed(data),
        "zstd" => Cow::Owned(all(zstd::Decoder::with_buffer(data).map_err(broken)?, header)?),
        "lz4" => Cow::Owned(all(lz4_flex::frame::FrameDecoder::new(data), header)?),
        other => return Err(Packed::Unknown(other.into())),
    };
    if header.uncompressed_crc != 0 && crc32fast::hash(&records) != header.uncompressed_crc {
        return Err(Packed::Broken("its checksum is wrong".into()));
    }
    Ok(records)
}

/// Unpacks as many bytes as the chunk says it has, and no more, whatever its bytes would make of themselves.
fn all(packed: impl Read, header: &ChunkHeader) -> Result<Vec<u8>, Packed> {
    let mut records = Vec::new();
    let size = header.uncompressed_size;
    packed
        .take(size.saturating_add(1))
        .read_to_end(&mut records)
        .map_err(|e| Packed::Broken(e.to_string()))?;
    if records.len() as u64 != size {
        return Err(Packed::Broken(format!("it does not hold the {size} bytes that it says")));
    }
    Ok(records)
}

/// The library subtracts lengths in an attachment without checking them first.
fn attachment_fits(body: &[u8]) -> bool {
    // Two times, two texts, the length of the data, the data, a checksum.
    let mut at = 16usize;
    for size in [4, 4, 8] {
        let Some(bytes) = body.get(at..).and_then(|rest| rest.get(..size)) else { return false };
        let length = bytes.iter().rev().fold(0u64, |n, byte| n << 8 | u64::from(*byte));
        let Some(next) = usize::try_from(length).ok().and_then(|n| n.checked_add(at + size)) else {
            return false;
        };
        at = next;
    }
    at.checked_add(4).is_some_and(|end| end <= body.len())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn header(compression: &str, records: &[u8]) -> ChunkHeader {
        ChunkHeader {
            message_start_time: 0,
            message_end_time: 0,
            uncompressed_size: records.len() as u64,
            uncompressed_crc: crc32fast::hash(records),
            compression: compression.into(),
            compressed_size: 0,
        }
    }

    #[test]
    fn chunks_are_unpacked_or_refused() {
        let records = vec![7; 100_000];
        let zstd = zstd::encode_all(&records[..], 3).unwrap();
        let mut lz4 = lz4_flex::frame::FrameEncoder::new(Vec::new());
        lz4.write_all(&records).unwrap();
        let lz4 = lz4.finish().unwrap();
        for (name, packed) in [("", &records), ("zstd", &zstd), ("lz4", &lz4)] {
            assert_eq!(*unpack(&header(name, &records), packed).unwrap(), records[..], "{name}");
            // Cut, or of another checksum.
            assert!(unpack(&header(name, &records), &packed[..packed.len() / 2]).is_err(), "{name}");
            let other = ChunkHeader { uncompressed_crc: 1, ..header(name, &records) };
            assert!(unpack(&other, packed).unwrap_err().to_string().contains("checksum"), "{name}");
        }
        // No more is unpacked than the chunk says.
        let small = ChunkHeader { uncompressed_size: 10, ..header("zstd", &records) };
        assert!(unpack(&small, &zstd).unwrap_err().to_string().contains("10 bytes"));
        assert!(unpack(&header("brotli", &records), &zstd).unwrap_err().to_string().contains("`brotli`"));
    }
}
