//! Nodes whose mathematics is a [`NodeModel`]: the same source runs here in real time, is compiled into graphs, and runs
//! in batches.

use std::fmt;
use std::sync::Arc;

use parallax_model::node_model::{ErasedModel, FlatModel, NodeModel, NodeStep, Scratch, StepInputs, Typed};
use parallax_model::tree::Tree;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::node::{ErasedNode, InputWindow, NodeContext, NodeError, Step};
use crate::time::to_seconds;
use crate::tuning::{Parameter, Tuning};

/// What a model node starts with.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelStart {
    /// The leaves of the model's parameters.
    pub params: Vec<f64>,
    /// The leaves of the state before the first step.
    pub state: Vec<f64>,
}

impl ModelStart {
    /// The leaves of typed parameters and state of the model `M`.
    pub fn of<M: NodeModel>(params: &M::Params<f64>, state: &M::State<f64>) -> Self {
        Self { params: params.to_vec(), state: state.to_vec() }
    }
}

/// Reads a node's parameters in the graph.
type Start = dyn Fn(&NodeContext) -> Result<ModelStart, NodeError> + Send + Sync;

/// A kind's model, and how a node of that kind starts.
#[derive(Clone)]
pub struct ModelKind {
    model: Arc<dyn ErasedModel>,
    start: Arc<Start>,
    /// Parameters that may be set while a node runs, each with its leaf.
    settable: Arc<[(Parameter, usize)]>,
}

impl fmt::Debug for ModelKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ModelKind").field("model", &self.model.name()).finish_non_exhaustive()
    }
}

impl ModelKind {
    /// The model `M`, whose nodes start as `start` says.
    pub fn typed<M: NodeModel>(
        start: impl Fn(&NodeContext) -> Result<ModelStart, NodeError> + Send + Sync + 'static,
    ) -> Self {
        Self::flat(Typed::<M>::new(), start)
    }

    /// A model that is known only at run time, whose nodes start as `start` says.
    pub fn flat(
        model: impl FlatModel,
        start: impl Fn(&NodeContext) -> Result<ModelStart, NodeError> + Send + Sync + 'static,
    ) -> Self {
        Self { model: Arc::new(model), start: Arc::new(start), settable: Arc::new([]) }
    }

    /// The kind with one more parameter that may be set while a node runs: the leaf of this name among the model's
    /// parameters.
    ///
    /// # Panics
    ///
    /// When the model has no such parameter: a mistake in the kind.
    #[must_use]
    pub fn with_settable(mut self, parameter: Parameter) -> Self {
        let leaf = self.model.params().iter().position(|name| *name == parameter.name);
        let leaf =
            leaf.unwrap_or_else(|| panic!("the model {} has no `{}`", self.model.name(), parameter.name));
        self.settable = self.settable.iter().cloned().chain([(parameter, leaf)]).collect();
        self
    }

    /// The model.
    pub fn model(&self) -> &Arc<dyn ErasedModel> {
        &self.model
    }

    /// What the node with this context starts with.
    ///
    /// # Errors
    ///
    /// What the kind says about the node's parameters in the graph.
    ///
    /// # Panics
    ///
    /// When the kind gives another number of leaves than its model has: a mistake in the kind.
    pub fn start(&self, context: &NodeContext) -> Result<ModelStart, NodeError> {
        let start = (self.start)(context)?;
        assert_eq!(
            start.params.len(),
            self.model.params().len(),
            "parameters of the model {}",
            self.model.name()
        );
        assert_eq!(start.state.len(), self.model.state().len(), "state of the model {}", self.model.name());
        Ok(start)
    }

    /// A node with this context.
    ///
    /// # Errors
    ///
    /// As [`start`](Self::start).
    pub fn node(&self, context: &NodeContext) -> Result<ModelNode, NodeError> {
        let ModelStart { params, state } = self.start(context)?;
        let mut prepared = vec![0.0; self.model.prepared()];
        self.model.prepare_f64(&params, &mut prepared);
        Ok(ModelNode {
            model: Arc::clone(&self.model),
            prepared: prepared.into(),
            params: params.into(),
            start: state.clone().into(),
            state: state.into(),
            settable: Arc::clone(&self.settable),
            noise: vec![0.0; self.model.noise()].into(),
            random: context.random(),
            scratch: Scratch::default(),
        })
    }
}

/// A node that steps a model on plain numbers.
pub struct ModelNode {
    model: Arc<dyn ErasedModel>,
    params: Box<[f64]>,
    prepared: Box<[f64]>,
    /// The state before the first step.
    start: Box<[f64]>,
    state: Box<[f64]>,
    settable: Arc<[(Parameter, usize)]>,
    noise: Box<[f64]>,
    random: ChaCha8Rng,
    scratch: Scratch<f64>,
}

impl fmt::Debug for ModelNode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ModelNode")
            .field("model", &self.model.name())
            .field("params", &self.params)
            .field("state", &self.state)
            .finish_non_exhaustive()
    }
}

impl ModelNode {
    /// The leaves of its parameters.
    pub fn params(&self) -> &[f64] {
        &self.params
    }

    /// The leaves of its state, after the last step.
    pub fn state(&self) -> &[f64] {
        &self.state
    }

    /// The standard normal numbers of the last step.
    pub fn noise(&self) -> &[f64] {
        &self.noise
    }
}

impl ErasedNode for ModelNode {
    #[inline]
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        for number in &mut self.noise {
            *number = StandardNormal.sample(&mut self.random);
        }
        let windows = Windows(step.inputs());
        let times = [step.seq as f64, to_seconds(step.due), to_seconds(step.start)];
        let step = NodeStep::new(times, &self.noise, &windows).with_prepared(&self.prepared);
        self.model.step_f64(&self.params, &mut self.state, &step, &mut self.scratch, output);
        Ok(())
    }

    fn tuning(&mut self) -> Option<&mut dyn Tuning> {
        Some(self)
    }
}

impl Tuning for ModelNode {
    fn parameters(&self) -> Vec<Parameter> {
        self.settable.iter().map(|(parameter, _)| parameter.clone()).collect()
    }

    fn value(&self, parameter: usize) -> f64 {
        self.params[self.settable[parameter].1]
    }

    fn set(&mut self, parameter: usize, value: f64) {
        self.params[self.settable[parameter].1] = value;
    }

    fn settle(&mut self) -> Result<(), String> {
        self.model.prepare_f64(&self.params, &mut self.prepared);
        Ok(())
    }

    fn state(&self) -> Vec<String> {
        self.model.state()
    }

    fn read_state(&self, values: &mut [f64]) {
        values.copy_from_slice(&self.state);
    }

    /// The random numbers go on where they are.
    fn reset(&mut self) {
        self.state.copy_from_slice(&self.start);
    }
}

/// A receiver's windows, as models read them.
#[derive(Clone, Copy, Debug)]
pub struct Windows<'a>(pub &'a [InputWindow]);

impl StepInputs<f64> for Windows<'_> {
    fn port(&self, name: &str) -> Option<usize> {
        self.0.iter().position(|input| input.port() == name)
    }
    fn window(&self, port: usize) -> usize {
        self.0[port].stamps().len()
    }
    fn stamp(&self, port: usize, index: usize) -> [f64; 3] {
        let stamp = &self.0[port].stamps()[index];
        [stamp.seq.map_or(-1.0, |seq| seq as f64), to_seconds(stamp.sent), to_seconds(stamp.received)]
    }
    fn payload(&self, port: usize, index: usize) -> &[f64] {
        self.0[port].payload(index)
    }
}
