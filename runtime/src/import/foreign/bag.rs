//! ROS 2 bags, and other MCAP files with numbers in their messages. Those in SQLite: [`super::database`].

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Record, op};

use super::clock::{Clock, UnitFrom};
use super::header::clean;
use super::ros::Definition;
use super::value::{Numbers, Value, of_json, stamp};
use super::{ForeignError, Found, Group, Series, suggest};
use crate::recording::container::{Cut, Raw, Walk, parse, unpack};
use crate::recording::ros2msg::distinct;

/// Reads a bag's folder: all MCAP files in it, or all SQLite files, in the order of their names.
pub(super) fn folder(path: &Path, progress: &mut dyn FnMut(u64)) -> Result<Found, ForeignError> {
    let io = |source| ForeignError::Io { path: path.into(), source };
    let (mut files, mut databases): (Vec<PathBuf>, Vec<PathBuf>) = (Vec::new(), Vec::new());
    for entry in path.read_dir().map_err(io)? {
        let file = entry.map_err(io)?.path();
        match file.extension().and_then(|extension| extension.to_str()) {
            Some("mcap") => files.push(file),
            Some("db3") => databases.push(file),
            _ => {}
        }
    }
    let mut bag = Bag::default();
    let in_databases = files.is_empty();
    if in_databases {
        std::mem::swap(&mut files, &mut databases);
    }
    // `bag_2.mcap` comes before `bag_10.mcap`.
    files.sort_by_key(|file| (file.as_os_str().len(), file.clone()));
    databases.sort();
    for database in databases {
        bag.notes.push(format!("{} is not read: the MCAP files beside it are", database.display()));
    }
    if files.is_empty() {
        return Err(ForeignError::NotABag { path: path.into() });
    }
    let mut before = 0;
    for file in &files {
        before += bag.read(file, in_databases, &mut |bytes| progress(before + bytes))?;
    }
    Ok(bag.found(path, files.len()))
}

/// Reads one MCAP file, or one SQLite file.
pub(super) fn file(
    path: &Path,
    in_database: bool,
    progress: &mut dyn FnMut(u64),
) -> Result<Found, ForeignError> {
    let mut bag = Bag::default();
    bag.read(path, in_database, progress)?;
    Ok(bag.found(path, 1))
}

/// What is known of the messages so far.
#[derive(Default)]
pub(super) struct Bag {
    topics: BTreeMap<String, Topic>,
    /// Of the file that is read: schemas, and the topic of each channel with the way to decode it.
    schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    channels: BTreeMap<u16, (String, Option<Decoder>)>,
    pub(super) notes: Vec<String>,
    pub(super) form: String,
}

pub(super) enum Decoder {
    Ros(Definition),
    Json,
}

#[derive(Default)]
struct Topic {
    kind: String,
    numbers: Numbers,
    logged: Vec<Option<i64>>,
    published: Vec<Option<i64>>,
    stamped: Vec<Option<i64>>,
    /// Messages that cannot be decoded: how many, and why the first one.
    bad: usize,
    why: String,
    /// Why none of it is read.
    unread: Option<String>,
}

impl Bag {
    /// Reads a file of the bag; gives its size.
    fn read(
        &mut self,
        path: &Path,
        in_database: bool,
        progress: &mut dyn FnMut(u64),
    ) -> Result<u64, ForeignError> {
        if in_database { super::database::read(self, path, progress) } else { self.mcap(path, progress) }
    }

