//! Where, node by node: each node of a recording alone, on its recorded inputs, against its recorded output.
//!
//! A node that gives its recorded output again is cleared. One that does not is where a gap lies, whatever the plant does.
//! Nodes that no program knows, and those that read what no one recorded, cannot be judged. What remains between the
//! nodes that act and those that sense is the unrecorded stretch: the plant. The diagnosis never reads the messages of a
//! node that stands in for hardware.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use parallax_model::system::System;
use parallax_runtime::data::DataSpace;
use parallax_runtime::node::{ErasedNode, NodeContext, NodeError, Step};
use parallax_runtime::recording::{NodeTrack, Recording};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::tuning::Tuning;
use parallax_sim::{Difference, ReplayError, ReplayOptions, replay};
use serde::{Deserialize, Serialize};

use crate::noise;
use crate::readings::lattice::lattice;
use crate::statistics::{root_mean_square, standard_deviation};

/// Share of an output's own variation up to which a difference is that of another machine's arithmetic.
const ARITHMETIC: f64 = 1e-6;

/// What the replay of every node found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Nodes {
    /// In the order of the graph.
    pub nodes: Vec<NodeGap>,
    /// The stretches that no node records, each from a node that acts to one that senses.
    pub unrecorded: Vec<Stretch>,
}

/// One node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeGap {
    /// `node:N`.
    pub place: String,
    /// What can be said of it.
    pub verdict: Verdict,
    /// Steps that ran again.
    pub steps: u64,
    /// Steps whose output was not the recorded one, bit for bit.
    pub differing: u64,
    /// The largest gap of its leaves, in units of their resolution.
    pub gap: f64,
    /// Its output, leaf by leaf, where it differs.
    pub leaves: Vec<LeafGap>,
    /// The first difference, as a sentence.
    pub first_difference: Option<String>,
}

/// What can be said of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// It explains its output.
    Cleared,
    /// It does not give its recorded output on its recorded inputs.
    Differs,
    /// The simulator does not know it: there is no such kind, or its output does not follow from its inputs.
    Unknown,
    /// It reads what was not recorded: it belongs to the stretch between actuators and sensors.
    Sensor,
    /// It stands in for hardware.
    Hardware,
}

/// One leaf of a node's output.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeafGap {
    /// Its name.
    pub leaf: String,
    /// Root mean square difference, in the leaf's unit.
    pub difference: f64,
    /// The smallest change that the recorded leaf shows: its lattice or its noise.
    pub resolution: f64,
    /// The difference in units of the resolution.
    pub gap: f64,
}

/// A stretch that no node records.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Stretch {
    /// The node that acts, `node:motor`.
    pub actuator: String,
    /// The node that senses, `node:camera`.
    pub sensor: String,
}

/// Replays every node of a recording alone, with the kinds that `registry` knows.
///
/// # Errors
///
/// [`ReplayError`] when the recording does not fit together or does not fit the registry.
pub fn nodes(recording: &Recording, registry: &Registry) -> Result<Nodes, ReplayError> {
    let unknown: BTreeSet<&str> = unknown(recording, registry);
    let registry = completed(recording, registry);
    let heard = Heard::default();
    let report = replay(recording, &registry, &listening(recording, &registry, &heard))?;
    let outputs = heard.0.lock().unwrap_or_else(PoisonError::into_inner);
    let mut found = Nodes { nodes: Vec::new(), unrecorded: stretches(recording) };
    for replayed in &report.nodes {
        let Some(track) = recording.node(&replayed.name) else { continue };
        let verdict = if track.stand_in {
            Verdict::Hardware
        } else if unknown.contains(replayed.name.as_str()) || replayed.injected {
            Verdict::Unknown
        } else if reads_hardware(recording, &replayed.name) {
            Verdict::Sensor
        } else {
            Verdict::Cleared
        };
        let mut node = NodeGap {
            place: format!("node:{}", replayed.name),
            verdict,
            steps: 0,
            differing: 0,
            gap: 0.0,
            leaves: Vec::new(),
            first_difference: None,
        };
        if verdict == Verdict::Cleared {
            let ran = outputs.iter().find(|(name, _)| *name == replayed.name).map_or(&[][..], |o| &o.1);
            node.leaves = leaves(track, ran);
            node.gap = node.leaves.iter().map(|l| l.gap).fold(0.0, f64::max);
            (node.steps, node.differing) = (replayed.steps, replayed.differing);
            node.first_difference = replayed.first_difference.as_ref().map(Difference::to_string);
            if !node.leaves.is_empty() {
                node.verdict = Verdict::Differs;
            }
        }
        found.nodes.push(node);
    }
    Ok(found)
}

/// The name of a node, and the leaves of all that it sent.
type Sent = (String, Vec<f64>);

/// What nodes sent in the replay.
#[derive(Clone, Default)]
struct Heard(Arc<Mutex<Vec<Sent>>>);

/// A node whose outputs are written down.
struct Listener {
    node: Box<dyn ErasedNode>,
    name: String,
    heard: Heard,
}

impl Listener {
    fn hear(&self, output: &[f64]) {
        let mut all = self.heard.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.last().is_none_or(|last| last.0 != self.name) {
            all.push((self.name.clone(), Vec::new()));
        }
        if let Some(last) = all.last_mut() {
            last.1.extend_from_slice(output);
        }
    }
}

