//! What a step of a block reads: histories at the places that the tables name, or what a delay selects that is known only
//! at run time.

use std::cell::Cell;

use parallax_model::node_model::StepInputs;
use parallax_runtime::time::{Nanos, to_seconds};

use super::number::Number;
use crate::compiled::{InputRows, Interpolation};

/// The last outputs of one node, for every block of a group: `[block][place][leaf]`.
#[derive(Debug)]
pub(super) struct History<T> {
    pub(super) leaves: usize,
    places: usize,
    values: Vec<T>,
}

impl<T: Number> History<T> {
    /// The initial message in all places.
    pub(super) fn new(initial: &[f64], places: usize, blocks: usize) -> Self {
        let message = initial.iter().map(|&value| T::constant(value));
        let values = message.cycle().take(initial.len() * places * blocks).collect();
        Self { leaves: initial.len(), places, values }
    }

    #[inline(always)]
    pub(super) fn message(&self, block: usize, place: u32) -> &[T] {
        let first = (block * self.places + place as usize) * self.leaves;
        &self.values[first..first + self.leaves]
    }

    #[inline(always)]
    pub(super) fn message_mut(&mut self, block: usize, place: u32) -> &mut [T] {
        let first = (block * self.places + place as usize) * self.leaves;
        &mut self.values[first..first + self.leaves]
    }
}

/// The messages of a port whose delay is known only at run time: they differ from environment to environment.
#[derive(Debug)]
pub(super) struct Selected<T> {
    /// `[block][place in the window][leaf]`
    values: Vec<T>,
    /// `[block][place in the window]`
    stamps: Vec<[T; 3]>,
    window: usize,
    leaves: usize,
}

impl<T: Number> Selected<T> {
    /// Room for what `input` reads from messages of so many leaves; none where the tables say what is seen.
    pub(super) fn new(input: &InputRows, leaves: usize, blocks: usize) -> Self {
        let window = if input.is_open() { input.window } else { 0 };
        let zero = T::constant(0.0);
        Self {
            values: vec![zero; blocks * window * leaves],
            stamps: vec![[zero; 3]; blocks * window],
            window,
            leaves,
        }
    }

    /// Selects, for every environment of a block, the messages that a step at `start` (s) sees under its own delay.
    pub(super) fn select(
        &mut self,
        input: &InputRows,
        row: usize,
        start: f64,
        history: &History<T>,
        block: usize,
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
                let message = history.message(block, read[held]);
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
                let after = history.message(block, read[after]);
                let first = (block * self.window + index) * self.leaves;
                let to = &mut self.values[first..first + self.leaves];
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
        history: &History<T>,
        block: usize,
    ) {
        let Some(delay) = &input.from_output else { return };
        let first = row * input.candidates;
        for lane in 0..T::LANES {
            let message = |candidate: usize| history.message(block, input.read[first + candidate]);
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
                let place = (block * self.window + index) * self.leaves;
                for (to, from) in self.values[place..place + self.leaves].iter_mut().zip(message(held)) {
                    to.set(lane, from.get(lane));
                }
            }
        }
    }
}

/// The inputs of one step of one block.
pub(super) struct SlotInputs<'a, T> {
    pub(super) ports: &'a [String],
    pub(super) inputs: &'a [InputRows],
    pub(super) selected: &'a [Selected<T>],
    /// Where its stamps stand in the tables.
    pub(super) row: usize,
    /// Places in histories: port after port, message after message.
    pub(super) read: &'a [u32],
    /// Where each port's places begin.
    pub(super) offsets: &'a [usize],
    pub(super) histories: &'a [History<T>],
    pub(super) block: Cell<usize>,
}

impl<T: Number> StepInputs<T> for SlotInputs<'_, T> {
    #[inline]
    fn port(&self, name: &str) -> Option<usize> {
        // Names are short: a loop over bytes is faster than a call.
        let same = |port: &String| port.len() == name.len() && port.bytes().eq(name.bytes());
        self.ports.iter().position(same)
    }
    #[inline]
    fn window(&self, port: usize) -> usize {
        self.inputs[port].window
    }
    #[inline]
    fn stamp(&self, port: usize, index: usize) -> [T; 3] {
        let input = &self.inputs[port];
        if input.is_open() {
            let selected = &self.selected[port];
            return selected.stamps[self.block.get() * selected.window + index];
        }
        let place = self.row * input.candidates + index;
        let stamps =
            [f64::from(input.seq[place]), to_seconds(input.sent[place]), to_seconds(input.received[place])];
        stamps.map(T::constant)
    }
    #[inline]
    fn payload(&self, port: usize, index: usize) -> &[T] {
        let input = &self.inputs[port];
        if input.is_open() {
            let selected = &self.selected[port];
            let first = (self.block.get() * selected.window + index) * selected.leaves;
            return &selected.values[first..first + selected.leaves];
        }
        let place = self.read[self.offsets[port] + index];
        self.histories[input.from].message(self.block.get(), place)
    }
}
