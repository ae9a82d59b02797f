//! A recorded graph around the simulated machine: its nodes run as they are, under the simulated clock, with delays drawn
//! as they were measured; what senses the machine gives its readings.

use std::sync::{Arc, Mutex, PoisonError};

use parallax_model::system::System;
use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::node::{ErasedNode, NodeContext, NodeError, Step};
use parallax_runtime::recording::log::Log;
use parallax_runtime::recording::{FaultKind, NodeTrack, Recording};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};
use parallax_sim::Executor;
use parallax_sim::delays::{LeftOut, Measured, Place, fit, fitted_graph};

use super::trace::{Bound, Trace};
use super::world::World;
use super::{ClosedLoopError, Lost};
use crate::experiment::Held;

/// The leaf that says when a payload was true (s from the run's start).
const STAMP: &str = "stamp";

/// The recorded graph without hardware, ready to be run around a machine.
pub(super) struct Around<'a> {
    recording: &'a Recording,
    spec: GraphSpec,
    /// All kinds but those of the sensors; their nodes draw the numbers that they drew in the recording.
    registry: Registry,
    sensors: Vec<Sensor>,
    drivers: Vec<Driver>,
    /// The recording's first stamp, where the machine's time begins.
    first: Nanos,
}

/// A node that reads the machine.
struct Sensor {
    node: String,
    /// For each leaf the machine's output; `None` for the stamp.
    leaves: Vec<Option<usize>>,
}

/// A node that drives the machine.
#[derive(Clone)]
struct Driver {
    node: String,
    stamp: Option<usize>,
    /// Leaves and the machine's inputs that they command.
    leaves: Vec<(usize, usize)>,
}

/// The node and the leaf that a signal `NODE.LEAF` is; a message of a single scalar has a leaf without a name.
fn leaf<'a>(recording: &'a Recording, signal: &str) -> Option<(&'a NodeTrack, usize)> {
    recording.nodes.iter().filter(|track| !track.stand_in).find_map(|track| {
        let rest = signal.strip_prefix(track.name.as_str())?;
        let leaf = if rest.is_empty() { "" } else { rest.strip_prefix('.')? };
        Some((track, track.layout.leaf(leaf)?))
    })
}

impl<'a> Around<'a> {
    /// Takes the hardware and its sensors out of the recorded graph; `log` is the recording's.
    pub(super) fn new(
        recording: &'a Recording,
        registry: &Registry,
        system: &System,
        log: &Log,
    ) -> Result<Self, ClosedLoopError> {
        let mut drivers: Vec<Driver> = Vec::new();
        for (index, input) in system.inputs.iter().enumerate() {
            let driven = Some(&input.signal).filter(|_| input.others.is_empty());
            let Some((track, leaf)) = driven.and_then(|signal| leaf(recording, signal)) else {
                let all: Vec<&str> =
                    [&input.signal].into_iter().chain(&input.others).map(String::as_str).collect();
                return Err(ClosedLoopError::NotDriven {
                    file: system.file.clone(),
                    input: input.name.clone(),
                    signal: all.join(" and "),
                });
            };
            match drivers.iter_mut().find(|driver| driver.node == track.name) {
                Some(driver) => driver.leaves.push((leaf, index)),
                None => drivers.push(Driver {
                    node: track.name.clone(),
                    stamp: track.layout.leaf(STAMP),
                    leaves: vec![(leaf, index)],
                }),
            }
        }
        let mut sensors: Vec<Sensor> = Vec::new();
        for output in &system.outputs {
            let Some((track, _)) = leaf(recording, &output.signal) else { continue };
            if sensors.iter().any(|sensor| sensor.node == track.name) {
                continue;
            }
            let read = |name: &String| {
                let signal =
                    if name.is_empty() { track.name.clone() } else { format!("{}.{name}", track.name) };
                let output = system.outputs.iter().position(|output| output.signal == signal);
                if output.is_none() && name != STAMP {
                    return Err(ClosedLoopError::Sensor { node: track.name.clone(), leaf: name.clone() });
                }
                Ok(output)
            };
            let leaves = track.layout.leaves.iter().map(read).collect::<Result<_, _>>()?;
            sensors.push(Sensor { node: track.name.clone(), leaves });
        }
        let fitted = fitted_graph(recording, registry).map_err(|e| ClosedLoopError::Graph(Box::new(e)))?;
        let mut around = Self {
            recording,
            spec: fitted.graph,
            registry: Registry::new(),
            sensors,
            drivers,
            first: log.span().map_or(0, |(first, _)| first),
        };
        around.take_out_hardware()?;
        around.put_sensors_in(recording);
        for node in &around.spec.nodes {
            if let Some(kind) = registry.get(&node.kind) {
                around.registry.insert(&node.kind, as_recorded(kind.clone(), recording.clock.seed()));
            }
        }
        Ok(around)
    }