    fn mcap(&mut self, path: &Path, progress: &mut dyn FnMut(u64)) -> Result<u64, ForeignError> {
        let io = |source| ForeignError::Io { path: path.into(), source };
        let damaged =
            |at: u64, reason: &str| ForeignError::Damaged { path: path.into(), at, reason: reason.into() };
        self.schemas.clear();
        self.channels.clear();
        let file = File::open(path).map_err(io)?;
        let size = file.metadata().map_err(io)?.len();
        let mut reader = BufReader::with_capacity(1 << 18, file);
        let mut magic = [0; 8];
        reader.read_exact(&mut magic).map_err(|_| damaged(0, "the file is cut off"))?;
        if magic != mcap::MAGIC {
            return Err(damaged(0, "it does not begin like an MCAP file"));
        }
        let mut at = 8;
        let mut body = Vec::new();
        loop {
            let mut head = [0; 9];
            let read = reader.read_exact(&mut head);
            let mut length = [0; 8];
            length.copy_from_slice(&head[1..]);
            let length = u64::from_le_bytes(length);
            body.clear();
            let whole = read.is_ok()
                && length <= size
                && (&mut reader).take(length).read_to_end(&mut body).map_err(io)? as u64 == length;
            if !whole {
                let file = path.display();
                self.notes.push(format!("{file} is cut off at byte {at}; what was complete by then is read"));
                break;
            }
            let raw = Raw { at: usize::try_from(at).unwrap_or(usize::MAX), opcode: head[0], body: &body };
            if raw.opcode == op::FOOTER {
                break;
            }
            self.record(path, raw, false)?;
            at += 9 + length;
            progress(at);
        }
        Ok(size)
    }

    fn record(&mut self, path: &Path, raw: Raw<'_>, inside: bool) -> Result<(), ForeignError> {
        let at = raw.at;
        let damaged = |reason: String| ForeignError::Damaged { path: path.into(), at: at as u64, reason };
        match raw.opcode {
            op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::ATTACHMENT => {}
            _ => return Ok(()),
        }
        match parse(raw).map_err(damaged)? {
            Record::Header(header) => self.form = header.profile,
            Record::Attachment { header, .. } if header.name == crate::recording::DESCRIPTION => {
                return Err(ForeignError::Ours { path: path.into() });
            }
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Record::Channel(channel) => {
                let (kind, decoder) = self.decoder(channel.schema_id, &channel.message_encoding);
                let decoder = self.declare(&channel.topic, kind, decoder);
                self.channels.insert(channel.id, (channel.topic, decoder));
            }
            Record::Message { header, data } => self.message(&header, &data),
            Record::Chunk { header, data } if !inside => {
                let data = unpack(&header, &data).map_err(|reason| damaged(reason.to_string()))?;
                for inner in Walk::new(&data, at) {
                    match inner {
                        Ok(inner) => self.record(path, inner, true)?,
                        Err(Cut(_)) => return Err(damaged("the chunk ends inside a record".into())),
                    }
                }
            }
            Record::Chunk { .. } => return Err(damaged("a chunk lies inside a chunk".into())),
            _ => {}
        }
        Ok(())
    }

    /// The type of a channel's messages, and how they are decoded, or why not.
    fn decoder(&self, schema: u16, encoding: &str) -> (String, Result<Decoder, String>) {
        let Some((name, language, text)) = self.schemas.get(&schema) else {
            let decoder =
                if encoding == "json" { Ok(Decoder::Json) } else { Err("it has no definition".into()) };
            return (String::new(), decoder);
        };
        let decoder = match (encoding, language.as_str()) {
            ("json", _) => Ok(Decoder::Json),
            ("cdr", "ros2msg") => match std::str::from_utf8(text) {
                Ok(text) if !text.trim().is_empty() || name.ends_with("/Empty") => {
                    Definition::parse(name, text).map(Decoder::Ros)
                }
                _ => Err("its definition is empty: record again on a machine that has the package".into()),
            },
            (encoding, language) => {
                Err(format!("messages in `{encoding}` with definitions in `{language}` are not read"))
            }
        };
        (name.clone(), decoder)
    }

    /// A topic of messages of this type; gives how they are decoded, or keeps why not.
    pub(super) fn declare(
        &mut self,
        topic: &str,
        kind: String,
        decoder: Result<Decoder, String>,
    ) -> Option<Decoder> {
        let topic = self.topics.entry(topic.to_owned()).or_default();
        topic.kind = kind;
        decoder.map_err(|why| topic.unread = Some(why)).ok()
    }

    fn message(&mut self, header: &MessageHeader, data: &[u8]) {
        let Some((topic, Some(decoder))) = self.channels.get(&header.channel_id) else { return };
        let Some(topic) = self.topics.get_mut(topic) else { return };
        topic.take(decoder, header.log_time, header.publish_time, data);
    }

