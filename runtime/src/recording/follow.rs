//! A recording that is still being written, read as it grows.
//!
//! Only what is complete is taken: chunks come whole, because the writer gives them to the system in one piece. The file is
//! read and nobody is asked for anything, so whoever writes it does not notice.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};

use super::container::{Cut, Raw, Walk, parse, unpack};
use super::error::RecordingError;

/// Bytes taken from the file at a time, unless a record is longer.
const PORTION: u64 = 4 << 20;
/// A record's head: what it is, and its length.
const HEAD: usize = 9;

/// A channel of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Its topic.
    pub topic: String,
    /// How its messages are encoded: `cdr`.
    pub encoding: String,
    /// What its messages are called, such as `pendulum/msg/Motion`.
    pub schema: String,
    /// In which language they are defined: `ros2msg`.
    pub language: String,
    /// The definition.
    pub definition: Vec<u8>,
    /// What else the file says of it.
    pub metadata: BTreeMap<String, String>,
}

/// A message of the file.
#[derive(Debug, Clone, Copy)]
pub struct Followed<'a> {
    /// Where it came.
    pub channel: &'a Channel,
    /// Its number in the channel.
    pub sequence: u32,
    /// When, ns since the start of the run.
    pub time: u64,
    /// What it says.
    pub data: &'a [u8],
}

/// Reads a recording while it is written.
#[derive(Debug)]
pub struct Follow {
    path: PathBuf,
    file: File,
    /// Where the first record begins that has not been taken.
    at: u64,
    buffer: Vec<u8>,
    schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
    ended: bool,
}

