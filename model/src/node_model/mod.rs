//! A node's mathematics inside a graph: from its state and the messages in its windows to the next state and a message.
//!
//! A [`NodeModel`] is written once, over any [`Scalar`]. A graph's runtimes hold it as an [`ErasedModel`], which steps
//! on plain numbers, steps on many environments at once, and writes itself down as a [`Program`](crate::Program) for
//! windows of given sizes.
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

mod blocks;
mod erased;
mod flat;

use std::fmt;

pub use blocks::{BlockPort, BlockStamps, BlockStep, BlockStore};
pub use erased::ErasedModel;
pub use flat::{FlatInputs, FlatModel, Scratch, Typed};

use crate::dual::Dual;
use crate::scalar::Scalar;
use crate::tree::Tree;

/// A number with its derivatives in eight directions at once: what an [`ErasedModel`] is differentiated with. Eight fill
/// a register of the widest machines; more directions are further blocks.
pub type Directions = Dual<8>;

/// A node's mathematics: pure, generic over the scalar. See the [module](self).
pub trait NodeModel: 'static {
    /// The model's name, which its program carries.
    const NAME: &'static str;
    /// How many numbers a step draws from the standard normal distribution.
    const NOISE: usize = 0;
    /// How many numbers [`prepare`](Self::prepare) writes.
    const PREPARED: usize = 0;

    /// Constants that a fit may move.
    type Params<T: Scalar>: Tree<T>;
    /// What the node remembers from step to step.
    type State<T: Scalar>: Tree<T>;
    /// The message that every step sends.
    type Output<T: Scalar>: Tree<T>;

    /// What follows from the parameters alone, such as reciprocals: computed before the first step, and found by every
    /// step in [`NodeStep::prepared`].
    fn prepare<T: Scalar>(params: &Self::Params<T>, prepared: &mut [T]) {
        let _ = (params, prepared);
    }

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
    /// What [`NodeModel::prepare`] made of the parameters.
    pub prepared: &'a [T],
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
    /// A step with number, due time and start (s), noise and messages, of a model that prepares nothing.
    #[inline(always)]
    pub fn new([seq, due, start]: [T; 3], noise: &'a [T], inputs: &'a dyn StepInputs<T>) -> Self {
        Self { seq, due, start, noise, prepared: &[], inputs }
    }

    /// The same step with what the model has prepared.
    #[inline(always)]
    pub fn with_prepared(self, prepared: &'a [T]) -> Self {
        Self { prepared, ..self }
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
        Seen { message: read(self.inputs.payload(port, index)), inputs: self.inputs, port, index }
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
        Seen { message: read(self.inputs.payload(port, index)), inputs: self.inputs, port, index }
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

    /// Message `index` of the window of `port`, oldest first, for models whose messages are known only at run time: its number
    /// (−1 for an initial message), when it was sent and received (s), and its leaves.
    ///
    /// # Panics
    ///
    /// When there is no such port or message: a mistake in the model itself.
    #[inline(always)]
    pub fn raw(&self, port: &str, index: usize) -> ([T; 3], &'a [T]) {
        let port = self.find(port);
        (self.inputs.stamp(port, index), self.inputs.payload(port, index))
    }

    #[inline(always)]
    fn find(&self, port: &str) -> usize {
        match self.inputs.port(port) {
            Some(port) => port,
            None => panic!("the kind of node has no port `{port}`; add it with `NodeKind::input`"),
        }
    }
}

/// The tree of these leaves.
#[inline(always)]
fn read<T: Scalar, M: Tree<T>>(leaves: &[T]) -> M {
    assert_eq!(leaves.len(), M::LEAVES, "a message of another number of leaves than the model reads");
    let mut index = 0;
    M::build(&mut || {
        index += 1;
        leaves[index - 1].loaded()
    })
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
