//! Computation graphs with simulator nodes: what was recorded, with a world in the place of the hardware.
//!
//! From the episodes of a recorded graph an [`Augmentation`] makes episodes of another graph (van der Heijden et al.,
//! "REX", section 3.3 and figure 4): nodes are dropped, simulator nodes step at a rate of their own, and connections are
//! added whose delays are drawn from a distribution or left open for training. What was recorded and stays keeps its
//! recorded times and windows.
//!
//! New nodes step on an ideal grid, and nobody waits on new connections: a step sees what has arrived by its start, under
//! the rules of [`schedule`](parallax_runtime::schedule) for connections that are not blocking.

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphError, GraphSpec, JitterPolicy, NodeSpec};
use parallax_runtime::random::{Purpose, derived, stream};
use parallax_runtime::registry::Registry;
use parallax_runtime::time::{Grid, Nanos, from_seconds};
use rayon::prelude::*;

use crate::compiled::{Interpolation, TrainableConnection};
use crate::episode::{Consumption, Episode, NodeSteps};

/// How long messages of a new connection travel.
#[derive(Debug, Clone, PartialEq)]
pub enum EdgeDelay {
    /// Drawn from a distribution, once per message; messages never overtake each other.
    Given(Delay),
    /// Chosen when the graph runs, between two bounds. Until then the episodes hold the windows of the mean of both.
    Trainable {
        /// The shortest, s.
        min: f64,
        /// The longest, s.
        max: f64,
        /// How payloads follow.
        interpolation: Interpolation,
    },
}

/// Why a graph cannot be augmented.
#[derive(Debug, thiserror::Error)]
pub enum AugmentError {
    /// The graph does not have this node.
    #[error("the graph has no node `{node}`; it has {known}")]
    NoNode {
        /// The name.
        node: String,
        /// The names that there are.
        known: String,
    },
    /// The new graph is not valid.
    #[error("the augmented graph: {0}")]
    Graph(#[from] GraphError),
    /// A new connection is blocking.
    #[error(
        "the new connection {from} -> {to} is blocking: what was recorded cannot wait for it; make it non-blocking"
    )]
    Blocking {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
    },
    /// A trainable delay is not possible.
    #[error("the trainable delay of {from} -> {to} needs 0 <= min <= max, finite; it has {min} and {max} s")]
    Bounds {
        /// The sender.
        from: String,
        /// The receiver.
        to: String,
        /// The shortest, s.
        min: f64,
        /// The longest, s.
        max: f64,
    },
    /// A new node's phase is not possible.
    #[error(
        "the phase of the new node `{node}` has to be a finite number of seconds, at least 0; it is {phase}"
    )]
    Phase {
        /// The node.
        node: String,
        /// The phase, s.
        phase: f64,
    },
    /// An episode is not one of the graph.
    #[error("episode {episode} does not fit the graph: {problem}")]
    Episode {
        /// Its number.
        episode: usize,
        /// How.
        problem: String,
    },
}

/// A graph with simulator nodes, and its episodes: ready to be compiled.
#[derive(Debug, Clone)]
pub struct Augmented {
    /// The new graph. Phases of its nodes are those that it would have if it ran; the episodes' are what they were told.
    pub graph: Graph,
    /// Its episodes.
    pub episodes: Vec<Episode>,
    /// The connections whose delays are open, for [`CompileOptions`](crate::compiled::CompileOptions).
    pub trainable: Vec<TrainableConnection>,
}

/// What to change about a recorded graph.
///
/// ```
/// use parallax_runtime::delay::Delay;
/// use parallax_runtime::graph::{ConnectionSpec, Graph, NodeSpec};
/// use parallax_runtime::registry::Registry;
/// use parallax_sim::augment::{Augmentation, EdgeDelay};
/// use parallax_sim::compiled::{CompileOptions, Interpolation, compile};
/// use parallax_sim::Episode;
/// # fn example(graph: &Graph, registry: &Registry, episode: Episode) -> Result<(), Box<dyn std::error::Error>> {
/// // The recorded world, a stand-in, becomes a simulator at 200 Hz; how old its images are is to be found.
/// let hidden = EdgeDelay::Trainable { min: 0.0, max: 0.05, interpolation: Interpolation::Linear };
/// let augmented = Augmentation::new(graph)
///     .node(NodeSpec::new("world", "example/simulator", 200.0), 0.0)
///     .connect(ConnectionSpec::new("motor", "world"), EdgeDelay::Given(Delay::constant(0.003)))
///     .connect(ConnectionSpec::new("world", "camera"), hidden)
///     .apply(registry, &[episode], 1)?;
/// let options = CompileOptions { trainable: augmented.trainable, ..CompileOptions::default() };
/// let compiled = compile(&augmented.graph, &augmented.episodes, &options)?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone)]
pub struct Augmentation<'a> {
    graph: &'a Graph,
    dropped: Vec<String>,
    nodes: Vec<(NodeSpec, f64)>,
    recast: Vec<NodeSpec>,
    connections: Vec<(ConnectionSpec, EdgeDelay)>,
}

