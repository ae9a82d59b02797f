//! The signs of life of nodes on other machines: their pages, copied here word by word, so that reports, `top` and the
//! watch over hanging nodes see them like those of any other node.

use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::{Acquire, Release};

use super::hosts::Placement;
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::vitals::{InputVital, Vital, Vitals};
use crate::recording::LossReason;
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
                    let word = word.load(Acquire);
                    if *told == word && !(all && word != 0) {
                        continue;
                    }
                    *told = word;
                    if telegrams.last().is_some_and(|telegram| telegram.len() >= MOST * ENTRY) {
                        telegrams.push(Vec::new());
                    }
                    let Some(telegram) = telegrams.last_mut() else { continue };
                    write(telegram, node, page, place, word);
                }
            }
        }
        telegrams.retain(|telegram| !telegram.is_empty());
        telegrams
    }

    /// Takes in what another machine tells of its nodes; its clock shows `offset` more than this one's. What does not fit is
    /// left out: it comes from elsewhere.
    pub(super) fn hear(&self, placement: &Placement, host: usize, offset: Nanos, telegram: &[u8]) {
        for (node, page, place, word) in entries(telegram) {
            if placement.of.get(node) != Some(&host) {
                continue;
            }
            let Some(cell) = self.cell(node, page, place) else { continue };
            let here = match page {
                0 => translate(place, word, offset),
                _ => word,
            };
            cell.store(here, Release);
        }
    }

    /// What is known here of the nodes of another machine that was started again: their counts, for it to go on with. `next`
    /// gives the number after that of the last message, or record, that came from a node.
    pub(super) fn memory(
        &self,
        placement: &Placement,
        host: usize,
        next: impl Fn(usize) -> (u64, u64),
    ) -> Vec<u8> {
        let mut telegram = Vec::new();
        for (node, pages) in self.pages.iter().enumerate().filter(|(node, _)| placement.of[*node] == host) {
            let (message, record) = next(node);
            let ahead = message.saturating_sub(pages.get(Vital::Next));
            for (page, words) in pages.pages().enumerate() {
                for (place, word) in words.iter().enumerate() {
                    let known = word.load(Acquire);
                    // What it told last may be older than what came from it.
                    let word = match (page, place) {
                        (0, place) if place == Vital::Next as usize => known.max(message),
                        (0, place) if place == Vital::Sent as usize => known.saturating_add(ahead),
                        // Each message has a record: those that came tell of records that did not.
                        (0, place) if place == Vital::Records as usize => {
                            known.saturating_add(ahead).max(record)
                        }
                        (0, place) if !lasts(place) => 0,
                        _ => known,
                    };
                    if word != 0 {
                        write(&mut telegram, node, page, place, word);
                    }
                }
            }
        }
        telegram
    }

    /// This machine was started again: its nodes go on with the counts that another one knows of them.
    pub(super) fn remember(&self, placement: &Placement, memory: &[u8]) {
        for (node, page, place, word) in entries(memory) {
            let own = placement.of.get(node) == Some(&placement.me) && (page > 0 || lasts(place));
            if let Some(cell) = self.cell(node, page, place).filter(|_| own) {
                cell.store(word, Release);
            }
        }
        let own = self.pages.iter().enumerate().filter(|(node, _)| placement.is_here(*node));
        for (pages, input) in
            own.flat_map(|(_, pages)| (0..pages.delays.len()).map(move |input| (pages, input)))
        {
            // The words were not told at one moment. What is known to have come, and has gone nowhere else, waited.
            let lost = LossReason::ALL.into_iter().filter(|reason| *reason != LossReason::Malformed);
            let lost: u64 = lost.map(|reason| pages.lost(input, reason)).sum();
            let gone = [InputVital::Consumed, InputVital::Superseded].map(|vital| pages.input(input, vital));
            let waiting = pages.input(input, InputVital::Known).saturating_sub(gone[0] + gone[1] + lost);
            pages.set_input(input, InputVital::Waiting, waiting);
        }
    }

    fn cell(&self, node: usize, page: usize, place: usize) -> Option<&AtomicU64> {
        self.pages.get(node)?.pages().nth(page)?.get(place)
    }
}

/// Adds one word to a telegram.
fn write(telegram: &mut Vec<u8>, node: usize, page: usize, place: usize, word: u64) {
    telegram.extend((node as u32).to_le_bytes());
    telegram.extend((page as u16).to_le_bytes());
    telegram.extend((place as u16).to_le_bytes());
    telegram.extend(word.to_le_bytes());
}

/// The words of a telegram: node, page, place, and the word itself.
fn entries(telegram: &[u8]) -> impl Iterator<Item = (usize, usize, usize, u64)> {
    telegram.chunks_exact(ENTRY).map(|entry| {
        let number = |from: usize, to: usize| {
            entry[from..to].iter().rev().fold(0u64, |word, byte| word << 8 | u64::from(*byte))
        };
        (number(0, 4) as usize, number(4, 6) as usize, number(6, 8) as usize, number(8, 16))
    })
}

/// Times of the monotonic clock, which are those of one machine.
const TIMES: [Vital; 3] = [Vital::Beat, Vital::Stepping, Vital::Ended];
/// What holds for one process only.
const OF_A_PROCESS: [Vital; 2] = [Vital::Process, Vital::Thread];

/// Whether a word of a node's first page outlives its process and its machine.
fn lasts(place: usize) -> bool {
    !TIMES.iter().chain(&OF_A_PROCESS).any(|vital| *vital as usize == place)
}

/// What a word of a node's first page means here: times of the monotonic clock are this machine's, and its processes are
/// none of this machine.
fn translate(place: usize, word: u64, offset: Nanos) -> u64 {
    if TIMES.iter().any(|vital| *vital as usize == place) && word != 0 {
        // Never later than now: the estimate of the offset may be that much off.
        return (word as Nanos).saturating_sub(offset).clamp(1, monotonic()) as u64;
    }
    if OF_A_PROCESS.iter().any(|vital| *vital as usize == place) {
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
