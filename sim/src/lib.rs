//! The graph under a simulated clock, and replay of what was recorded.
//!
//! The key types: an [`Executor`] runs a graph on simulated time, with delays drawn from the given distributions; it
//! drives the same gates and the same nodes as the wall clock does. [`replay`] runs the nodes of a
//! [`Recording`](parallax_runtime::recording::Recording) again on exactly what they consumed, compares their outputs bit
//! for bit, and holds the recorded schedule against the rules; a [`ReplayReport`] says what it found.
//!
//! An [`Episode`] is the timing of a run alone: [`generate`] draws one without running a node, [`augment`] puts simulator
//! nodes into one, and [`compiled`] turns a graph and its episodes into tables that accelerators run. [`identify`](mod@identify)
//! finds parameters, first states and hidden delays from recordings.
//!
//! ```
//! use parallax_model::tree::Tree;
//! use parallax_runtime::delay::Delay;
//! use parallax_runtime::graph::GraphBuilder;
//! use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
//! use parallax_runtime::registry::{NodeKind, Registry};
//! use parallax_sim::{Executor, ReplayOptions, replay};
//!
//! #[derive(Tree, Clone, Default)]
//! struct Count { value: f64 }
//! impl Message for Count { const NAME: &'static str = "example/Count"; }
//!
//! struct Counter;
//! impl Node for Counter {
//!     type Output = Count;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
//!         Ok(Count { value: step.seq as f64 })
//!     }
//! }
//!
//! const COUNTER: Port<Count> = Port::new("counter");
//! struct Doubler;
//! impl Node for Doubler {
//!     type Output = Count;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
//!         Ok(Count { value: 2.0 * step.latest(COUNTER).message.value })
//!     }
//! }
//!
//! let registry = Registry::new()
//!     .with("counter", NodeKind::new(|_| Ok(Counter)))
//!     .with("doubler", NodeKind::new(|_| Ok(Doubler)).input(COUNTER));
//! let mut graph = GraphBuilder::new("doubling");
//! let counter = graph.node::<Counter>("counter", "counter", 100.0).add();
//! let doubler = graph.node::<Doubler>("doubler", "doubler", 50.0).add();
//! let delay = Delay::Normal { mean: 0.004, std: 0.001 };
//! graph.connect(counter, doubler, COUNTER).blocking().delay(delay).add();
//! let graph = graph.supervisor(doubler).validate(&registry)?;
//!
//! let recording = Executor::new(graph, 7).record(2_000_000_000)?;
//! assert_eq!(recording.node("counter").unwrap().steps.len(), 200);
//! let report = replay(&recording, &registry, &ReplayOptions::default())?;
//! assert!(report.is_exact());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod augment;
pub mod batch;
mod changes;
pub mod compiled;
pub mod delays;
pub mod episode;
mod event;
mod executor;
mod generate;
pub mod identify;
mod outcome;
mod replay;
pub mod supergraph;
mod trajectory;

pub use changes::{ChangePlan, ChangesError};
pub use episode::Episode;
pub use executor::Executor;
pub use generate::{generate, generate_many};
pub use outcome::{ConnectionAccount, Outcome, SimError};
pub use replay::{Difference, NodeReplay, Override, ReplayError, ReplayOptions, ReplayReport, replay};
pub use trajectory::{NodeTrajectory, trajectories};
