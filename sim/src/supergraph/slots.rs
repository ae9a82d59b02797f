//! From partitions to a supergraph and the embedding of each.

use super::poset::{Distinct, Matcher};
use super::{Embedding, Method, Partition, SupergraphError, baseline, grow};

/// Slots in the order in which an executor runs them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Supergraph {
    /// The node of every slot; the last slot is the supervisor's.
    pub labels: Vec<u32>,
    /// Dependencies between slots: every edge of every partition, and the order of the slots of each node. Sorted; each
    /// leads forward.
    pub edges: Vec<(u32, u32)>,
    /// The slots by longest path from a slot without inputs: those of one generation do not depend on each other and are
    /// of different nodes. The last holds the supervisor's slot alone. Slots are numbered generation by generation.
    pub generations: Vec<Vec<u32>>,
    /// No supergraph of the same partitions has fewer slots than this (for each node, its most steps in a partition).
    pub bound: usize,
}

impl Supergraph {
    /// The share of the slots that is filled, in `partitions` partitions with `vertices` vertices in all.
    pub fn efficiency(&self, vertices: usize, partitions: usize) -> f64 {
        vertices as f64 / (self.labels.len() * partitions).max(1) as f64
    }

    /// Whether `slots` embeds `partition`: labels match, slots differ, edges and the steps of one node lead forward, and
    /// the supervisor's step has the last slot.
    pub fn embeds(&self, partition: &Partition, embedding: &Embedding) -> bool {
        let (labels, slots) = (&partition.labels, &embedding.slots);
        let matches = labels.len() == slots.len()
            && labels.iter().zip(slots).all(|(label, &slot)| self.labels.get(slot as usize) == Some(label));
        let mut last = vec![None; self.labels.iter().max().map_or(0, |&label| label as usize + 1)];
        matches
            // Slots of one label that increase differ, and slots of different labels do anyway.
            && labels.iter().zip(slots).all(|(&label, &slot)| {
                last[label as usize].replace(slot).is_none_or(|before| before < slot)
            })
            && partition.edges.iter().all(|&(from, to)| slots[from as usize] < slots[to as usize])
    }

    /// Orders the slots of `sequence` (without the supervisor's) by generations, given all edges between them.
    /// Also returns the new number of every slot, the supervisor's last.
    pub(super) fn order(
        sequence: &[u32],
        supervisor: u32,
        edges: Vec<(u32, u32)>,
        bound: usize,
    ) -> (Supergraph, Vec<u32>) {
        let last = sequence.len();
        let mut edges = edges;
        let mut slot_of = std::collections::HashMap::new();
        for (slot, label) in sequence.iter().enumerate() {
            if let Some(before) = slot_of.insert(label, slot) {
                edges.push((before as u32, slot as u32));
            }
        }
        edges.sort_unstable();
        edges.dedup();
        let mut level = vec![0usize; last + 1];
        // Sorted by tail, and every edge leads forward: a slot's level is known before its edges are looked at.
        for &(from, to) in &edges {
            level[to as usize] = level[to as usize].max(level[from as usize] + 1);
        }
        level[last] = level[..last].iter().max().map_or(0, |&level| level + 1);
        let mut sorted: Vec<usize> = (0..=last).collect();
        sorted.sort_by_key(|&slot| (level[slot], slot));
        let mut number = vec![0u32; last + 1];
        let mut generations = vec![Vec::new(); level[last] + 1];
        for (new, &old) in sorted.iter().enumerate() {
            number[old] = new as u32;
            generations[level[old]].push(new as u32);
        }
        for (from, to) in &mut edges {
            (*from, *to) = (number[*from as usize], number[*to as usize]);
        }
        edges.sort_unstable();
        let labels = sorted.iter().map(|&slot| sequence.get(slot).copied().unwrap_or(supervisor)).collect();
        (Supergraph { labels, edges, generations, bound }, number)
    }
}