impl<'a> Augmentation<'a> {
    /// Nothing changed yet.
    pub fn new(graph: &'a Graph) -> Self {
        Self { graph, dropped: Vec::new(), nodes: Vec::new(), recast: Vec::new(), connections: Vec::new() }
    }

    /// Drops a node with all its connections.
    #[must_use]
    pub fn drop_node(mut self, name: impl Into<String>) -> Self {
        self.dropped.push(name.into());
        self
    }

    /// Adds a node that steps on an ideal grid from `phase` (s) on and takes, for every step, its expected computation
    /// delay. It takes the place of a node of the same name, whose connections it keeps: where none is given anew, their
    /// messages are drawn again from the delay that the graph says, and nobody waits for them.
    #[must_use]
    pub fn node(mut self, node: NodeSpec, phase: f64) -> Self {
        self.nodes.push((node, phase));
        self
    }

    /// Gives a node another kind or other parameters. It steps when it did, and what it saw of connections that stay is what
    /// it saw.
    #[must_use]
    pub fn recast(mut self, node: NodeSpec) -> Self {
        self.recast.push(node);
        self
    }

    /// Adds a connection, in place of the one that feeds the same port, if there is one. The delay of `connection` itself
    /// does not count.
    #[must_use]
    pub fn connect(mut self, connection: ConnectionSpec, delay: EdgeDelay) -> Self {
        self.connections.push((connection, delay));
        self
    }

    /// Makes the new graph, and its episodes from those of the old graph. All delays are drawn from `seed`.
    ///
    /// # Errors
    ///
    /// When a name is unknown, the new graph is not valid, or an episode is not one of the old graph.
    pub fn apply(
        &self,
        registry: &Registry,
        episodes: &[Episode],
        seed: u64,
    ) -> Result<Augmented, AugmentError> {
        for (index, episode) in episodes.iter().enumerate() {
            episode.check(self.graph).map_err(|problem| AugmentError::Episode { episode: index, problem })?;
        }
        let spec = self.spec()?;
        let graph = spec.validate(registry)?;
        let mut trainable = Vec::new();
        for (spec, delay) in &self.connections {
            if let EdgeDelay::Trainable { min, max, interpolation } = *delay {
                let feeds = |&index: &usize| same_port(&graph.spec().connections[index], spec);
                let connection = (0..graph.connections().len()).find(feeds);
                trainable.extend(connection.map(|connection| TrainableConnection {
                    connection,
                    min: from_seconds(min),
                    max: from_seconds(max),
                    interpolation,
                }));
            }
        }
        let episodes = episodes.par_iter().enumerate();
        let episodes = episodes
            .map(|(index, old)| self.episode(&graph, old, derived(seed, &format!("episode {index}"))));
        Ok(Augmented { episodes: episodes.collect(), graph, trainable })
    }

    fn is_new(&self, node: &str) -> bool {
        self.nodes.iter().any(|(new, _)| new.name == node)
    }

    /// The new graph as data.
    fn spec(&self) -> Result<GraphSpec, AugmentError> {
        let mut spec = self.graph.spec().clone();
        for name in self.dropped.iter().chain(self.recast.iter().map(|node| &node.name)) {
            if self.graph.index(name).is_none() {
                let known: Vec<&str> = self.graph.nodes().iter().map(|node| node.name.as_str()).collect();
                return Err(AugmentError::NoNode { node: name.clone(), known: known.join(", ") });
            }
        }
        for node in &self.recast {
            spec.nodes.iter_mut().filter(|old| old.name == node.name).for_each(|old| old.clone_from(node));
        }
        spec.nodes.retain(|node| !self.dropped.contains(&node.name));
        spec.connections
            .retain(|edge| !self.dropped.contains(&edge.from) && !self.dropped.contains(&edge.to));
        for (node, phase) in &self.nodes {
            if !phase.is_finite() || *phase < 0.0 {
                return Err(AugmentError::Phase { node: node.name.clone(), phase: *phase });
            }
            match spec.nodes.iter_mut().find(|old| old.name == node.name) {
                Some(old) => *old = node.clone(),
                None => spec.nodes.push(node.clone()),
            }
        }
        // Nobody can wait for messages that are drawn anew, and who does not wait cannot start ahead of its tick.
        for edge in &mut spec.connections {
            let redrawn = self.is_new(&edge.from) || self.is_new(&edge.to);
            edge.blocking &= !redrawn;
        }
        for (edge, delay) in &self.connections {
            if edge.blocking {
                return Err(AugmentError::Blocking { from: edge.from.clone(), to: edge.to.clone() });
            }
            let delay = match delay {
                EdgeDelay::Given(delay) => delay.clone(),
                &EdgeDelay::Trainable { min, max, .. } => {
                    if !(min.is_finite() && max.is_finite() && 0.0 <= min && min <= max) {
                        let (from, to) = (edge.from.clone(), edge.to.clone());
                        return Err(AugmentError::Bounds { from, to, min, max });
                    }
                    Delay::constant(0.5 * (min + max))
                }
            };
            let edge = ConnectionSpec { delay, ..edge.clone() };
            match spec.connections.iter_mut().find(|old| same_port(old, &edge)) {
                Some(old) => *old = edge,
                None => spec.connections.push(edge),
            }
        }
        for node in &mut spec.nodes {
            let waits = |edge: &ConnectionSpec| edge.to != node.name || edge.blocking;
            node.advance &= spec.connections.iter().all(waits);
        }
        Ok(spec)
    }

