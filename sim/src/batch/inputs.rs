//! What a step reads that the tables alone do not say: messages that a delay selects which is known only at run time, and
//! stamps.

use parallax_model::Scalar;
use parallax_model::lanes::{InMemory, Kernel, Level, Simd};
use parallax_model::node_model::{BlockStamps, BlockStore};
use parallax_runtime::time::{Nanos, to_seconds};

use super::number::Number;
use crate::compiled::{InputRows, Interpolation, TrainableDelay};

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

    /// Selects, for every environment, the messages that a step at `start` (ns) sees under its own delay, whose place
    /// between its bounds `alphas` holds, one for each block.
    pub(super) fn select(
        &mut self,
        input: &InputRows,
        row: usize,
        start: Nanos,
        (history, seen): (&BlockStore<T>, &mut BlockStore<T>),
        alphas: &[T],
    ) {
        let Some(delay) = input.trainable else { return };
        let rows = row * input.candidates..(row + 1) * input.candidates;
        let (seqs, read, sent) = (&input.seq[rows.clone()], &input.read[rows.clone()], &input.sent[rows]);
        let (window, stamps) = (input.window, &mut self.stamps[..]);
        Level::widest().run(Select { delay, window, seqs, read, sent, start, history, seen, stamps, alphas });
    }
}

/// Selection by a delay, on lanes: among the candidates of a row those that are there, as lanes of masks.
struct Select<'a, T> {
    delay: TrainableDelay,
    window: usize,
    seqs: &'a [i32],
    read: &'a [u32],
    sent: &'a [Nanos],
    start: Nanos,
    history: &'a BlockStore<T>,
    seen: &'a mut BlockStore<T>,
    stamps: &'a mut [[T; 3]],
    alphas: &'a [T],
}

/// The line on which a place in the window lies when a given candidate is the newest that is there.
struct Held {
    /// When its message was sent, s after the start; and how much later the next one was, s.
    sent: f64,
    gap: f64,
    /// How much later the newest one was sent, s.
    before_newest: f64,
}

impl<T> Select<'_, T> {
    /// The candidate towards which the payload lies: before the first message and after the last it holds.
    #[inline(always)]
    fn after(&self, candidate: usize) -> usize {
        let holds = self.seqs[candidate] < 0 || candidate == self.seqs.len() - 1;
        if holds { candidate } else { candidate + 1 }
    }

    #[inline(always)]
    fn held(&self, newest: usize, index: usize) -> Held {
        let candidate = newest + 1 - self.window + index;
        let sent = |candidate: usize| self.sent[candidate];
        Held {
            sent: to_seconds(sent(candidate).saturating_sub(self.start)),
            gap: to_seconds(sent(self.after(candidate)).saturating_sub(sent(candidate))),
            before_newest: to_seconds(sent(newest).saturating_sub(sent(candidate))),
        }
    }
}

/// Methods, because a closure that is called several times stays a call, even in a kernel.
impl<T: InMemory> Select<'_, T> {
    /// Whether a candidate is there; `until` is when the newest is sent that can be, s after the start.
    #[inline(always)]
    fn there<S: Simd>(&self, candidate: usize, until: T::On<S>) -> <T::On<S> as Scalar>::Mask {
        let sent = to_seconds(self.sent[candidate].saturating_sub(self.start));
        let sent = T::On::<S>::constant(if self.seqs[candidate] < 0 { f64::NEG_INFINITY } else { sent });
        if self.delay.skip { sent.lt(until) } else { sent.le(until) }
    }

    #[inline(always)]
    fn leaf<S: Simd>(&self, block: usize, candidate: usize, leaf: usize) -> T::On<S> {
        T::registers::<S>(self.history.message(block, self.read[candidate] as usize))[leaf].loaded()
    }
}

/// For so many candidates, whether they are there is found once for all that is selected.
const KEPT: usize = 16;

/// Four messages in a row, and when: the middle ones are around what is looked for, or those before the last that is none are
/// the newest.
#[derive(Clone, Copy)]
struct Row {
    /// Their candidates.
    four: [usize; 4],
    /// When the second was sent, s after the start; for an earlier place of the window later by what lies between it and the
    /// newest.
    sent: f64,
    /// How much later the third was sent, s; zero where there is none.
    gap: f64,
    /// For each second after the second one, by how much the third's weight grows on the chord.
    per_gap: f64,
    /// What the bend adds to the weights of the first, third and fourth, for each square second.
    bend: [f64; 3],
}

