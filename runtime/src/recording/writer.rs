//! Writes a recording while it happens.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{Attachment, WriteOptions};
use serde::Serialize;

use super::access::claim_empty;
use super::cdr::CdrWriter;
use super::description::{DESCRIPTION, Description, DescriptionFile, FORMAT, NodeDescription, WITHOUT_DATA};
use super::error::RecordingError;
use super::ros2msg::{self, Schema};
use super::shape::Shape;
use super::{
    Access, Change, ClockReading, Consumed, Fault, Loss, Packing, RecordingSink, SinkError, StepRecord,
    StepView,
};
use crate::data::Data;
use crate::time::Nanos;

/// Keys of a channel's metadata.
pub(super) const NODE: &str = "parallax.node";
pub(super) const CONTENT: &str = "parallax.content";
/// The record that a finished recording ends with, and what it says.
pub(super) const END: &str = "parallax.end";
pub(super) const DURATION: &str = "duration_ns";
const LEAVES: &str = "parallax.leaves";

/// A chunk is closed when it holds this much, or this span of time: what a killed recorder loses at most.
const CHUNK_BYTES: u64 = 256 * 1024;
const CHUNK_SPAN: u64 = 1_000_000_000;

/// Writes a recording, message by message and step by step.
///
/// The same calls give the same bytes: neither host nor date is written, except inside a wall clock that the
/// caller describes.
pub struct RecordingWriter {
    path: PathBuf,
    mcap: mcap::Writer<BufWriter<File>>,
    cdr: CdrWriter,
    tracks: Vec<TrackChannels>,
    losses: u16,
    faults: u16,
    changes: u16,
    /// Only where the graph runs on several machines.
    clocks: Option<u16>,
    notes: u32,
    origin: Nanos,
    /// Log time of the first message of the open chunk.
    chunk_start: Option<u64>,
    /// Bytes of all messages so far.
    bytes: u64,
}

/// Where one node's records go.
struct TrackChannels {
    name: String,
    leaves: usize,
    shape: Shape,
    messages: u16,
    steps: u16,
}

/// What a channel holds, as its metadata say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Content {
    Messages,
    Steps,
    Losses,
    Faults,
    Changes,
    Clocks,
}

impl Content {
    pub(super) const ALL: [Content; 6] = [
        Content::Messages,
        Content::Steps,
        Content::Losses,
        Content::Faults,
        Content::Changes,
        Content::Clocks,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Content::Messages => "messages",
            Content::Steps => "steps",
            Content::Losses => "losses",
            Content::Faults => "faults",
            Content::Changes => "changes",
            Content::Clocks => "clocks",
        }
    }
}

impl RecordingWriter {
    /// Begins a recording, which its owner alone may read; a file at this path is replaced.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Io`] when the file cannot be made.
    pub fn create(path: &Path, description: &Description) -> Result<Self, RecordingError> {
        Self::create_for(path, description, Access::Owner, Packing::default())
    }

    /// As [`create`](Self::create), for others, too, and packed otherwise.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Io`] when the file cannot be made, or given to the group.
    pub fn create_for(
        path: &Path,
        description: &Description,
        access: Access,
        packing: Packing,
    ) -> Result<Self, RecordingError> {
        Self::with_origin(path, description, 0, access, packing)
    }

