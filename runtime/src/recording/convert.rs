//! Between recordings and logs: a graph's recording read as signals, and somebody's log kept as a recording.

use serde_json::json;

use super::log::{Log, Role, Signal, Source};
use super::{Clock, MessageRecord, NodeTrack, Recording};
use crate::data::Data;
use crate::graph::{GraphSpec, NodeSpec, Parameters};
use crate::node::Layout;
use crate::time::{Nanos, from_seconds};

/// The kind of a node that stands for an imported signal. No registry has it: such a recording cannot be replayed.
pub const IMPORTED_SIGNAL: &str = "imported/signal";

/// The kind of the entry that keeps what an imported log says of the whole run.
const IMPORTED_LOG: &str = "imported/log";

/// The leaf that says when a payload was true, in seconds since the run's start.
const STAMP: &str = "stamp";

impl Recording {
    /// The recording as named signals.
    ///
    /// A graph's leaves are called `NODE.LEAF` and count from the `stamp` leaf of their message, else from when it was
    /// sent. Nodes that stand in for hardware are left out. A node that feeds a stand-in gives commands, one that a
    /// stand-in feeds gives measurements, any other gives references. An imported log comes back as it was.
    ///
    /// Samples that are no signal's (not finite, or followed by another of the same stamp) are left out, and
    /// [`Log::notes`] says how many.
    pub fn log(&self) -> Log {
        if self.is_imported() {
            return self.imported_log();
        }
        let mut log = Log { title: self.graph.name.clone(), ..Log::default() };
        log.notes.extend(self.truncated.clone());
        for track in self.nodes.iter().filter(|track| !track.stand_in) {
            let stamp = track.layout.leaf(STAMP);
            let role = self.role(&track.name);
            for (index, leaf) in track.layout.leaves.iter().enumerate() {
                if Some(index) == stamp {
                    continue;
                }
                let samples = track.messages.iter().map(|message| {
                    let stamp = stamp.map_or(Some(message.sent), |stamp| seconds(message.payload[stamp]));
                    (stamp, message.payload[index])
                });
                // A message of a single scalar has a leaf without a name.
                let name =
                    if leaf.is_empty() { track.name.clone() } else { format!("{}.{leaf}", track.name) };
                let source = Source { file: self.graph.name.clone(), column: name.clone() };
                let signal =
                    Signal { name, role, unit: String::new(), times: vec![], values: vec![], source };
                log.add(signal, samples);
            }
        }
        log
    }

    /// Whether this is a log that was imported, rather than a graph that ran.
    pub fn is_imported(&self) -> bool {
        self.graph.nodes.iter().any(|node| node.kind == IMPORTED_SIGNAL)
    }

    fn role(&self, node: &str) -> Role {
        let stands_in = |name: &str| self.node(name).is_some_and(|track| track.stand_in);
        let connected = |matches: &dyn Fn(&str, &str) -> bool| {
            self.graph.connections.iter().any(|connection| matches(&connection.from, &connection.to))
        };
        if connected(&|from, to| from == node && stands_in(to)) {
            Role::Command
        } else if connected(&|from, to| to == node && stands_in(from)) {
            Role::Measurement
        } else {
            Role::Reference
        }
    }

    fn imported_log(&self) -> Log {
        let text = |parameters: &Parameters, key: &str| {
            parameters.get(key).and_then(|value| value.as_str()).unwrap_or_default().to_owned()
        };
        let mut log = Log { title: self.graph.name.clone(), ..Log::default() };
        log.notes.extend(self.truncated.clone());
        if let Some(about) = self.graph.nodes.iter().find(|node| node.kind == IMPORTED_LOG) {
            log.license = text(&about.parameters, "license");
            let constants = about.parameters.get("constants").and_then(|value| value.as_object());
            let number = |(name, value): (&String, &serde_json::Value)| Some((name.clone(), value.as_f64()?));
            log.constants = constants.into_iter().flatten().filter_map(number).collect();
        }
        for node in self.graph.nodes.iter().filter(|node| node.kind == IMPORTED_SIGNAL) {
            let Some(track) = self.node(&node.name) else { continue };
            let signal = Signal {
                name: node.name.clone(),
                role: text(&node.parameters, "role").parse().unwrap_or(Role::Reference),
                unit: text(&node.parameters, "unit"),
                times: vec![],
                values: vec![],
                source: Source {
                    file: text(&node.parameters, "file"),
                    column: text(&node.parameters, "column"),
                },
            };
            let samples = track
                .messages
                .iter()
                .map(|message| (Some(message.sent), message.payload.first().copied().unwrap_or(f64::NAN)));
            log.add(signal, samples);
        }
        log
    }
}

