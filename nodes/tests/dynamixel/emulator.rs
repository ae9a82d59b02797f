//! Servos that exist as a thread only, at the other end of a pseudo-terminal, and speak the real protocol: the control
//! table of an XL330 with its access rules, its watchdog, and the ways in which a real line goes wrong.
//!
//! It parses and builds packets by code of its own, byte by byte, so that a mistake in the driver's codec is not shared.

use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

/// How the line goes wrong.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Trouble {
    None,
    /// Nothing answers.
    Silence,
    /// One bit of every answer is another one.
    Flip,
    /// Answers end in the middle.
    Half,
    /// Answers come in pieces, with garbage in front of them.
    Noise,
    /// The next answer comes after this time, and then all is well.
    Late(Duration),
    /// Answers come from another id.
    Stranger,
    /// Answers are a byte longer than asked for.
    Longer,
}

pub(crate) struct Servo {
    id: u8,
    pub(crate) table: [u8; 256],
    heard: Instant,
    /// Every write that was carried out: address and bytes.
    pub(crate) written: Vec<(u16, Vec<u8>)>,
}

impl Servo {
    fn new(id: u8) -> Self {
        let mut servo = Self { id, table: [0; 256], heard: Instant::now(), written: Vec::new() };
        servo.put(0, &1200_u16.to_le_bytes());
        servo.put(6, &[46, id]);
        servo.put(11, &[3]);
        servo.put(36, &885_u16.to_le_bytes());
        servo.put(38, &1750_u16.to_le_bytes());
        servo.put(48, &4095_i32.to_le_bytes());
        servo.put(132, &2048_i32.to_le_bytes());
        servo
    }

    pub(crate) fn word(&self, address: usize) -> i16 {
        i16::from_le_bytes([self.table[address], self.table[address + 1]])
    }

    pub(crate) fn long(&self, address: usize) -> i32 {
        i32::from_le_bytes(self.table[address..address + 4].try_into().unwrap())
    }

    pub(crate) fn put(&mut self, address: usize, bytes: &[u8]) {
        self.table[address..address + bytes.len()].copy_from_slice(bytes);
    }

    /// An instruction came: the watchdog is fed, or has bitten already. The motor reaches its goal at once.
    fn hear(&mut self) {
        let limit = self.table[98];
        if (1..=127).contains(&limit) && self.heard.elapsed() > Duration::from_millis(20 * u64::from(limit)) {
            self.table[98] = 255;
        }
        self.heard = Instant::now();
        if self.table[64] == 1 && self.table[98] != 255 {
            match self.table[11] {
                3 => self.table.copy_within(116..120, 132),
                0 => self.table.copy_within(102..104, 126),
                _ => {}
            }
        }
    }

    /// Carries a write out; gives the error number.
    fn write(&mut self, address: usize, data: &[u8]) -> u8 {
        const FIELDS: [(usize, usize); 12] = [
            (7, 1),
            (11, 1),
            (36, 2),
            (38, 2),
            (64, 1),
            (65, 1),
            (68, 1),
            (98, 1),
            (100, 2),
            (102, 2),
            (104, 4),
            (116, 4),
        ];
        let Some((_, length)) = FIELDS.iter().find(|(at, _)| *at == address) else { return 7 };
        if data.len() != *length {
            return 5;
        }
        if address < 64 && self.table[64] == 1 {
            return 7;
        }
        // Once the watchdog has stopped the servo, goals cannot be written until it is cleared.
        if self.table[98] == 255 && (100..=116).contains(&address) {
            return 4;
        }
        let beyond = |limit: usize| {
            i16::from_le_bytes([data[0], data[1]]).unsigned_abs() > self.word(limit).unsigned_abs()
        };
        let refused = match address {
            11 if ![0, 1, 3, 4, 5, 16].contains(&data[0]) => 4,
            64 if data[0] > 1 => 4,
            98 if data[0] > 127 => 4,
            100 if beyond(36) => 6,
            102 if beyond(38) => 6,
            116 if self.table[11] == 3 => {
                let goal = i32::from_le_bytes(data.try_into().unwrap());
                if (self.long(52)..=self.long(48)).contains(&goal) { 0 } else { 6 }
            }
            _ => 0,
        };
        if refused == 0 {
            self.put(address, data);
            self.written.push((address as u16, data.to_vec()));
        }
        refused
    }
}

