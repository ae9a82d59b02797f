//! A node's mathematics inside a graph: from its state and the messages in its windows to the next state and a message.
//!
//! A [`NodeModel`] is written once, over any [`Scalar`]. A graph's runtimes hold it as an [`ErasedModel`], which steps
//! on plain numbers, steps on lanes, and writes itself down as a [`Program`] for windows of given sizes.
//!
//! The program has one flat form, which everything outside Rust binds to. Its inputs are, in order, `params.*`,
//! `state.*`, `step.seq`, `step.due` and `step.start` (s), `noise_0` and so on, and for every port, for every message of
//! its window from the oldest on, `inputs.PORT_i.seq` (−1 for an initial message), `inputs.PORT_i.sent` and
//! `inputs.PORT_i.received` (s) and `inputs.PORT_i.message.LEAF`. Its outputs are `state.*` and then `output.LEAF`.
//!
//! ```
//! use parallax_model::node_model::{ErasedModel, NodeModel, NodeStep, PortShape, Typed};
//! use parallax_model::{Scalar, Tree};
//!
//! #[derive(Tree)]
//! struct Angle<T> { angle: T }
//! #[derive(Tree)]
//! struct Gain<T> { gain: T }
//!
//! /// Passes the newest angle on, times a gain.
//! struct Amplifier;
//! impl NodeModel for Amplifier {
//!     const NAME: &'static str = "amplifier";
//!     type Params<T: Scalar> = Gain<T>;
//!     type State<T: Scalar> = ();
//!     type Output<T: Scalar> = Angle<T>;
//!     fn step<T: Scalar>(p: &Gain<T>, _: (), step: &NodeStep<'_, T>) -> ((), Angle<T>) {
//!         let seen = step.latest::<Angle<T>>("camera").message;
//!         ((), Angle { angle: seen.angle * p.gain })
//!     }
//! }
//!
//! let port = PortShape { name: "camera".into(), leaves: vec!["angle".into()], window: 1 };
//! let program = Typed::<Amplifier>::new().program(&[port]);
//! assert_eq!(program.inputs()[0], "params.gain");
//! assert_eq!(program.inputs()[7], "inputs.camera_0.message.angle");
//! assert_eq!(program.outputs(), ["output.angle"]);
//! ```

use std::any::Any;
use std::fmt;
use std::marker::PhantomData;

use crate::lanes::{F32x32, F64x16, InMemory, Kernel, Level, Simd};
use crate::program::{Program, Workspace};
use crate::scalar::Scalar;
use crate::trace::{Traced, trace_fn};
use crate::tree::{Tree, leaf_names};

/// A node's mathematics: pure, generic over the scalar. See the [module](self).
pub trait NodeModel: 'static {
    /// The model's name, which its program carries.
    const NAME: &'static str;
    /// How many numbers a step draws from the standard normal distribution.
    const NOISE: usize = 0;

    /// Constants that a fit may move.
    type Params<T: Scalar>: Tree<T>;
    /// What the node remembers from step to step.
    type State<T: Scalar>: Tree<T>;
    /// The message that every step sends.
    type Output<T: Scalar>: Tree<T>;

    /// One step: the state after it, and its message.
    fn step<T: Scalar>(
        params: &Self::Params<T>,
        state: Self::State<T>,
        step: &NodeStep<'_, T>,
    ) -> (Self::State<T>, Self::Output<T>);
}

/// Where a step's messages come from: a receiver's windows, a compiled graph's histories, a flat list.
pub trait StepInputs<T> {
    /// The place of the port called `name`.
    fn port(&self, name: &str) -> Option<usize>;
    /// How many messages its window has: always the connection's window, initial messages included.
    fn window(&self, port: usize) -> usize;
    /// Number (−1 for an initial message), sent (s) and received (s) of message `index` of `port`, oldest first.
    fn stamp(&self, port: usize, index: usize) -> [T; 3];
    /// The leaves of message `index` of `port`, oldest first.
    fn payload(&self, port: usize, index: usize) -> &[T];
}

