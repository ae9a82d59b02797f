//! What a recording says about itself: the attachment `graph.json`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::Clock;
use crate::any_number;
use crate::graph::{Graph, GraphSpec};
use crate::node::Layout;
use crate::time::Nanos;

/// Name of the attachment that says what is in the file.
pub(crate) const DESCRIPTION: &str = "graph.json";
/// Version of what this writer writes; a reader refuses larger ones.
pub(super) const FORMAT: u32 = 2;
/// Version of recordings without data, which older readers read.
pub(super) const WITHOUT_DATA: u32 = 1;

/// What is in a recording besides its messages and steps: the attachment `graph.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The graph that ran.
    pub graph: GraphSpec,
    /// The clock that it ran under.
    pub clock: Clock,
    /// The nodes whose messages and steps are recorded, in order.
    pub nodes: Vec<NodeDescription>,
    /// The machine of each node, where there are several.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub hosts: BTreeMap<String, String>,
}

/// A node of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeDescription {
    /// Its name.
    pub name: String,
    /// Layout of its output messages.
    pub layout: Layout,
    /// The leaves of its initial message.
    #[serde(with = "any_number::list")]
    pub initial: Vec<f64>,
    /// Whether it stands in for hardware.
    pub stand_in: bool,
    /// The most bytes of data that its messages have; 0 for messages without.
    #[serde(default, skip_serializing_if = "is_none")]
    pub data: usize,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
fn is_none(data: &usize) -> bool {
    *data == 0
}

impl Description {
    /// What a run of `graph` under `clock` records.
    pub fn new(graph: &Graph, clock: Clock) -> Self {
        let nodes = graph.nodes().iter().map(|node| NodeDescription {
            name: node.name.clone(),
            layout: node.kind.output().clone(),
            initial: node.kind.initial_message().to_vec(),
            stand_in: node.kind.is_stand_in(),
            data: node.kind.data_capacity(),
        });
        Self { graph: graph.spec().clone(), clock, nodes: nodes.collect(), hosts: BTreeMap::new() }
    }
}

/// The attachment as it stands in the file.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct DescriptionFile {
    pub(super) format: u32,
    /// Versions of the programs that wrote the file.
    pub(super) versions: BTreeMap<String, String>,
    /// Time of the recording that the file's time 0 stands for: MCAP times cannot be negative.
    pub(super) origin: Nanos,
    #[serde(flatten)]
    pub(super) description: Description,
}
