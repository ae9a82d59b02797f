//! Reads a recording back.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::Path;

use mcap::records::{Record, op};
use serde::de::DeserializeOwned;

use super::cdr::{CdrError, CdrReader};
use super::container::{Cut, Packed, Raw, Walk, parse, unpack};
use super::description::{DESCRIPTION, DescriptionFile, FORMAT};
use super::error::RecordingError;
use super::shape::Shape;
use super::writer::{CONTENT, Content, DURATION, END, NODE};
use super::{Consumed, InputRecord, MessageRecord, NodeTrack, Recording, StepRecord};
use crate::time::Nanos;

impl Recording {
    /// Reads a recording.
    ///
    /// Of a file whose end is missing, what its finished chunks hold is read, and
    /// [`truncated`](Recording::truncated) says so.
    ///
    /// # Errors
    ///
    /// [`RecordingError`]: the file is missing, empty, not MCAP, another program's, or damaged.
    pub fn read(path: impl AsRef<Path>) -> Result<Recording, RecordingError> {
        let path = path.as_ref();
        let bytes = fs::read(path).map_err(|source| match source.kind() {
            io::ErrorKind::NotFound => RecordingError::Missing { path: path.into() },
            _ => RecordingError::Io { path: path.into(), what: "read the file", source },
        })?;
        Reader::new(path).read(&bytes)
    }
}

/// Where the messages of a channel go.
#[derive(Debug, Clone)]
struct Target {
    topic: String,
    content: Content,
    /// Index of the node's track.
    node: usize,
}