/// A time in seconds that fits.
fn seconds(value: f64) -> Option<Nanos> {
    (value.abs() < 9e9).then(|| from_seconds(value))
}

impl Log {
    /// Adds a signal with those of the samples that it can have.
    pub(crate) fn add(&mut self, mut signal: Signal, samples: impl Iterator<Item = (Option<Nanos>, f64)>) {
        let mut kept: Vec<(Nanos, f64)> = Vec::new();
        let (mut unusable, mut repeated) = (0_usize, 0_usize);
        for (stamp, value) in samples {
            match stamp {
                Some(stamp) if value.is_finite() => kept.push((stamp, value)),
                _ => unusable += 1,
            }
        }
        // The sort keeps the order of equal stamps, of which the last counts.
        kept.sort_by_key(|(stamp, _)| *stamp);
        for (index, (stamp, value)) in kept.iter().enumerate() {
            if kept.get(index + 1).is_some_and(|(next, _)| next == stamp) {
                repeated += 1;
            } else {
                signal.times.push(*stamp);
                signal.values.push(*value);
            }
        }
        if unusable > 0 {
            self.notes.push(format!(
                "{}: {unusable} samples without a finite value or stamp left out",
                signal.name
            ));
        }
        if repeated > 0 {
            self.notes.push(format!(
                "{}: {repeated} samples left out that others with the same stamp follow",
                signal.name
            ));
        }
        self.signals.push(signal);
    }

    /// The log as a recording that can be written to a file: one track for each signal, without steps.
    /// [`Recording::log`] gives the log back.
    pub fn recording(&self) -> Recording {
        let mut about = NodeSpec::new("log", IMPORTED_LOG, 1.0);
        let constants: Parameters =
            self.constants.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        about.parameters.insert("license".into(), json!(self.license));
        about.parameters.insert("constants".into(), constants.into());

        let mut graph = GraphSpec {
            name: self.title.clone(),
            supervisor: String::new(),
            nodes: vec![about],
            connections: Vec::new(),
            plant: None,
        };
        let mut nodes = Vec::with_capacity(self.signals.len());
        for signal in &self.signals {
            let mut node = NodeSpec::new(&signal.name, IMPORTED_SIGNAL, signal.rate().unwrap_or(1.0));
            node.parameters.insert("role".into(), json!(signal.role));
            node.parameters.insert("unit".into(), json!(signal.unit));
            node.parameters.insert("file".into(), json!(signal.source.file));
            node.parameters.insert("column".into(), json!(signal.source.column));
            graph.nodes.push(node);
            let messages = signal.times.iter().zip(&signal.values).zip(0..);
            nodes.push(NodeTrack {
                name: signal.name.clone(),
                layout: Layout { name: "imported/Signal".into(), leaves: vec!["value".into()] },
                initial: vec![0.0],
                stand_in: false,
                messages: messages
                    .map(|((time, value), seq)| MessageRecord {
                        seq,
                        sent: *time,
                        payload: vec![*value],
                        data: Data::default(),
                    })
                    .collect(),
                steps: Vec::new(),
            });
        }
        Recording {
            graph,
            clock: Clock::Wall { start: 0, host: String::new(), seed: 0 },
            duration: self.span().map_or(0, |(_, last)| last),
            nodes,
            losses: Vec::new(),
            faults: Vec::new(),
            changes: Vec::new(),
            hosts: Default::default(),
            clocks: Vec::new(),
            truncated: None,
        }
    }
}
