//! Partitions as partial orders, in a form that is equal for equal ones.

use std::collections::HashMap;

use super::{Partition, SupergraphError};

/// A partition without the supervisor's step. The vertices are sorted by label and, within a label, by order; those of
/// one label follow each other. A vertex is thus known by its label and its number, and equal orders are equal here.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Poset {
    pub(super) labels: Vec<u32>,
    /// The first vertex of every label's run of vertices, and the number of vertices.
    pub(super) chains: Vec<(u32, u32)>,
    first_below: Vec<u32>,
    /// Per vertex those that must come right before it, the one before it of its label included, sorted.
    below: Vec<u32>,
}

impl Poset {
    /// The order of a partition, and for every vertex of the partition its vertex here (none for the supervisor's).
    pub(super) fn new(
        number: usize,
        partition: &Partition,
        supervisor: u32,
    ) -> Result<(Poset, Vec<u32>), SupergraphError> {
        let labels = &partition.labels;
        let vertices = labels.len();
        let last = vertices.saturating_sub(1);
        if labels.iter().take(last).any(|&label| label == supervisor) {
            return Err(SupergraphError::Supervisor { partition: number });
        }
        let inner = if labels.last() == Some(&supervisor) { last } else { vertices };
        let mut sorted: Vec<u32> = (0..inner as u32).collect();
        sorted.sort_by_key(|&vertex| labels[vertex as usize]);
        let mut name = vec![u32::MAX; vertices];
        for (index, &vertex) in sorted.iter().enumerate() {
            name[vertex as usize] = index as u32;
        }
        let labels: Vec<u32> = sorted.iter().map(|&vertex| labels[vertex as usize]).collect();
        let mut pairs = Vec::with_capacity(partition.edges.len() + inner);
        for &(from, to) in &partition.edges {
            if from >= to || to as usize >= vertices {
                return Err(SupergraphError::Edge { partition: number, from, to, vertices });
            }
            if (to as usize) < inner {
                pairs.push((name[to as usize], name[from as usize]));
            }
        }
        let mut chains = Vec::new();
        for (index, &label) in labels.iter().enumerate() {
            if index > 0 && labels[index - 1] == label {
                pairs.push((index as u32, index as u32 - 1));
            } else {
                chains.push((label, index as u32));
            }
        }
        pairs.sort_unstable();
        pairs.dedup();
        let mut first_below = vec![0u32; inner + 1];
        for &(to, _) in &pairs {
            first_below[to as usize + 1] += 1;
        }
        for index in 0..inner {
            first_below[index + 1] += first_below[index];
        }
        let below = pairs.into_iter().map(|(_, from)| from).collect();
        Ok((Poset { labels, chains, first_below, below }, name))
    }

    pub(super) fn len(&self) -> usize {
        self.labels.len()
    }

    pub(super) fn below(&self, vertex: u32) -> &[u32] {
        &self.below
            [self.first_below[vertex as usize] as usize..self.first_below[vertex as usize + 1] as usize]
    }

    /// The vertices of chain `chain`.
    pub(super) fn chain(&self, chain: usize) -> std::ops::Range<u32> {
        let end = self.chains.get(chain + 1).map_or(self.labels.len() as u32, |&(_, first)| first);
        self.chains[chain].1..end
    }

    /// A topological order of the vertices.
    pub(super) fn order(&self) -> Vec<u32> {
        let (above, mut waiting) = self.above();
        let mut order: Vec<u32> =
            (0..self.len() as u32).filter(|&vertex| waiting[vertex as usize] == 0).collect();
        let mut next = 0;
        while let Some(&vertex) = order.get(next) {
            next += 1;
            for &reader in &above[vertex as usize] {
                waiting[reader as usize] -= 1;
                if waiting[reader as usize] == 0 {
                    order.push(reader);
                }
            }
        }
        order
    }

    fn above(&self) -> (Vec<Vec<u32>>, Vec<u32>) {
        let mut above = vec![Vec::new(); self.len()];
        let mut waiting = vec![0; self.len()];
        for vertex in 0..self.len() as u32 {
            waiting[vertex as usize] = self.below(vertex).len() as u32;
            for &input in self.below(vertex) {
                above[input as usize].push(vertex);
            }
        }
        (above, waiting)
    }

