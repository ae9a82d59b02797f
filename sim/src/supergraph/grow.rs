//! The minimum common supergraph by greedy growth with backtracking.

use std::collections::HashSet;

use super::merge::merge;
use super::poset::{Distinct, Matcher, Poset};

/// States that a merge keeps, and for how many vertices in all: a merge of a large order keeps fewer.
const WIDTH: usize = 32;
const WIDTH_VERTICES: usize = 640;
/// Vertices and slots looked at before the backtracking ends even if more was asked for, about a second: it must end on
/// large graphs, and a clock would make the result depend on the machine.
const WORK: usize = 500_000_000;
/// Slots that are taken back at a time, at most.
const STRETCH: usize = 12;

struct Search<'a> {
    posets: &'a [Poset],
    labels: usize,
    /// The fewest slots of every label.
    most: Vec<u32>,
    matcher: Matcher,
    /// The orders, those that were last found not to fit in front: they are likely not to fit the next attempt.
    suspects: Vec<u32>,
    /// Vertices and slots looked at so far.
    work: usize,
}

impl Search<'_> {
    fn fits_all(&mut self, sequence: &[u32]) -> bool {
        let (posets, matcher, work) = (self.posets, &mut self.matcher, &mut self.work);
        let misfit = self.suspects.iter().position(|&index| {
            let poset = &posets[index as usize];
            *work += poset.len() + sequence.len();
            !matcher.fits(poset, sequence)
        });
        match misfit {
            Some(place) => {
                self.suspects[..=place].rotate_right(1);
                false
            }
            None => true,
        }
    }

    /// Adds slots until every order fits; the orders are looked at from `first` on, then those before.
    fn grow(&mut self, mut sequence: Vec<u32>, first: usize) -> Vec<u32> {
        for index in (first..self.posets.len()).chain(0..first) {
            let poset = &self.posets[index];
            self.work += poset.len() + sequence.len();
            if !self.matcher.fits(poset, &sequence) {
                let width = (WIDTH_VERTICES / poset.len().max(1)).clamp(2, WIDTH);
                // What a merge costs, roughly: in every slot, every state's counts of every chain.
                self.work += width * poset.chains.len() * sequence.len();
                sequence = merge(poset, &sequence, self.labels, width);
            }
        }
        sequence
    }

    /// Leaves out every slot that can be. One pass does: what cannot be left out of a sequence cannot be of a part.
    fn shrink(&mut self, mut sequence: Vec<u32>) -> Vec<u32> {
        let mut counts = vec![0u32; self.labels];
        sequence.iter().for_each(|&label| counts[label as usize] += 1);
        for slot in (0..sequence.len()).rev() {
            let label = sequence[slot];
            if counts[label as usize] == self.most[label as usize] {
                continue;
            }
            sequence.remove(slot);
            if self.fits_all(&sequence) {
                counts[label as usize] -= 1;
            } else {
                sequence.insert(slot, label);
            }
        }
        sequence
    }
}

/// A short sequence of labels into which every order fits.
///
/// Growth: from the largest order to the smallest, each that does not fit is merged in; then slots that are not needed
/// are left out. Backtracking: a stretch of the sequence is taken back and grown again with the orders in another
/// succession; the result is kept if it is no longer than before, until the bound is reached or `backtrack` attempts are
/// made.
pub(super) fn minimum_common(distinct: &Distinct, labels: usize, backtrack: usize) -> Vec<u32> {
    let posets = &distinct.posets;
    let most = distinct.most(labels);
    let bound = most.iter().sum::<u32>() as usize;
    let matcher = Matcher::new(labels);
    let mut search =
        Search { posets, labels, most, matcher, suspects: (0..posets.len() as u32).collect(), work: 0 };
    let sequence = search.grow(Vec::new(), 0);
    let mut best = search.shrink(sequence);
    let mut current = best.clone();
    let mut seen = HashSet::from([best.clone()]);
    search.work = 0;
    for attempt in 0..backtrack {
        if best.len() <= bound || search.work > WORK {
            break;
        }
        // Stretches of one slot to half of the sequence, everywhere.
        let length = 1 + attempt % (current.len() / 2).clamp(1, STRETCH);
        let begin = attempt * 5 % (current.len() - length + 1);
        let mut part = current.clone();
        part.drain(begin..begin + length);
        let sequence = search.grow(part, attempt * 7 % posets.len());
        let sequence = search.shrink(sequence);
        if sequence.len() <= current.len() && seen.insert(sequence.clone()) {
            if sequence.len() < best.len() {
                best = sequence.clone();
            }
            current = sequence;
        }
    }
    best
}
