//! What a node is to the runtime: a step from typed inputs to one typed output.
//!
//! A [`Node`] is written against its own message types; the runtime drives it as an [`ErasedNode`] that reads and
//! writes plain `f64` leaves. Nothing on the way allocates.
//!
//! ```
//! use parallax_model::tree::Tree;
//! use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
//!
//! #[derive(Tree, Clone, Default)]
//! struct Angle { angle: f64 }
//! impl Message for Angle { const NAME: &'static str = "example/Angle"; }
//!
//! const CAMERA: Port<Angle> = Port::new("camera");
//!
//! /// Averages the angles in its window.
//! struct Smoother;
//! impl Node for Smoother {
//!     type Output = Angle;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
//!         let window = step.window(CAMERA);
//!         let count = window.len() as f64;
//!         Ok(Angle { angle: window.map(|received| received.message.angle).sum::<f64>() / count })
//!     }
//! }
//! ```

use std::fmt;
use std::marker::PhantomData;

use parallax_model::tree::{Tree, leaf_names};
use rand_chacha::ChaCha8Rng;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::data::DataSpace;
use crate::random::{Purpose, fnv1a, stream};
use crate::tuning::Tuning;

mod step;

pub use step::{Consumed, Received, Step, Window};

pub use crate::window::InputWindow;

/// A node's own parameters: a table, as in `graph.toml`.
pub type Parameters = serde_json::Map<String, serde_json::Value>;

/// The payload of a message: a tree of `f64` leaves with a name.
///
/// A leaf called `stamp` (seconds since the run's start) says when the payload was true. Without one, the message
/// counts as of the time it was sent.
pub trait Message: Tree<f64> + Clone + Default + Send + 'static {
    /// Its name, `package/Name`: `pendulum/Angle`. It becomes the name of the recorded schema.
    const NAME: &'static str;
}

/// The shape of a message: two ends of a connection must agree on it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layout {
    /// The message's name.
    pub name: String,
    /// The names of its leaves, in order.
    pub leaves: Vec<String>,
}

impl Layout {
    /// The layout of `M`.
    pub fn of<M: Message>() -> Self {
        Self { name: M::NAME.to_owned(), leaves: leaf_names::<f64, M>() }
    }

    /// A hash of the name and the leaves, the same on every machine and in every version.
    pub fn hash(&self) -> u64 {
        // A newline cannot occur inside a name, so different layouts never give the same text.
        let mut text = self.name.clone();
        for leaf in &self.leaves {
            text.push('\n');
            text.push_str(leaf);
        }
        fnv1a(text.as_bytes())
    }

    /// Where the leaf `name` lies.
    pub fn leaf(&self, name: &str) -> Option<usize> {
        self.leaves.iter().position(|leaf| leaf == name)
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {{ {} }}", self.name, self.leaves.join(", "))
    }
}

/// One input of a kind of node, by name, carrying messages `M`. Declare it as a constant.
pub struct Port<M> {
    name: &'static str,
    message: PhantomData<fn() -> M>,
}

impl<M: Message> Port<M> {
    /// The input called `name`.
    pub const fn new(name: &'static str) -> Self {
        Self { name, message: PhantomData }
    }

    /// Its name.
    pub const fn name(self) -> &'static str {
        self.name
    }
}

impl<M> Clone for Port<M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for Port<M> {}

impl<M> fmt::Debug for Port<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Port").field(&self.name).finish()
    }
}

/// Why a node could not be built or a step could not be made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NodeError {
    /// The parameters in the graph are not what the kind of node understands.
    #[error("parameters of node `{node}`: {problem}; change them in the graph")]
    Parameters {
        /// The node.
        node: String,
        /// What is wrong.
        problem: String,
    },
    /// The node gave up.
    #[error("{0}")]
    Failed(String),
    /// The run is over for this node: nobody wants a further step of it, and that is no fault. A simulated run ends there; in
    /// real time the node waits for the end of the run, which whoever made it say so has to bring about.
    #[error("nobody wants a further step of it")]
    Over,
}

impl NodeError {
    /// The node gave up, for the reason in `message`.
    pub fn failed(message: impl Into<String>) -> Self {
        Self::Failed(message.into())
    }
}

/// A node: a state, and a step that runs at a rate.
///
/// `step` runs on the real-time path: it must not allocate, lock or wait.
pub trait Node: Send {
    /// What every step sends.
    type Output: Message;

    /// Makes one step.
    ///
    /// # Errors
    ///
    /// A node that cannot go on says why; it takes no further steps, and its receivers react as to a dead sender.
    fn step(&mut self, step: &Step<'_>) -> Result<Self::Output, NodeError>;

    /// The node takes no further steps, for whatever reason: a driver leaves its hardware in a safe state here. It is
    /// called once, also after a step that failed or panicked; it must not take long. Nothing can call it in a process
    /// that is killed: see `stop_after_crash` in the [launch settings](crate::launch::NodeLaunch).
    fn stop(&mut self, why: Stopping) {
        let _ = why;
    }

    /// What may be set, seen and reset of it while it runs: nothing, unless it says so.
    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        None
    }
}