    /// Drops what follows from other pairs, so that orders are equal that were written down with different edges.
    pub(super) fn reduced(&self) -> Poset {
        let words = self.len().div_ceil(64);
        let mut closure = vec![0u64; words * self.len()];
        let mut kept: Vec<Vec<u32>> = vec![Vec::new(); self.len()];
        let order = self.order();
        let mut rank = vec![0u32; self.len()];
        for (index, &vertex) in order.iter().enumerate() {
            rank[vertex as usize] = index as u32;
        }
        let mut row = vec![0u64; words];
        for &vertex in &order {
            row.fill(0);
            let mut below = self.below(vertex).to_vec();
            // The latest first: what an earlier one of them is below of, it already covers.
            below.sort_unstable_by_key(|&input| std::cmp::Reverse(rank[input as usize]));
            for input in below {
                let (word, bit) = (input as usize / 64, 1u64 << (input % 64));
                if row[word] & bit == 0 {
                    kept[vertex as usize].push(input);
                    row[word] |= bit;
                    let from = input as usize * words;
                    for (own, other) in row.iter_mut().zip(&closure[from..from + words]) {
                        *own |= other;
                    }
                }
            }
            closure[vertex as usize * words..(vertex as usize + 1) * words].copy_from_slice(&row);
        }
        let mut first_below = vec![0u32];
        let mut below = Vec::new();
        for mut inputs in kept {
            inputs.sort_unstable();
            below.extend(inputs);
            first_below.push(below.len() as u32);
        }
        Poset { labels: self.labels.clone(), chains: self.chains.clone(), first_below, below }
    }
}

/// The different orders among many partitions.
pub(super) struct Distinct {
    /// The orders, each once, largest first.
    pub(super) posets: Vec<Poset>,
    /// Per partition its order's index.
    pub(super) of: Vec<u32>,
    /// Per partition its vertices' names in the order.
    pub(super) names: Vec<Vec<u32>>,
}

impl Distinct {
    pub(super) fn new(partitions: &[Partition], supervisor: u32) -> Result<Distinct, SupergraphError> {
        let mut written: HashMap<Poset, u32> = HashMap::new();
        let mut orders: HashMap<Poset, u32> = HashMap::new();
        let mut posets: Vec<Poset> = Vec::new();
        let (mut of, mut names) =
            (Vec::with_capacity(partitions.len()), Vec::with_capacity(partitions.len()));
        for (number, partition) in partitions.iter().enumerate() {
            let (poset, name) = Poset::new(number, partition, supervisor)?;
            names.push(name);
            of.push(match written.get(&poset) {
                Some(&index) => index,
                None => {
                    let reduced = poset.reduced();
                    let index = *orders.entry(reduced).or_insert_with_key(|reduced| {
                        posets.push(reduced.clone());
                        posets.len() as u32 - 1
                    });
                    written.insert(poset, index);
                    index
                }
            });
        }
        // Largest first, equal ones in the order of their first appearance.
        let mut sorted: Vec<u32> = (0..posets.len() as u32).collect();
        sorted.sort_by_key(|&index| std::cmp::Reverse(posets[index as usize].len()));
        let mut place = vec![0u32; posets.len()];
        for (to, &from) in sorted.iter().enumerate() {
            place[from as usize] = to as u32;
        }
        let posets = sorted.iter().map(|&index| posets[index as usize].clone()).collect();
        of.iter_mut().for_each(|index| *index = place[*index as usize]);
        Ok(Distinct { posets, of, names })
    }

    /// The fewest slots of every label, and so of all: a label's most vertices in any order.
    pub(super) fn most(&self, labels: usize) -> Vec<u32> {
        let mut most = vec![0u32; labels];
        for poset in &self.posets {
            for chain in 0..poset.chains.len() {
                let label = &mut most[poset.chains[chain].0 as usize];
                *label = (*label).max(poset.chain(chain).len() as u32);
            }
        }
        most
    }
}

/// Embeds orders into sequences of labels; keeps its room between calls.
pub(super) struct Matcher {
    /// Per label the chain's next vertex and the end of the chain.
    next: Vec<(u32, u32)>,
    /// Per vertex whether it has a slot.
    placed: Vec<bool>,
}

impl Matcher {
    pub(super) fn new(labels: usize) -> Matcher {
        Matcher { next: vec![(0, 0); labels], placed: Vec::new() }
    }

    /// Whether `poset` fits into `sequence`; `visit` sees every vertex and its slot, the earliest that it can have.
    ///
    /// Taking the first slot that fits is right: a vertex that is placed earlier never keeps another from its slot, as
    /// the vertices of one label have one order.
    pub(super) fn embed(&mut self, poset: &Poset, sequence: &[u32], mut visit: impl FnMut(u32, u32)) -> bool {
        self.next.fill((0, 0));
        for (chain, &(label, _)) in poset.chains.iter().enumerate() {
            let range = poset.chain(chain);
            self.next[label as usize] = (range.start, range.end);
        }
        self.placed.clear();
        self.placed.resize(poset.len(), false);
        let mut missing = poset.len();
        for (slot, &label) in sequence.iter().enumerate() {
            let (vertex, end) = self.next[label as usize];
            if vertex < end && poset.below(vertex).iter().all(|&input| self.placed[input as usize]) {
                self.placed[vertex as usize] = true;
                self.next[label as usize].0 += 1;
                visit(vertex, slot as u32);
                missing -= 1;
                if missing == 0 {
                    return true;
                }
            }
        }
        missing == 0
    }

    pub(super) fn fits(&mut self, poset: &Poset, sequence: &[u32]) -> bool {
        self.embed(poset, sequence, |_, _| ())
    }
}