/// One step, as a model sees it. Times are seconds since the run's start.
#[derive(Clone, Copy)]
pub struct NodeStep<'a, T> {
    /// The step's number, from 0.
    pub seq: T,
    /// When it was due, s.
    pub due: T,
    /// When it started, s.
    pub start: T,
    /// Independent standard normal numbers, [`NodeModel::NOISE`] of them.
    pub noise: &'a [T],
    inputs: &'a dyn StepInputs<T>,
}

impl<T: fmt::Debug> fmt::Debug for NodeStep<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeStep")
            .field("seq", &self.seq)
            .field("due", &self.due)
            .field("start", &self.start)
            .finish_non_exhaustive()
    }
}

impl<'a, T: Scalar> NodeStep<'a, T> {
    /// A step with number, due time and start (s), noise and messages.
    #[inline(always)]
    pub fn new([seq, due, start]: [T; 3], noise: &'a [T], inputs: &'a dyn StepInputs<T>) -> Self {
        Self { seq, due, start, noise, inputs }
    }

    /// How many messages the window of `port` has.
    ///
    /// # Panics
    ///
    /// When the kind of node has no such port: a mistake in the model itself.
    #[inline(always)]
    pub fn window(&self, port: &str) -> usize {
        self.inputs.window(self.find(port))
    }

    /// Message `index` of the window of `port`, oldest first.
    ///
    /// # Panics
    ///
    /// When there is no such port or message: a mistake in the model itself.
    #[inline(always)]
    pub fn message<M: Tree<T>>(&self, port: &str, index: usize) -> Seen<'a, T, M> {
        let port = self.find(port);
        Seen { message: M::read_from(self.inputs.payload(port, index)), inputs: self.inputs, port, index }
    }

    /// The newest message at `port`.
    ///
    /// # Panics
    ///
    /// When the kind of node has no such port: a mistake in the model itself.
    #[inline(always)]
    pub fn latest<M: Tree<T>>(&self, port: &str) -> Seen<'a, T, M> {
        let port = self.find(port);
        let index = self.inputs.window(port) - 1;
        Seen { message: M::read_from(self.inputs.payload(port, index)), inputs: self.inputs, port, index }
    }

    /// One leaf of the newest message at `port`, by its place.
    ///
    /// # Panics
    ///
    /// When there is no such port or leaf: a mistake in the model itself.
    #[inline(always)]
    pub fn leaf(&self, port: &str, leaf: usize) -> T {
        let port = self.find(port);
        self.inputs.payload(port, self.inputs.window(port) - 1)[leaf]
    }

    #[inline(always)]
    fn find(&self, port: &str) -> usize {
        match self.inputs.port(port) {
            Some(port) => port,
            None => panic!("the kind of node has no port `{port}`; add it with `NodeKind::input`"),
        }
    }
}

/// A message in a step's window.
#[derive(Clone, Copy)]
pub struct Seen<'a, T, M> {
    /// The payload.
    pub message: M,
    inputs: &'a dyn StepInputs<T>,
    port: usize,
    index: usize,
}

impl<T: Scalar, M> Seen<'_, T, M> {
    /// The sender's step that made it; −1 for an initial message.
    #[inline(always)]
    pub fn seq(&self) -> T {
        self.inputs.stamp(self.port, self.index)[0]
    }

    /// When it was sent, s; 0 for an initial message.
    #[inline(always)]
    pub fn sent(&self) -> T {
        self.inputs.stamp(self.port, self.index)[1]
    }

    /// When it arrived, s; 0 for an initial message.
    #[inline(always)]
    pub fn received(&self) -> T {
        self.inputs.stamp(self.port, self.index)[2]
    }

    /// Whether it is a message that was sent, not an initial one.
    #[inline(always)]
    pub fn was_sent(&self) -> T::Mask {
        self.seq().ge(T::constant(0.0))
    }
}

impl<T, M: fmt::Debug> fmt::Debug for Seen<'_, T, M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Seen").field("message", &self.message).finish_non_exhaustive()
    }
}

