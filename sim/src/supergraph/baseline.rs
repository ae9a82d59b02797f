//! The two sequences that van der Heijden et al. (2024) compare with: large, but found without a search.

use super::poset::Distinct;

/// Every label, as often as the largest order has vertices: the i-th vertex of a topological order finds its label in
/// the i-th round.
pub(super) fn topological(distinct: &Distinct, labels: &[u32]) -> Vec<u32> {
    let most = distinct.posets.iter().map(|poset| poset.len()).max().unwrap_or(0);
    rounds(labels, most)
}

/// Every label, as often as the deepest order has generations. The steps of one node count as following each other, so
/// that no two of them share a generation.
pub(super) fn generational(distinct: &Distinct, labels: &[u32]) -> Vec<u32> {
    let depth = distinct.posets.iter().map(|poset| {
        let mut level = vec![0usize; poset.len()];
        for vertex in poset.order() {
            let below = poset.below(vertex).iter().map(|&input| level[input as usize]);
            level[vertex as usize] = below.max().unwrap_or(0) + 1;
        }
        level.into_iter().max().unwrap_or(0)
    });
    rounds(labels, depth.max().unwrap_or(0))
}

fn rounds(labels: &[u32], rounds: usize) -> Vec<u32> {
    std::iter::repeat_n(labels, rounds).flatten().copied().collect()
}