/// The distinct edges among many, gathered without keeping all of them.
#[derive(Default)]
pub(super) struct Edges {
    edges: Vec<(u32, u32)>,
    distinct: usize,
}

impl Edges {
    pub(super) fn push(&mut self, edge: (u32, u32)) {
        self.edges.push(edge);
        if self.edges.len() >= 2 * self.distinct + (1 << 16) {
            self.compact();
        }
    }

    fn compact(&mut self) {
        self.edges.sort_unstable();
        self.edges.dedup();
        self.distinct = self.edges.len();
    }

    pub(super) fn finish(mut self) -> Vec<(u32, u32)> {
        self.compact();
        self.edges
    }
}

/// Finds slots for all partitions, and a slot for every vertex of each; the embeddings are in the order of the
/// partitions.
///
/// `supervisor` is the label of the supervisor. Its step is the last vertex of its partition; a partition of the start
/// may have none. Equal partitions, up to how their edges are written down, are looked at once. The result depends on
/// nothing but the arguments. By [`Method::Mcs`] it never has more slots than by the other two.
///
/// Errors: an edge that does not lead forward, or a step of the supervisor that is not the last.
pub fn supergraph(
    partitions: &[Partition],
    supervisor: u32,
    method: Method,
) -> Result<(Supergraph, Vec<Embedding>), SupergraphError> {
    let distinct = Distinct::new(partitions, supervisor)?;
    let (sequence, bound) = sequence(&distinct, supervisor, method);
    let mut matcher = Matcher::new(label_count(&distinct, supervisor));
    let slots_of: Vec<Vec<u32>> = distinct
        .posets
        .iter()
        .map(|poset| {
            let mut slots = vec![0u32; poset.len()];
            let fits = matcher.embed(poset, &sequence, |vertex, slot| slots[vertex as usize] = slot);
            debug_assert!(fits, "every method's sequence holds every order");
            slots
        })
        .collect();
    let last = sequence.len() as u32;
    let mut edges = Edges::default();
    let mut embeddings = Vec::with_capacity(partitions.len());
    for ((partition, &poset), names) in partitions.iter().zip(&distinct.of).zip(&distinct.names) {
        let slots_of = &slots_of[poset as usize];
        let slots: Vec<u32> =
            names.iter().map(|&name| slots_of.get(name as usize).copied().unwrap_or(last)).collect();
        for &(from, to) in &partition.edges {
            edges.push((slots[from as usize], slots[to as usize]));
        }
        embeddings.push(Embedding { slots });
    }
    let (found, number) = Supergraph::order(&sequence, supervisor, edges.finish(), bound + 1);
    for embedding in &mut embeddings {
        embedding.slots.iter_mut().for_each(|slot| *slot = number[*slot as usize]);
    }
    Ok((found, embeddings))
}

pub(super) fn label_count(distinct: &Distinct, supervisor: u32) -> usize {
    let labels = distinct.posets.iter().flat_map(|poset| poset.chains.iter().map(|&(label, _)| label));
    labels.max().unwrap_or(0).max(supervisor) as usize + 1
}

/// The labels of the slots without the supervisor's, and the fewest that there can be.
pub(super) fn sequence(distinct: &Distinct, supervisor: u32, method: Method) -> (Vec<u32>, usize) {
    let count = label_count(distinct, supervisor);
    let most = distinct.most(count);
    let labels: Vec<u32> = (0..count as u32).filter(|&label| most[label as usize] > 0).collect();
    let sequence = match method {
        Method::Topological => baseline::topological(distinct, &labels),
        Method::Generational => baseline::generational(distinct, &labels),
        Method::Mcs { backtrack } => {
            let grown = grow::minimum_common(distinct, count, backtrack);
            let simple = baseline::generational(distinct, &labels);
            if grown.len() <= simple.len() { grown } else { simple }
        }
    };
    (sequence, most.iter().sum::<u32>() as usize)
}
