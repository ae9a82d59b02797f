//! The records of an MCAP file, read so that a cut or damaged file gives an answer and never a panic.
//!
//! The file is walked from the front and its summary is not needed, because a recorder that was killed never
//! wrote one.

use mcap::records::{Record, op};

/// One record of the file, not yet interpreted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Raw<'a> {
    /// Where it begins in the file.
    pub(super) at: usize,
    pub(super) opcode: u8,
    pub(super) body: &'a [u8],
}

/// Walks over records that follow each other: those of a file, or those inside a chunk.
#[derive(Debug)]
pub(super) struct Walk<'a> {
    bytes: &'a [u8],
    position: usize,
    /// Where `bytes` begins in the file.
    origin: usize,
}

/// The bytes end inside the record that begins here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cut(pub(super) usize);

impl<'a> Walk<'a> {
    pub(super) fn new(bytes: &'a [u8], origin: usize) -> Self {
        Self { bytes, position: 0, origin }
    }

    /// Offset in the file of what comes next.
    pub(super) fn at(&self) -> usize {
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
pub(super) fn parse<'a>(raw: Raw<'a>) -> Result<Record<'a>, String> {
    if raw.opcode == op::ATTACHMENT && !attachment_fits(raw.body) {
        return Err("the attachment is longer than its record".into());
    }
    mcap::parse_record(raw.opcode, raw.body).map_err(|e| e.to_string())
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