/// Why a node takes no further steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stopping {
    /// The run is over, or somebody stopped it.
    Over,
    /// Its own step failed or panicked.
    Failed,
    /// A node that it waits for is gone.
    SenderGone,
    /// The launcher is gone.
    LauncherGone,
    /// An earlier process of this node was killed, and this one was started for nothing but to stop: no step was made.
    AfterCrash,
}

/// A node whose output is written as leaves: what executors drive. Every [`Node`] is one.
pub trait ErasedNode: Send {
    /// Makes one step and writes the output's leaves, in the order of its layout.
    ///
    /// # Errors
    ///
    /// As [`Node::step`].
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError>;

    /// As [`step_into`](Self::step_into), for nodes whose kind declares [data](crate::data).
    ///
    /// # Errors
    ///
    /// As [`Node::step`].
    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        let _ = data;
        self.step_into(step, output)
    }

    /// As [`Node::stop`].
    fn stop(&mut self, why: Stopping) {
        let _ = why;
    }

    /// As [`Node::tuning`].
    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        None
    }
}

impl<N: Node> ErasedNode for N {
    #[inline]
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        self.step(step)?.write_to(output);
        Ok(())
    }

    fn stop(&mut self, why: Stopping) {
        Node::stop(self, why);
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        Node::tuning(self)
    }
}

/// What a kind of node is told when a node is built.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeContext {
    /// The node's name in the graph.
    pub name: String,
    /// Its rate, Hz.
    pub rate: f64,
    /// The seed of the run. For random numbers use [`random`](Self::random), which is the node's own stream.
    pub seed: u64,
    /// Its parameters in the graph.
    pub parameters: Parameters,
}

impl NodeContext {
    /// The parameters as a type; give fields `#[serde(default)]` to make them optional and the struct
    /// `#[serde(deny_unknown_fields)]` to catch misspelt ones.
    ///
    /// # Errors
    ///
    /// [`NodeError::Parameters`] when they do not fit.
    pub fn parameters<P: DeserializeOwned>(&self) -> Result<P, NodeError> {
        serde_json::from_value(serde_json::Value::Object(self.parameters.clone()))
            .map_err(|error| self.parameter_error(error.to_string()))
    }

    /// An error about the parameters.
    pub fn parameter_error(&self, problem: impl Into<String>) -> NodeError {
        NodeError::Parameters { node: self.name.clone(), problem: problem.into() }
    }

    /// The node's own stream of random numbers: the same for one seed and name, whatever other nodes draw.
    pub fn random(&self) -> ChaCha8Rng {
        stream(self.seed, Purpose::Node, &self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Tree, Clone, Default, Debug, PartialEq)]
    struct Pair {
        left: f64,
        right: f64,
    }
    impl Message for Pair {
        const NAME: &'static str = "test/Pair";
    }
    const IN: Port<Pair> = Port::new("in");

    struct Swap;
    impl Node for Swap {
        type Output = Pair;
        fn step(&mut self, step: &Step<'_>) -> Result<Pair, NodeError> {
            let Pair { left, right } = step.latest(IN).message;
            Ok(Pair { left: right, right: left })
        }
    }

    #[test]
    fn an_erased_node_reads_and_writes_leaves() {
        let mut input = InputWindow::new("in", 2, 2);
        input.clear(0);
        input.push(Consumed::INITIAL, &[0.0, 0.0]);
        input.push(Consumed { seq: Some(4), sent: 1, received: 2 }, &[1.0, 2.0]);
        let inputs = [input];
        let step = Step::new(0, 3, 3, &inputs);
        let mut output = [0.0; 2];
        let node: &mut dyn ErasedNode = &mut Swap;
        node.step_into(&step, &mut output).unwrap();
        assert_eq!(output, [2.0, 1.0]);
        let seqs: Vec<_> = step.window(IN).map(|received| received.seq).collect();
        assert_eq!(seqs, [None, Some(4)]);
    }

    #[test]
    fn layouts_differ_by_name_leaf_and_order() {
        let layout = |name: &str, leaves: &[&str]| Layout {
            name: name.into(),
            leaves: leaves.iter().map(|leaf| (*leaf).into()).collect(),
        };
        let hash = layout("a", &["x", "y"]).hash();
        assert_ne!(hash, layout("a", &["y", "x"]).hash());
        assert_ne!(hash, layout("b", &["x", "y"]).hash());
        assert_ne!(hash, layout("a", &["xy"]).hash());
        assert_eq!(Layout::of::<Pair>(), layout("test/Pair", &["left", "right"]));
        // The hash is compared between programs: it must not change from build to build.
        assert_eq!(Layout::of::<Pair>().hash(), fnv1a(b"test/Pair\nleft\nright"));
    }

    #[test]
    #[should_panic(expected = "does not declare the port `other`")]
    fn an_undeclared_port_is_a_mistake_of_the_node() {
        Step::new(0, 0, 0, &[]).latest(Port::<Pair>::new("other"));
    }
}
