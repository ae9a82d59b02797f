//! What a step reads that the tables alone do not say: messages that a delay selects which is known only at run time, and
//! stamps.

use parallax_model::node_model::{BlockStamps, BlockStore};
use parallax_runtime::time::{Nanos, to_seconds};

use super::number::Number;
use crate::compiled::{InputRows, Interpolation};

/// The messages of a port whose delay is known only at run time: they differ from environment to environment.
#[derive(Debug)]
pub(super) struct Selected<T> {
    /// In which of the group's stores they are, a place for each message of the window.
    pub(super) store: usize,
    /// `[block][place in the window]`
    stamps: Vec<[T; 3]>,
    window: usize,
}

/// Where a block's messages are selected from, and where they are put.
pub(super) struct Selecting<'a, T> {
    pub(super) history: &'a BlockStore<T>,
    pub(super) seen: &'a mut BlockStore<T>,
    pub(super) block: usize,
}

impl<T: Number> Selected<T> {
    /// Room for the stamps of what `input` reads; none where the tables say what is seen.
    pub(super) fn new(input: &InputRows, store: usize, blocks: usize) -> Self {
        let window = if input.is_open() { input.window } else { 0 };
        Self { store, stamps: vec![[T::constant(0.0); 3]; blocks * window], window }
    }

    /// Selects, for every environment of a block, the messages that a step at `start` (s) sees under its own delay.
    pub(super) fn select(
        &mut self,
        input: &InputRows,
        row: usize,
        start: f64,
        Selecting { history, seen, block }: Selecting<'_, T>,
        alphas: &[f64],
    ) {
        let Some(delay) = &input.trainable else { return };
        let rows = row * input.candidates..(row + 1) * input.candidates;
        let (seqs, read) = (&input.seq[rows.clone()], &input.read[rows.clone()]);
        let sent = |candidate: usize| to_seconds(input.sent[rows.start + candidate]);
        let (min, max) = (to_seconds(delay.min), to_seconds(delay.max));
        let last = input.candidates - 1;
        for (lane, alpha) in alphas.iter().enumerate() {
            let seconds = min + alpha.clamp(0.0, 1.0) * (max - min);
            let until = start - seconds;
            let arrived = |candidate: usize| {
                let on_time = if delay.skip { sent(candidate) < until } else { sent(candidate) <= until };
                on_time || seqs[candidate] < 0
            };
            // The newest that has arrived; at least a whole window has under the longest delay.
            let mut newest = input.window - 1;
            while newest < last && arrived(newest + 1) {
                newest += 1;
            }
            for index in 0..input.window {
                let held = newest + 1 - input.window + index;
                let initial = seqs[held] < 0;
                let received = if initial { 0.0 } else { sent(held) + seconds };
                let stamps = [f64::from(seqs[held]), sent(held), received];
                for (stamp, value) in self.stamps[block * self.window + index].iter_mut().zip(stamps) {
                    stamp.set(lane, value);
                }
                let message = history.message(block, read[held] as usize);
                let (after, share) = match delay.interpolation {
                    Interpolation::Hold => (held, 0.0),
                    // Before the first message and after the last it holds.
                    Interpolation::Linear if initial || held == last => (held, 0.0),
                    Interpolation::Linear => {
                        let look = until - (sent(newest) - sent(held));
                        let gap = sent(held + 1) - sent(held);
                        (held + 1, if gap > 0.0 { ((look - sent(held)) / gap).clamp(0.0, 1.0) } else { 0.0 })
                    }
                };
                let after = history.message(block, read[after] as usize);
                let to = seen.message_mut(block, index);
                for ((to, message), after) in to.iter_mut().zip(message).zip(after) {
                    let (a, b) = (message.get(lane), after.get(lane));
                    to.set(lane, if share == 0.0 { a } else { a + share * (b - a) });
                }
            }
        }
    }
}

impl<T: Number> Selected<T> {
    /// Selects, for every environment of a block, the messages that a step at `start` (ns) sees, where their delays
    /// follow from what the sender sent. Decided in whole nanoseconds, as by the executor.
    pub(super) fn select_by_output(
        &mut self,
        input: &InputRows,
        row: usize,
        start: Nanos,
        Selecting { history, seen, block }: Selecting<'_, T>,
    ) {
        let Some(delay) = &input.from_output else { return };
        let first = row * input.candidates;
        for lane in 0..T::LANES {
            let message = |candidate: usize| history.message(block, input.read[first + candidate] as usize);
            let leaf = |candidate: usize| message(candidate)[delay.computation.leaf].get(lane);
            let newest = delay.newest(input, row, start, leaf);
            for index in 0..input.window {
                let held = newest + 1 - input.window + index;
                let seq = input.seq[first + held];
                let sent = if seq < 0 { 0 } else { delay.sent(input.sent[first + held], leaf(held)) };
                let received = if seq < 0 { 0 } else { delay.received(sent) };
                let stamps = [f64::from(seq), to_seconds(sent), to_seconds(received)];
                for (stamp, value) in self.stamps[block * self.window + index].iter_mut().zip(stamps) {
                    stamp.set(lane, value);
                }
                for (to, from) in seen.message_mut(block, index).iter_mut().zip(message(held)) {
                    to.set(lane, from.get(lane));
                }
            }
        }
    }
}

/// The stamps of what a step sees: the tables', or those of what was selected.
pub(super) struct SlotStamps<'a, T> {
    pub(super) inputs: &'a [InputRows],
    pub(super) selected: &'a [Selected<T>],
    /// Where its stamps stand in the tables.
    pub(super) row: usize,
}

impl<T: Number> BlockStamps<T> for SlotStamps<'_, T> {
    fn stamp(&self, block: usize, port: usize, index: usize) -> [T; 3] {
        let input = &self.inputs[port];
        if input.is_open() {
            let selected = &self.selected[port];
            return selected.stamps[block * selected.window + index];
        }
        let place = self.row * input.candidates + index;
        let stamps =
            [f64::from(input.seq[place]), to_seconds(input.sent[place]), to_seconds(input.received[place])];
        stamps.map(T::constant)
    }
}
