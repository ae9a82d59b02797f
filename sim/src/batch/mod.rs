//! Thousands of environments or parameter sets through a compiled graph, on lanes times threads.
//!
//! A [`Batch`] joins the tables of a [`CompiledGraph`] with the models of the graph's nodes. [`Environments`] says what
//! differs: the episode, parameters, states, trainable delays, noise, outputs given from outside. Environments of one
//! episode share its schedule, so they are stepped together: in blocks of lanes, several blocks to a group, groups on
//! threads. Results do not depend on the number of threads, nor on what else is in the batch.
//!
//! With [`Precision::Double`] each environment is computed on plain `f64`: a step has the bits that the node itself
//! computes from the same state, inputs and noise. Lanes agree with that to 1e-12 for each step. An episode that many
//! environments share is fastest: a group runs at full speed when its episode has a multiple of 16 environments (32 in
//! single precision), and best with 64.
//!
//! ```
//! use parallax_sim::batch::{Batch, Given, Precision};
//! use parallax_sim::compiled::{CompileOptions, compile};
//! use parallax_sim::generate_many;
//!
//! let graph = parallax_nodes::pendulum::simulated().validate(&parallax_nodes::registry())?;
//! let episodes = generate_many(&graph, 7, 1_000_000_000, 2)?;
//! // The agent's actions are drawn beforehand.
//! let options = CompileOptions { pinned: vec![graph.supervisor()], ..CompileOptions::default() };
//! let compiled = compile(&graph, &episodes, &options)?;
//!
//! let batch = Batch::new(&graph, &compiled, 7)?;
//! let masses: Vec<f64> = (0..32).map(|index| 0.05 + 0.001 * f64::from(index)).collect();
//! let actions = vec![1.5; 32 * 50]; // V: 32 environments, 50 steps, one leaf
//! let mut environments = batch.environments(32);
//! environments
//!     .set_param("world", "pendulum.mass", &masses)?
//!     .give("agent", Given::PerEnvironment { steps: 50, values: &actions })?;
//! let rollout = batch.rollout(&environments, Precision::DoubleLanes, &["world"])?;
//! let world = &rollout.outputs[0];
//! assert_ne!(world.message(0, 90), world.message(31, 90));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod environments;
mod error;
mod group;
mod inputs;
mod number;
mod prefetch;
mod schedule;

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use parallax_model::lanes::{F32x32, F64x16};
use parallax_model::node_model::ErasedModel;
use parallax_runtime::graph::Graph;
use rayon::prelude::*;

use crate::compiled::CompiledGraph;

pub use environments::{Environments, Given};
pub(crate) use environments::{Passes, Place, Slope};
pub use error::BatchError;
use group::Group;
pub(crate) use group::Made;
pub(crate) use number::Number;
use schedule::Schedule;

/// Environments of one group: enough that looking into the tables costs little, few enough to stay in the first cache.
const GROUP: usize = 64;

/// What environments are computed with.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Precision {
    /// Plain `f64`, one environment at a time.
    Double,
    /// Sixteen environments at a time in double precision.
    #[default]
    DoubleLanes,
    /// Thirty-two environments at a time in single precision.
    SingleLanes,
}

/// A compiled graph with its models, ready to run.
pub struct Batch<'a> {
    compiled: &'a CompiledGraph,
    nodes: Vec<BatchNode>,
    connections: Vec<String>,
    /// One for each episode.
    schedules: Vec<Schedule>,
    /// Where each port's places begin among those that a step reads, `[slot][port]`.
    offsets: Vec<Vec<usize>>,
    seed: u64,
}

/// What a node computes and starts with.
struct BatchNode {
    /// None where outputs are given.
    model: Option<Arc<dyn ErasedModel>>,
    ports: Vec<String>,
    params: Vec<f64>,
    state: Vec<f64>,
    initial: Vec<f64>,
}

impl fmt::Debug for Batch<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nodes: Vec<&str> = self.compiled.nodes.iter().map(|node| node.name.as_str()).collect();
        f.debug_struct("Batch").field("nodes", &nodes).field("seed", &self.seed).finish_non_exhaustive()
    }
}