impl<T> Select<'_, T> {
    /// How much later a message was sent than one before it, s; zero where that one never was.
    fn between(&self, before: usize, after: usize) -> f64 {
        match self.seqs[before] < 0 {
            true => 0.0,
            false => to_seconds(self.sent[after].saturating_sub(self.sent[before])),
        }
    }

    /// The row in which a place in the window lies when a given candidate is the newest that is there.
    fn row(&self, newest: usize, index: usize) -> Row {
        let held = newest + 1 - self.window + index;
        let end = self.seqs.len() - 1;
        // Beyond the newest of all the parabola through the newest three goes on; what was never sent holds.
        let middle = held.min(end - 1);
        let middle = if self.between(middle, middle + 1) > 0.0 { middle } else { held };
        let (first, last) = (middle.saturating_sub(1), (middle + 1).min(end));
        let next = (last + 1).min(end);
        let (before, gap, after) =
            (self.between(first, middle), self.between(middle, last), self.between(last, next));
        // Second divided differences of the one parabola and the other.
        let mut bend = [0.0; 3];
        let (back, front) = (gap > 0.0 && before > 0.0, gap > 0.0 && after > 0.0);
        let share = if back && front { 0.5 } else { 1.0 };
        if back {
            bend[0] += share / (before * (before + gap));
            bend[1] += share / (gap * (before + gap));
        }
        if front {
            bend[1] -= share / (gap * after);
            bend[2] += share / (after * (gap + after));
        }
        Row {
            four: [first, middle, last, next],
            sent: to_seconds(self.sent[middle].saturating_sub(self.start)) + self.between(held, newest),
            gap,
            per_gap: if gap > 0.0 { 1.0 / gap } else { 0.0 },
            bend,
        }
    }
}

impl<T: InMemory> Select<'_, T> {
    /// The weights of a row's messages at `until`, s after the start.
    #[inline(always)]
    fn weights<S: Simd>(row: &Row, until: T::On<S>) -> [T::On<S>; 4] {
        let along = until - row.sent;
        let bend = along * (along - row.gap);
        let (first, next) = (bend * row.bend[0], bend * row.bend[2]);
        let last = along * row.per_gap + bend * row.bend[1];
        [first, T::On::<S>::constant(1.0) - first - last - next, last, next]
    }

    /// What is seen of a payload that is smooth, at a place in the window.
    #[inline(always)]
    fn smooth<S: Simd>(&mut self, index: usize, (min, max): (f64, f64)) {
        let (zero, one) = (T::On::<S>::constant(0.0), T::On::<S>::constant(1.0));
        let (count, window) = (self.seqs.len(), self.window);
        // The candidates reach one message further back than the longest delay: one is always there.
        let few = count <= KEPT;
        let mut rows = [self.row(window, index); KEPT];
        for (newest, row) in (window..count).zip(&mut rows).skip(1) {
            *row = self.row(newest, index);
        }
        for block in 0..self.alphas.len() {
            let alpha = one.min(zero.max(T::load::<S>(&self.alphas[block])));
            let until = zero - (alpha * (max - min) + min);
            let mut weights = [zero; KEPT];
            let place = |candidate: usize| candidate.min(KEPT - 1);
            if few {
                for (newest, row) in (window..count).zip(&rows) {
                    let own = Self::weights::<S>(row, until);
                    let there = self.there::<S>(newest, until);
                    // Candidates are in the order in which they were sent: the one before is left behind.
                    if let Some(before) = row.four[0].checked_sub(1) {
                        let before = &mut weights[place(before)];
                        *before = T::On::<S>::select(there, zero, *before);
                    }
                    // One that stands for two has the weight of that which is nearer to the second.
                    for of in [3, 2, 0, 1] {
                        let weight = &mut weights[place(row.four[of])];
                        *weight = match newest == window {
                            true => own[of],
                            false => T::On::<S>::select(there, own[of], *weight),
                        };
                    }
                }
            }
            for leaf in 0..self.history.leaves() {
                let mut value = zero;
                if few {
                    for (candidate, weight) in weights[..count.min(KEPT)].iter().enumerate() {
                        value += *weight * self.leaf::<S>(block, candidate, leaf);
                    }
                } else {
                    for newest in window..count {
                        let row = self.row(newest, index);
                        let mut sum = zero;
                        for (candidate, weight) in row.four.into_iter().zip(Self::weights::<S>(&row, until)) {
                            sum += weight * self.leaf::<S>(block, candidate, leaf);
                        }
                        value = match newest == window {
                            true => sum,
                            false => T::On::<S>::select(self.there::<S>(newest, until), sum, value),
                        };
                    }
                }
                T::registers_mut::<S>(self.seen.message_mut(block, index))[leaf] = value;
            }
        }
    }
}

