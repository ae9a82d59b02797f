//! A graph written in Rust, with message types checked by the compiler.

use std::marker::PhantomData;

use parallax_model::node_model::NodeModel;

use super::{
    ConnectionSpec, GraphSpec, JitterPolicy, NodeSpec, OnDeadSender, PlantSpec, SafeValue, Scheduling,
};
use crate::data::DataNode;
use crate::delay::Delay;
use crate::node::{Layout, Message, Node, Port};

/// Builds a [`GraphSpec`]. A connection to a port of another message type does not compile.
///
/// ```
/// # use parallax_model::tree::Tree;
/// # use parallax_runtime::graph::GraphBuilder;
/// # use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
/// # #[derive(Tree, Clone, Default)] struct Angle { angle: f64 }
/// # impl Message for Angle { const NAME: &'static str = "example/Angle"; }
/// # #[derive(Tree, Clone, Default)] struct Torque { torque: f64 }
/// # impl Message for Torque { const NAME: &'static str = "example/Torque"; }
/// # struct Camera;
/// # impl Node for Camera {
/// #     type Output = Angle;
/// #     fn step(&mut self, _: &Step<'_>) -> Result<Angle, NodeError> { Ok(Angle::default()) }
/// # }
/// # struct Agent;
/// # impl Node for Agent {
/// #     type Output = Torque;
/// #     fn step(&mut self, _: &Step<'_>) -> Result<Torque, NodeError> { Ok(Torque::default()) }
/// # }
/// // `Camera` is a node that sends `Angle`, `Agent` one that has an input for it.
/// const CAMERA: Port<Angle> = Port::new("camera");
///
/// let mut graph = GraphBuilder::new("look and act");
/// let camera = graph.node::<Camera>("camera", "example/camera", 60.0).core(0).add();
/// let agent = graph.node::<Agent>("agent", "example/agent", 30.0).add();
/// graph.connect(camera, agent, CAMERA).blocking().window(2).add();
/// let spec = graph.supervisor(agent);
/// assert_eq!(spec.connections[0].window, 2);
/// ```
///
/// The other way round the message types do not fit:
///
/// ```compile_fail,E0308
/// # use parallax_model::tree::Tree;
/// # use parallax_runtime::graph::GraphBuilder;
/// # use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
/// # #[derive(Tree, Clone, Default)] struct Angle { angle: f64 }
/// # impl Message for Angle { const NAME: &'static str = "example/Angle"; }
/// # #[derive(Tree, Clone, Default)] struct Torque { torque: f64 }
/// # impl Message for Torque { const NAME: &'static str = "example/Torque"; }
/// # struct Camera;
/// # impl Node for Camera {
/// #     type Output = Angle;
/// #     fn step(&mut self, _: &Step<'_>) -> Result<Angle, NodeError> { Ok(Angle::default()) }
/// # }
/// # struct Agent;
/// # impl Node for Agent {
/// #     type Output = Torque;
/// #     fn step(&mut self, _: &Step<'_>) -> Result<Torque, NodeError> { Ok(Torque::default()) }
/// # }
/// const CAMERA: Port<Angle> = Port::new("camera");
///
/// let mut graph = GraphBuilder::new("look and act");
/// let camera = graph.node::<Camera>("camera", "example/camera", 60.0).core(0).add();
/// let agent = graph.node::<Agent>("agent", "example/agent", 30.0).add();
/// graph.connect(agent, camera, CAMERA).blocking().window(2).add();
/// ```
#[derive(Debug, Clone)]
pub struct GraphBuilder {
    spec: GraphSpec,
}

/// A node in a [`GraphBuilder`] that sends messages `M`.
pub struct NodeHandle<M> {
    index: usize,
    message: PhantomData<fn() -> M>,
}

impl<M> Clone for NodeHandle<M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for NodeHandle<M> {}

impl<M> std::fmt::Debug for NodeHandle<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("NodeHandle").field(&self.index).finish()
    }
}

impl GraphBuilder {
    /// An empty graph.
    pub fn new(name: impl Into<String>) -> Self {
        let name = name.into();
        Self {
            spec: GraphSpec {
                name,
                supervisor: String::new(),
                nodes: Vec::new(),
                connections: Vec::new(),
                plant: None,
            },
        }
    }

