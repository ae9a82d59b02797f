//! Models on flat lists of leaves.

use std::any::Any;
use std::fmt;
use std::marker::PhantomData;

use super::{NodeModel, NodeStep, PortShape, StepInputs};
use crate::program::Workspace;
use crate::scalar::Scalar;
use crate::tree::{Tree, leaf_names};

/// Memory that steps need, kept between them so that only the first one allocates.
#[derive(Debug)]
pub struct Scratch<T: Scalar> {
    /// For models that evaluate programs.
    pub workspace: Workspace<T>,
    /// Free for the model's use; what it holds between steps has no meaning.
    pub values: Vec<T>,
    /// The scratch of the registers that stand for `T` in a kernel.
    registers: Option<Box<dyn Any + Send + Sync>>,
}

impl<T: Scalar> Scratch<T> {
    pub(super) fn of_registers<R: Scalar<Mask: Send + Sync> + Send + Sync>(&mut self) -> &mut Scratch<R> {
        if !self.registers.as_ref().is_some_and(|scratch| scratch.is::<Scratch<R>>()) {
            self.registers = Some(Box::new(Scratch::<R>::default()));
        }
        let scratch = self.registers.as_mut().and_then(|scratch| scratch.downcast_mut());
        scratch.expect("it was just put there")
    }
}

impl<T: Scalar> Default for Scratch<T> {
    fn default() -> Self {
        Self { workspace: Workspace::new(), values: Vec::new(), registers: None }
    }
}

impl<T: Scalar> Clone for Scratch<T> {
    fn clone(&self) -> Self {
        Self { workspace: self.workspace.clone(), values: self.values.clone(), registers: None }
    }
}

/// A model on flat lists of leaves, for models whose shape is known only at run time, such as equations from a file.
/// Every [`NodeModel`] is one, through [`Typed`].
pub trait FlatModel: Send + Sync + 'static {
    /// Whether steps use their scratch. Where they do not, nobody looks for it.
    const USES_SCRATCH: bool = true;

    /// The model's name.
    fn name(&self) -> &str;
    /// The names of the parameters' leaves.
    fn params(&self) -> Vec<String>;
    /// The names of the state's leaves.
    fn state(&self) -> Vec<String>;
    /// The names of the message's leaves.
    fn output(&self) -> Vec<String>;
    /// How many standard normal numbers a step draws.
    fn noise(&self) -> usize {
        0
    }
    /// How many numbers [`prepare`](Self::prepare) writes.
    fn prepared(&self) -> usize {
        0
    }
    /// What follows from the parameters alone; every step finds it in [`NodeStep::prepared`].
    fn prepare<T: Scalar>(&self, params: &[T], prepared: &mut [T]) {
        let _ = (params, prepared);
    }
    /// One step: replaces `state` by the next and writes the message to `output`.
    fn step<T: Scalar>(
        &self,
        params: &[T],
        state: &mut [T],
        step: &NodeStep<'_, T>,
        scratch: &mut Scratch<T>,
        output: &mut [T],
    );
}

/// A [`NodeModel`] as a value.
pub struct Typed<M>(PhantomData<fn() -> M>);

impl<M> Typed<M> {
    /// The model `M`.
    pub const fn new() -> Self {
        Self(PhantomData)
    }
}

impl<M> Default for Typed<M> {
    fn default() -> Self {
        Self::new()
    }
}

impl<M: NodeModel> fmt::Debug for Typed<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Typed").field(&M::NAME).finish()
    }
}

impl<M: NodeModel> FlatModel for Typed<M> {
    const USES_SCRATCH: bool = false;

    fn name(&self) -> &str {
        M::NAME
    }
    fn params(&self) -> Vec<String> {
        leaf_names::<f64, M::Params<f64>>()
    }
    fn state(&self) -> Vec<String> {
        leaf_names::<f64, M::State<f64>>()
    }
    fn output(&self) -> Vec<String> {
        leaf_names::<f64, M::Output<f64>>()
    }
    fn noise(&self) -> usize {
        M::NOISE
    }
    fn prepared(&self) -> usize {
        M::PREPARED
    }
    fn prepare<T: Scalar>(&self, params: &[T], prepared: &mut [T]) {
        M::prepare(&M::Params::read_from(params), prepared);
    }
    #[inline(always)]
    fn step<T: Scalar>(
        &self,
        params: &[T],
        state: &mut [T],
        step: &NodeStep<'_, T>,
        _: &mut Scratch<T>,
        output: &mut [T],
    ) {
        let (next, message) = M::step(&M::Params::read_from(params), M::State::read_from(state), step);
        next.write_to(state);
        message.write_to(output);
    }
}

/// Messages in the order of a program's inputs: per port, per message, three stamps and the leaves.
#[derive(Clone, Copy, Debug)]
pub struct FlatInputs<'a, T> {
    /// The ports.
    pub ports: &'a [PortShape],
    /// What the ports hold, in order.
    pub values: &'a [T],
}

impl<'a, T> FlatInputs<'a, T> {
    /// Stamps and leaves of one message.
    fn message(&self, port: usize, index: usize) -> &'a [T] {
        let before: usize = self.ports[..port].iter().map(|port| port.window * (3 + port.leaves.len())).sum();
        let size = 3 + self.ports[port].leaves.len();
        &self.values[before + index * size..before + (index + 1) * size]
    }
}

impl<T: Scalar> StepInputs<T> for FlatInputs<'_, T> {
    fn port(&self, name: &str) -> Option<usize> {
        self.ports.iter().position(|port| port.name == name)
    }
    fn window(&self, port: usize) -> usize {
        self.ports[port].window
    }
    fn stamp(&self, port: usize, index: usize) -> [T; 3] {
        let message = self.message(port, index);
        [message[0], message[1], message[2]]
    }
    fn payload(&self, port: usize, index: usize) -> &[T] {
        &self.message(port, index)[3..]
    }
}
