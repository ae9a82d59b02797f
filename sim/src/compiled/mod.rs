//! A graph and its episodes as tables, for executors that decide nothing at run time.
//!
//! [`compile`] cuts every episode into *passes*, one for each step of the supervisor (and some before its first), gives
//! every step a *slot* of one supergraph, and writes down, for every slot and pass, what runs and which messages it
//! reads. An executor walks through the passes and the slots in order. For every slot that runs it reads the inputs from
//! the senders' histories at the given places, makes the step, and writes the output into the node's own history at the
//! given place. Nothing else is needed: the tables hold no rule of the schedule.
//!
//! Times in the tables are those of the episodes, but for delays that are left open. A connection's delay may be chosen at
//! run time ([`TrainableDelay`]). A computation delay that follows from a step's output is what it was in the recording, or
//! what the graph expects in a generated episode; with [`OutputDelays::AtRunTime`] it is what the output says that an
//! executor of the tables computes ([`OutputDelay`]), as under the simulated clock. In both cases a row holds all messages
//! that could be there, and the executor of the tables takes those that are.
//!
//! A [`CompiledGraph`] knows nothing of what the nodes compute: the native batch and JAX run the same tables.

mod build;
mod candidates;
mod from_output;
mod rings;
mod rows;
mod trainable;

use parallax_runtime::time::Nanos;

use crate::supergraph::{Cut, Method, StartUp, Supergraph, SupergraphError};

pub use build::compile;
pub use from_output::{OutputDelay, OutputDelays};
pub use trainable::{Interpolation, TrainableConnection, TrainableDelay};

/// What to compile, and how.
#[derive(Debug, Clone, Default)]
pub struct CompileOptions {
    /// How slots are found.
    pub method: Method,
    /// Which steps run in which pass.
    pub cut: Cut,
    /// Where the steps run that are due before the supervisor's first: in its pass, which may then need slots that
    /// stay empty ever after, or in passes of their own ([`CompiledGraph::warm_up`]).
    pub start: StartUp,
    /// Nodes, by their place in the graph, of which every step is kept, although no step of the supervisor depends on it.
    pub keep: Vec<usize>,
    /// Nodes, by their place in the graph, whose outputs are given instead of computed: their steps read nothing and
    /// depend on nothing. A pinned supervisor still reads its inputs.
    pub pinned: Vec<usize>,
    /// For every node of the graph whether a step depends on the state that the step before left. Absent: a node whose
    /// kind is a model without state has none, every other node has one.
    pub stateful: Option<Vec<bool>>,
    /// Connections whose delay is chosen at run time.
    pub trainable: Vec<TrainableConnection>,
    /// Computation delays that follow from outputs: as in the episodes, or decided at run time.
    pub output_delays: OutputDelays,
}

/// Why a graph and its episodes cannot be compiled.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CompileError {
    /// There is nothing to compile.
    #[error("there is no episode; record or generate one first")]
    NoEpisodes,
    /// The supervisor never steps.
    #[error("the supervisor `{node}` makes no step in any episode; they are too short")]
    NoSteps {
        /// The supervisor.
        node: String,
    },
    /// An episode is not one of this graph.
    #[error("episode {episode} does not fit the graph: {problem}")]
    Episode {
        /// Its number.
        episode: usize,
        /// How.
        problem: String,
    },
    /// A node is named that the graph does not have.
    #[error("there is no node {node} in a graph of {nodes}")]
    NoNode {
        /// Its place.
        node: usize,
        /// How many there are.
        nodes: usize,
    },
    /// A list has not one entry for each node.
    #[error("`stateful` has {found} entries for {nodes} nodes")]
    Stateful {
        /// Its entries.
        found: usize,
        /// How many nodes there are.
        nodes: usize,
    },
    /// A trainable delay is not possible.
    #[error("connection {connection} cannot be trained: {problem}")]
    Trainable {
        /// Its place in the graph.
        connection: usize,
        /// Why.
        problem: String,
    },
    /// A delay that follows from an output cannot be decided at run time.
    #[error(
        "the computation delay of node `{node}` follows from its output and cannot be decided at run time: {problem}; \
         compile it as it is scheduled"
    )]
    OutputDelay {
        /// The node.
        node: String,
        /// Why.
        problem: String,
    },
    /// A table would need larger numbers than it has.
    #[error("the tables would be too large: {steps} steps; compile shorter episodes")]
    TooLarge {
        /// How many.
        steps: usize,
    },
    /// The steps cannot be put in order.
    #[error(transparent)]
    Supergraph(#[from] SupergraphError),
}