    /// A message at a topic that was declared.
    #[cfg(feature = "rosbag2")]
    pub(super) fn put(&mut self, topic: &str, decoder: &Decoder, logged: u64, data: &[u8]) {
        if let Some(topic) = self.topics.get_mut(topic) {
            topic.take(decoder, logged, logged, data);
        }
    }

    fn found(mut self, path: &Path, files: usize) -> Found {
        let mut taken = BTreeSet::new();
        let mut groups = Vec::new();
        for (name, topic) in std::mem::take(&mut self.topics) {
            let of = if topic.kind.is_empty() { String::new() } else { format!(" ({})", topic.kind) };
            if let Some(why) = &topic.unread {
                self.notes.push(format!("topic {name}{of} is left out: {why}"));
            }
            if topic.bad > 0 {
                let (bad, why) = (topic.bad, &topic.why);
                self.notes.push(format!("topic {name}{of}: {bad} messages cannot be decoded: {why}"));
            }
            for long in &topic.numbers.long {
                self.notes.push(format!("topic {name}{of}: the list `{long}` is too long for signals"));
            }
            if topic.numbers.paths.is_empty() {
                if topic.unread.is_none() && topic.numbers.rows > 0 {
                    self.notes.push(format!("topic {name}{of} has no numbers"));
                }
                continue;
            }
            groups.push(topic.group(&name, &mut taken));
        }
        let ros = match self.form.as_str() {
            "ros2" => "ROS 2 bag (MCAP)",
            super::database::FORM => super::database::FORM,
            _ => "MCAP",
        };
        let form = if files > 1 { format!("{ros} of {files} files") } else { ros.into() };
        Found { path: path.into(), form, groups, notes: self.notes }
    }
}

impl Topic {
    fn take(&mut self, decoder: &Decoder, logged: u64, published: u64, data: &[u8]) {
        let decoded = match decoder {
            Decoder::Ros(definition) => definition.decode(data).map_err(|error| error.to_string()),
            Decoder::Json => {
                serde_json::from_slice(data).map(|json| of_json(&json)).map_err(|e| e.to_string())
            }
        };
        match decoded {
            Ok(message) => self.push(logged, published, &message),
            Err(why) => self.fail(why),
        }
    }

    /// A message that cannot be decoded.
    fn fail(&mut self, why: String) {
        self.bad += 1;
        if self.why.is_empty() {
            self.why = why;
        }
    }

    fn push(&mut self, logged: u64, published: u64, message: &Value) {
        self.numbers.push(message);
        let time = |time: u64| i64::try_from(time).ok();
        self.logged.push(time(logged));
        self.published.push(time(published));
        self.stamped.push(stamp(message));
    }

    /// Its clocks, the one that is nearest to the truth first, and its series.
    fn group(self, name: &str, taken: &mut BTreeSet<String>) -> Group {
        let mut clocks = Vec::new();
        let clock = |name, stamps| Clock::nanos(name, stamps, UnitFrom::Stated);
        // A stamp of another clock than the others is none that goes together with them.
        if self.stamped.iter().all(Option::is_some) {
            clocks.push(clock("header.stamp", self.stamped));
        }
        if self.published != self.logged {
            clocks.push(clock("publish", self.published));
        }
        clocks.push(clock("log", self.logged));
        let topic = clean(name);
        let series = self.numbers.paths.into_iter().zip(self.numbers.columns).map(|(path, values)| {
            let within = if path == "data" { String::new() } else { clean_path(&path) };
            let full = if within.is_empty() { topic.clone() } else { format!("{topic}.{within}") };
            let unit = suggest::ros_unit(&self.kind, &path).to_owned();
            Series { name: distinct(full, taken), column: path, unit, values, clock: 0, role: None }
        });
        Group {
            name: name.into(),
            series: series.collect(),
            kind: self.kind.clone(),
            clocks,
            rows: self.numbers.rows,
            first_line: 1,
        }
    }
}

fn clean_path(path: &str) -> String {
    let path = path.strip_prefix("data[").map_or_else(|| path.to_owned(), |rest| format!("[{rest}"));
    clean(&path)
}
