//! The supergraph: one fixed order of slots that every partition of every episode fits into.
//!
//! An accelerator runs the same operations in every step. The steps that a graph of asynchronous nodes takes between two
//! steps of its supervisor, a *partition*, differ from one to the next: a sensor ran twice here and not at all there. A
//! [`Supergraph`] is a sequence of *slots*, each for a step of one node; an [`Embedding`] gives every step of a partition
//! a slot. An executor runs through the slots in order and masks those that a partition leaves empty. Few slots mean
//! little wasted work: the *efficiency* is the share of the slots that is filled.
//!
//! The key functions: [`partition()`] cuts the computation graph of an episode at the supervisor's steps,
//! [`supergraph()`] finds the slots for given partitions, and [`plan()`] does both together, which gives the fewest
//! slots.
//!
//! # What an embedding must keep
//!
//! A partition is a directed acyclic graph whose vertices are labelled with nodes. An embedding must give
//!
//! 1. every vertex a slot with its label, and no slot to two vertices;
//! 2. to the head of every edge a slot later in the fixed order than to its tail;
//! 3. to the steps of one node slots in the order of the steps.
//!
//! This is what an executor needs and all that it needs: it runs the slots in order, reads every input from a history of
//! its sender, and so computes each step with the numbers of the episode if and only if what the step reads was computed
//! before. Which message a step consumes is recorded; *when* an executor computes a step changes nothing else. The third
//! condition holds by itself for a node with a state, whose steps depend on each other; for the others it keeps a
//! history in the order of its messages.
//!
//! Van der Heijden, Ferranti, Kober and Babuška (2024, *Efficient parallelized simulation of cyber-physical systems*) ask
//! for a subgraph monomorphism: every edge of a partition must be an edge of the supergraph. A sequence of slots read as
//! a total order has an edge from every slot to all later ones, so conditions 1 and 2 are the same monomorphism into the
//! *transitive closure* of the order in which slots run. Asking for literal edges of a sparser graph can only add slots.
//! The smallest supergraph is then a shortest common supersequence of partial orders: a sequence of labels of which
//! every partition has a topological order as a subsequence. For chains this is the shortest common supersequence, which
//! is NP-hard, so the search is a heuristic; [`Supergraph::bound`] says how far from the best it can be at most.
//!
//! ```
//! use parallax_sim::supergraph::{Method, Partition, supergraph};
//!
//! // A world (0) at twice the rate of the supervisor (2), and a sensor (1) that sees either of its steps.
//! let early = Partition { labels: vec![0, 1, 0, 2], edges: vec![(0, 1), (0, 2), (1, 3)] };
//! let late = Partition { labels: vec![0, 0, 1, 2], edges: vec![(0, 1), (1, 2), (2, 3)] };
//! let none = Partition { labels: vec![0, 0, 2], edges: vec![(0, 1)] };
//! let (found, embeddings) = supergraph(&[early, late, none], 2, Method::default())?;
//! // The sensor that sees the world's first step may as well run after the second: one order serves all three.
//! assert_eq!(found.labels, [0, 0, 1, 2]);
//! assert_eq!(embeddings[0].slots, [0, 2, 1, 3]);
//! assert_eq!(embeddings[2].slots, [0, 1, 3]);
//! assert!((found.efficiency(11, 3) - 11.0 / 12.0).abs() < 1e-12);
//! # Ok::<(), parallax_sim::supergraph::SupergraphError>(())
//! ```

mod baseline;
mod cut;
mod dag;
mod grow;
mod merge;
mod plan;
mod poset;
mod slots;
mod spread;
mod sweep;

pub use cut::{Cut, Partitioning, StartUp, partition};
pub use dag::{Dag, DagInput, DagNode};
pub use plan::{Plan, PlanOptions, plan};
pub use slots::{Supergraph, supergraph};

use thiserror::Error;

/// The steps that run between two steps of the supervisor, the second included: a DAG of labelled vertices.
///
/// The vertices are in a topological order, those of one label in the order of their node's steps.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Partition {
    /// The node of every vertex.
    pub labels: Vec<u32>,
    /// Edges by position in `labels`, from the smaller to the larger.
    pub edges: Vec<(u32, u32)>,
}

/// How the slots are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The minimum common supergraph: grown greedily from the partitions, then taken back in parts and grown again.
    Mcs {
        /// How often a part is taken back and grown again, where the bound is not reached before.
        backtrack: usize,
    },
    /// A slot of every node for every vertex of the largest partition: any topological order of any partition fits.
    Topological,
    /// A slot of every node for every generation (longest path) of the deepest partition.
    Generational,
}

impl Default for Method {
    fn default() -> Method {
        Method::Mcs { backtrack: 200 }
    }
}

/// The slot of every vertex of a partition, in the order of its vertices.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Embedding {
    /// Indices into [`Supergraph::labels`].
    pub slots: Vec<u32>,
}

/// What no supergraph can be made of.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SupergraphError {
    /// partition {partition}: the edge from {from} to {to} does not lead forward among {vertices} vertices
    #[error(
        "partition {partition}: the edge from {from} to {to} does not lead forward among {vertices} vertices"
    )]
    Edge {
        /// Index of the partition.
        partition: usize,
        /// Tail of the edge.
        from: u32,
        /// Head of the edge.
        to: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// partition {partition}: the supervisor's step is not its last and only one
    #[error("partition {partition}: the supervisor has a step that is not the last vertex")]
    Supervisor {
        /// Index of the partition.
        partition: usize,
    },
    /// the supervisor is node {supervisor}, and there are {nodes} nodes
    #[error("the supervisor is node {supervisor}, and there are {nodes} nodes")]
    NoSupervisor {
        /// Index of the supervisor.
        supervisor: u32,
        /// Number of nodes.
        nodes: usize,
    },
    /// node {node}: an input from node {from} with window {window} lists {listed} messages for {steps} steps
    #[error(
        "node {node}: an input from node {from} with window {window} lists {listed} messages for {steps} steps"
    )]
    Input {
        /// The receiving node.
        node: usize,
        /// The sending node.
        from: u32,
        /// Messages per step.
        window: usize,
        /// Length of the list.
        listed: usize,
        /// Steps of the receiver.
        steps: usize,
    },
    /// node {node}, step {step} consumes message {seq} of node {from}, which has {steps} steps
    #[error("node {node}, step {step} consumes message {seq} of node {from}, which has {steps} steps")]
    NoMessage {
        /// The receiving node.
        node: usize,
        /// Its step.
        step: usize,
        /// The sending node.
        from: u32,
        /// The message that is not there.
        seq: i64,
        /// Steps of the sender.
        steps: usize,
    },
    /// the steps depend on each other in a cycle: node {node}, step {step} is on it or after it
    #[error("the steps depend on each other in a cycle: node {node}, step {step} is on it or after it")]
    Cycle {
        /// A node.
        node: usize,
        /// Its step.
        step: usize,
    },
    /// the episodes have different nodes: {found} in episode {episode}, {expected} in the first
    #[error("the episodes have different nodes: {found} in episode {episode}, {expected} in the first")]
    Nodes {
        /// Index of the episode.
        episode: usize,
        /// Its number of nodes.
        found: usize,
        /// The first episode's.
        expected: usize,
    },
}