impl<'a> Batch<'a> {
    /// The models of `graph` behind the tables compiled from it. Parameters and states are those that nodes start with in
    /// a run with this seed.
    ///
    /// # Errors
    ///
    /// [`BatchError::OtherGraph`], [`BatchError::NoModel`], and what a kind says about its node's parameters.
    pub fn new(graph: &Graph, compiled: &'a CompiledGraph, seed: u64) -> Result<Self, BatchError> {
        let plans = graph.nodes();
        if plans.len() != compiled.nodes.len() {
            return Err(BatchError::OtherGraph { compiled: compiled.nodes.len(), graph: plans.len() });
        }
        let mut nodes = Vec::with_capacity(plans.len());
        for (index, plan) in plans.iter().enumerate() {
            let ports = plan.kind.inputs().iter().map(|port| port.name.clone()).collect();
            let initial = plan.kind.initial_message().to_vec();
            let runs = compiled.slots.iter().any(|slot| slot.node == index);
            nodes.push(if compiled.nodes[index].pinned || !runs {
                BatchNode { model: None, ports, params: Vec::new(), state: Vec::new(), initial }
            } else {
                let kind = plan.kind.node_model();
                let kind = kind.ok_or_else(|| BatchError::NoModel { node: plan.name.clone() })?;
                let start = kind.start(&graph.context(index, seed))?;
                let model = Some(Arc::clone(kind.model()));
                BatchNode { model, ports, params: start.params, state: start.state, initial }
            });
        }
        let connections = (0..graph.connections().len()).map(|index| graph.connection_name(index)).collect();
        let schedules = (0..compiled.episodes).map(|episode| Schedule::new(compiled, episode)).collect();
        let offsets = compiled.slots.iter().map(schedule::offsets).collect();
        Ok(Self { compiled, nodes, connections, schedules, offsets, seed })
    }