pub(crate) struct Line {
    trouble: Trouble,
    pub(crate) servos: Vec<Servo>,
}

/// A pseudo-terminal with servos at its other end.
pub(crate) struct Emulator {
    pub(crate) path: PathBuf,
    line: Arc<Mutex<Line>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    /// Held so that the terminal stays while nobody has it open.
    _terminal: OwnedFd,
}

impl Emulator {
    pub(crate) fn new(ids: &[u8]) -> Self {
        let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&controller).unwrap();
        unlockpt(&controller).unwrap();
        let path = PathBuf::from(ptsname(&controller, Vec::new()).unwrap().into_string().unwrap());
        let terminal = rustix::fs::open(&path, OFlags::RDWR | OFlags::NOCTTY, Mode::empty()).unwrap();
        let servos = ids.iter().map(|id| Servo::new(*id)).collect();
        let line = Arc::new(Mutex::new(Line { trouble: Trouble::None, servos }));
        let stop = Arc::new(AtomicBool::new(false));
        let (theirs, ends) = (line.clone(), stop.clone());
        let thread = Some(std::thread::spawn(move || serve(&controller, &theirs, &ends)));
        Self { path, line, stop, thread, _terminal: terminal }
    }

    pub(crate) fn line(&self) -> MutexGuard<'_, Line> {
        self.line.lock().unwrap()
    }

    pub(crate) fn trouble(&self, trouble: Trouble) {
        self.line().trouble = trouble;
    }

    /// Takes the line away, as when the adapter is unplugged.
    pub(crate) fn unplug(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        self.unplug();
    }
}

fn serve(controller: &OwnedFd, line: &Mutex<Line>, stop: &AtomicBool) {
    let mut bytes = Vec::new();
    while !stop.load(Ordering::SeqCst) {
        let wait = Timespec { tv_sec: 0, tv_nsec: 5_000_000 };
        if poll(&mut [PollFd::new(controller, PollFlags::IN)], Some(&wait)).unwrap_or(0) == 0 {
            continue;
        }
        let mut piece = [0; 256];
        let Ok(count) = rustix::io::read(controller, &mut piece) else { continue };
        bytes.extend_from_slice(&piece[..count]);
        while let Some((id, instruction, parameters)) = take(&mut bytes) {
            carry_out(controller, &mut line.lock().unwrap(), id, instruction, &parameters);
        }
    }
}

/// The next whole packet with a right check sum, unstuffed.
fn take(bytes: &mut Vec<u8>) -> Option<(u8, u8, Vec<u8>)> {
    loop {
        let start = bytes.windows(4).position(|window| window == [0xff, 0xff, 0xfd, 0x00])?;
        bytes.drain(..start);
        let length = usize::from(*bytes.get(5)?) + 256 * usize::from(*bytes.get(6)?);
        if bytes.len() < 7 + length {
            return None;
        }
        let packet: Vec<u8> = bytes.drain(..7 + length).collect();
        let end = packet.len() - 2;
        if check_sum(&packet[..end]).to_le_bytes() != packet[end..] {
            continue;
        }
        let (mut plain, mut stuffed): (Vec<u8>, bool) = (Vec::new(), false);
        for &byte in &packet[7..end] {
            if !(stuffed && byte == 0xfd) {
                plain.push(byte);
            }
            stuffed = !stuffed && plain.ends_with(&[0xff, 0xff, 0xfd]);
        }
        return Some((packet[4], plain[0], plain[1..].to_vec()));
    }
}