    pub(super) fn with_origin(
        path: &Path,
        description: &Description,
        origin: Nanos,
        access: Access,
        packing: Packing,
    ) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.into(), what: "create the file", source };
        let fail = |source| RecordingError::Write { path: path.into(), source };
        let open = OpenOptions::new().write(true).create(true).truncate(false).mode(Access::NEW).open(path);
        let file = open.map_err(io)?;
        claim_empty(&file, path)?;
        access.give(&file).map_err(|source| RecordingError::Io {
            path: path.into(),
            what: "set who may read",
            source,
        })?;
        let file = BufWriter::with_capacity(CHUNK_BYTES as usize, file);
        let mut mcap = packing
            .of(WriteOptions::new(), description)
            .profile("ros2")
            .library(concat!("parallax ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk goes to the file in one piece when it is complete.
            .disable_seeking(true)
            .create(file)
            .map_err(fail)?;
        let file = DescriptionFile {
            format: if description.nodes.iter().any(|node| node.data > 0) { FORMAT } else { WITHOUT_DATA },
            versions: BTreeMap::from([("parallax".into(), env!("CARGO_PKG_VERSION").into())]),
            origin,
            description: description.clone(),
        };
        let data = serde_json::to_vec_pretty(&file).map_err(|e| io(e.into()))?;
        mcap.attach(&Attachment {
            log_time: 0,
            create_time: 0,
            name: DESCRIPTION.into(),
            media_type: "application/json".into(),
            data: data.into(),
        })
        .map_err(fail)?;

        let mut channels = Channels { mcap: &mut mcap, types: BTreeMap::new() };
        let mut tracks = Vec::with_capacity(description.nodes.len());
        for NodeDescription { name, layout, data, .. } in &description.nodes {
            let shape = Shape::of(layout, *data > 0);
            let schema = channels.named_apart(shape.schema(layout));
            let leaves = serde_json::to_string(&layout.leaves).map_err(|e| io(e.into()))?;
            let about = [(NODE, name.as_str()), (LEAVES, &leaves)];
            let messages =
                channels.add(&format!("/{name}"), &schema, Content::Messages, &about).map_err(fail)?;
            let about = [(NODE, name.as_str())];
            let steps = channels
                .add(&format!("/{name}/steps"), &ros2msg::step(), Content::Steps, &about)
                .map_err(fail)?;
            let leaves = layout.leaves.len();
            tracks.push(TrackChannels { name: name.clone(), leaves, shape, messages, steps });
        }
        let note = ros2msg::note();
        let losses = channels.add("/parallax/losses", &note, Content::Losses, &[]).map_err(fail)?;
        let faults = channels.add("/parallax/faults", &note, Content::Faults, &[]).map_err(fail)?;
        let changes = channels.add("/parallax/changes", &note, Content::Changes, &[]).map_err(fail)?;
        let clocks = match description.hosts.is_empty() {
            true => None,
            false => Some(channels.add("/parallax/clocks", &note, Content::Clocks, &[]).map_err(fail)?),
        };
        // The channels get a chunk of their own at the front: damage further on then leaves the rest readable.
        mcap.flush().map_err(fail)?;
        let cdr = CdrWriter::default();
        Ok(Self {
            path: path.into(),
            mcap,
            cdr,
            tracks,
            losses,
            faults,
            changes,
            clocks,
            notes: 0,
            origin,
            chunk_start: None,
            bytes: 0,
        })
    }

    /// Writes a message of the node with this index in the description.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Unwritable`] for a payload of another length than the layout, a sequence number
    /// beyond 32 bits or a time before the recording's origin; [`RecordingError::Write`].
    pub fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
    ) -> Result<(), RecordingError> {
        self.message_with_data(node, seq, sent, payload, &[])
    }

    /// As [`message`](RecordingWriter::message), with the message's [data](crate::data).
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message), and for data of a node that was described without.
    pub fn message_with_data(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &[u8],
    ) -> Result<(), RecordingError> {
        let TrackChannels { messages: channel, leaves, shape, .. } = self.tracks[node];
        let refuse = |reason: String| RecordingError::Unwritable {
            path: self.path.clone(),
            node: self.tracks[node].name.clone(),
            what: format!("message {seq}"),
            reason,
        };
        if payload.len() != leaves {
            return Err(refuse(format!("it has {} values and the layout {leaves} leaves", payload.len())));
        }
        if !shape.has_data() && !data.is_empty() {
            return Err(refuse(format!("it has {} bytes of data, and its kind declares none", data.len())));
        }
        let sequence = u32::try_from(seq).map_err(|_| refuse("MCAP counts to 2^32 only".into()))?;
        let time =
            self.time(sent).ok_or_else(|| refuse(format!("it was sent at {sent} ns, before the start")))?;
        shape.write(&mut self.cdr, &self.tracks[node].name, sent, payload, data);
        self.put(channel, sequence, time)
    }

    /// Writes a step of the node with this index in the description.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), RecordingError> {
        let inputs = step.inputs.iter().map(|input| (input.port(), input.stamps(), input.superseded()));
        self.put_step(node, [step.due, step.start, step.end], step.seq, inputs)
    }

    /// As [`step`](RecordingWriter::step), from a record.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn step_record(&mut self, node: usize, step: &StepRecord) -> Result<(), RecordingError> {
        let inputs = step.inputs.iter().map(|input| (&*input.port, &*input.consumed, input.superseded));
        self.put_step(node, [step.due, step.start, step.end], step.seq, inputs)
    }

    fn put_step<'a>(
        &mut self,
        node: usize,
        times: [Nanos; 3],
        seq: u64,
        inputs: impl ExactSizeIterator<Item = (&'a str, &'a [Consumed], u64)>,
    ) -> Result<(), RecordingError> {
        let channel = self.tracks[node].steps;
        let refuse = |reason: String| RecordingError::Unwritable {
            path: self.path.clone(),
            node: self.tracks[node].name.clone(),
            what: format!("step {seq}"),
            reason,
        };
        let sequence = u32::try_from(seq).map_err(|_| refuse("MCAP counts to 2^32 only".into()))?;
        let end = times[2];
        let time = self.time(end).ok_or_else(|| refuse(format!("it ended at {end} ns, before the start")))?;
        encode_step(&mut self.cdr, seq, times, inputs);
        self.put(channel, sequence, time)
    }

    /// Writes that messages were lost.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn loss(&mut self, loss: &Loss) -> Result<(), RecordingError> {
        self.note(self.losses, loss.time, loss)
    }

    /// Writes that something went wrong.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn fault(&mut self, fault: &Fault) -> Result<(), RecordingError> {
        self.note(self.faults, fault.time, fault)
    }

    /// Writes that something was set or reset.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn change(&mut self, change: &Change) -> Result<(), RecordingError> {
        self.note(self.changes, change.time, change)
    }

    /// Writes how the clocks of two machines stood to each other; nothing, if the description names no machines.
    ///
    /// # Errors
    ///
    /// As [`message`](RecordingWriter::message).
    pub fn clock(&mut self, reading: &ClockReading) -> Result<(), RecordingError> {
        match self.clocks {
            Some(channel) => self.note(channel, reading.time, reading),
            None => Ok(()),
        }
    }

    fn note(&mut self, channel: u16, time: Nanos, note: &impl Serialize) -> Result<(), RecordingError> {
        let io = |source| RecordingError::Io { path: self.path.clone(), what: "describe a loss", source };
        let json = serde_json::to_string(note).map_err(|e| io(e.into()))?;
        self.cdr.begin();
        self.cdr.text(&json);
        let time = u64::try_from(time.saturating_sub(self.origin)).unwrap_or(0);
        self.notes += 1;
        self.put(channel, self.notes - 1, time)
    }

    /// Hands everything that was written so far to the system: it survives the end of this process.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`], when the disk is full, for instance.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.chunk_start = None;
        self.mcap.flush().map_err(|source| RecordingError::Write { path: self.path.clone(), source })
    }

    /// Bytes of the messages written so far: about the length of the file, before it is packed.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Ends the recording of a run that lasted `duration`: the rest is written, and the summary that lets
    /// readers jump.
    ///
    /// # Errors
    ///
    /// [`RecordingError::Write`].
    pub fn finish(mut self, duration: Nanos) -> Result<(), RecordingError> {
        let fail = |source| RecordingError::Write { path: self.path.clone(), source };
        let metadata = BTreeMap::from([(DURATION.into(), duration.to_string())]);
        self.mcap.write_metadata(&mcap::records::Metadata { name: END.into(), metadata }).map_err(fail)?;
        self.mcap.finish().map_err(fail)?;
        let flushed = self.mcap.into_inner().into_inner().map(drop);
        flushed.map_err(|e| RecordingError::Io {
            path: self.path,
            what: "write the end",
            source: e.into_error(),
        })
    }

    /// A time as the file has it.
    fn time(&self, time: Nanos) -> Option<u64> {
        time.checked_sub(self.origin).and_then(|time| u64::try_from(time).ok())
    }

    fn put(&mut self, channel_id: u16, sequence: u32, time: u64) -> Result<(), RecordingError> {
        let fail = |source| RecordingError::Write { path: self.path.clone(), source };
        let start = *self.chunk_start.get_or_insert(time);
        if time.saturating_sub(start) >= CHUNK_SPAN {
            self.mcap.flush().map_err(fail)?;
            self.chunk_start = Some(time);
        }
        // What stands around a message: its record's head and its entry in the chunk's index.
        self.bytes += self.cdr.bytes().len() as u64 + 47;
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, self.cdr.bytes()).map_err(fail)
    }
}