    /// Drops the nodes that stand in for hardware, and what only they feed.
    fn take_out_hardware(&mut self) -> Result<(), ClosedLoopError> {
        let stands_in = |name: &str| self.recording.node(name).is_some_and(|track| track.stand_in);
        let senses = |name: &str| self.sensors.iter().any(|sensor| sensor.node == name);
        let blind = self
            .spec
            .connections
            .iter()
            .find(|edge| stands_in(&edge.from) && !senses(&edge.to) && !stands_in(&edge.to));
        if let Some(edge) = blind {
            return Err(ClosedLoopError::Hardware { node: edge.to.clone(), hardware: edge.from.clone() });
        }
        let gone: Vec<String> =
            self.spec.nodes.iter().map(|node| node.name.clone()).filter(|name| stands_in(name)).collect();
        let sensing: Vec<String> = self.sensors.iter().map(|sensor| sensor.node.clone()).collect();
        self.spec.nodes.retain(|node| !gone.contains(&node.name));
        self.spec.connections.retain(|edge| {
            !gone.contains(&edge.from) && !gone.contains(&edge.to) && !sensing.contains(&edge.to)
        });
        self.spec.plant = None;
        Ok(())
    }

    /// Puts the machine's readings in the place of the nodes that sense it. A message comes as late after its stamp as the
    /// recorded ones did.
    fn put_sensors_in(&mut self, recording: &Recording) {
        for sensor in &self.sensors {
            let Some(node) = self.spec.node_mut(&sensor.node) else { continue };
            let mut replaced = NodeSpec::new(node.name.clone(), kind_of(&sensor.node), node.rate);
            let track = recording.node(&sensor.node);
            if let Some((track, stamp)) = track.and_then(|track| Some((track, track.layout.leaf(STAMP)?))) {
                let age = |message: &parallax_runtime::recording::MessageRecord| {
                    (message.sent - from_seconds(message.payload[stamp])).max(0)
                };
                let delays: Vec<Nanos> = track.messages.iter().map(age).collect();
                let place = Place::Computation { node: sensor.node.clone() };
                let successive = vec![true; delays.len()];
                let measured = Measured { place, delays, successive, left_out: LeftOut::default() };
                replaced.computation = fit(&measured).map_or(replaced.computation, |found| found.fit);
            }
            *node = replaced;
        }
        let rate = |spec: &GraphSpec, name: &str| spec.node(name).map_or(1.0, |node| node.rate);
        for sensor in &self.sensors {
            for driver in &self.drivers {
                let per_step = rate(&self.spec, &driver.node) / rate(&self.spec, &sensor.node);
                let mut edge = ConnectionSpec::new(&driver.node, &sensor.node);
                // All commands since the last reading, and a few more where one was late.
                (edge.window, edge.skip) = (2 * per_step.ceil() as usize + 8, true);
                self.spec.connections.push(edge);
            }
        }
    }

