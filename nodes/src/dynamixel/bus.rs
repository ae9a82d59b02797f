//! A bus of servos: one question at a time, and its answer within a time.

use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::packet::{BROADCAST, HIGHEST_ID, Instruction, Packet, PacketError, Parser};
use super::port::SerialPort;

/// What a servo says is wrong with an instruction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It could not be done.
    #[error("it could not be done")]
    Failed,
    /// The servo does not know the instruction.
    #[error("it does not know the instruction")]
    Instruction,
    /// The packet arrived damaged.
    #[error("the instruction arrived damaged")]
    Crc,
    /// The value is outside the range of its address.
    #[error("the value is outside the range of this address")]
    Range,
    /// The value is longer or shorter than what stands at the address.
    #[error("the value has not the length of what stands at this address")]
    Length,
    /// The value is beyond a limit set in the control table.
    #[error("the value is beyond a limit in its control table")]
    Limit,
    /// The address cannot be written, or not while torque is on.
    #[error("the address can only be read, or not be written while torque is on")]
    Access,
    /// A number that the protocol does not know.
    #[error("unknown error {0}")]
    Unknown(u8),
}

impl Refusal {
    /// What the low seven bits of a status packet's error say.
    pub fn from_byte(byte: u8) -> Option<Self> {
        match byte & 0x7f {
            0 => None,
            1 => Some(Self::Failed),
            2 => Some(Self::Instruction),
            3 => Some(Self::Crc),
            4 => Some(Self::Range),
            5 => Some(Self::Length),
            6 => Some(Self::Limit),
            7 => Some(Self::Access),
            other => Some(Self::Unknown(other)),
        }
    }
}

/// What can go wrong on a bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// The port could not be opened.
    #[error(
        "the port {path} cannot be opened: {source}. Is the adapter plugged in (ls /dev/serial/by-id), in use, or \
         closed to this user (sudo usermod -a -G dialout $USER)?"
    )]
    Open {
        /// The port.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// The port broke while it was used.
    #[error("the port {path} failed: {source}. Was the adapter unplugged?")]
    Port {
        /// The port.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// A servo did not answer.
    #[error(
        "servo {id} did not answer within {:.1} ms. Check its id, the baud rate, the wiring and its supply{hint}",
        timeout.as_secs_f64() * 1e3
    )]
    Silent {
        /// The servo.
        id: u8,
        /// How long was waited.
        timeout: Duration,
        /// What came instead, in words; empty for nothing.
        hint: &'static str,
    },
    /// An answer arrived damaged.
    #[error("the answer of servo {id} is damaged: {source}")]
    Damaged {
        /// The servo.
        id: u8,
        /// How.
        source: PacketError,
    },
    /// A servo refused an instruction.
    #[error("servo {id} refused {what} at address {address}: {reason}")]
    Refused {
        /// The servo.
        id: u8,
        /// What was asked, in words.
        what: &'static str,
        /// Where in its control table.
        address: u16,
        /// Why.
        reason: Refusal,
    },
    /// An answer is longer or shorter than asked for.
    #[error("servo {id} answered with {got} bytes instead of {expected}")]
    Size {
        /// The servo.
        id: u8,
        /// What came.
        got: usize,
        /// What was asked for.
        expected: usize,
    },
    /// The question is none: too long, or to an id that no servo has.
    #[error("{0}")]
    Question(&'static str),
}

/// What an answer says beside its data.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Answer {
    /// The servo reports a fault of its hardware; its register "hardware error status" says which.
    pub alert: bool,
}

/// An error of a port, with its path.
fn broken(port: &SerialPort) -> impl Fn(io::Error) -> BusError {
    |source| BusError::Port { path: port.path().into(), source }
}

/// A serial port with servos on it. Nothing here allocates once it is open.
#[derive(Debug)]
pub struct Bus {
    port: SerialPort,
    timeout: Duration,
    packet: Packet,
    parser: Parser,
    damaged: u64,
}

impl Bus {
    /// Opens the port; an answer may take as long as `timeout`.
    ///
    /// USB adapters of FTDI hold bytes back for 16 ms unless they are told not to:
    /// `echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer`.
    ///
    /// # Errors
    ///
    /// [`BusError::Open`].
    pub fn open(path: &Path, baud: u32, timeout: Duration) -> Result<Self, BusError> {
        let port =
            SerialPort::open(path, baud).map_err(|source| BusError::Open { path: path.into(), source })?;
        Ok(Self { port, timeout, packet: Packet::default(), parser: Parser::default(), damaged: 0 })
    }

    /// How many packets arrived damaged so far.
    pub fn damaged(&self) -> u64 {
        self.damaged
    }

    /// The port it is on.
    pub fn path(&self) -> &Path {
        self.port.path()
    }

    /// Sends the packet that has been put together. What is left of older answers is thrown away first: it would be taken
    /// for the answer to this one.
    fn ask(&mut self) -> Result<(), BusError> {
        let bytes = self.packet.end().ok_or(BusError::Question("the packet is too long for the bus"))?;
        self.parser.clear();
        let broken = broken(&self.port);
        self.port.discard().map_err(&broken)?;
        self.port.write(bytes, Instant::now() + self.timeout).map_err(&broken)
    }