/// A graph and its episodes as tables.
///
/// All tables of a [`Rows`] are `[episode][pass]`, episode-major, pass fastest; the pass in which the supervisor makes
/// its step `k` is `warm_up + k`.
#[derive(Debug, Clone, PartialEq)]
pub struct CompiledGraph {
    /// The nodes, in the order of the graph.
    pub nodes: Vec<CompiledNode>,
    /// The slots, in the order in which they run; the last is the supervisor's.
    pub slots: Vec<Slot>,
    /// How many episodes there are.
    pub episodes: usize,
    /// How many steps the supervisor makes in the longest episode.
    pub steps: usize,
    /// How many steps the supervisor makes in each episode; the passes after that are padding, in which nothing runs.
    pub lengths: Vec<u32>,
    /// How many passes come before the supervisor's first step, in which the supervisor's slot does not run. 0
    /// with [`StartUp::First`].
    pub warm_up: usize,
    /// How many steps run in all episodes together.
    pub executed: usize,
    /// The slots as graph theory sees them, with their dependencies and generations.
    pub supergraph: Supergraph,
}

impl CompiledGraph {
    /// How many passes the tables have for each episode: `warm_up + steps`.
    pub fn passes(&self) -> usize {
        self.warm_up + self.steps
    }

    /// Where a pass of an episode lies in the tables.
    pub fn row(&self, episode: usize, pass: usize) -> usize {
        episode * self.passes() + pass
    }

    /// The share of slots that a step fills, padding aside.
    pub fn efficiency(&self) -> f64 {
        let passes: usize = self.lengths.iter().map(|&length| length as usize + self.warm_up).sum();
        self.executed as f64 / (passes * self.slots.len()).max(1) as f64
    }

    /// The supervisor's place among the nodes.
    pub fn supervisor(&self) -> usize {
        self.slots.last().map_or(0, |slot| slot.node)
    }
}

/// One node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CompiledNode {
    /// Its name.
    pub name: String,
    /// How many of its outputs are kept, at least 1. A history starts with the initial message in all places.
    pub history: usize,
    /// Whether a step depends on the state that the step before left.
    pub stateful: bool,
    /// Whether its outputs are given.
    pub pinned: bool,
}

/// One place in the order of execution.
#[derive(Debug, Clone, PartialEq)]
pub struct Slot {
    /// The node that steps here, by its place in the graph.
    pub node: usize,
    /// Whether it runs in every pass of every episode, padding aside: no mask is needed.
    pub always: bool,
    /// What runs when.
    pub rows: Rows,
}

/// What a slot does, `[episode][pass]`. Where it does not run, everything but `run` is what it was in a pass in which it
/// did: valid, and harmless to compute with.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rows {
    /// 1 where a step runs.
    pub run: Vec<u8>,
    /// The step's number.
    pub seq: Vec<i32>,
    /// When it was due, ns since the run's start.
    pub due: Vec<Nanos>,
    /// When it starts, ns since the run's start.
    pub start: Vec<Nanos>,
    /// The place in the node's history that takes the output.
    pub write: Vec<u32>,
    /// That place, where it is the same in all passes.
    pub constant_write: Option<u32>,
    /// One for each port of the kind, in its order; none for a pinned node other than the supervisor.
    pub inputs: Vec<InputRows>,
}

/// What one port of a slot reads, `[episode][pass][candidate]`, oldest first.
#[derive(Debug, Clone, PartialEq)]
pub struct InputRows {
    /// The connection, by its place in the graph.
    pub connection: usize,
    /// The sender, by its place in the graph.
    pub from: usize,
    /// How many messages the step sees.
    pub window: usize,
    /// How many messages stand in a row: `window`, or more where the delay is known only at run time.
    pub candidates: usize,
    /// The messages' numbers, −1 for an initial message.
    pub seq: Vec<i32>,
    /// When they were sent, ns; 0 for an initial message. Where the delay follows from the sender's output: when the
    /// sender's step started.
    pub sent: Vec<Nanos>,
    /// When they arrived, ns; 0 for an initial message. Where the delay is known only at run time: under the shortest.
    pub received: Vec<Nanos>,
    /// Their places in the sender's history.
    pub read: Vec<u32>,
    /// For each candidate the place, where it is the same in all passes.
    pub constant_read: Vec<Option<u32>>,
    /// The delay, where it is chosen at run time.
    pub trainable: Option<TrainableDelay>,
    /// The delay, where the sender's output decides it at run time. At most one of the two is there.
    pub from_output: Option<OutputDelay>,
}

impl InputRows {
    /// Whether a row holds more than the step sees: its delay is known only at run time.
    #[inline]
    pub fn is_open(&self) -> bool {
        self.trainable.is_some() || self.from_output.is_some()
    }
}
