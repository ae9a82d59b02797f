//! Packets of the Dynamixel Protocol 2.0: putting them together and taking them apart, without allocating.
//!
//! ```text
//! FF FF FD 00 | id | length (2) | instruction | parameters ... | CRC-16 (2)
//! ```
//!
//! The length counts from the instruction on. A status packet is an instruction 0x55 whose first parameter is the error.
//! Where instruction and parameters hold `FF FF FD`, another `FD` is stuffed in, so that no packet contains a header.
//! Source: ROBOTIS e-Manual, *DYNAMIXEL Protocol 2.0*.

use std::fmt;

/// How every packet begins.
pub const HEADER: [u8; 4] = [0xff, 0xff, 0xfd, 0x00];
/// The address of all servos at once.
pub const BROADCAST: u8 = 0xfe;
/// The highest address of a single servo.
pub const HIGHEST_ID: u8 = 252;
/// Bytes of a packet at most, here: enough for the largest control table and for dozens of servos at once.
pub const LONGEST: usize = 1024;

/// Bytes before the instruction: header, id, length.
const FRONT: usize = 7;
/// Where the bytes that are counted in the length begin.
const COUNTED: usize = 7;

/// What a servo is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Instruction {
    /// Say that you are there: model number and firmware version.
    Ping = 0x01,
    /// Send a part of the control table.
    Read = 0x02,
    /// Change a part of the control table.
    Write = 0x03,
    /// Start anew.
    Reboot = 0x08,
    /// The answer of a servo.
    Status = 0x55,
    /// Several servos send the same part of their tables, one after the other.
    SyncRead = 0x82,
    /// Several servos change the same part of their tables; none answers.
    SyncWrite = 0x83,
}

impl Instruction {
    /// The instruction with this number, if it is one of those used here.
    pub fn from_byte(byte: u8) -> Option<Self> {
        [Self::Ping, Self::Read, Self::Write, Self::Reboot, Self::Status, Self::SyncRead, Self::SyncWrite]
            .into_iter()
            .find(|instruction| *instruction as u8 == byte)
    }
}

/// CRC-16 as all packets carry it: polynomial 0x8005, start 0, bits in order.
pub fn crc(bytes: &[u8]) -> u16 {
    const TABLE: [u16; 256] = table();
    bytes.iter().fold(0, |crc, byte| (crc << 8) ^ TABLE[usize::from((crc >> 8) as u8 ^ byte)])
}

const fn table() -> [u16; 256] {
    let mut table = [0; 256];
    let mut index = 0;
    while index < 256 {
        let mut crc = (index as u16) << 8;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 0x8000 != 0 { (crc << 1) ^ 0x8005 } else { crc << 1 };
            bit += 1;
        }
        table[index] = crc;
        index += 1;
    }
    table
}

/// A packet being put together, in memory of its own.
#[derive(Clone)]
pub struct Packet {
    bytes: [u8; LONGEST],
    length: usize,
    full: bool,
}

impl Default for Packet {
    fn default() -> Self {
        Self { bytes: [0; LONGEST], length: 0, full: false }
    }
}

impl fmt::Debug for Packet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:02x?}", &self.bytes[..self.length])
    }
}

impl Packet {
    /// Begins a packet for `id`; what was in this one is forgotten.
    pub fn begin(&mut self, id: u8, instruction: Instruction) -> &mut Self {
        self.full = false;
        self.bytes[..4].copy_from_slice(&HEADER);
        self.bytes[4] = id;
        self.length = FRONT;
        self.push(instruction as u8);
        self
    }

    fn push(&mut self, byte: u8) {
        // Room for the CRC stays.
        if self.length + 3 > LONGEST {
            self.full = true;
            return;
        }
        self.bytes[self.length] = byte;
        self.length += 1;
    }

    /// Adds parameters.
    pub fn add(&mut self, parameters: &[u8]) -> &mut Self {
        for &byte in parameters {
            self.push(byte);
            if self.length >= FRONT + 3 && self.bytes[self.length - 3..self.length] == [0xff, 0xff, 0xfd] {
                self.push(0xfd);
            }
        }
        self
    }

    /// Adds a number of two bytes.
    pub fn word(&mut self, number: u16) -> &mut Self {
        self.add(&number.to_le_bytes())
    }

    /// Ends the packet; gives its bytes, or `None` when it became longer than [`LONGEST`].
    pub fn end(&mut self) -> Option<&[u8]> {
        if self.full {
            return None;
        }
        let counted = (self.length - COUNTED + 2) as u16;
        self.bytes[5..7].copy_from_slice(&counted.to_le_bytes());
        let crc = crc(&self.bytes[..self.length]).to_le_bytes();
        self.bytes[self.length..self.length + 2].copy_from_slice(&crc);
        self.length += 2;
        Some(&self.bytes[..self.length])
    }
}