/// Adds channels to a file.
struct Channels<'a> {
    mcap: &'a mut mcap::Writer<BufWriter<File>>,
    /// Definition of every type that has been used, by name.
    types: BTreeMap<String, String>,
}

impl Channels<'_> {
    /// The schema, under a name that no other definition has: viewers know types by name.
    fn named_apart(&mut self, mut schema: Schema) -> Schema {
        let name = schema.name.clone();
        let mut number = 2;
        while self.types.get(&schema.name).is_some_and(|text| *text != schema.text)
            || RESERVED.contains(&&*schema.name)
        {
            schema.name = format!("{name}{number}");
            number += 1;
        }
        self.types.insert(schema.name.clone(), schema.text.clone());
        schema
    }

    fn add(
        &mut self,
        topic: &str,
        schema: &Schema,
        content: Content,
        about: &[(&str, &str)],
    ) -> Result<u16, mcap::McapError> {
        let id = self.mcap.add_schema(&schema.name, "ros2msg", schema.text.as_bytes())?;
        let mut metadata: BTreeMap<String, String> =
            about.iter().map(|(key, value)| ((*key).into(), (*value).into())).collect();
        metadata.insert(CONTENT.into(), content.name().into());
        self.mcap.add_channel(id, topic, "cdr", &metadata)
    }
}

