//! What differs from environment to environment.

use parallax_runtime::random::derived;

use super::{Batch, BatchError};

/// Outputs that a node does not compute.
#[derive(Debug, Clone, Copy)]
pub enum Given<'a> {
    /// Every environment's own: `[environment][step][leaf]`, the steps being the node's own.
    PerEnvironment {
        /// How many steps there are.
        steps: usize,
        /// The leaves.
        values: &'a [f64],
    },
    /// The same for all environments of an episode, such as what was recorded: `[episode][step][leaf]`.
    PerEpisode {
        /// How many steps there are.
        steps: usize,
        /// The leaves.
        values: &'a [f64],
    },
}

impl Given<'_> {
    /// In which row of steps an environment's outputs begin.
    pub(super) fn row(&self, environment: usize, episode: usize) -> usize {
        match self {
            Given::PerEnvironment { steps, .. } => environment * steps,
            Given::PerEpisode { steps, .. } => episode * steps,
        }
    }

    #[inline(always)]
    pub(super) fn values(&self) -> &[f64] {
        match self {
            Given::PerEnvironment { values, .. } | Given::PerEpisode { values, .. } => values,
        }
    }
}

/// Environments of a [`Batch`]: at first all alike but for their noise, with the episodes dealt out in turn.
#[derive(Debug, Clone)]
pub struct Environments<'a> {
    batch: &'a Batch<'a>,
    pub(super) episodes: Vec<u32>,
    /// The seeds of their noise; absent: each has its own by its number.
    seeds: Option<Vec<u64>>,
    /// `[node]`, each `[environment][leaf]`.
    pub(super) params: Vec<Vec<f64>>,
    pub(super) states: Vec<Vec<f64>>,
    /// Per connection, `[environment]`; empty where the delay is not trainable.
    pub(super) alphas: Vec<Vec<f64>>,
    pub(super) given: Vec<Option<Given<'a>>>,
    /// Whether models draw no noise.
    pub(super) quiet: bool,
    /// What each environment is differentiated by; empty where nothing is.
    pub(super) slopes: Vec<Vec<Slope>>,
    /// The passes of its episode that each environment runs; empty where all run all.
    pub(super) passes: Vec<Passes>,
}

/// A part of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Passes {
    /// The first pass. From the second on, states are those after the pass before, and of what computed nodes sent before
    /// nothing is known.
    pub(crate) first: usize,
    /// Before this pass states are shown.
    pub(crate) cut: usize,
    /// The first pass that does not run any more.
    pub(crate) end: usize,
}

impl Passes {
    /// An episode from its beginning.
    pub(crate) fn until(end: usize) -> Self {
        Self { first: 0, cut: end, end }
    }
}

/// A number that an environment starts with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Place {
    /// A parameter of a node.
    Param { node: usize, leaf: usize },
    /// A leaf of a node's first state.
    State { node: usize, leaf: usize },
    /// A trainable delay's place between its bounds.
    Delay { connection: usize },
}

/// How a number changes along a direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Slope {
    pub(crate) place: Place,
    pub(crate) direction: usize,
    pub(crate) slope: f64,
}

impl<'a> Environments<'a> {
    pub(super) fn new(batch: &'a Batch<'a>, count: usize) -> Self {
        let repeat = |leaves: &[f64]| leaves.repeat(count);
        let trainable = |connection: usize| {
            let inputs = batch.compiled.slots.iter().flat_map(|slot| &slot.rows.inputs);
            inputs.filter(|input| input.trainable.is_some()).any(|input| input.connection == connection)
        };
        Self {
            batch,
            episodes: (0..count).map(|index| (index % batch.compiled.episodes) as u32).collect(),
            seeds: None,
            params: batch.nodes.iter().map(|node| repeat(&node.params)).collect(),
            states: batch.nodes.iter().map(|node| repeat(&node.state)).collect(),
            alphas: (0..batch.connections.len())
                .map(|connection| if trainable(connection) { vec![0.0; count] } else { Vec::new() })
                .collect(),
            given: vec![None; batch.nodes.len()],
            quiet: false,
            slopes: Vec::new(),
            passes: Vec::new(),
        }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.episodes.len()
    }

