//! A trained policy as a node: a multilayer perceptron from a safetensors file, which steps in microseconds and allocates
//! nothing.
//!
//! # The file
//!
//! Tensors, in the order in which `torch.nn.Linear` and others have them, as `F32` or `F64`:
//!
//! | name | shape |
//! |---|---|
//! | `layers.0.weight`, `layers.1.weight`, ... | outputs × inputs |
//! | `layers.0.bias`, ... | outputs; without one it is zero |
//!
//! Metadata (a safetensors header holds text only; lists are JSON, one number an observation or action):
//!
//! | key | meaning |
//! |---|---|
//! | `format` | `parallax-policy-1` |
//! | `activation` | after every layer but the last: `tanh`, `relu`, `leaky_relu` (0.01), `elu`, `swish` (or `silu`), `sigmoid`, `softplus`, `gelu` (its tanh form), `none` |
//! | `output_activation` | after the last layer; without it `none` |
//! | `observations` | names of the input message's leaves, in the order of the network's inputs; `sin(leaf)` and `cos(leaf)` may stand for an angle. Without it, all leaves but `stamp` |
//! | `actions` | names of the output message's leaves, in the order of the network's outputs. Without it, all leaves |
//! | `past_observations`, `past_actions` | how many earlier observations and actions the network sees; without them, none |
//! | `observation_mean`, `observation_std` | each input enters as `(value - mean) / std`: one number for each, the past ones included |
//! | `observation_clip` | a number: what enters is held within ± it |
//! | `action_scale`, `action_offset` | each action leaves as `output * scale + offset` |
//! | `action_low`, `action_high` | each action is held within these, after that |
//!
//! The network's inputs are the observations of this step, those of the steps before (newest first), and the actions that
//! were sent in the steps before (newest first, after scaling). In the first step the past observations are that step's own,
//! and the past actions are zero. `parallax.train` writes such files (`docs/training.md`); by hand, in Python:
//!
//! ```python
//! from safetensors.numpy import save_file
//! save_file({"layers.0.weight": w0, "layers.0.bias": b0, "layers.1.weight": w1, "layers.1.bias": b1}, "policy.safetensors",
//!           metadata={"format": "parallax-policy-1", "activation": "tanh", "observations": '["cos(angle)", "sin(angle)", "speed"]',
//!                     "action_scale": "[4.0]"})
//! ```
//!
//! All arithmetic is in double precision: the numbers are those of numpy in double precision to 1e-12.
//!
//! # The node
//!
//! ```toml
//! [[node]]
//! name = "agent"
//! kind = "pendulum/policy"
//! rate = 50.0
//! parameters = { file = "policy.safetensors" }
//! ```

mod file;
mod memory;
mod network;

use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use parallax_runtime::node::{Layout, Message, Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

pub use file::PolicyError;
pub use network::{Activation, Network};

use file::Source;
use memory::Memory;

/// What the policy sees.
pub const fn observation<M: Message>() -> Port<M> {
    Port::new("observation")
}

/// Parameters of the node in a graph.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// The safetensors file, relative to where the program runs.
    pub file: PathBuf,
}

/// A kind of policy, from messages `O` to messages `A`; its input is called `observation`.
pub fn kind<O: Message, A: Message>() -> NodeKind {
    NodeKind::new(|context| {
        let Parameters { file } = context.parameters()?;
        Policy::<O, A>::read(&file).map_err(|error| context.parameter_error(error.to_string()))
    })
    .input(observation::<O>())
}

/// A policy from messages `O` to messages `A`.
#[derive(Clone, Debug)]
pub struct Policy<O, A> {
    network: Network,
    observations: Box<[Source]>,
    /// Where each action goes in the output.
    actions: Box<[usize]>,
    memory: Memory,
    inputs: Box<[f64]>,
    outputs: Box<[f64]>,
    leaves: Box<[f64]>,
    messages: PhantomData<fn(O) -> A>,
}

impl<O: Message, A: Message> Policy<O, A> {
    /// Reads a policy from its file.
    ///
    /// # Errors
    ///
    /// [`PolicyError`] when the file is none, or does not fit the messages.
    pub fn read(path: &Path) -> Result<Self, PolicyError> {
        let file::Contents { network, observations, actions, past_observations, past_actions } =
            file::read(path, &Layout::of::<O>(), &Layout::of::<A>())?;
        Ok(Self {
            inputs: vec![0.0; network.inputs()].into(),
            outputs: vec![0.0; network.outputs()].into(),
            leaves: A::default().to_vec().into(),
            memory: Memory::new(observations.len(), past_observations, actions.len(), past_actions),
            network,
            observations,
            actions,
            messages: PhantomData,
        })
    }

    /// What the policy does about a message. One with a history remembers this step.
    ///
    /// # Errors
    ///
    /// [`NodeError::Failed`] when an observation is not finite: an action that follows from it would be none.
    pub fn act(&mut self, leaves: &[f64]) -> Result<A, NodeError> {
        let (present, past) = self.inputs.split_at_mut(self.observations.len());
        for (input, source) in present.iter_mut().zip(&self.observations) {
            *input = source.value(leaves);
            if !input.is_finite() {
                return Err(NodeError::failed(format!(
                    "the observation {} is {input}: the policy has no answer to that",
                    source.describe(&Layout::of::<O>())
                )));
            }
        }
        self.memory.read(present, past);
        self.network.evaluate(&self.inputs, &mut self.outputs);
        self.memory.remember(&self.inputs[..self.observations.len()], &self.outputs);
        for (leaf, action) in self.actions.iter().zip(&self.outputs) {
            self.leaves[*leaf] = *action;
        }
        Ok(A::read_from(&self.leaves))
    }
}

impl<O: Message, A: Message> Node for Policy<O, A> {
    type Output = A;

    fn step(&mut self, step: &Step<'_>) -> Result<A, NodeError> {
        // The newest message as leaves: nothing needs to be taken apart and put together again.
        match step
            .inputs()
            .first()
            .and_then(|input| Some(input.payload(input.stamps().len().checked_sub(1)?)))
        {
            Some(leaves) => self.act(leaves),
            None => self.act(&O::default().to_vec()),
        }
    }
}
