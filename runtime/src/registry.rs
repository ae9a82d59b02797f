//! The kinds of node that a program knows, by name.
//!
//! A graph names kinds, so that it can be written in a file and attached to a recording; the registry turns the names
//! into running nodes.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use parallax_model::node_model::NodeModel;
use parallax_model::tree::Tree;

use crate::data::{DataNode, Writing};
use crate::graph::{GraphSpec, NodeSpec, SafeOutput, SafeValue};
use crate::model_node::{ModelKind, ModelStart};
use crate::node::{ErasedNode, Layout, Message, Node, NodeContext, NodeError, Port};
use crate::tuning::Parameter;

/// An input that a kind of node declares.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputPort {
    /// Its name.
    pub name: String,
    /// The messages it takes.
    pub layout: Layout,
}

/// Builds a node from its context.
pub type Build = dyn Fn(&NodeContext) -> Result<Box<dyn ErasedNode>, NodeError> + Send + Sync;

/// A kind of node: its inputs, its output, and how to build one.
///
/// ```
/// # use parallax_model::tree::Tree;
/// # use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
/// # use parallax_runtime::registry::{NodeKind, Registry};
/// # #[derive(Tree, Clone, Default)] struct Angle { angle: f64 }
/// # impl Message for Angle { const NAME: &'static str = "example/Angle"; }
/// # const CAMERA: Port<Angle> = Port::new("camera");
/// # struct Hold { gain: f64 }
/// # impl Node for Hold {
/// #     type Output = Angle;
/// #     fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
/// #         Ok(Angle { angle: self.gain * step.latest(CAMERA).message.angle })
/// #     }
/// # }
/// #[derive(serde::Deserialize)]
/// #[serde(deny_unknown_fields)]
/// struct Parameters { gain: f64 }
///
/// let hold = NodeKind::new(|context| {
///     let Parameters { gain } = context.parameters()?;
///     Ok(Hold { gain })
/// })
/// .input(CAMERA);
/// let registry = Registry::new().with("example/hold", hold);
/// assert!(registry.get("example/hold").is_some());
/// ```
#[derive(Clone)]
pub struct NodeKind {
    inputs: Vec<InputPort>,
    output: Layout,
    initial: Vec<f64>,
    data: usize,
    safe: Option<SafeOutput>,
    deterministic: bool,
    stand_in: bool,
    model: Option<ModelKind>,
    build: Arc<Build>,
    /// For kinds of another program.
    external: Option<Arc<BuildExternal>>,
    /// For kinds that follow from their graph.
    by_graph: Option<Arc<MakeByGraph>>,
}

/// Puts a node into another one.
pub type Wrap = dyn Fn(&NodeContext, Box<dyn ErasedNode>) -> Box<dyn ErasedNode> + Send + Sync;

/// Makes the kind of one node of a graph: from the graph, the node, and the messages of other nodes by their names. The error
/// says what is wrong with the node.
pub type MakeByGraph =
    dyn Fn(&GraphSpec, &NodeSpec, &dyn Fn(&str) -> Option<Layout>) -> Result<NodeKind, String> + Send + Sync;

/// An input of a node of another program, as its graph connects it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExternalInput {
    /// The input.
    pub port: InputPort,
    /// How many messages a step sees.
    pub window: usize,
}

/// Builds a node of another program from its context, its inputs and its output.
pub type BuildExternal =
    dyn Fn(&NodeContext, &[ExternalInput], &Layout) -> Result<Box<dyn ErasedNode>, NodeError> + Send + Sync;