    /// Runs the graph until `to` (s from the recording's first stamp) around a machine on its way.
    pub(super) fn run(
        &self,
        bound: &Bound,
        system: &System,
        world: World,
        to: f64,
        seed: u64,
    ) -> Result<Result<Trace, Lost>, ClosedLoopError> {
        let shared = Arc::new(Mutex::new(Shared {
            world,
            first: to_seconds(self.first),
            taken: vec![None; self.drivers.len()],
            lost: false,
        }));
        let mut registry = self.registry.clone();
        for sensor in &self.sensors {
            let Some(track) = self.recording.node(&sensor.node) else { continue };
            let (shared, leaves) = (Arc::clone(&shared), sensor.leaves.clone());
            let drivers = self.drivers.clone();
            let mut kind = NodeKind::erased(track.layout.clone(), track.initial.clone(), move |_| {
                Ok(Box::new(Reader {
                    shared: Arc::clone(&shared),
                    leaves: leaves.clone(),
                    drivers: drivers.clone(),
                    shown: vec![0.0; leaves.len()],
                }))
            });
            for driver in &self.drivers {
                let layout = self.recording.node(&driver.node).map(|track| track.layout.clone());
                kind = layout
                    .into_iter()
                    .fold(kind, |kind, layout| kind.input_with_layout(&driver.node, layout));
            }
            registry.insert(kind_of(&sensor.node), kind);
        }
        let graph = self.spec.validate(&registry).map_err(|e| ClosedLoopError::Graph(Box::new(e)))?;
        let end = self.first.saturating_add(from_seconds(to));
        let found = Executor::new(graph, seed).record(end).map_err(|e| ClosedLoopError::Run(Box::new(e)))?;
        if shared.lock().unwrap_or_else(PoisonError::into_inner).lost {
            return Ok(Err(Lost));
        }
        let fault = found.faults.iter().find_map(|fault| match &fault.kind {
            FaultKind::Failed { message } => Some((fault, message)),
            _ => None,
        });
        if let Some((fault, why)) = fault {
            return Err(ClosedLoopError::Fault {
                node: fault.node.clone(),
                time: to_seconds(fault.time - self.first),
                why: why.clone(),
            });
        }
        Ok(Ok(self.trace(bound, system, &found.log())))
    }

    /// The signals of a run of this graph.
    fn trace(&self, bound: &Bound, system: &System, log: &Log) -> Trace {
        let held = |signal: &String| {
            log.signal(signal).map_or_else(
                |_| Held::default(),
                |signal| Held {
                    times: signal.times.iter().map(|t| (t - self.first) as f64 * 1e-9).collect(),
                    values: signal.values.clone(),
                },
            )
        };
        Trace {
            readings: system.outputs.iter().map(|output| held(&output.signal)).collect(),
            commands: system.inputs.iter().map(|input| held(&input.signal)).collect(),
            others: bound.others.iter().map(held).collect(),
        }
    }
}

/// The kind of node that gives the machine's readings in the place of `node`.
fn kind_of(node: &str) -> String {
    format!("closed-loop/{node}")
}

/// A kind whose nodes draw what they drew in the recorded run, whatever the seed of this one.
fn as_recorded(kind: NodeKind, seed: u64) -> NodeKind {
    let (output, initial, inputs) =
        (kind.output().clone(), kind.initial_message().to_vec(), kind.inputs().to_vec());
    let same = NodeKind::erased(output, initial, move |context| {
        kind.build(&NodeContext { seed, ..context.clone() })
    });
    inputs.into_iter().fold(same, |kind, port| kind.input_with_layout(port.name, port.layout))
}

/// The machine, which several sensors may read.
struct Shared {
    world: World,
    /// Where the machine's time begins (s from the run's start).
    first: f64,
    /// The last message of each driver that the machine has had.
    taken: Vec<Option<u64>>,
    lost: bool,
}

/// A sensor of the machine, as a node.
struct Reader {
    shared: Arc<Mutex<Shared>>,
    leaves: Vec<Option<usize>>,
    drivers: Vec<Driver>,
    /// What it sent last: what it sends again where a reading is lost.
    shown: Vec<f64>,
}

impl ErasedNode for Reader {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let mut guard = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = &mut *guard;
        for (place, (driver, window)) in self.drivers.iter().zip(step.inputs()).enumerate() {
            for (index, message) in window.stamps().iter().enumerate() {
                if message.seq <= shared.taken[place] {
                    continue;
                }
                shared.taken[place] = message.seq;
                let payload = window.payload(index);
                let time = driver.stamp.map_or(to_seconds(message.sent), |leaf| payload[leaf]) - shared.first;
                for (leaf, input) in &driver.leaves {
                    shared.lost |= !payload[*leaf].is_finite();
                    shared.world.command(*input, time, payload[*leaf]);
                }
            }
        }
        let now = to_seconds(step.start);
        for (leaf, shown) in self.leaves.iter().zip(&mut self.shown) {
            match leaf {
                Some(output) => *shown = shared.world.read(*output, now - shared.first).unwrap_or(*shown),
                None => *shown = now,
            }
        }
        shared.lost |= shared.world.is_lost();
        if shared.lost {
            return Err(NodeError::failed("the simulated machine has left all bounds"));
        }
        output.copy_from_slice(&self.shown);
        Ok(())
    }
}