    /// So many environments; change what should differ.
    pub fn environments(&self, count: usize) -> Environments<'_> {
        Environments::new(self, count)
    }

    fn node(&self, name: &str) -> Result<usize, BatchError> {
        let found = self.compiled.nodes.iter().position(|node| node.name == name);
        found.ok_or_else(|| BatchError::NoNode { node: name.to_owned() })
    }

    /// One more than the number of the node's last step in any episode.
    fn steps_of(&self, node: usize) -> usize {
        let slots = self.compiled.slots.iter().filter(|slot| slot.node == node);
        let steps = slots.flat_map(|slot| slot.rows.seq.iter().zip(&slot.rows.run));
        steps.filter(|(_, run)| **run != 0).map(|(seq, _)| *seq as usize + 1).max().unwrap_or(0)
    }

    /// Runs every environment through its episode and keeps the outputs of the nodes named.
    ///
    /// # Errors
    ///
    /// [`BatchError::NoNode`] and [`BatchError::NotGiven`].
    pub fn rollout(
        &self,
        environments: &Environments<'_>,
        precision: Precision,
        keep: &[&str],
    ) -> Result<Rollout, BatchError> {
        match precision {
            Precision::Double => self.rollout_on::<f64>(environments, keep),
            Precision::DoubleLanes => self.rollout_on::<F64x16>(environments, keep),
            Precision::SingleLanes => self.rollout_on::<F32x32>(environments, keep),
        }
    }

    /// Runs every environment through its episode and reduces what happens: `start` makes a result for each group of
    /// environments, and `each` sees it with every pass. Gives the results and the groups' environments.
    ///
    /// # Errors
    ///
    /// [`BatchError::NotGiven`].
    pub fn fold<R: Send>(
        &self,
        environments: &Environments<'_>,
        precision: Precision,
        start: impl Fn(&[usize]) -> R + Sync,
        each: impl Fn(&mut R, &Moment<'_>) + Sync,
    ) -> Result<Vec<(Vec<usize>, R)>, BatchError> {
        match precision {
            Precision::Double => self.fold_on::<f64, R>(environments, start, each),
            Precision::DoubleLanes => self.fold_on::<F64x16, R>(environments, start, each),
            Precision::SingleLanes => self.fold_on::<F32x32, R>(environments, start, each),
        }
    }

    fn fold_on<T: Number, R: Send>(
        &self,
        environments: &Environments<'_>,
        start: impl Fn(&[usize]) -> R + Sync,
        each: impl Fn(&mut R, &Moment<'_>) + Sync,
    ) -> Result<Vec<(Vec<usize>, R)>, BatchError> {
        let groups = self.groups(environments, GROUP)?;
        let results = groups.into_par_iter().map(|members| {
            let mut result = start(&members);
            Group::<T>::new(self, environments, &members).run(|_| {}, |moment| each(&mut result, moment));
            (members, result)
        });
        Ok(results.collect())
    }

    /// Runs every environment's part of its episode in groups of at most `most`, and shows every output to `made` with the
    /// result that `start` made for its group, and the states to `cut`, where the part is cut. Gives the groups'
    /// environments and results.
    pub(crate) fn visit<T: Number, R: Send>(
        &self,
        environments: &Environments<'_>,
        most: usize,
        start: impl Fn(&[usize]) -> R + Sync,
        made: impl Fn(&mut R, &Made<'_, T>) + Sync,
        cut: impl Fn(&mut R, &States<'_, '_, T>) + Sync,
    ) -> Result<Vec<(Vec<usize>, R)>, BatchError> {
        let groups = self.groups(environments, most)?;
        let results = groups.into_par_iter().map(|members| {
            let mut result = start(&members);
            let mut group = Group::<T>::new(self, environments, &members);
            let all = Passes::until(usize::MAX);
            let Passes { first, cut: at, end } = environments.passes.get(members[0]).copied().unwrap_or(all);
            group.give_before(first);
            group.run_for(first..at, |output| made(&mut result, output), |_| {});
            if at < end {
                cut(&mut result, &States { group: &group });
                group.run_for(at..end, |output| made(&mut result, output), |_| {});
            }
            (members, result)
        });
        Ok(results.collect())
    }

    /// The nodes that carry a state from step to step and are computed, with the places of their leaves.
    pub(crate) fn states(&self) -> impl Iterator<Item = Place> {
        let computed = self.nodes.iter().enumerate().filter(|(_, node)| node.model.is_some());
        computed
            .flat_map(|(node, content)| (0..content.state.len()).map(move |leaf| Place::State { node, leaf }))
    }

    /// The first pass of an episode in which a step starts at `time` (s) or later.
    pub(crate) fn pass_at(&self, episode: usize, time: f64) -> usize {
        self.schedules[episode].pass_at(time)
    }

    fn rollout_on<T: Number>(
        &self,
        environments: &Environments<'_>,
        keep: &[&str],
    ) -> Result<Rollout, BatchError> {
        let groups = self.groups(environments, GROUP)?;
        let count = environments.len();
        let mut outputs = Vec::with_capacity(keep.len());
        for name in keep {
            let node = self.node(name)?;
            let (steps, leaves) = (self.steps_of(node), self.nodes[node].initial.len());
            let values = vec![f64::NAN; count * steps * leaves];
            outputs.push(Kept { node: (*name).to_owned(), index: node, steps, leaves, values });
        }
        let mut states: Vec<Vec<f64>> =
            self.nodes.iter().map(|node| vec![0.0; count * node.state.len()]).collect();
        {
            let mut kept: Vec<(usize, usize, RowsOf<'_>)> = outputs
                .iter_mut()
                .map(|kept| {
                    (kept.index, kept.leaves, rows_of(&mut kept.values, kept.steps * kept.leaves, count))
                })
                .collect();
            let mut state: Vec<RowsOf<'_>> = states
                .iter_mut()
                .zip(&self.nodes)
                .map(|(values, node)| rows_of(values, node.state.len(), count))
                .collect();
            // Every group gets the rows of its own environments.
            let work: Vec<_> = groups
                .iter()
                .map(|members| {
                    let kept: Vec<_> = kept
                        .iter_mut()
                        .map(|(node, leaves, rows)| (*node, *leaves, take_rows(rows, members)))
                        .collect();
                    let state: Vec<_> = state.iter_mut().map(|rows| take_rows(rows, members)).collect();
                    (members, kept, state)
                })
                .collect();
            work.into_par_iter().for_each(|(members, mut kept, mut state)| {
                let mut group = Group::<T>::new(self, environments, members);
                group.run(
                    |made| {
                        for (node, leaves, rows) in &mut kept {
                            if made.node == *node {
                                let first = made.seq as usize * *leaves;
                                made.each(|position, leaf, value| rows[position][first + leaf] = value);
                            }
                        }
                    },
                    |_| {},
                );
                for (node, rows) in state.iter_mut().enumerate() {
                    for (position, row) in rows.iter_mut().enumerate() {
                        row.iter_mut().zip(group.state(node, position)).for_each(|(to, value)| *to = value);
                    }
                }
            });
        }
        Ok(Rollout { outputs, states })
    }

    /// Environments of one episode, and of the same part of it, at most so many together.
    fn groups(&self, environments: &Environments<'_>, most: usize) -> Result<Vec<Vec<usize>>, BatchError> {
        for (index, node) in self.compiled.nodes.iter().enumerate() {
            let runs = self.compiled.slots.iter().any(|slot| slot.node == index);
            if node.pinned && runs && environments.given[index].is_none() {
                return Err(BatchError::NotGiven { node: node.name.clone() });
            }
        }
        let mut alike: BTreeMap<(u32, Option<Passes>), Vec<usize>> = BTreeMap::new();
        for (environment, &episode) in environments.episodes.iter().enumerate() {
            let passes = environments.passes.get(environment).copied();
            alike.entry((episode, passes)).or_default().push(environment);
        }
        Ok(alike.values().flat_map(|members| members.chunks(most)).map(<[usize]>::to_vec).collect())
    }
}

/// The states of a group in the middle of its run.
pub(crate) struct States<'s, 'a, T: Number> {
    group: &'s Group<'a, T>,
}

impl<T: Number> States<'_, '_, T> {
    /// How many blocks the group's environments fill.
    pub(crate) fn blocks(&self) -> usize {
        self.group.blocks()
    }

    /// A node's state in one block of environments.
    pub(crate) fn block(&self, node: usize, block: usize) -> &[T] {
        self.group.block_state(node, block)
    }
}

/// One row for each environment, until it is taken.
type RowsOf<'r> = Vec<Option<&'r mut [f64]>>;

fn rows_of(values: &mut [f64], width: usize, count: usize) -> RowsOf<'_> {
    if width == 0 {
        return (0..count).map(|_| Some(&mut [][..])).collect();
    }
    values.chunks_exact_mut(width).map(Some).collect()
}

fn take_rows<'r>(rows: &mut [Option<&'r mut [f64]>], members: &[usize]) -> Vec<&'r mut [f64]> {
    members.iter().filter_map(|&member| rows[member].take()).collect()
}