    /// Begins a node that runs `N` at `rate` Hz; `kind` is its key in the registry. Ends with [`NodeBuilder::add`].
    pub fn node<N: Node>(
        &mut self,
        name: impl Into<String>,
        kind: impl Into<String>,
        rate: f64,
    ) -> NodeBuilder<'_, N::Output> {
        NodeBuilder { graph: self, spec: NodeSpec::new(name, kind, rate), message: PhantomData }
    }

    /// Begins a node whose messages have [data](crate::data), with steps of `N` at `rate` Hz; `kind` is its key in the
    /// registry. Ends with [`NodeBuilder::add`].
    pub fn data_node<N: DataNode>(
        &mut self,
        name: impl Into<String>,
        kind: impl Into<String>,
        rate: f64,
    ) -> NodeBuilder<'_, N::Output> {
        NodeBuilder { graph: self, spec: NodeSpec::new(name, kind, rate), message: PhantomData }
    }

    /// Begins a node that steps the model `M` at `rate` Hz; `kind` is its key in the registry. Ends with
    /// [`NodeBuilder::add`].
    pub fn model<M: NodeModel>(
        &mut self,
        name: impl Into<String>,
        kind: impl Into<String>,
        rate: f64,
    ) -> NodeBuilder<'_, M::Output<f64>> {
        NodeBuilder { graph: self, spec: NodeSpec::new(name, kind, rate), message: PhantomData }
    }

    /// Begins a connection from one node to the input `port` of another. Ends with [`ConnectionBuilder::add`].
    pub fn connect<M: Message, N>(
        &mut self,
        from: NodeHandle<M>,
        to: NodeHandle<N>,
        port: Port<M>,
    ) -> ConnectionBuilder<'_> {
        let name = |index: usize| self.spec.nodes[index].name.clone();
        let mut spec = ConnectionSpec::new(name(from.index), name(to.index));
        if port.name() != spec.from {
            spec.port = Some(port.name().to_owned());
        }
        ConnectionBuilder { graph: self, spec }
    }

    /// Attaches the nominal simulator of the stretch that no node records: the text of a `system.toml`.
    pub fn plant(&mut self, system: impl Into<String>) {
        self.spec.plant = Some(PlantSpec { system: system.into() });
    }

    /// Names the supervisor and ends the graph.
    pub fn supervisor<M>(mut self, node: NodeHandle<M>) -> GraphSpec {
        self.spec.supervisor = self.spec.nodes[node.index].name.clone();
        self.spec
    }
}

/// A node being described.
#[derive(Debug)]
#[must_use = "a node is part of the graph only after `add`"]
pub struct NodeBuilder<'a, M> {
    graph: &'a mut GraphBuilder,
    spec: NodeSpec,
    message: PhantomData<fn() -> M>,
}

impl<M> NodeBuilder<'_, M> {
    /// Sets one of the kind's parameters.
    pub fn parameter(mut self, name: &str, value: impl Into<serde_json::Value>) -> Self {
        self.spec.parameters.insert(name.to_owned(), value.into());
        self
    }

    /// How long a step takes.
    pub fn computation(mut self, delay: Delay) -> Self {
        self.spec.computation = delay;
        self
    }

    /// What an overrun does to later ticks.
    pub fn scheduling(mut self, scheduling: Scheduling) -> Self {
        self.spec.scheduling = scheduling;
        self
    }

    /// Starts as soon as the blocking inputs are there.
    pub fn advance(mut self) -> Self {
        self.spec.advance = true;
        self
    }

    /// Pins it to a core.
    pub fn core(mut self, core: usize) -> Self {
        self.spec.core = Some(core);
        self
    }

    /// What it does when a node it waits for is gone.
    pub fn on_dead_sender(mut self, reaction: OnDeadSender) -> Self {
        self.spec.on_dead_sender = reaction;
        self
    }

    /// What its receivers are given when it is gone, hangs or is too late.
    pub fn safe(mut self, message: &M) -> Self
    where
        M: Message,
    {
        let values = message.to_vec().into_iter().map(SafeValue::Number);
        self.spec.safe = Some(Layout::of::<M>().leaves.into_iter().zip(values).collect());
        self
    }

    /// Adds it to the graph.
    pub fn add(self) -> NodeHandle<M> {
        self.graph.spec.nodes.push(self.spec);
        NodeHandle { index: self.graph.spec.nodes.len() - 1, message: PhantomData }
    }
}

/// A connection being described.
#[derive(Debug)]
#[must_use = "a connection is part of the graph only after `add`"]
pub struct ConnectionBuilder<'a> {
    graph: &'a mut GraphBuilder,
    spec: ConnectionSpec,
}

impl ConnectionBuilder<'_> {
    /// A step waits for the messages that belong to it.
    pub fn blocking(mut self) -> Self {
        self.spec.blocking = true;
        self
    }

    /// How many messages a step sees.
    pub fn window(mut self, messages: usize) -> Self {
        self.spec.window = messages;
        self
    }

    /// A message that arrives exactly at the start is left for the next step.
    pub fn skip(mut self) -> Self {
        self.spec.skip = true;
        self
    }

    /// How jitter is treated.
    pub fn jitter(mut self, policy: JitterPolicy) -> Self {
        self.spec.jitter = policy;
        self
    }

    /// How long a message travels.
    pub fn delay(mut self, delay: Delay) -> Self {
        self.spec.delay = delay;
        self
    }

    /// Adds it to the graph.
    pub fn add(self) {
        self.graph.spec.connections.push(self.spec);
    }
}