/// What is wrong with bytes that should be a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PacketError {
    /// The check sum does not fit: bytes were changed on the way.
    #[error(
        "the check sum is {got:04x} instead of {expected:04x}: the line is disturbed, or two servos have one id"
    )]
    Crc {
        /// What the packet says.
        got: u16,
        /// What its bytes give.
        expected: u16,
    },
    /// The length is not that of any packet.
    #[error("a packet claims a length of {length}")]
    Length {
        /// What it claims.
        length: usize,
    },
}

/// A packet that has been taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received<'a> {
    /// Who sent it, or to whom it is.
    pub id: u8,
    /// Number of the instruction; 0x55 for an answer.
    pub instruction: u8,
    /// The parameters, without stuffing.
    pub parameters: &'a [u8],
}

/// Finds packets in a stream of bytes, whatever stands between them.
#[derive(Clone)]
pub struct Parser {
    bytes: [u8; LONGEST],
    length: usize,
    /// Bytes at the front that have been handed out.
    used: usize,
    skipped: u64,
}

impl Default for Parser {
    fn default() -> Self {
        Self { bytes: [0; LONGEST], length: 0, used: 0, skipped: 0 }
    }
}

impl fmt::Debug for Parser {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Parser").field("waiting", &(self.length - self.used)).finish_non_exhaustive()
    }
}

impl Parser {
    /// Forgets what has been read.
    pub fn clear(&mut self) {
        (self.length, self.used) = (0, 0);
    }

    /// How many bytes were no part of a packet so far.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// The room for bytes that come next; it is never empty.
    pub fn room(&mut self) -> &mut [u8] {
        self.bytes.copy_within(self.used..self.length, 0);
        (self.length, self.used) = (self.length - self.used, 0);
        if self.length == LONGEST {
            // More than the longest packet and still none: it is garbage.
            self.skip(1);
            return self.room();
        }
        &mut self.bytes[self.length..]
    }

    /// So many bytes have been put into the [room](Self::room).
    pub fn filled(&mut self, count: usize) {
        self.length = (self.length + count).min(LONGEST);
    }

    fn skip(&mut self, count: usize) {
        self.used += count;
        self.skipped += count as u64;
    }

    /// The next packet; `None` when more bytes are needed.
    ///
    /// # Errors
    ///
    /// [`PacketError`]; the search goes on behind the header of what was no packet.
    pub fn next_packet(&mut self) -> Result<Option<Received<'_>>, PacketError> {
        // To the next header, or to what may become one.
        while self.used < self.length {
            let rest = &self.bytes[self.used..self.length];
            let compared = rest.len().min(HEADER.len());
            if rest[..compared] == HEADER[..compared] {
                break;
            }
            self.skip(1);
        }
        let rest = &self.bytes[self.used..self.length];
        if rest.len() < FRONT {
            return Ok(None);
        }
        let counted = usize::from(u16::from_le_bytes([rest[5], rest[6]]));
        let total = FRONT + counted;
        if counted < 3 || total > LONGEST {
            self.skip(HEADER.len());
            return Err(PacketError::Length { length: counted });
        }
        if rest.len() < total {
            return Ok(None);
        }
        let expected = crc(&rest[..total - 2]);
        let got = u16::from_le_bytes([rest[total - 2], rest[total - 1]]);
        if got != expected {
            self.skip(HEADER.len());
            return Err(PacketError::Crc { got, expected });
        }
        let (start, id) = (self.used, rest[4]);
        self.used += total;
        let body = &mut self.bytes[start + FRONT..start + total - 2];
        let length = unstuff(body);
        let (instruction, parameters) = (body[0], &body[1..length]);
        Ok(Some(Received { id, instruction, parameters }))
    }
}