/// What a group looks like after a pass.
pub struct Moment<'m> {
    /// The pass, those before the supervisor's first step included.
    pub pass: usize,
    /// The supervisor's step; none in the passes before its first.
    pub step: Option<usize>,
    /// The group's environments.
    pub members: &'m [usize],
    output: &'m dyn Fn(usize, usize, usize) -> f64,
}

impl Moment<'_> {
    /// A leaf of the newest output of a node, by its place in the graph, of the environment at `position` among the
    /// members.
    ///
    /// # Panics
    ///
    /// When there is no such node, member or leaf.
    pub fn output(&self, node: usize, position: usize, leaf: usize) -> f64 {
        assert!(position < self.members.len(), "a group of {} environments", self.members.len());
        (self.output)(node, position, leaf)
    }
}

impl fmt::Debug for Moment<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Moment")
            .field("pass", &self.pass)
            .field("members", &self.members)
            .finish_non_exhaustive()
    }
}

/// What a node sent.
#[derive(Debug, Clone, PartialEq)]
pub struct Kept {
    /// The node.
    pub node: String,
    index: usize,
    /// How many steps there are room for.
    pub steps: usize,
    /// How many leaves a message has.
    pub leaves: usize,
    /// `[environment][step][leaf]`; not a number where a step did not run.
    pub values: Vec<f64>,
}

impl Kept {
    /// The message of an environment's step.
    ///
    /// # Panics
    ///
    /// When there is none.
    pub fn message(&self, environment: usize, step: usize) -> &[f64] {
        assert!(step < self.steps, "node `{}` makes at most {} steps", self.node, self.steps);
        &self.values[(environment * self.steps + step) * self.leaves..][..self.leaves]
    }
}

/// The result of [`Batch::rollout`].
#[derive(Debug, Clone, PartialEq)]
pub struct Rollout {
    /// The outputs of the nodes kept, in their order.
    pub outputs: Vec<Kept>,
    /// Per node, in the order of the graph, the state after the last step: `[environment][leaf]`.
    pub states: Vec<Vec<f64>>,
}