    /// Waits for the answer of `id`, copies its data, and says what it reports.
    fn answer(
        &mut self,
        id: u8,
        data: &mut [u8],
        question: (&'static str, u16),
        deadline: Instant,
    ) -> Result<Answer, BusError> {
        let mut hint = "";
        loop {
            loop {
                match self.parser.next_packet() {
                    // Adapters of one wire may hear their own question.
                    Ok(Some(packet)) if packet.instruction != Instruction::Status as u8 => {}
                    Ok(Some(packet)) if packet.id != id => hint = "; another servo answered instead",
                    Ok(Some(packet)) => {
                        let [error, answer @ ..] = packet.parameters else {
                            return Err(BusError::Size { id, got: 0, expected: data.len() + 1 });
                        };
                        if let Some(reason) = Refusal::from_byte(*error) {
                            let (what, address) = question;
                            return Err(BusError::Refused { id, what, address, reason });
                        }
                        if answer.len() != data.len() {
                            return Err(BusError::Size { id, got: answer.len(), expected: data.len() });
                        }
                        data.copy_from_slice(answer);
                        return Ok(Answer { alert: error & 0x80 != 0 });
                    }
                    Err(source) => {
                        self.damaged += 1;
                        // A header by chance in front of the answer is no reason to give up; silence after it is.
                        hint = "; what came was damaged";
                        if self.parser.skipped() == 0 {
                            return Err(BusError::Damaged { id, source });
                        }
                    }
                    Ok(None) => break,
                }
            }
            let count = self.port.read(self.parser.room(), deadline).map_err(broken(&self.port))?;
            if count == 0 {
                return Err(BusError::Silent { id, timeout: self.timeout, hint });
            }
            self.parser.filled(count);
        }
    }

    fn single(id: u8) -> Result<(), BusError> {
        if id <= HIGHEST_ID { Ok(()) } else { Err(BusError::Question("a servo's id is 0 to 252")) }
    }

    /// Asks whether a servo is there; gives its model number and its firmware's version.
    ///
    /// # Errors
    ///
    /// [`BusError`].
    pub fn ping(&mut self, id: u8) -> Result<(u16, u8), BusError> {
        Self::single(id)?;
        self.packet.begin(id, Instruction::Ping);
        self.ask()?;
        let mut data = [0; 3];
        self.answer(id, &mut data, ("a ping", 0), Instant::now() + self.timeout)?;
        Ok((u16::from_le_bytes([data[0], data[1]]), data[2]))
    }

    /// Reads a part of a servo's control table.
    ///
    /// # Errors
    ///
    /// [`BusError`].
    pub fn read(&mut self, id: u8, address: u16, data: &mut [u8]) -> Result<Answer, BusError> {
        Self::single(id)?;
        let length = u16::try_from(data.len()).map_err(|_| BusError::Question("too much to read at once"))?;
        self.packet.begin(id, Instruction::Read).word(address).word(length);
        self.ask()?;
        self.answer(id, data, ("a read", address), Instant::now() + self.timeout)
    }

    /// Changes a part of a servo's control table.
    ///
    /// # Errors
    ///
    /// [`BusError`].
    pub fn write(&mut self, id: u8, address: u16, data: &[u8]) -> Result<Answer, BusError> {
        Self::single(id)?;
        self.packet.begin(id, Instruction::Write).word(address).add(data);
        self.ask()?;
        self.answer(id, &mut [], ("a write", address), Instant::now() + self.timeout)
    }

    /// Lets a servo start anew, which clears a hardware error.
    ///
    /// # Errors
    ///
    /// [`BusError`].
    pub fn reboot(&mut self, id: u8) -> Result<Answer, BusError> {
        Self::single(id)?;
        self.packet.begin(id, Instruction::Reboot);
        self.ask()?;
        self.answer(id, &mut [], ("a reboot", 0), Instant::now() + self.timeout)
    }

    /// Reads the same part of several servos' tables with one question. `data` gets the parts one after the other, each
    /// `data.len() / ids.len()` bytes long.
    ///
    /// # Errors
    ///
    /// [`BusError`]; that of the first servo that does not answer well, what stood before it in `ids` is read.
    pub fn sync_read(&mut self, ids: &[u8], address: u16, data: &mut [u8]) -> Result<(), BusError> {
        ids.iter().try_for_each(|id| Self::single(*id))?;
        if ids.is_empty() || !data.len().is_multiple_of(ids.len()) {
            return Err(BusError::Question(
                "the room for the answers must be a multiple of the number of servos",
            ));
        }
        let each = data.len() / ids.len();
        let length = u16::try_from(each).map_err(|_| BusError::Question("too much to read at once"))?;
        self.packet.begin(BROADCAST, Instruction::SyncRead).word(address).word(length).add(ids);
        self.ask()?;
        for (&id, part) in ids.iter().zip(data.chunks_exact_mut(each.max(1))) {
            self.answer(id, part, ("a sync read", address), Instant::now() + self.timeout)?;
        }
        Ok(())
    }

    /// Changes the same part of several servos' tables at one moment. No servo answers this.
    ///
    /// # Errors
    ///
    /// [`BusError`] when the question could not be sent.
    pub fn sync_write<const N: usize>(
        &mut self,
        address: u16,
        parts: &[(u8, [u8; N])],
    ) -> Result<(), BusError> {
        parts.iter().try_for_each(|(id, _)| Self::single(*id))?;
        let packet = self.packet.begin(BROADCAST, Instruction::SyncWrite).word(address).word(N as u16);
        for (id, data) in parts {
            packet.add(&[*id]).add(data);
        }
        self.ask()
    }
}
