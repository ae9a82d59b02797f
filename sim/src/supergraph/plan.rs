//! Partitions and slots found together: the fewest slots over which whole episodes can be spread.

use rayon::prelude::*;

use super::cut::StartUp;
use super::dag::Steps;
use super::poset::Distinct;
use super::slots::{Edges, sequence};
use super::spread::Spread;
use super::{
    Cut, Dag, Embedding, Method, Partition, Partitioning, Supergraph, SupergraphError, supergraph, sweep,
};

/// How [`plan()`] cuts and what it looks for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PlanOptions {
    /// Which steps run together.
    pub cut: Cut,
    /// Where the steps run that are due before the supervisor's first.
    pub start: StartUp,
    /// How the slots are found.
    pub method: Method,
}

/// Episodes in partitions, and a slot for every step.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    /// The slots.
    pub supergraph: Supergraph,
    /// Every episode's partitions. `warm_up` is the same for all: where an episode needs less, its first partitions are
    /// empty, so that step k of the supervisor is partition `warm_up + k` everywhere.
    pub episodes: Vec<Partitioning>,
    /// Per episode and partition the slots of its vertices.
    pub embeddings: Vec<Vec<Embedding>>,
}

impl Plan {
    /// The number of steps that run, over all episodes.
    pub fn vertices(&self) -> usize {
        self.episodes.iter().map(Partitioning::vertices).sum()
    }

    /// The number of partitions, over all episodes, those before the supervisor's first step included.
    pub fn partitions(&self) -> usize {
        self.episodes.iter().map(|episode| episode.partitions.len()).sum()
    }

    /// The share of the slots that is filled.
    pub fn efficiency(&self) -> f64 {
        self.supergraph.efficiency(self.vertices(), self.partitions())
    }

    /// Puts empty partitions in front until all episodes have as many before the supervisor's first step.
    fn aligned(mut self) -> Plan {
        let most = self.episodes.iter().map(|episode| episode.warm_up).max().unwrap_or(0);
        for (episode, embeddings) in self.episodes.iter_mut().zip(&mut self.embeddings) {
            let lacking = most - episode.warm_up;
            episode.warm_up = most;
            episode.partitions.splice(0..0, vec![Partition::default(); lacking]);
            episode.steps.splice(0..0, vec![Vec::new(); lacking]);
            embeddings.splice(0..0, vec![Embedding::default(); lacking]);
        }
        self
    }
}

/// Cuts all episodes and finds slots for them. Nodes are labelled alike in all; `supervisor` is one of them.
///
/// With [`Cut::Balanced`] and [`Method::Mcs`] the two are one problem. Given the slots, whether an episode can be spread
/// over them is decided exactly: from its last step back, every step gets the last free slot of its node before all that
/// depends on it; no other way of spreading gives any step a later one. So the search starts from the supergraph of the
/// balanced partitions, leaves out and moves slots as long as every episode can still be spread, and the partitions are
/// what the spreading gives: each step as late as the slots allow, none further ahead than the cut says.
///
/// Otherwise the episodes are cut by [`partition`](super::partition()), and the slots are those of [`supergraph()`].
///
/// Errors: as those two; episodes with different nodes.
pub fn plan(dags: &[Dag<'_>], supervisor: u32, options: &PlanOptions) -> Result<Plan, SupergraphError> {
    for (episode, dag) in dags.iter().enumerate() {
        if dag.nodes.len() != dags[0].nodes.len() {
            let (found, expected) = (dag.nodes.len(), dags[0].nodes.len());
            return Err(SupergraphError::Nodes { episode, found, expected });
        }
    }
    let cut: Vec<(Steps, Partitioning)> = dags
        .par_iter()
        .map(|dag| {
            let mut steps = Steps::new(dag, supervisor)?;
            let place = match options.cut {
                Cut::Ancestors => steps.latest.clone(),
                Cut::Balanced { ahead } => {
                    steps.limit(ahead);
                    sweep::balance(dag, &steps, options.start)
                }
            };
            let partitioning = Partitioning::collect(&steps, &place, &steps.order);
            Ok((steps, partitioning))
        })
        .collect::<Result<_, _>>()?;
    let (steps, mut episodes): (Vec<Steps>, Vec<Partitioning>) = cut.into_iter().unzip();
    let counts: Vec<usize> = episodes.iter().map(|episode| episode.partitions.len()).collect();
    let all: Vec<Partition> =
        episodes.iter_mut().flat_map(|episode| std::mem::take(&mut episode.partitions)).collect();

    if let (Cut::Balanced { .. }, Method::Mcs { backtrack }) = (options.cut, options.method) {
        let distinct = Distinct::new(&all, supervisor)?;
        let (start, _) = sequence(&distinct, supervisor, options.method);
        let mut spread = Spread::new(&steps, options.start);
        let sequence = spread.improve(start, backtrack);
        return Ok(finish(&spread, &sequence, supervisor).aligned());
    }
    let (supergraph, embeddings) = supergraph(&all, supervisor, options.method)?;
    let (mut all, mut embeddings) = (all.into_iter(), embeddings.into_iter());
    let embeddings = counts.iter().map(|&count| embeddings.by_ref().take(count).collect()).collect();
    for (episode, count) in episodes.iter_mut().zip(counts) {
        episode.partitions = all.by_ref().take(count).collect();
    }
    Ok(Plan { supergraph, episodes, embeddings }.aligned())
}

/// The partitions and embeddings that spreading over `sequence` gives.
fn finish(spread: &Spread<'_>, sequence: &[u32], supervisor: u32) -> Plan {
    let last = sequence.len() as u32;
    let mut edges = Edges::default();
    let mut embeddings = Vec::with_capacity(spread.episodes());
    let mut episodes = Vec::with_capacity(spread.episodes());
    let spreads: Vec<(Partitioning, Vec<Embedding>)> =
        (0..spread.episodes()).into_par_iter().map(|episode| spread.partitions(episode, sequence)).collect();
    for (partitioning, embedded) in spreads {
        for (partition, embedding) in partitioning.partitions.iter().zip(&embedded) {
            for &(from, to) in &partition.edges {
                edges.push((embedding.slots[from as usize], embedding.slots[to as usize]));
            }
        }
        episodes.push(partitioning);
        embeddings.push(embedded);
    }
    let bound = spread.bound().iter().sum::<u32>() as usize + 1;
    let (supergraph, number) = Supergraph::order(sequence, supervisor, edges.finish(), bound);
    debug_assert_eq!(number[last as usize], last);
    for slot in embeddings.iter_mut().flatten().flat_map(|embedding| &mut embedding.slots) {
        *slot = number[*slot as usize];
    }
    Plan { supergraph, episodes, embeddings }
}