    /// The seed of an environment's noise.
    pub(super) fn seed(&self, environment: usize) -> u64 {
        match &self.seeds {
            Some(seeds) => seeds[environment],
            None => derived(self.batch.seed, &format!("environment {environment}")),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.episodes.is_empty()
    }

    /// Models draw no noise: all their normal numbers are zero. For predictions of what was measured.
    pub fn quiet(&mut self) -> &mut Self {
        self.quiet = true;
        self
    }

    /// Sets which part of its episode each environment runs; those of one part are stepped together.
    pub(crate) fn set_passes(&mut self, passes: Vec<Passes>) -> Result<&mut Self, BatchError> {
        self.check_count("parts of episodes", passes.len(), self.len())?;
        self.passes = passes;
        Ok(self)
    }

    /// Sets one environment's number.
    pub(crate) fn put(&mut self, environment: usize, place: Place, value: f64) {
        let nodes = &self.batch.nodes;
        match place {
            Place::Param { node, leaf } => {
                self.params[node][environment * nodes[node].params.len() + leaf] = value;
            }
            Place::State { node, leaf } => {
                self.states[node][environment * nodes[node].state.len() + leaf] = value;
            }
            Place::Delay { connection } => self.alphas[connection][environment] = value,
        }
    }

    /// Differentiates one environment by these.
    pub(crate) fn incline(&mut self, environment: usize, slopes: Vec<Slope>) {
        self.slopes.resize(self.episodes.len(), Vec::new());
        self.slopes[environment] = slopes;
    }

    /// Sets every environment's episode.
    ///
    /// # Errors
    ///
    /// [`BatchError::Count`] and [`BatchError::NoEpisode`].
    pub fn set_episodes(&mut self, episodes: &[u32]) -> Result<&mut Self, BatchError> {
        self.check_count("episodes", episodes.len(), self.len())?;
        let available = self.batch.compiled.episodes;
        if let Some(&episode) = episodes.iter().find(|&&episode| episode as usize >= available) {
            return Err(BatchError::NoEpisode { episode, episodes: available });
        }
        self.episodes.copy_from_slice(episodes);
        Ok(self)
    }

    /// Sets every environment's seed, from which its nodes' noise is drawn as in a run with that seed.
    ///
    /// # Errors
    ///
    /// [`BatchError::Count`].
    pub fn set_seeds(&mut self, seeds: &[u64]) -> Result<&mut Self, BatchError> {
        self.check_count("seeds", seeds.len(), self.len())?;
        self.seeds = Some(seeds.to_vec());
        Ok(self)
    }

    /// Sets one parameter of a node, one value for each environment.
    ///
    /// # Errors
    ///
    /// [`BatchError::NoNode`], [`BatchError::NoLeaf`] and [`BatchError::Count`].
    pub fn set_param(&mut self, node: &str, leaf: &str, values: &[f64]) -> Result<&mut Self, BatchError> {
        let index = self.batch.node(node)?;
        let names = self.batch.nodes[index].model.as_ref().map_or_else(Vec::new, |model| model.params());
        let place = find_leaf(node, "parameter", leaf, &names)?;
        self.check_count("values of a parameter", values.len(), self.len())?;
        set_column(&mut self.params[index], names.len(), place, values);
        Ok(self)
    }

    /// Sets one leaf of a node's state before its first step, one value for each environment.
    ///
    /// # Errors
    ///
    /// As [`set_param`](Self::set_param).
    pub fn set_state(&mut self, node: &str, leaf: &str, values: &[f64]) -> Result<&mut Self, BatchError> {
        let index = self.batch.node(node)?;
        let names = self.batch.nodes[index].model.as_ref().map_or_else(Vec::new, |model| model.state());
        let place = find_leaf(node, "state", leaf, &names)?;
        self.check_count("values of a state", values.len(), self.len())?;
        set_column(&mut self.states[index], names.len(), place, values);
        Ok(self)
    }

    /// Sets a trainable delay's place between its bounds, from 0 to 1, one for each environment. At first it is 0.
    ///
    /// # Errors
    ///
    /// [`BatchError::NotTrainable`] and [`BatchError::Count`].
    pub fn set_delay(&mut self, connection: &str, alphas: &[f64]) -> Result<&mut Self, BatchError> {
        let found = self.batch.connections.iter().position(|name| name == connection);
        let trainable = found.filter(|&index| !self.alphas[index].is_empty() || self.is_empty());
        let Some(index) = trainable else {
            return Err(BatchError::NotTrainable { connection: connection.to_owned() });
        };
        self.check_count("places of a delay", alphas.len(), self.len())?;
        self.alphas[index].copy_from_slice(alphas);
        Ok(self)
    }

    /// Gives the outputs of a node that was pinned when the graph was compiled, such as actions drawn beforehand.
    ///
    /// # Errors
    ///
    /// [`BatchError::NoNode`], [`BatchError::NotPinned`], [`BatchError::Count`] and [`BatchError::GivenSteps`].
    pub fn give(&mut self, node: &str, given: Given<'a>) -> Result<&mut Self, BatchError> {
        let index = self.batch.node(node)?;
        if !self.batch.compiled.nodes[index].pinned {
            return Err(BatchError::NotPinned { node: node.to_owned() });
        }
        let leaves = self.batch.nodes[index].initial.len();
        let (rows, steps, found) = match given {
            Given::PerEnvironment { steps, values } => (self.len(), steps, values.len()),
            Given::PerEpisode { steps, values } => (self.batch.compiled.episodes, steps, values.len()),
        };
        self.check_count("given numbers", found, rows * steps * leaves)?;
        let needed = self.batch.steps_of(index);
        if steps < needed {
            return Err(BatchError::GivenSteps { node: node.to_owned(), steps, needed });
        }
        self.given[index] = Some(given);
        Ok(self)
    }

    fn check_count(&self, what: &'static str, found: usize, expected: usize) -> Result<(), BatchError> {
        if found == expected { Ok(()) } else { Err(BatchError::Count { what, found, expected }) }
    }
}

fn find_leaf(node: &str, what: &'static str, leaf: &str, names: &[String]) -> Result<usize, BatchError> {
    names.iter().position(|name| name == leaf).ok_or_else(|| BatchError::NoLeaf {
        node: node.to_owned(),
        what,
        leaf: leaf.to_owned(),
        known: names.join(", "),
    })
}

fn set_column(rows: &mut [f64], width: usize, place: usize, values: &[f64]) {
    for (row, value) in rows.chunks_exact_mut(width).zip(values) {
        row[place] = *value;
    }
}