impl ErasedNode for Listener {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.node.step_into(step, output)?;
        self.hear(output);
        Ok(())
    }

    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        self.node.step_with_data(step, output, data)?;
        self.hear(output);
        Ok(())
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        self.node.tuning()
    }
}

/// Nodes that can be judged, run again under a listener.
fn listening(recording: &Recording, registry: &Registry, heard: &Heard) -> ReplayOptions {
    let mut kinds: Vec<(String, NodeKind)> = Vec::new();
    for node in &recording.graph.nodes {
        let track = recording.node(&node.name);
        if let (Some(kind), Some(track)) = (registry.get(&node.kind), track)
            && kind.is_deterministic()
            && !kind.is_stand_in()
            && !track.stand_in
            && !reads_hardware(recording, &node.name)
        {
            kinds.push((node.name.clone(), kind.clone()));
        }
    }
    let heard = heard.clone();
    let wrap = move |context: &NodeContext| {
        let kind = &kinds.iter().find(|(name, _)| *name == context.name)?.1;
        Some(kind.build(context).map(|node| {
            let name = context.name.clone();
            Box::new(Listener { node, name, heard: heard.clone() }) as Box<dyn ErasedNode>
        }))
    };
    ReplayOptions { overrides: Some(Box::new(wrap)) }
}

/// Nodes whose kind the registry does not have.
fn unknown<'a>(recording: &'a Recording, registry: &Registry) -> BTreeSet<&'a str> {
    let nodes = recording.graph.nodes.iter();
    nodes.filter(|n| registry.get(&n.kind).is_none()).map(|n| n.name.as_str()).collect()
}

/// The registry with a place for every kind that it lacks, shaped as the recording says; its nodes never run.
fn completed(recording: &Recording, registry: &Registry) -> Registry {
    let mut all = registry.clone();
    for node in recording.graph.nodes.iter().filter(|n| registry.get(&n.kind).is_none()) {
        let Some(track) = recording.node(&node.name) else { continue };
        let mut kind = NodeKind::erased(track.layout.clone(), track.initial.clone(), |context| {
            Err(context.parameter_error(format!("the kind of node `{}` is not known", context.name)))
        })
        .not_deterministic();
        for connection in recording.graph.connections.iter().filter(|c| c.to == node.name) {
            if let Some(sender) = recording.node(&connection.from) {
                kind = kind.input_with_layout(connection.port(), sender.layout.clone());
            }
        }
        all.insert(node.kind.clone(), kind);
    }
    all
}

fn stands_in(recording: &Recording, node: &str) -> bool {
    recording.node(node).is_some_and(|track| track.stand_in)
}

fn reads_hardware(recording: &Recording, node: &str) -> bool {
    recording.graph.connections.iter().any(|c| c.to == node && stands_in(recording, &c.from))
}

/// What differs between the recorded outputs and those of the replay, beyond arithmetic.
fn leaves(track: &NodeTrack, ran: &[f64]) -> Vec<LeafGap> {
    let width = track.layout.leaves.len();
    let mut found = Vec::new();
    for (index, leaf) in track.layout.leaves.iter().enumerate() {
        let again = ran.iter().skip(index).step_by(width.max(1));
        let (mut recorded, mut differences) = (Vec::new(), Vec::new());
        for (step, again) in track.steps.iter().zip(again) {
            let Some(message) = track.message(step.seq) else { continue };
            let value = message.payload[index];
            // Two values that are both no numbers agree.
            if value.is_nan() && again.is_nan() {
                continue;
            }
            recorded.push(value);
            differences.push(again - value);
        }
        let difference = root_mean_square(&differences);
        let size = standard_deviation(&recorded).max(1e-3 * root_mean_square(&recorded));
        if difference.is_nan() || difference > ARITHMETIC * size {
            let step = lattice(&recorded).map_or(0.0, |l| l.step);
            let floor = (ARITHMETIC * size).max(f64::MIN_POSITIVE);
            let resolution = noise::model_free(&recorded, None).max(step).max(floor);
            found.push(LeafGap { leaf: leaf.clone(), difference, resolution, gap: difference / resolution });
        }
    }
    found
}

/// The pairs of an acting and a sensing node with hardware between them: as the attached plant names them, else the
/// nodes on both sides of those that stand in for hardware.
fn stretches(recording: &Recording) -> Vec<Stretch> {
    let stretch = |actuator: &str, sensor: &str| Stretch {
        actuator: format!("node:{actuator}"),
        sensor: format!("node:{sensor}"),
    };
    let plant = recording.graph.plant.as_ref().and_then(|p| System::parse(&p.system, "system.toml").ok());
    let mut found = BTreeSet::new();
    if let Some(system) = plant {
        let node = |signal: &str| signal.split('.').next().unwrap_or(signal).to_owned();
        for input in &system.inputs {
            for output in &system.outputs {
                found.insert(stretch(&node(&input.signal), &node(&output.signal)));
            }
        }
        return found.into_iter().collect();
    }
    for into in recording.graph.connections.iter().filter(|c| stands_in(recording, &c.to)) {
        let out = recording.graph.connections.iter().filter(|c| c.from == into.to);
        for out in out.filter(|c| !stands_in(recording, &c.to) && !stands_in(recording, &into.from)) {
            found.insert(stretch(&into.from, &out.to));
        }
    }
    found.into_iter().collect()
}