impl NodeKind {
    /// A kind whose nodes are built by `build`. It has no inputs yet, is deterministic, and its initial message is the
    /// output's default.
    pub fn new<N: Node + 'static>(
        build: impl Fn(&NodeContext) -> Result<N, NodeError> + Send + Sync + 'static,
    ) -> Self {
        Self::erased(Layout::of::<N::Output>(), N::Output::default().to_vec(), move |context| {
            Ok(Box::new(build(context)?))
        })
    }

    /// A kind whose messages have up to `most` bytes of [data](crate::data) beside their leaves.
    pub fn with_data<N: DataNode + 'static>(
        most: usize,
        build: impl Fn(&NodeContext) -> Result<N, NodeError> + Send + Sync + 'static,
    ) -> Self {
        Self::erased(Layout::of::<N::Output>(), N::Output::default().to_vec(), move |context| {
            Ok(Box::new(Writing(build(context)?)))
        })
        .data(most)
    }

    /// A kind known only by its layouts, such as one that calls another language. `initial` holds one value a leaf.
    ///
    /// # Panics
    ///
    /// When `initial` does not fit `output`.
    pub fn erased(
        output: Layout,
        initial: Vec<f64>,
        build: impl Fn(&NodeContext) -> Result<Box<dyn ErasedNode>, NodeError> + Send + Sync + 'static,
    ) -> Self {
        assert_eq!(output.leaves.len(), initial.len(), "the initial message of {output} has another length");
        Self {
            inputs: Vec::new(),
            output,
            initial,
            data: 0,
            safe: None,
            deterministic: true,
            stand_in: false,
            model: None,
            build: Arc::new(build),
            external: None,
            by_graph: None,
        }
    }

    /// A kind that another program runs, such as the interpreter of another language: its messages follow from the
    /// [graph](crate::graph). `build` is for that program; one that only starts, reads or replays graphs with such
    /// nodes never builds them, and says so in an error of its own.
    ///
    /// It counts as [not deterministic](Self::not_deterministic): its messages are taken from a recording, not made again.
    pub fn external(
        build: impl Fn(&NodeContext, &[ExternalInput], &Layout) -> Result<Box<dyn ErasedNode>, NodeError>
        + Send
        + Sync
        + 'static,
    ) -> Self {
        let unshaped = |_: &NodeContext| -> Result<Box<dyn ErasedNode>, NodeError> {
            Err(NodeError::failed("its messages are not known: no graph has been validated"))
        };
        let kind = Self::erased(Layout { name: String::new(), leaves: Vec::new() }, Vec::new(), unshaped);
        Self { external: Some(Arc::new(build)), ..kind }.not_deterministic()
    }

    /// A kind whose inputs, messages or model follow from a node's parameters and the nodes around it: `make` is called for
    /// every such node when its graph is validated.
    pub fn by_graph(
        make: impl Fn(&GraphSpec, &NodeSpec, &dyn Fn(&str) -> Option<Layout>) -> Result<NodeKind, String>
        + Send
        + Sync
        + 'static,
    ) -> Self {
        let unshaped = |_: &NodeContext| -> Result<Box<dyn ErasedNode>, NodeError> {
            Err(NodeError::failed("its messages are not known: no graph has been validated"))
        };
        let kind = Self::erased(Layout { name: String::new(), leaves: Vec::new() }, Vec::new(), unshaped);
        Self { by_graph: Some(Arc::new(make)), ..kind }
    }

    /// Whether it is known in a graph only.
    pub fn is_by_graph(&self) -> bool {
        self.by_graph.is_some()
    }

    /// What makes the kind of one node, where it is known in a graph only.
    pub(crate) fn maker(&self) -> Option<&MakeByGraph> {
        self.by_graph.as_deref()
    }

    /// Whether it is run by another program.
    pub fn is_external(&self) -> bool {
        self.external.is_some()
    }

    /// The kind with each node that it builds put into another one by `wrap`, such as one that waits before every step.
    #[must_use]
    pub fn around(self, wrap: Arc<Wrap>) -> Self {
        let Self { build, external, by_graph, .. } = self.clone();
        let around = wrap.clone();
        let build: Arc<Build> = Arc::new(move |context| Ok(around(context, build(context)?)));
        let around = wrap.clone();
        let external = external.map(|build| -> Arc<BuildExternal> {
            Arc::new(move |context, inputs, output| Ok(around(context, build(context, inputs, output)?)))
        });
        let by_graph = by_graph.map(|make| -> Arc<MakeByGraph> {
            Arc::new(move |graph, node, layout| Ok(make(graph, node, layout)?.around(wrap.clone())))
        });
        Self { build, external, by_graph, ..self }
    }

    /// An external kind whose messages are known.
    pub(crate) fn shaped(
        &self,
        inputs: Vec<ExternalInput>,
        output: Layout,
        initial: Vec<f64>,
        data: usize,
    ) -> Self {
        let mut kind = self.clone();
        if let Some(build) = &self.external {
            let (build, ports, sent) = (build.clone(), inputs.clone(), output.clone());
            kind.build = Arc::new(move |context| build(context, &ports, &sent));
        }
        kind.inputs = inputs.into_iter().map(|input| input.port).collect();
        (kind.output, kind.initial, kind.data) = (output, initial, data);
        kind
    }

    /// A kind whose nodes step the model `M`, so that they can also be compiled and run in batches. `start` reads a
    /// node's parameters in the graph and gives what the model starts with. The initial message is the output's
    /// default.
    ///
    /// ```
    /// # use parallax_model::node_model::{NodeModel, NodeStep};
    /// # use parallax_model::{Scalar, Tree};
    /// # use parallax_runtime::node::Message;
    /// # use parallax_runtime::registry::NodeKind;
    /// #[derive(Tree, Clone, Default)]
    /// struct Count<T = f64> { count: T }
    /// impl Message for Count { const NAME: &'static str = "example/Count"; }
    ///
    /// struct Counter;
    /// impl NodeModel for Counter {
    ///     const NAME: &'static str = "counter";
    ///     type Params<T: Scalar> = ();
    ///     type State<T: Scalar> = Count<T>;
    ///     type Output<T: Scalar> = Count<T>;
    ///     fn step<T: Scalar>(_: &(), state: Count<T>, _: &NodeStep<'_, T>) -> (Count<T>, Count<T>) {
    ///         let next = Count { count: state.count + 1.0 };
    ///         (Count { count: next.count }, next)
    ///     }
    /// }
    ///
    /// let kind = NodeKind::model::<Counter>(|_| Ok(((), Count { count: 0.0 })));
    /// assert!(kind.node_model().is_some());
    /// ```
    pub fn model<M: NodeModel>(
        start: impl Fn(&NodeContext) -> Result<(M::Params<f64>, M::State<f64>), NodeError> + Send + Sync + 'static,
    ) -> Self
    where
        M::Output<f64>: Message,
    {
        let kind = ModelKind::typed::<M>(move |context| {
            let (params, state) = start(context)?;
            Ok(ModelStart::of::<M>(&params, &state))
        });
        Self::from_model(Layout::of::<M::Output<f64>>(), M::Output::<f64>::default().to_vec(), kind)
    }

    /// A kind whose nodes step a model that is known only at run time.
    ///
    /// # Panics
    ///
    /// When `output` or `initial` does not fit the model's output.
    pub fn from_model(output: Layout, initial: Vec<f64>, kind: ModelKind) -> Self {
        assert_eq!(output.leaves, kind.model().output(), "the output of the model {}", kind.model().name());
        let model = kind.clone();
        let erased = Self::erased(output, initial, move |context| Ok(Box::new(kind.node(context)?)));
        Self { model: Some(model), ..erased }
    }

    /// Declares an input.
    #[must_use]
    pub fn input<M: Message>(self, port: Port<M>) -> Self {
        self.input_with_layout(port.name(), Layout::of::<M>())
    }

    /// Declares an input by its layout.
    #[must_use]
    pub fn input_with_layout(mut self, name: impl Into<String>, layout: Layout) -> Self {
        self.inputs.push(InputPort { name: name.into(), layout });
        self
    }

    /// Declares that messages have up to `most` bytes of [data](crate::data) beside their leaves. Shared memory is taken
    /// for so many, whatever a message then has.
    #[must_use]
    pub fn data(mut self, most: usize) -> Self {
        self.data = most;
        self
    }

    /// What receivers see before the first message has come.
    ///
    /// # Panics
    ///
    /// When `M` is not the kind's output.
    #[must_use]
    pub fn initial<M: Message>(mut self, message: &M) -> Self {
        assert_eq!(self.output, Layout::of::<M>(), "the initial message must be of the kind's output");
        self.initial = message.to_vec();
        self
    }

    /// What receivers are given when a node of this kind is gone, hangs or is too late: a command that does no harm. The
    /// graph or its launch settings may say otherwise.
    ///
    /// # Panics
    ///
    /// When `M` is not the kind's output.
    #[must_use]
    pub fn safe<M: Message>(mut self, message: &M) -> Self {
        assert_eq!(self.output, Layout::of::<M>(), "the safe output must be of the kind's output");
        self.safe = Some(SafeOutput::new(message.to_vec().into_iter().map(SafeValue::Number)));
        self
    }

    /// Marks the kind as one whose outputs do not follow from its inputs and seed alone: a driver of hardware, or a
    /// node that reads the clock. Replay compares it without expecting the same bits.
    #[must_use]
    pub fn not_deterministic(mut self) -> Self {
        self.deterministic = false;
        self
    }

    /// Marks the kind as standing in for hardware. Its messages are recorded for replay; the diagnosis never reads
    /// them, as it could not on a machine.
    #[must_use]
    pub fn stand_in(mut self) -> Self {
        self.stand_in = true;
        self
    }

    /// Declares a parameter of the kind's model that may be set while a node runs: `parallax set`. Other kinds say so with
    /// [`Node::tuning`].
    ///
    /// # Panics
    ///
    /// When the kind has no model, or its model has no parameter of this name.
    #[must_use]
    pub fn settable(mut self, parameter: Parameter) -> Self {
        let model = self.model.take();
        let model = model.unwrap_or_else(|| panic!("`{}`: the kind has no model", parameter.name));
        let model = model.with_settable(parameter);
        let kind = model.clone();
        self.build = Arc::new(move |context| Ok(Box::new(kind.node(context)?)));
        self.model = Some(model);
        self
    }

    /// The inputs, in the order in which steps see them.
    pub fn inputs(&self) -> &[InputPort] {
        &self.inputs
    }

    /// The layout of the output.
    pub fn output(&self) -> &Layout {
        &self.output
    }

    /// The leaves of the initial message.
    pub fn initial_message(&self) -> &[f64] {
        &self.initial
    }

    /// The most bytes of [data](crate::data) that a message has; 0 for messages without.
    pub fn data_capacity(&self) -> usize {
        self.data
    }

    /// What receivers are given when a node of this kind is gone, if the kind says so.
    pub fn safe_output(&self) -> Option<&SafeOutput> {
        self.safe.as_ref()
    }

    /// Whether equal inputs and an equal seed give equal outputs, bit for bit.
    pub fn is_deterministic(&self) -> bool {
        self.deterministic
    }

    /// Whether it stands in for hardware.
    pub fn is_stand_in(&self) -> bool {
        self.stand_in
    }

    /// The model that its nodes step; `None` for nodes that are plain Rust.
    pub fn node_model(&self) -> Option<&ModelKind> {
        self.model.as_ref()
    }

    /// Builds a node.
    ///
    /// # Errors
    ///
    /// What the kind says about its parameters.
    pub fn build(&self, context: &NodeContext) -> Result<Box<dyn ErasedNode>, NodeError> {
        (self.build)(context)
    }
}