/// A port of a model as its graph connects it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortShape {
    /// The port's name.
    pub name: String,
    /// The leaves of its messages, in order.
    pub leaves: Vec<String>,
    /// How many messages a step sees.
    pub window: usize,
}

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
    fn of_registers<R: Scalar<Mask: Send + Sync> + Send + Sync>(&mut self) -> &mut Scratch<R> {
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

/// A model of which only the shape is known: what runtimes hold. Every [`FlatModel`] is one.
pub trait ErasedModel: Send + Sync {
    /// The model's name.
    fn name(&self) -> &str;
    /// The names of the parameters' leaves.
    fn params(&self) -> Vec<String>;
    /// The names of the state's leaves.
    fn state(&self) -> Vec<String>;
    /// The names of the message's leaves.
    fn output(&self) -> Vec<String>;
    /// How many standard normal numbers a step draws.
    fn noise(&self) -> usize;

    /// The model as a program, in the [module](self)'s flat form, for these ports.
    fn program(&self, ports: &[PortShape]) -> Program;

    /// One step on numbers: replaces `state` by the next and writes the message to `output`.
    ///
    /// # Panics
    ///
    /// When a slice has another length than the model's list of leaves.
    fn step_f64(
        &self,
        params: &[f64],
        state: &mut [f64],
        step: &NodeStep<'_, f64>,
        scratch: &mut Scratch<f64>,
        output: &mut [f64],
    );

    /// As [`step_f64`](Self::step_f64), for 16 nodes at once, on the widest instructions of this machine.
    ///
    /// # Panics
    ///
    /// As [`step_f64`](Self::step_f64).
    fn step_f64x16(
        &self,
        params: &[F64x16],
        state: &mut [F64x16],
        step: &NodeStep<'_, F64x16>,
        scratch: &mut Scratch<F64x16>,
        output: &mut [F64x16],
    );

    /// As [`step_f64x16`](Self::step_f64x16), for 32 nodes in single precision.
    ///
    /// # Panics
    ///
    /// As [`step_f64`](Self::step_f64).
    fn step_f32x32(
        &self,
        params: &[F32x32],
        state: &mut [F32x32],
        step: &NodeStep<'_, F32x32>,
        scratch: &mut Scratch<F32x32>,
        output: &mut [F32x32],
    );
}

/// One step of a model on lanes, to be compiled for every instruction set.
struct StepKernel<'a, 'b, M, T: Scalar> {
    model: &'a M,
    params: &'a [T],
    state: &'a mut [T],
    step: &'a NodeStep<'b, T>,
    scratch: &'a mut Scratch<T>,
    output: &'a mut [T],
}

impl<M: FlatModel, T: InMemory> Kernel for StepKernel<'_, '_, M, T> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let NodeStep { seq, due, start, noise, inputs } = self.step;
        let times = [T::load::<S>(seq), T::load::<S>(due), T::load::<S>(start)];
        let inputs = RegisterInputs::<T, S> { inputs: *inputs, registers: PhantomData };
        let step = NodeStep::new(times, T::registers::<S>(noise), &inputs);
        self.model.step::<T::On<S>>(
            T::registers::<S>(self.params),
            T::registers_mut::<S>(self.state),
            &step,
            self.scratch.of_registers(),
            T::registers_mut::<S>(self.output),
        );
    }
}

/// The inputs of lanes in memory, read as registers.
struct RegisterInputs<'a, T, S> {
    inputs: &'a dyn StepInputs<T>,
    registers: PhantomData<S>,
}

impl<S: Simd, T: InMemory> StepInputs<T::On<S>> for RegisterInputs<'_, T, S> {
    #[inline(always)]
    fn port(&self, name: &str) -> Option<usize> {
        self.inputs.port(name)
    }
    #[inline(always)]
    fn window(&self, port: usize) -> usize {
        self.inputs.window(port)
    }
    #[inline(always)]
    fn stamp(&self, port: usize, index: usize) -> [T::On<S>; 3] {
        self.inputs.stamp(port, index).map(|stamp| T::load::<S>(&stamp))
    }
    #[inline(always)]
    fn payload(&self, port: usize, index: usize) -> &[T::On<S>] {
        T::registers::<S>(self.inputs.payload(port, index))
    }
}