/// Type names that are ours.
const RESERVED: [&str; 4] = [
    "parallax_msgs/msg/Step",
    "parallax_msgs/msg/StepInput",
    "parallax_msgs/msg/Consumed",
    "parallax_msgs/msg/Note",
];

/// Encodes a step as [`ros2msg::step`] describes it; the times are due, start and end.
fn encode_step<'a>(
    cdr: &mut CdrWriter,
    seq: u64,
    times: [Nanos; 3],
    inputs: impl ExactSizeIterator<Item = (&'a str, &'a [Consumed], u64)>,
) {
    cdr.begin();
    cdr.u64(seq);
    times.iter().for_each(|time| cdr.i64(*time));
    cdr.length(inputs.len());
    for (port, consumed, superseded) in inputs {
        cdr.text(port);
        cdr.length(consumed.len());
        for Consumed { seq, sent, received } in consumed {
            cdr.flag(seq.is_none());
            cdr.u64(seq.unwrap_or(0));
            cdr.i64(*sent);
            cdr.i64(*received);
        }
        cdr.u64(superseded);
    }
}

impl RecordingSink for RecordingWriter {
    fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &Data,
    ) -> Result<(), SinkError> {
        self.message_with_data(node, seq, sent, payload, data).map_err(|e| SinkError(e.into()))
    }

    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError> {
        self.step(node, step).map_err(|e| SinkError(e.into()))
    }

    fn loss(&mut self, loss: &Loss) -> Result<(), SinkError> {
        self.loss(loss).map_err(|e| SinkError(e.into()))
    }

    fn fault(&mut self, fault: &Fault) -> Result<(), SinkError> {
        self.fault(fault).map_err(|e| SinkError(e.into()))
    }

    fn change(&mut self, change: &Change) -> Result<(), SinkError> {
        self.change(change).map_err(|e| SinkError(e.into()))
    }
}