impl<T: InMemory> Kernel for Select<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self) {
        let (min, max) = (to_seconds(self.delay.min), to_seconds(self.delay.max));
        let (zero, one) = (T::On::<S>::constant(0.0), T::On::<S>::constant(1.0));
        let (last, window) = (self.seqs.len() - 1, self.window);
        let linear = self.delay.interpolation == Interpolation::Linear;
        let smooth = self.delay.interpolation == Interpolation::Smooth;
        if smooth {
            // No closure, which would stay a call outside this kernel's registers.
            for index in 0..window {
                self.smooth::<S>(index, (min, max));
            }
        }
        for block in 0..self.alphas.len() {
            // At a bound it is the number itself that is kept, with its derivative.
            let alpha = one.min(zero.max(T::load::<S>(&self.alphas[block])));
            let seconds = alpha * (max - min) + min;
            let until = -seconds;
            // Candidates are in the order in which they were sent: whose successor is there is not the newest.
            let mut kept = [zero.lt(zero); KEPT];
            for (mask, newest) in kept.iter_mut().zip(window..=last) {
                *mask = self.there::<S>(newest, until);
            }
            for index in 0..window {
                let first = index;
                let mut seq = T::On::<S>::constant(f64::from(self.seqs[first]));
                let mut sent = T::On::<S>::constant(to_seconds(self.sent[first]));
                for newest in window..=last {
                    let held = newest + 1 - window + index;
                    let there = match newest - window {
                        k if k < KEPT => kept[k],
                        _ => self.there::<S>(newest, until),
                    };
                    let (number, time) = (f64::from(self.seqs[held]), to_seconds(self.sent[held]));
                    seq = T::On::<S>::select(there, T::On::<S>::constant(number), seq);
                    sent = T::On::<S>::select(there, T::On::<S>::constant(time), sent);
                }
                let stamps = &mut self.stamps[block * window + index];
                T::store::<S>(&mut stamps[0], seq);
                T::store::<S>(&mut stamps[1], sent);
                let received = T::On::<S>::select(seq.lt(zero), zero, sent + seconds);
                T::store::<S>(&mut stamps[2], received);

                if smooth {
                    continue;
                }
                // How far the payload lies on the way to the next message.
                let mut share = zero;
                if linear {
                    let held = self.held(window - 1, index);
                    let mut base = T::On::<S>::constant(held.sent + held.before_newest);
                    let mut gap = T::On::<S>::constant(held.gap);
                    for newest in window..=last {
                        let held = self.held(newest, index);
                        let there = match newest - window {
                            k if k < KEPT => kept[k],
                            _ => self.there::<S>(newest, until),
                        };
                        let line = T::On::<S>::constant(held.sent + held.before_newest);
                        base = T::On::<S>::select(there, line, base);
                        gap = T::On::<S>::select(there, T::On::<S>::constant(held.gap), gap);
                    }
                    let moves = gap.gt(zero);
                    let along = (until - base) / T::On::<S>::select(moves, gap, one);
                    share = T::On::<S>::select(moves, one.min(zero.max(along)), zero);
                }
                for leaf in 0..self.history.leaves() {
                    let mut a = self.leaf::<S>(block, first, leaf);
                    for newest in window..=last {
                        let there = match newest - window {
                            k if k < KEPT => kept[k],
                            _ => self.there::<S>(newest, until),
                        };
                        let held = newest + 1 - window + index;
                        a = T::On::<S>::select(there, self.leaf::<S>(block, held, leaf), a);
                    }
                    if linear {
                        let mut b = self.leaf::<S>(block, self.after(first), leaf);
                        for newest in window..=last {
                            let there = match newest - window {
                                k if k < KEPT => kept[k],
                                _ => self.there::<S>(newest, until),
                            };
                            let after = self.after(newest + 1 - window + index);
                            b = T::On::<S>::select(there, self.leaf::<S>(block, after, leaf), b);
                        }
                        a += share * (b - a);
                    }
                    T::registers_mut::<S>(self.seen.message_mut(block, index))[leaf] = a;
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
        let (sent, received) = (to_seconds(input.sent[place]), to_seconds(input.received[place]));
        [T::constant(f64::from(input.seq[place])), T::constant(sent), T::constant(received)]
    }
}