/// Takes stuffed bytes out; gives the length that is left.
fn unstuff(body: &mut [u8]) -> usize {
    let (mut from, mut to) = (0, 0);
    while from < body.len() {
        body[to] = body[from];
        (from, to) = (from + 1, to + 1);
        if to >= 3 && body[to - 3..to] == [0xff, 0xff, 0xfd] && body.get(from) == Some(&0xfd) {
            from += 1;
        }
    }
    to
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn packet(id: u8, instruction: Instruction, parameters: &[u8]) -> Vec<u8> {
        Packet::default().begin(id, instruction).add(parameters).end().expect("short").to_vec()
    }

    #[test]
    fn packets_of_the_manual() {
        let ping = [0xff, 0xff, 0xfd, 0x00, 0x01, 0x03, 0x00, 0x01, 0x19, 0x4e];
        assert_eq!(packet(1, Instruction::Ping, &[]), ping);
        let read = [0xff, 0xff, 0xfd, 0x00, 0x01, 0x07, 0x00, 0x02, 0x84, 0x00, 0x04, 0x00, 0x1d, 0x15];
        assert_eq!(packet(1, Instruction::Read, &[0x84, 0, 4, 0]), read);
        let write =
            [0xff, 0xff, 0xfd, 0x00, 0x01, 0x09, 0x00, 0x03, 0x74, 0x00, 0x00, 0x02, 0x00, 0x00, 0xca, 0x89];
        assert_eq!(packet(1, Instruction::Write, &[0x74, 0, 0, 2, 0, 0]), write);
        let status =
            [0xff, 0xff, 0xfd, 0x00, 0x01, 0x08, 0x00, 0x55, 0x00, 0xa6, 0x00, 0x00, 0x00, 0x8c, 0xc0];
        let mut parser = Parser::default();
        parser.room()[..status.len()].copy_from_slice(&status);
        parser.filled(status.len());
        let expected = Received { id: 1, instruction: 0x55, parameters: &[0, 0xa6, 0, 0, 0] };
        assert_eq!(parser.next_packet(), Ok(Some(expected)));
        assert_eq!(parser.next_packet(), Ok(None));
    }

    #[test]
    fn a_header_in_the_parameters_is_stuffed() {
        let sent = packet(3, Instruction::Write, &[0xff, 0xff, 0xfd, 0x00, 0xff, 0xff, 0xfd]);
        assert_eq!(sent.windows(4).filter(|window| **window == HEADER).count(), 1);
        assert_eq!(sent.len(), 7 + 1 + 7 + 2 + 2);
    }

    #[test]
    fn a_packet_that_is_too_long_is_refused() {
        assert!(Packet::default().begin(1, Instruction::Write).add(&[0; LONGEST]).end().is_none());
    }

    /// Bytes in which headers and stuffing are frequent.
    fn bytes(most: usize) -> impl Strategy<Value = Vec<u8>> {
        let byte = prop_oneof![Just(0xff), Just(0xfd), Just(0x00), any::<u8>()];
        prop::collection::vec(byte, 0..most)
    }

    proptest! {
        #[test]
        fn what_is_put_together_is_taken_apart(
            packets in prop::collection::vec((0..=HIGHEST_ID, bytes(120)), 1..5),
            pieces in prop::collection::vec(1_usize..40, 1..20),
        ) {
            let stream: Vec<u8> =
                packets.iter().flat_map(|(id, data)| packet(*id, Instruction::Write, data)).collect();
            let mut parser = Parser::default();
            let mut got = Vec::new();
            let (mut rest, mut pieces) = (&stream[..], pieces.iter().cycle());
            while !rest.is_empty() {
                let room = parser.room();
                let count = (*pieces.next().expect("a cycle")).min(rest.len()).min(room.len());
                room[..count].copy_from_slice(&rest[..count]);
                parser.filled(count);
                rest = &rest[count..];
                while let Some(received) = parser.next_packet().expect("undisturbed") {
                    got.push((received.id, received.parameters.to_vec()));
                }
            }
            prop_assert_eq!(got, packets);
            prop_assert_eq!(parser.skipped(), 0);
        }

        #[test]
        fn garbage_is_survived_and_the_next_packet_found(garbage in bytes(3000), flip in any::<Option<u8>>()) {
            let mut good = packet(7, Instruction::Status, &[0, 1, 2, 3]);
            if let Some(flip) = flip {
                let at = usize::from(flip) % good.len();
                good[at] ^= 1 << (flip % 8);
            }
            // Enough silence lets a packet that the garbage pretended to begin run out.
            let stream = [garbage, vec![0; LONGEST], good.clone(), vec![0; LONGEST]].concat();
            let mut parser = Parser::default();
            let mut found = 0;
            let mut rest = &stream[..];
            while !rest.is_empty() {
                // Nearly full with what claims to be a long packet, the parser takes less than there is.
                let room = parser.room();
                prop_assert!(!room.is_empty());
                let count = room.len().min(rest.len()).min(64);
                room[..count].copy_from_slice(&rest[..count]);
                parser.filled(count);
                rest = &rest[count..];
                loop {
                    match parser.next_packet() {
                        Ok(Some(received)) if received.id == 7 && received.parameters == [0, 1, 2, 3] => found += 1,
                        Ok(Some(_)) | Err(_) => {}
                        Ok(None) => break,
                    }
                }
            }
            if flip.is_none() {
                prop_assert!(found >= 1);
            } else {
                prop_assert_eq!(found, 0, "a changed bit is noticed");
            }
        }

        #[test]
        fn any_changed_bit_is_noticed(data in bytes(60), at in any::<prop::sample::Index>(), bit in 0_u32..8) {
            let mut sent = packet(9, Instruction::Status, &data);
            let at = at.index(sent.len());
            sent[at] ^= 1 << bit;
            let mut parser = Parser::default();
            parser.room()[..sent.len()].copy_from_slice(&sent);
            parser.filled(sent.len());
            loop {
                match parser.next_packet() {
                    Ok(Some(received)) => prop_assert!(false, "{:?}", received),
                    Ok(None) => break,
                    Err(_) => {}
                }
            }
        }
    }
}
