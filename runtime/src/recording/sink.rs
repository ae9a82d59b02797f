//! What takes a run as it happens: nothing, a recording in memory, or a file.

use std::collections::BTreeMap;

use super::{Change, Clock, Fault, InputRecord, Loss, MessageRecord, NodeTrack, Recording, StepRecord};
use crate::data::Data;
use crate::graph::Graph;
use crate::node::InputWindow;
use crate::time::Nanos;

/// A sink that could not take what it was given.
#[derive(Debug, thiserror::Error)]
#[error("the recording cannot be written: {0}")]
pub struct SinkError(#[source] pub Box<dyn std::error::Error + Send + Sync>);

/// One step, lent to a sink.
#[derive(Debug, Clone, Copy)]
pub struct StepView<'a> {
    /// Its number, from 0.
    pub seq: u64,
    /// When it was due.
    pub due: Nanos,
    /// When it started.
    pub start: Nanos,
    /// When it ended.
    pub end: Nanos,
    /// What it saw.
    pub inputs: &'a [InputWindow],
}

impl StepView<'_> {
    /// The step as a record of its own.
    pub fn to_record(&self) -> StepRecord {
        StepRecord {
            seq: self.seq,
            due: self.due,
            start: self.start,
            end: self.end,
            inputs: self.inputs.iter().map(InputRecord::from).collect(),
        }
    }
}

/// Takes a run as it happens. Nodes are named by their place in the graph.
pub trait RecordingSink {
    /// A node sent a message.
    ///
    /// # Errors
    ///
    /// When it cannot be kept.
    fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &Data,
    ) -> Result<(), SinkError>;

    /// A node finished a step.
    ///
    /// # Errors
    ///
    /// When it cannot be kept.
    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError>;

    /// A message was lost.
    ///
    /// # Errors
    ///
    /// When it cannot be kept.
    fn loss(&mut self, loss: &Loss) -> Result<(), SinkError>;

    /// A node ended early.
    ///
    /// # Errors
    ///
    /// When it cannot be kept.
    fn fault(&mut self, fault: &Fault) -> Result<(), SinkError>;

    /// Something was set or reset in a node.
    ///
    /// # Errors
    ///
    /// When it cannot be kept.
    fn change(&mut self, change: &Change) -> Result<(), SinkError>;
}

/// Keeps nothing.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoSink;

impl RecordingSink for NoSink {
    fn message(&mut self, _: usize, _: u64, _: Nanos, _: &[f64], _: &Data) -> Result<(), SinkError> {
        Ok(())
    }
    fn step(&mut self, _: usize, _: &StepView<'_>) -> Result<(), SinkError> {
        Ok(())
    }
    fn loss(&mut self, _: &Loss) -> Result<(), SinkError> {
        Ok(())
    }
    fn fault(&mut self, _: &Fault) -> Result<(), SinkError> {
        Ok(())
    }
    fn change(&mut self, _: &Change) -> Result<(), SinkError> {
        Ok(())
    }
}

/// A recording in the making, in memory.
#[derive(Debug, Clone)]
pub struct MemorySink {
    recording: Recording,
}

impl MemorySink {
    /// An empty recording of `graph`.
    pub fn new(graph: &Graph, clock: Clock) -> Self {
        let nodes = graph
            .nodes()
            .iter()
            .map(|node| NodeTrack {
                name: node.name.clone(),
                layout: node.kind.output().clone(),
                initial: node.kind.initial_message().to_vec(),
                stand_in: node.kind.is_stand_in(),
                messages: Vec::new(),
                steps: Vec::new(),
            })
            .collect();
        Self {
            recording: Recording {
                graph: graph.spec().clone(),
                clock,
                duration: 0,
                nodes,
                losses: Vec::new(),
                faults: Vec::new(),
                changes: Vec::new(),
                hosts: BTreeMap::new(),
                clocks: Vec::new(),
                truncated: None,
            },
        }
    }

    /// The recording of a run that lasted `duration`.
    pub fn finish(mut self, duration: Nanos) -> Recording {
        self.recording.duration = duration;
        self.recording
    }
}

impl RecordingSink for MemorySink {
    fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &Data,
    ) -> Result<(), SinkError> {
        let (payload, data) = (payload.to_vec(), data.clone());
        self.recording.nodes[node].messages.push(MessageRecord { seq, sent, payload, data });
        Ok(())
    }

    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError> {
        self.recording.nodes[node].steps.push(step.to_record());
        Ok(())
    }

    fn loss(&mut self, loss: &Loss) -> Result<(), SinkError> {
        self.recording.losses.push(loss.clone());
        Ok(())
    }

    fn fault(&mut self, fault: &Fault) -> Result<(), SinkError> {
        self.recording.faults.push(fault.clone());
        Ok(())
    }

    fn change(&mut self, change: &Change) -> Result<(), SinkError> {
        self.recording.changes.push(change.clone());
        Ok(())
    }
}