impl Follow {
    /// Opens a recording at its beginning.
    ///
    /// # Errors
    ///
    /// [`RecordingError`]: it is not there, or cannot be read.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.into(), what: "open the file", source };
        let file = File::open(path).map_err(io)?;
        Ok(Self {
            path: path.into(),
            file,
            at: 0,
            buffer: Vec::new(),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            ended: false,
        })
    }

    /// The channels so far, in the order of the file.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.channels.values()
    }

    /// Whether the file has ended as it should: nothing more comes.
    pub fn ended(&self) -> bool {
        self.ended
    }

    /// Goes to what has not been written yet; of what has, only the channels are taken, which lie in front of the first message.
    ///
    /// # Errors
    ///
    /// As [`poll`](Self::poll).
    pub fn skip(&mut self) -> Result<(), RecordingError> {
        let size = self.size()?;
        while !self.ended {
            // The head, and of a chunk when its messages begin and end.
            let mut head = [0; HEAD + 16];
            let at = self.at.max(mcap::MAGIC.len() as u64);
            let read = self.read_at(at, &mut head)?;
            if read < HEAD {
                break;
            }
            let next = at.saturating_add(HEAD as u64).saturating_add(length(&head));
            if next > size {
                break;
            }
            let of_messages = read == head.len() && head[0] == op::CHUNK && head[HEAD + 8..] != [0; 8];
            if of_messages {
                self.at = next;
            } else {
                self.portion(next - self.at, &mut |_| {})?;
            }
        }
        Ok(())
    }

    /// Takes what has been written since the last time, and gives `each` every message.
    ///
    /// # Errors
    ///
    /// [`RecordingError::NotMcap`], [`RecordingError::Damaged`] and [`RecordingError::Io`]: what is there is not what a recording
    /// holds.
    pub fn poll(&mut self, each: &mut dyn FnMut(Followed<'_>)) -> Result<(), RecordingError> {
        let size = self.size()?;
        while self.at < size && !self.ended {
            let before = self.at;
            let mut want = PORTION;
            loop {
                self.portion(want, each)?;
                if self.at > before || self.at.saturating_add(want) >= size {
                    break;
                }
                // One record that is longer.
                want = want.saturating_mul(4);
            }
            if self.at == before {
                break;
            }
        }
        Ok(())
    }

    /// Takes the records that lie whole within the next bytes.
    fn portion(&mut self, bytes: u64, each: &mut dyn FnMut(Followed<'_>)) -> Result<(), RecordingError> {
        let mut buffer = std::mem::take(&mut self.buffer);
        buffer.clear();
        let io = |source| RecordingError::Io { path: self.path.clone(), what: "read the file", source };
        self.file.seek(SeekFrom::Start(self.at)).map_err(io)?;
        (&self.file).take(bytes).read_to_end(&mut buffer).map_err(io)?;
        let result = self.records(&buffer, each);
        self.buffer = buffer;
        result
    }

    fn records(&mut self, bytes: &[u8], each: &mut dyn FnMut(Followed<'_>)) -> Result<(), RecordingError> {
        let mut start = 0;
        if self.at == 0 {
            start = mcap::MAGIC.len();
            if bytes.len() < start {
                return Ok(());
            }
            if !bytes.starts_with(mcap::MAGIC) {
                let found = bytes[..start].to_vec();
                return Err(RecordingError::NotMcap { path: self.path.clone(), found });
            }
        }
        let mut walk = Walk::new(&bytes[start..], start);
        let origin = self.at;
        while let Some(Ok(raw)) = walk.next() {
            self.record(raw, origin, false, each)?;
            self.at = origin + walk.at() as u64;
            if self.ended {
                break;
            }
        }
        Ok(())
    }

    fn record(
        &mut self,
        raw: Raw<'_>,
        origin: u64,
        inside: bool,
        each: &mut dyn FnMut(Followed<'_>),
    ) -> Result<(), RecordingError> {
        let path = self.path.clone();
        let at = usize::try_from(origin).unwrap_or(usize::MAX).saturating_add(raw.at);
        let damaged = |reason: String| RecordingError::Damaged { path: path.clone(), at, reason };
        match raw.opcode {
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK => {}
            op::DATA_END | op::FOOTER => {
                self.ended = true;
                return Ok(());
            }
            _ => return Ok(()),
        }
        match parse(raw).map_err(damaged)? {
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Record::Channel(channel) => {
                let (schema, language, definition) =
                    self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let channel_ = Channel {
                    topic: channel.topic,
                    encoding: channel.message_encoding,
                    schema,
                    language,
                    definition,
                    metadata: channel.metadata,
                };
                self.channels.insert(channel.id, channel_);
            }
            Record::Message { header, data } => {
                let Some(channel) = self.channels.get(&header.channel_id) else {
                    return Err(damaged(format!(
                        "a message of the channel {}, which is not there",
                        header.channel_id
                    )));
                };
                let (sequence, time) = (header.sequence, header.log_time);
                each(Followed { channel, sequence, time, data: &data });
            }
            Record::Chunk { header, data } if !inside => {
                let data = unpack(&header, &data).map_err(|reason| damaged(reason.to_string()))?;
                for inner in Walk::new(&data, raw.at) {
                    match inner {
                        Ok(inner) => self.record(inner, origin, true, each)?,
                        Err(Cut(_)) => return Err(damaged("the chunk ends inside a record".into())),
                    }
                }
            }
            _ => return Err(damaged("a chunk lies inside a chunk".into())),
        }
        Ok(())
    }

    fn size(&self) -> Result<u64, RecordingError> {
        let io = |source| RecordingError::Io { path: self.path.clone(), what: "read the file", source };
        Ok(self.file.metadata().map_err(io)?.len())
    }

    /// As many bytes as there are at a place.
    fn read_at(&mut self, at: u64, bytes: &mut [u8]) -> Result<usize, RecordingError> {
        let io = |source| RecordingError::Io { path: self.path.clone(), what: "read the file", source };
        self.file.seek(SeekFrom::Start(at)).map_err(io)?;
        let mut read = 0;
        while read < bytes.len() {
            match (&self.file).read(&mut bytes[read..]).map_err(io)? {
                0 => break,
                more => read += more,
            }
        }
        Ok(read)
    }
}

/// The length that a record's head says.
fn length(head: &[u8]) -> u64 {
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&head[1..HEAD]);
    u64::from_le_bytes(bytes)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use mcap::records::MessageHeader;

    use super::*;

    /// A file as a recorder writes it: channels first, then chunks; and how long it was after each flush.
    fn written(chunks: u64) -> (Vec<u8>, Vec<usize>) {
        let mut lengths = Vec::new();
        let mut bytes = std::io::Cursor::new(Vec::new());
        let mut mcap =
            mcap::WriteOptions::new().compression(None).disable_seeking(true).create(&mut bytes).unwrap();
        let schema = mcap.add_schema("x/msg/X", "ros2msg", b"float64 x").unwrap();
        let channel = mcap.add_channel(schema, "/x", "cdr", &BTreeMap::new()).unwrap();
        mcap.flush().unwrap();
        for chunk in 0..chunks {
            for part in 0..3 {
                let time = 1 + chunk * 10 + part;
                let header = MessageHeader {
                    channel_id: channel,
                    sequence: time as u32,
                    log_time: time,
                    publish_time: time,
                };
                mcap.write_to_known_channel(&header, &[time as u8; 100]).unwrap();
            }
            mcap.flush().unwrap();
        }
        mcap.finish().unwrap();
        drop(mcap);
        let bytes = bytes.into_inner();
        // Records end where the walk finds them to.
        let mut walk = Walk::new(&bytes[mcap::MAGIC.len()..], mcap::MAGIC.len());
        while walk.next().is_some_and(|record| record.is_ok()) {
            lengths.push(walk.at());
        }
        (bytes, lengths)
    }

    #[test]
    fn what_grows_is_read_once_and_whole_however_it_is_cut() {
        let (bytes, _) = written(4);
        let path = tempfile::NamedTempFile::new().unwrap();
        let mut follow = Follow::open(path.path()).unwrap();
        let mut file = path.reopen().unwrap();
        let mut times = Vec::new();
        for part in bytes.chunks(37) {
            file.write_all(part).unwrap();
            let mut each = |message: Followed<'_>| {
                assert_eq!((&*message.channel.topic, message.data), ("/x", &[message.time as u8; 100][..]));
                times.push(message.time);
            };
            follow.poll(&mut each).unwrap();
        }
        assert_eq!(times, [1, 2, 3, 11, 12, 13, 21, 22, 23, 31, 32, 33]);
        assert!(follow.ended());
        let channel = follow.channels().next().unwrap();
        assert_eq!((&*channel.schema, &*channel.definition), ("x/msg/X", &b"float64 x"[..]));
    }

    #[test]
    fn whoever_comes_late_sees_what_comes_then() {
        let (bytes, lengths) = written(4);
        for &until in &lengths {
            let path = tempfile::NamedTempFile::new().unwrap();
            let mut file = path.reopen().unwrap();
            file.write_all(&bytes[..until]).unwrap();
            let mut follow = Follow::open(path.path()).unwrap();
            follow.skip().unwrap();
            let mut all = Follow::open(path.path()).unwrap();
            let mut before = 0;
            all.poll(&mut |_| before += 1).unwrap();
            file.write_all(&bytes[until..]).unwrap();
            let mut after = 0;
            follow.poll(&mut |_| after += 1).unwrap();
            assert_eq!(before + after, 12, "{until}");
            assert!(follow.ended());
        }
    }

    #[test]
    fn what_is_damaged_says_where() {
        let path = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(path.path(), "no such file").unwrap();
        let poll = || Follow::open(path.path()).unwrap().poll(&mut |_| {}).unwrap_err();
        assert!(matches!(poll(), RecordingError::NotMcap { .. }));
        let (mut bytes, _) = written(2);
        let at = bytes.windows(100).position(|data| data == [11; 100]).unwrap();
        bytes[at] = 0;
        std::fs::write(path.path(), &bytes).unwrap();
        let RecordingError::Damaged { at: place, reason, .. } = poll() else { panic!("it is damaged") };
        assert!(place < at && reason.contains("checksum"), "{place} {reason}");
    }
}