/// The check sum, bit by bit.
fn check_sum(bytes: &[u8]) -> u16 {
    let mut crc = 0_u16;
    for byte in bytes {
        crc ^= u16::from(*byte) << 8;
        for _ in 0..8 {
            crc = if crc & 0x8000 == 0 { crc << 1 } else { (crc << 1) ^ 0x8005 };
        }
    }
    crc
}

fn carry_out(controller: &OwnedFd, line: &mut Line, id: u8, instruction: u8, parameters: &[u8]) {
    let number = |at: usize| usize::from(parameters[at]) + 256 * usize::from(parameters[at + 1]);
    let Line { trouble, servos } = line;
    servos.iter_mut().filter(|servo| id == 0xfe || servo.id == id).for_each(Servo::hear);
    match instruction {
        0x82 => {
            let (address, length) = (number(0), number(2));
            for wanted in &parameters[4..] {
                if let Some(servo) = servos.iter().find(|servo| servo.id == *wanted) {
                    answer(controller, trouble, servo, 0, &servo.table[address..address + length]);
                }
            }
        }
        0x83 => {
            let (address, length) = (number(0), number(2));
            for part in parameters[4..].chunks(1 + length) {
                if let Some(servo) = servos.iter_mut().find(|servo| servo.id == part[0]) {
                    servo.write(address, &part[1..]);
                }
            }
        }
        _ => {
            let Some(servo) = servos.iter_mut().find(|servo| servo.id == id) else { return };
            let (error, data) = match instruction {
                0x01 => (0, vec![servo.table[0], servo.table[1], servo.table[6]]),
                0x02 => match servo.table.get(number(0)..number(0) + number(2)) {
                    Some(data) => (0, data.to_vec()),
                    None => (4, Vec::new()),
                },
                0x03 => (servo.write(number(0), &parameters[2..]), Vec::new()),
                0x08 => {
                    servo.put(64, &[0]);
                    servo.put(70, &[0]);
                    (0, Vec::new())
                }
                _ => (2, Vec::new()),
            };
            answer(controller, trouble, servo, error, &data);
        }
    }
}

fn answer(controller: &OwnedFd, trouble: &mut Trouble, servo: &Servo, error: u8, data: &[u8]) {
    let id = if *trouble == Trouble::Stranger { servo.id ^ 0x10 } else { servo.id };
    let alert = if servo.table[70] == 0 { 0 } else { 0x80 };
    let longer: &[u8] = if *trouble == Trouble::Longer { &[0x11] } else { &[] };
    let mut body = vec![0x55];
    for &byte in [error | alert].iter().chain(data).chain(longer) {
        body.push(byte);
        if body.ends_with(&[0xff, 0xff, 0xfd]) {
            body.push(0xfd);
        }
    }
    let mut packet = vec![0xff, 0xff, 0xfd, 0x00, id];
    packet.extend_from_slice(&((body.len() + 2) as u16).to_le_bytes());
    packet.extend_from_slice(&body);
    packet.extend_from_slice(&check_sum(&packet).to_le_bytes());
    let write = |bytes: &[u8]| {
        let mut rest = bytes;
        while !rest.is_empty() {
            match rustix::io::write(controller, rest) {
                Ok(count) => rest = &rest[count..],
                Err(_) => return,
            }
        }
    };
    match *trouble {
        Trouble::Silence => {}
        Trouble::Flip => {
            let at = packet.len() - 3;
            packet[at] ^= 0x08;
            write(&packet);
        }
        Trouble::Half => write(&packet[..packet.len() / 2]),
        Trouble::Noise => {
            write(&[0x00, 0xff, 0xff, 0x12, 0xff, 0xff, 0xfd]);
            for piece in packet.chunks(3) {
                write(piece);
                std::thread::sleep(Duration::from_micros(300));
            }
        }
        Trouble::Late(time) => {
            std::thread::sleep(time);
            *trouble = Trouble::None;
            write(&packet);
        }
        Trouble::None | Trouble::Stranger | Trouble::Longer => write(&packet),
    }
}