impl<M: FlatModel> ErasedModel for M {
    fn name(&self) -> &str {
        FlatModel::name(self)
    }
    fn params(&self) -> Vec<String> {
        FlatModel::params(self)
    }
    fn state(&self) -> Vec<String> {
        FlatModel::state(self)
    }
    fn output(&self) -> Vec<String> {
        FlatModel::output(self)
    }
    fn noise(&self) -> usize {
        FlatModel::noise(self)
    }

    fn program(&self, ports: &[PortShape]) -> Program {
        let (params, state, output) =
            (FlatModel::params(self), FlatModel::state(self), FlatModel::output(self));
        let (parameters, states, noise) = (params.len(), state.len(), FlatModel::noise(self));
        let inputs = program_inputs(&params, &state, noise, ports);
        let outputs: Vec<String> = state
            .iter()
            .map(|leaf| below("state", leaf))
            .chain(output.iter().map(|leaf| below("output", leaf)))
            .collect();
        trace_fn(FlatModel::name(self), &inputs, &outputs, |all| {
            let (params, rest) = all.split_at(parameters);
            let (state, rest) = rest.split_at(states);
            let (times, rest) = rest.split_at(3);
            let (noise, messages) = rest.split_at(noise);
            let messages = FlatInputs { ports, values: messages };
            let step = NodeStep::new([times[0], times[1], times[2]], noise, &messages);
            let mut next = state.to_vec();
            let mut message = vec![Traced::constant(0.0); output.len()];
            FlatModel::step(self, params, &mut next, &step, &mut Scratch::default(), &mut message);
            next.extend(message);
            next
        })
    }

    fn step_f64(
        &self,
        params: &[f64],
        state: &mut [f64],
        step: &NodeStep<'_, f64>,
        scratch: &mut Scratch<f64>,
        output: &mut [f64],
    ) {
        FlatModel::step(self, params, state, step, scratch, output);
    }

    fn step_f64x16(
        &self,
        params: &[F64x16],
        state: &mut [F64x16],
        step: &NodeStep<'_, F64x16>,
        scratch: &mut Scratch<F64x16>,
        output: &mut [F64x16],
    ) {
        Level::widest().run(StepKernel { model: self, params, state, step, scratch, output });
    }

    fn step_f32x32(
        &self,
        params: &[F32x32],
        state: &mut [F32x32],
        step: &NodeStep<'_, F32x32>,
        scratch: &mut Scratch<F32x32>,
        output: &mut [F32x32],
    ) {
        Level::widest().run(StepKernel { model: self, params, state, step, scratch, output });
    }
}

/// The names of a program's inputs, in the order of the flat form.
fn program_inputs(params: &[String], state: &[String], noise: usize, ports: &[PortShape]) -> Vec<String> {
    let mut names: Vec<String> = params.iter().map(|leaf| below("params", leaf)).collect();
    names.extend(state.iter().map(|leaf| below("state", leaf)));
    names.extend(["step.seq", "step.due", "step.start"].map(str::to_owned));
    names.extend((0..noise).map(|index| format!("noise_{index}")));
    for port in ports {
        for index in 0..port.window {
            let message = format!("inputs.{}_{index}", port.name);
            names.extend(["seq", "sent", "received"].map(|stamp| format!("{message}.{stamp}")));
            names.extend(port.leaves.iter().map(|leaf| below(&format!("{message}.message"), leaf)));
        }
    }
    names
}

/// `prefix.leaf`; a tree that is a single scalar has a leaf without a name.
fn below(prefix: &str, leaf: &str) -> String {
    if leaf.is_empty() { prefix.to_owned() } else { format!("{prefix}.{leaf}") }
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
