//! The graph of nodes: what runs, when it runs, how messages travel, and what is recorded.
//!
//! The key types:
//!
//! - [`GraphSpec`](graph::GraphSpec) is a graph as data, written with a [`GraphBuilder`](graph::GraphBuilder) or read from
//!   TOML; validated against a [`Registry`](registry::Registry) of the kinds of [`Node`](node::Node) that a program knows,
//!   it becomes a [`Graph`](graph::Graph).
//! - [`StepGate`](schedule::StepGate) decides when a node's steps run and what they consume, whatever clock drives it.
//! - [`Recording`](recording::Recording) is what happened: every message, and the schedule.
//!
//! ```
//! use parallax_model::tree::Tree;
//! use parallax_runtime::graph::GraphBuilder;
//! use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
//! use parallax_runtime::registry::{NodeKind, Registry};
//!
//! #[derive(Tree, Clone, Default)]
//! struct Angle { angle: f64 }
//! impl Message for Angle { const NAME: &'static str = "example/Angle"; }
//!
//! #[derive(Tree, Clone, Default)]
//! struct Torque { torque: f64 }
//! impl Message for Torque { const NAME: &'static str = "example/Torque"; }
//!
//! struct Camera;
//! impl Node for Camera {
//!     type Output = Angle;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
//!         Ok(Angle { angle: (step.start as f64 * 1e-9).sin() })
//!     }
//! }
//!
//! const CAMERA: Port<Angle> = Port::new("camera");
//! struct Agent;
//! impl Node for Agent {
//!     type Output = Torque;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Torque, NodeError> {
//!         Ok(Torque { torque: -2.0 * step.latest(CAMERA).message.angle })
//!     }
//! }
//!
//! let registry = Registry::new()
//!     .with("camera", NodeKind::new(|_| Ok(Camera)))
//!     .with("agent", NodeKind::new(|_| Ok(Agent)).input(CAMERA));
//! let mut graph = GraphBuilder::new("look and act");
//! let camera = graph.node::<Camera>("camera", "camera", 60.0).add();
//! let agent = graph.node::<Agent>("agent", "agent", 30.0).add();
//! graph.connect(camera, agent, CAMERA).blocking().window(2).add();
//! let graph = graph.supervisor(agent).validate(&registry)?;
//! assert_eq!(graph.order(), [0, 1]);
//! # Ok::<(), parallax_runtime::graph::GraphError>(())
//! ```

mod any_number;
pub mod channel;
pub mod clock;
#[cfg(feature = "conformance")]
pub mod conformance;
pub mod data;
pub mod delay;
pub mod doctor;
pub mod graph;
pub mod image;
pub mod import;
pub mod latency;
pub mod launch;
pub mod model_node;
pub mod node;
pub mod random;
pub mod recording;
pub mod registry;
pub mod schedule;
pub mod time;
pub mod tuning;
mod window;