struct Reader<'a> {
    path: &'a Path,
    recording: Option<Recording>,
    origin: Nanos,
    targets: BTreeMap<u16, Target>,
    /// By node, whether its messages have data.
    data: Vec<bool>,
    topics: BTreeSet<String>,
    /// The record that tells the duration has been read.
    ended: bool,
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path) -> Self {
        Self {
            path,
            recording: None,
            origin: 0,
            targets: BTreeMap::new(),
            data: Vec::new(),
            topics: BTreeSet::new(),
            ended: false,
        }
    }

    fn read(mut self, bytes: &[u8]) -> Result<Recording, RecordingError> {
        let path = || self.path.to_path_buf();
        if bytes.is_empty() {
            return Err(RecordingError::Empty { path: path() });
        }
        let Some(rest) = bytes.strip_prefix(mcap::MAGIC) else {
            if mcap::MAGIC.starts_with(bytes) {
                return Err(RecordingError::CutEarly { path: path(), at: bytes.len() });
            }
            return Err(RecordingError::NotMcap {
                path: path(),
                found: bytes[..bytes.len().min(8)].to_vec(),
            });
        };
        let mut walk = Walk::new(rest, mcap::MAGIC.len());
        let mut end = None;
        while let Some(raw) = walk.next() {
            match raw {
                Ok(raw) if raw.opcode == op::FOOTER => {
                    end = Some(walk.at());
                    break;
                }
                Ok(raw) => self.record(raw)?,
                Err(Cut(_)) => break,
            }
        }
        let whole = end.is_some_and(|end| bytes[end..].starts_with(mcap::MAGIC));
        let Some(mut recording) = self.recording else {
            let path = self.path.to_path_buf();
            if !whole {
                return Err(RecordingError::CutEarly { path, at: bytes.len() });
            }
            let topics: Vec<String> = self.topics.into_iter().collect();
            let topics = if topics.is_empty() { "none".into() } else { topics.join(", ") };
            return Err(RecordingError::Foreign { path, attachment: DESCRIPTION, topics });
        };
        if !self.ended {
            // The end is not known; nothing that was read happened after its last event.
            let steps = recording.nodes.iter().flat_map(|track| track.steps.iter().map(|step| step.end));
            let sent =
                recording.nodes.iter().flat_map(|track| track.messages.iter().map(|message| message.sent));
            recording.duration = steps.chain(sent).max().unwrap_or(0);
        }
        if !whole {
            recording.truncated = Some(format!(
                "the end of the file is missing: it stops at byte {}. What was complete by then has been read; the \
                 recorder was killed, or the file not copied whole",
                bytes.len()
            ));
        }
        Ok(recording)
    }

    fn damaged(&self, at: usize, reason: impl Into<String>) -> RecordingError {
        RecordingError::Damaged { path: self.path.into(), at, reason: reason.into() }
    }

    fn record(&mut self, raw: Raw<'_>) -> Result<(), RecordingError> {
        match raw.opcode {
            op::ATTACHMENT | op::METADATA | op::CHANNEL | op::MESSAGE | op::CHUNK => {}
            // Schemas are for other readers, and indexes repeat what the chunks say.
            _ => return Ok(()),
        }
        match parse(raw).map_err(|reason| self.damaged(raw.at, reason))? {
            Record::Attachment { header, data, .. } if header.name == DESCRIPTION => self.describe(&data),
            Record::Metadata(metadata) if metadata.name == END => {
                let duration = metadata.metadata.get(DURATION).and_then(|text| text.parse().ok());
                let duration =
                    duration.ok_or_else(|| self.damaged(raw.at, "it does not say how long the run was"))?;
                if let Some(recording) = &mut self.recording {
                    recording.duration = duration;
                    self.ended = true;
                }
                Ok(())
            }
            Record::Channel(channel) => {
                self.topics.insert(channel.topic.clone());
                self.channel(raw.at, channel)
            }
            Record::Message { header, data } => self.message(&header, &data),
            Record::Chunk { header, data } => {
                let data = unpack(&header, &data).map_err(|error| match error {
                    Packed::Unknown(compression) => {
                        RecordingError::Compressed { path: self.path.into(), at: raw.at, compression }
                    }
                    Packed::Broken(reason) => self.damaged(raw.at, reason),
                })?;
                for inner in Walk::new(&data, raw.at) {
                    match inner {
                        Ok(inner) if inner.opcode == op::CHUNK => {
                            return Err(self.damaged(raw.at, "a chunk lies inside a chunk"));
                        }
                        Ok(inner) => self.record(inner)?,
                        Err(Cut(_)) => return Err(self.damaged(raw.at, "the chunk ends inside a record")),
                    }
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn describe(&mut self, data: &[u8]) -> Result<(), RecordingError> {
        let fail = |reason: String| RecordingError::Description {
            path: self.path.into(),
            attachment: DESCRIPTION,
            reason,
        };
        #[derive(serde::Deserialize)]
        struct Version {
            format: u32,
        }
        let version: Version = serde_json::from_slice(data).map_err(|e| fail(e.to_string()))?;
        if version.format > FORMAT {
            return Err(fail(format!(
                "its format is {} and this program knows up to {FORMAT}",
                version.format
            )));
        }
        let file: DescriptionFile = serde_json::from_slice(data).map_err(|e| fail(e.to_string()))?;
        self.origin = file.origin;
        self.data = file.description.nodes.iter().map(|node| node.data > 0).collect();
        let nodes = file.description.nodes.into_iter();
        self.recording = Some(Recording {
            graph: file.description.graph,
            clock: file.description.clock,
            duration: 0,
            nodes: nodes
                .map(|node| NodeTrack {
                    name: node.name,
                    layout: node.layout,
                    initial: node.initial,
                    stand_in: node.stand_in,
                    messages: vec![],
                    steps: vec![],
                })
                .collect(),
            losses: vec![],
            faults: vec![],
            changes: vec![],
            hosts: file.description.hosts,
            clocks: vec![],
            truncated: None,
        });
        Ok(())
    }

    fn channel(&mut self, at: usize, channel: mcap::records::Channel) -> Result<(), RecordingError> {
        let Some(recording) = &self.recording else { return Ok(()) };
        // Other channels are those of somebody who added them to the file: they do not concern us.
        let Some(content) = channel.metadata.get(CONTENT) else { return Ok(()) };
        let Some(content) = Content::ALL.into_iter().find(|known| known.name() == content) else {
            return Ok(());
        };
        let node = match content {
            Content::Losses | Content::Faults | Content::Changes | Content::Clocks => 0,
            Content::Messages | Content::Steps => {
                let name = channel.metadata.get(NODE).map_or("", String::as_str);
                recording.nodes.iter().position(|track| track.name == name).ok_or_else(|| {
                    self.damaged(
                        at,
                        format!("topic {} is of a node {name:?} that is not in the graph", channel.topic),
                    )
                })?
            }
        };
        self.targets.insert(channel.id, Target { topic: channel.topic, content, node });
        Ok(())
    }

    fn message(&mut self, header: &mcap::records::MessageHeader, data: &[u8]) -> Result<(), RecordingError> {
        let Some(target) = self.targets.get(&header.channel_id) else { return Ok(()) };
        let Some(recording) = &mut self.recording else { return Ok(()) };
        let fail = |source| RecordingError::Message {
            path: self.path.into(),
            topic: target.topic.clone(),
            sequence: header.sequence,
            source,
        };
        match target.content {
            Content::Messages => {
                let track = &mut recording.nodes[target.node];
                let has_data = self.data.get(target.node) == Some(&true);
                let shape = Shape::of(&track.layout, has_data);
                let (payload, data) = shape.read(data, track.layout.leaves.len()).map_err(fail)?;
                // The writer put in a time that fits; the sum wraps only in a file that nobody wrote.
                let sent = (header.log_time as Nanos).wrapping_add(self.origin);
                track.messages.push(MessageRecord { seq: u64::from(header.sequence), sent, payload, data });
            }
            Content::Steps => recording.nodes[target.node].steps.push(step(data).map_err(fail)?),
            Content::Losses => recording.losses.push(note(data).map_err(fail)?),
            Content::Faults => recording.faults.push(note(data).map_err(fail)?),
            Content::Changes => recording.changes.push(note(data).map_err(fail)?),
            Content::Clocks => recording.clocks.push(note(data).map_err(fail)?),
        }
        Ok(())
    }
}

fn step(data: &[u8]) -> Result<StepRecord, CdrError> {
    let mut cdr = CdrReader::new(data)?;
    let (seq, due, start, end) = (cdr.u64()?, cdr.i64()?, cdr.i64()?, cdr.i64()?);
    let count = cdr.length(16)?;
    let mut inputs = Vec::with_capacity(count);
    for _ in 0..count {
        let port = cdr.text()?.to_owned();
        let count = cdr.length(25)?;
        let mut consumed = Vec::with_capacity(count);
        for _ in 0..count {
            let initial = cdr.flag()?;
            let seq = cdr.u64()?;
            let (sent, received) = (cdr.i64()?, cdr.i64()?);
            consumed.push(Consumed { seq: (!initial).then_some(seq), sent, received });
        }
        inputs.push(InputRecord { port, consumed, superseded: cdr.u64()? });
    }
    cdr.end()?;
    Ok(StepRecord { seq, due, start, end, inputs })
}

fn note<T: DeserializeOwned>(data: &[u8]) -> Result<T, CdrError> {
    let mut cdr = CdrReader::new(data)?;
    let value = serde_json::from_str(cdr.text()?).map_err(|_| CdrError::Text { at: 8 })?;
    cdr.end()?;
    Ok(value)
}
