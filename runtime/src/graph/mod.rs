//! Which nodes there are and how they are connected.
//!
//! A [`GraphSpec`] is data: written by hand, by a [`GraphBuilder`] that checks message types at compile time, or read
//! from a recording. [`GraphSpec::validate`] checks it against the kinds of node that a program knows and gives a
//! [`Graph`]: every node with its phase, every connection with its plan.

mod builder;
mod error;
mod external;
mod safe;
mod spec;
mod validate;

pub(crate) use validate::few;

pub use builder::{ConnectionBuilder, GraphBuilder, NodeBuilder, NodeHandle};
pub use error::{GraphError, GraphWarning, MAX_WINDOW};
pub use safe::{SafeOutput, SafeValue};
pub use spec::{
    ConnectionSpec, GraphSpec, JitterPolicy, NodeSpec, OnDeadSender, Parameters, PlantSpec, Scheduling,
};

use crate::delay::Delay;
use crate::node::{ErasedNode, NodeContext, NodeError};
use crate::registry::NodeKind;
use crate::time::{Grid, Nanos};

/// A graph that was checked and can run. Made by [`GraphSpec::validate`].
#[derive(Debug, Clone)]
pub struct Graph {
    spec: GraphSpec,
    nodes: Vec<NodePlan>,
    connections: Vec<ConnectionPlan>,
    order: Vec<usize>,
    supervisor: usize,
    warnings: Vec<GraphWarning>,
}

/// One node of a checked graph.
#[derive(Debug, Clone)]
pub struct NodePlan {
    /// Its name.
    pub name: String,
    /// Its kind.
    pub kind: NodeKind,
    /// When its ticks are due; the grid's phase is the node's.
    pub grid: Grid,
    /// How long a step takes.
    pub computation: Delay,
    /// What an overrun does.
    pub scheduling: Scheduling,
    /// Whether it starts as soon as its inputs are there.
    pub advance: bool,
    /// What it does when a node it waits for is gone.
    pub on_dead_sender: OnDeadSender,
    /// The core it is pinned to.
    pub core: Option<usize>,
    /// What its receivers are given when it is gone, hangs or is too late.
    pub safe: Option<SafeOutput>,
    /// The connections that feed it, one per input of the kind and in that order.
    pub inputs: Vec<usize>,
    /// The connections that it feeds, in the order of the graph.
    pub outputs: Vec<usize>,
    /// Its place among all nodes when a sender comes before its receivers (connections with `skip` aside). Equal times
    /// are ordered by it.
    pub rank: usize,
}

/// One connection of a checked graph.
#[derive(Debug, Clone)]
pub struct ConnectionPlan {
    /// The sending node.
    pub from: usize,
    /// The receiving node.
    pub to: usize,
    /// The place of the input among the receiver's.
    pub input: usize,
    /// The input's name.
    pub port: String,
    /// Whether a step waits for its messages.
    pub blocking: bool,
    /// How many messages a step sees.
    pub window: usize,
    /// Whether a message that arrives exactly at the start is left for the next step.
    pub skip: bool,
    /// How jitter is treated.
    pub jitter: JitterPolicy,
    /// How long a message travels.
    pub delay: Delay,
    /// Expected time from the sender's tick to the arrival: computation and communication.
    pub expected: Nanos,
    /// How many messages the receiver can hold.
    pub capacity: usize,
    /// How many leaves a message has.
    pub leaves: usize,
    /// The most bytes of [data](crate::data) that a message has.
    pub data: usize,
}

impl Graph {
    /// What it was made from.
    pub fn spec(&self) -> &GraphSpec {
        &self.spec
    }

    /// The nodes, in the order of the spec.
    pub fn nodes(&self) -> &[NodePlan] {
        &self.nodes
    }

    /// The connections, in the order of the spec.
    pub fn connections(&self) -> &[ConnectionPlan] {
        &self.connections
    }

    /// All nodes, senders before their receivers (connections with `skip` aside).
    pub fn order(&self) -> &[usize] {
        &self.order
    }

    /// The node at whose rate the graph is stepped.
    pub fn supervisor(&self) -> usize {
        self.supervisor
    }

    /// What is probably not meant.
    pub fn warnings(&self) -> &[GraphWarning] {
        &self.warnings
    }

    /// The place of the node called `name`.
    pub fn index(&self, name: &str) -> Option<usize> {
        self.nodes.iter().position(|node| node.name == name)
    }

    /// `from->to`, or `from->to.port` where the port has another name than the sender: the name of a connection's
    /// random stream, and what people read.
    pub fn connection_name(&self, connection: usize) -> String {
        let plan = &self.connections[connection];
        let (from, to) = (&self.nodes[plan.from].name, &self.nodes[plan.to].name);
        if plan.port == *from { format!("{from}->{to}") } else { format!("{from}->{to}.{}", plan.port) }
    }

    /// What the node at `index` is told when it is built.
    pub fn context(&self, index: usize, seed: u64) -> NodeContext {
        let spec = &self.spec.nodes[index];
        NodeContext { name: spec.name.clone(), rate: spec.rate, seed, parameters: spec.parameters.clone() }
    }

    /// Builds the node at `index`.
    ///
    /// # Errors
    ///
    /// What its kind says about its parameters.
    pub fn build(&self, index: usize, seed: u64) -> Result<Box<dyn ErasedNode>, NodeError> {
        self.nodes[index].kind.build(&self.context(index, seed))
    }

    /// Checks that every node's core is one of `available`, the cores that this process may use. A graph that is only
    /// simulated or read does not need them.
    ///
    /// # Errors
    ///
    /// [`GraphError::UnknownCore`].
    pub fn check_cores(&self, available: &[usize]) -> Result<(), GraphError> {
        for node in &self.nodes {
            if let Some(core) = node.core
                && !available.contains(&core)
            {
                let available: Vec<String> = available.iter().map(ToString::to_string).collect();
                return Err(GraphError::UnknownCore {
                    node: node.name.clone(),
                    core,
                    available: available.join(", "),
                });
            }
        }
        Ok(())
    }
}
