//! One step of a node in many environments: block after block of lanes, in one call.
//!
//! Environments that share a schedule make the same step at the same time and read the same places, each in memory of
//! its own. So what is found once for all of them (the model, the instructions, the ports) is found outside the loop,
//! and the loop over blocks is compiled together with the model.

use std::marker::PhantomData;

use super::{FlatModel, NodeStep, Scratch, StepInputs};
use crate::lanes::{InMemory, Kernel, Simd};
use crate::scalar::Scalar;

/// Messages of every block: `[block][place][leaf]`.
#[derive(Clone, Debug)]
pub struct BlockStore<T> {
    leaves: usize,
    places: usize,
    values: Vec<T>,
}

/// Without blocks.
impl<T> Default for BlockStore<T> {
    fn default() -> Self {
        Self { leaves: 0, places: 0, values: Vec::new() }
    }
}

impl<T: Scalar> BlockStore<T> {
    /// The same message in every place of every block.
    pub fn new(message: &[f64], places: usize, blocks: usize) -> Self {
        let leaves = message.iter().map(|&value| T::constant(value));
        let values = leaves.cycle().take(message.len() * places * blocks).collect();
        Self { leaves: message.len(), places, values }
    }

    /// How many leaves a message has.
    #[inline(always)]
    pub fn leaves(&self) -> usize {
        self.leaves
    }

    /// A block's message at a place.
    ///
    /// # Panics
    ///
    /// When there is no such block.
    #[inline(always)]
    pub fn message(&self, block: usize, place: usize) -> &[T] {
        let first = (block * self.places + place) * self.leaves;
        &self.values[first..first + self.leaves]
    }

    /// A block's message at a place.
    ///
    /// # Panics
    ///
    /// When there is no such block.
    #[inline(always)]
    pub fn message_mut(&mut self, block: usize, place: usize) -> &mut [T] {
        let first = (block * self.places + place) * self.leaves;
        &mut self.values[first..first + self.leaves]
    }
}

/// A port of a node that steps in blocks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockPort {
    /// Its name.
    pub name: String,
    /// How many messages a step sees.
    pub window: usize,
    /// In which store the messages lie.
    pub store: usize,
    /// Where the window begins in the list of places.
    pub first: usize,
}

/// Stamps of the messages that a block's step sees.
pub trait BlockStamps<T> {
    /// Number (−1 for an initial message), sent (s) and received (s) of message `index` of `port`, oldest first.
    fn stamp(&self, block: usize, port: usize, index: usize) -> [T; 3];
}

/// One step of every block. Lists of leaves are `[block][leaf]`.
pub struct BlockStep<'a, T> {
    /// How many blocks there are.
    pub blocks: usize,
    /// How many parameters, prepared numbers, leaves of the state and normal numbers each block has.
    pub widths: [usize; 4],
    /// Number, due time (s) and start (s) of the step.
    pub times: [f64; 3],
    /// The parameters.
    pub params: &'a [T],
    /// What the model has prepared of them.
    pub prepared: &'a [T],
    /// The states, to be replaced by the next ones.
    pub state: &'a mut [T],
    /// Standard normal numbers.
    pub noise: &'a [T],
    /// The ports.
    pub ports: &'a [BlockPort],
    /// The place of every message in its store: port after port, oldest first.
    pub places: &'a [u32],
    /// The messages.
    pub stores: &'a [BlockStore<T>],
    /// Their stamps.
    pub stamps: &'a dyn BlockStamps<T>,
    /// Where the outputs are written to.
    pub output: &'a mut BlockStore<T>,
    /// The place there.
    pub place: usize,
}

/// The inputs of one block, read as registers.
struct InBlock<'a, T, S> {
    block: usize,
    ports: &'a [BlockPort],
    places: &'a [u32],
    stores: &'a [BlockStore<T>],
    stamps: &'a dyn BlockStamps<T>,
    registers: PhantomData<S>,
}

impl<S: Simd, T: InMemory> StepInputs<T::On<S>> for InBlock<'_, T, S> {
    #[inline(always)]
    fn port(&self, name: &str) -> Option<usize> {
        self.ports.iter().position(|port| port.name == name)
    }
    #[inline(always)]
    fn window(&self, port: usize) -> usize {
        self.ports[port].window
    }
    #[inline(always)]
    fn stamp(&self, port: usize, index: usize) -> [T::On<S>; 3] {
        // Not `map`: what it calls would be compiled for the baseline.
        let [seq, sent, received] = self.stamps.stamp(self.block, port, index);
        [T::load::<S>(&seq), T::load::<S>(&sent), T::load::<S>(&received)]
    }
    #[inline(always)]
    fn payload(&self, port: usize, index: usize) -> &[T::On<S>] {
        let port = &self.ports[port];
        let place = self.places[port.first + index] as usize;
        T::registers::<S>(self.stores[port.store].message(self.block, place))
    }
}

/// All blocks' steps, to be compiled for every instruction set.
pub(super) struct BlockKernel<'a, 'b, M, T: Scalar> {
    pub(super) model: &'a M,
    pub(super) step: &'a mut BlockStep<'b, T>,
    pub(super) scratch: &'a mut Scratch<T>,
}

impl<M: FlatModel, T: InMemory> Kernel for BlockKernel<'_, '_, M, T> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let step = self.step;
        let mut unused = Scratch::default();
        let scratch = if M::USES_SCRATCH { self.scratch.of_registers() } else { &mut unused };
        // Not `map`, which stays a call in a large kernel.
        let [seq, due, start] = step.times;
        let times = [T::On::<S>::constant(seq), T::On::<S>::constant(due), T::On::<S>::constant(start)];
        let [params, prepared, state, noise] = step.widths;
        for block in 0..step.blocks {
            let inputs = InBlock {
                block,
                ports: step.ports,
                places: step.places,
                stores: step.stores,
                stamps: step.stamps,
                registers: PhantomData,
            };
            let seen = NodeStep::new(times, of_block::<S, T>(step.noise, noise, block), &inputs)
                .with_prepared(of_block::<S, T>(step.prepared, prepared, block));
            self.model.step::<T::On<S>>(
                of_block::<S, T>(step.params, params, block),
                T::registers_mut::<S>(&mut step.state[block * state..(block + 1) * state]),
                &seen,
                scratch,
                T::registers_mut::<S>(step.output.message_mut(block, step.place)),
            );
        }
    }
}

/// A block's part of a list, as registers.
#[inline(always)]
fn of_block<S: Simd, T: InMemory>(list: &[T], width: usize, block: usize) -> &[T::On<S>] {
    T::registers::<S>(&list[block * width..(block + 1) * width])
}
