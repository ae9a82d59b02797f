//! The signs of life of nodes on other machines: their pages, copied here word by word, so that reports, `top` and the
//! watch over hanging nodes see them like those of any other node.

use super::hosts::Placement;
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::vitals::{Vital, Vitals};
use crate::time::Nanos;

/// Bytes of one word that is told: node, page, place, and the word itself.
const ENTRY: usize = 4 + 2 + 2 + 8;
/// Words told at a time: a telegram stays small.
const MOST: usize = 4096;

/// The pages of all nodes of a run, as this machine tells and hears of them.
pub(super) struct Mirror {
    pages: Vec<Vitals>,
    /// By node and page: what was told last; empty for nodes of other machines.
    told: Vec<Vec<Vec<u64>>>,
}

impl Mirror {
    pub(super) fn new(graph: &Graph, placement: &Placement, pages: Vec<Vitals>) -> Self {
        let told = pages.iter().enumerate().map(|(node, vitals)| match placement.is_here(node) {
            true => vitals.pages().map(|page| vec![0; page.len()]).collect(),
            false => Vec::new(),
        });
        let told = told.collect();
        debug_assert_eq!(pages.len(), graph.nodes().len());
        Self { pages, told }
    }

    /// What has changed at the nodes of this machine since the last time; everything that is not zero when `all` is asked for.
    pub(super) fn news(&mut self, all: bool) -> Vec<Vec<u8>> {
        let mut telegrams = vec![Vec::new()];
        for (node, told) in self.told.iter_mut().enumerate() {
            for (page, (told, words)) in told.iter_mut().zip(self.pages[node].pages()).enumerate() {
                for (place, (told, word)) in told.iter_mut().zip(words).enumerate() {
                    let word = word.load(std::sync::atomic::Ordering::Acquire);
                    if *told == word && !(all && word != 0) {
                        continue;
                    }
                    *told = word;
                    if telegrams.last().is_some_and(|telegram| telegram.len() >= MOST * ENTRY) {
                        telegrams.push(Vec::new());
                    }
                    let Some(telegram) = telegrams.last_mut() else { continue };
                    telegram.extend((node as u32).to_le_bytes());
                    telegram.extend((page as u16).to_le_bytes());
                    telegram.extend((place as u16).to_le_bytes());
                    telegram.extend(word.to_le_bytes());
                }
            }
        }
        telegrams.retain(|telegram| !telegram.is_empty());
        telegrams
    }

    /// Takes in what another machine tells of its nodes; its clock shows `offset` more than this one's. What does not fit is
    /// left out: it comes from elsewhere.
    pub(super) fn hear(&self, placement: &Placement, host: usize, offset: Nanos, telegram: &[u8]) {
        for entry in telegram.chunks_exact(ENTRY) {
            let number = |from: usize, to: usize| {
                entry[from..to].iter().rev().fold(0u64, |word, byte| word << 8 | u64::from(*byte))
            };
            let (node, page, place, word) =
                (number(0, 4) as usize, number(4, 6) as usize, number(6, 8) as usize, number(8, 16));
            if placement.of.get(node) != Some(&host) {
                continue;
            }
            let cells = self.pages[node].pages().nth(page);
            let Some(cell) = cells.and_then(|cells| cells.get(place)) else { continue };
            let here = match page {
                0 => translate(place, word, offset),
                _ => word,
            };
            cell.store(here, std::sync::atomic::Ordering::Release);
        }
    }
}

/// What a word of a node's first page means here: times of the monotonic clock are this machine's, and its processes are
/// none of this machine.
fn translate(place: usize, word: u64, offset: Nanos) -> u64 {
    const TIMES: [Vital; 3] = [Vital::Beat, Vital::Stepping, Vital::Ended];
    if TIMES.iter().any(|vital| *vital as usize == place) && word != 0 {
        // Never later than now: the estimate of the offset may be that much off.
        return (word as Nanos).saturating_sub(offset).clamp(1, monotonic()) as u64;
    }
    if [Vital::Process, Vital::Thread].iter().any(|vital| *vital as usize == place) {
        return 0;
    }
    word
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_become_those_of_this_machine_and_processes_none() {
        let now = monotonic();
        let there = (now + 5_000_000_000) as u64;
        assert_eq!(translate(Vital::Beat as usize, there, 5_000_000_000), now as u64);
        assert_eq!(translate(Vital::Stepping as usize, 0, 5_000_000_000), 0);
        assert!(translate(Vital::Beat as usize, u64::MAX / 2, 0) as i64 <= monotonic());
        assert_eq!(translate(Vital::Process as usize, 77, 0), 0);
        assert_eq!(translate(Vital::Steps as usize, 77, 5), 77);
    }
}