    /// An episode of the new graph.
    fn episode(&self, graph: &Graph, old: &Episode, seed: u64) -> Episode {
        let mut episode = Episode::empty(graph, old.duration);
        for (plan, steps) in graph.nodes().iter().zip(&mut episode.nodes) {
            let new = self.nodes.iter().rev().find(|(node, _)| node.name == plan.name);
            *steps = match (new, self.graph.index(&plan.name)) {
                (None, Some(index)) => old.nodes[index].clone(),
                (Some((_, phase)), _) => ideal(
                    &plan.grid.with_phase(from_seconds(*phase)),
                    plan.computation.expected_nanos(),
                    old.duration,
                ),
                (None, None) => NodeSteps::default(),
            };
        }
        for (index, plan) in graph.connections().iter().enumerate() {
            let spec = &graph.spec().connections[index];
            let given = self.connections.iter().any(|(edge, _)| same_port(edge, spec));
            let redrawn = given || self.is_new(&spec.from) || self.is_new(&spec.to);
            let recorded = self.graph.spec().connections.iter().position(|edge| same_port(edge, spec));
            episode.connections[index] = match recorded {
                Some(recorded) if !redrawn => old.connections[recorded].clone(),
                _ => {
                    let sender = self.nodes.iter().rev().find(|(node, _)| node.name == spec.from);
                    let grid = &graph.nodes()[plan.from].grid;
                    let grid = sender.map_or(*grid, |(_, phase)| grid.with_phase(from_seconds(*phase)));
                    let (from, to) = (&episode.nodes[plan.from], &episode.nodes[plan.to]);
                    let mut random = stream(seed, Purpose::Communication, &graph.connection_name(index));
                    let mut delay = plan.delay.sampler(&[]);
                    let travel = || delay.sample(&mut random, &[]);
                    let held = (plan.jitter == JitterPolicy::Buffer).then_some((grid, plan.expected));
                    let seen = Arrivals::new(from, travel, held);
                    seen.consumption(to, plan.window, plan.skip)
                }
            };
        }
        episode
    }
}

/// Whether two connections feed the same port.
fn same_port(a: &ConnectionSpec, b: &ConnectionSpec) -> bool {
    a.to == b.to && a.port() == b.port()
}

/// Steps on an ideal grid, each of which takes `computation`.
fn ideal(grid: &Grid, computation: Nanos, duration: Nanos) -> NodeSteps {
    let mut steps = NodeSteps::default();
    let mut ticks = grid.ticks();
    let mut before = 0;
    loop {
        let start = ticks.time().max(before);
        if start >= duration {
            return steps;
        }
        before = start.saturating_add(computation);
        steps.due.push(ticks.time());
        steps.start.push(start);
        steps.end.push(before);
        ticks.advance();
    }
}

/// When the messages of a connection arrive, and from when on they may be used.
struct Arrivals {
    received: Vec<Nanos>,
    usable: Vec<Nanos>,
}

impl Arrivals {
    /// `held` is the sender's grid and the expected time from its tick to the arrival, where messages are held until then.
    fn new(from: &NodeSteps, mut travel: impl FnMut() -> Nanos, held: Option<(Grid, Nanos)>) -> Self {
        let mut expected =
            held.map(|(grid, expected)| grid.with_phase(grid.phase().saturating_add(expected)).ticks());
        let (mut last_received, mut last_usable) = (Nanos::MIN, Nanos::MIN);
        let mut arrivals =
            Self { received: Vec::with_capacity(from.len()), usable: Vec::with_capacity(from.len()) };
        for &sent in &from.end {
            last_received = sent.saturating_add(travel()).max(last_received);
            last_usable = last_usable.max(last_received);
            if let Some(ticks) = &mut expected {
                last_usable = last_usable.max(ticks.time());
                ticks.advance();
            }
            arrivals.received.push(last_received);
            arrivals.usable.push(last_usable);
        }
        arrivals
    }

    /// What a receiver with these steps sees.
    fn consumption(&self, to: &NodeSteps, window: usize, skip: bool) -> Consumption {
        let mut seen = Consumption::new(window, to.len());
        for &start in &to.start {
            let there = |&usable: &Nanos| if skip { usable < start } else { usable <= start };
            let newest = self.usable.partition_point(there) as i64;
            for seq in newest - window as i64..newest {
                seen.seq.push(seq.max(-1));
                seen.received.push(usize::try_from(seq).map_or(0, |seq| self.received[seq]));
            }
        }
        seen
    }
}