impl fmt::Debug for NodeKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeKind")
            .field("inputs", &self.inputs)
            .field("output", &self.output)
            .field("deterministic", &self.deterministic)
            .field("stand_in", &self.stand_in)
            .finish_non_exhaustive()
    }
}

/// The kinds of node that a program knows.
#[derive(Debug, Clone, Default)]
pub struct Registry {
    kinds: BTreeMap<String, NodeKind>,
}

impl Registry {
    /// A registry that knows nothing.
    pub fn new() -> Self {
        Self::default()
    }

    /// The registry with one kind more. A kind of the same name is replaced, so that a program may bring its own.
    #[must_use]
    pub fn with(mut self, name: impl Into<String>, kind: NodeKind) -> Self {
        self.insert(name, kind);
        self
    }

    /// Adds a kind and returns the one that had this name before.
    pub fn insert(&mut self, name: impl Into<String>, kind: NodeKind) -> Option<NodeKind> {
        self.kinds.insert(name.into(), kind)
    }

    /// Adds everything that `other` knows.
    pub fn extend(&mut self, other: Registry) {
        self.kinds.extend(other.kinds);
    }

    /// The kind called `name`.
    pub fn get(&self, name: &str) -> Option<&NodeKind> {
        self.kinds.get(name)
    }

    /// The names of all kinds, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.kinds.keys().map(String::as_str)
    }
}
