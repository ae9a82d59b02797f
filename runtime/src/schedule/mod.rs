//! When a step runs and what it consumes.
//!
//! One pure state machine per node decides both: the [`StepGate`]. It is told what arrived, when steps began and ended,
//! and which senders died; it says what the next step waits for, and which messages a step sees. It reads no clock, does
//! no input or output, and allocates nothing after it was made. The wall clock, the simulated clock and replay drive the
//! same gate, so a schedule means the same everywhere. An [`Inbox`] is a gate with the payloads beside it.
//!
//! The rules:
//!
//! - Tick k is due at `phase + k / rate`. A step starts at the latest of: its due time plus shift, the end of the previous
//!   step, and for each blocking input the time from which the last message it waits for may be used.
//! - A blocking input of step k waits for, and sees, the messages up to the last one whose ideal send time
//!   (`sender phase + i / sender rate`) is not after the due time of k; with `skip`, not at it either. Every pair of steps
//!   that wait for each other is thereby ordered by due time, and among equal due times by the graph without its skipped
//!   connections, so no valid graph can block itself.
//! - A non-blocking input sees what may be used by the start; with `skip`, before the start.
//! - A message may be used from its arrival ([`JitterPolicy::Latest`](crate::graph::JitterPolicy)) or from its expected
//!   arrival, whichever is later ([`JitterPolicy::Buffer`](crate::graph::JitterPolicy)).
//! - An overrun is a step that ends after the next one was due. Under
//!   [`Scheduling::Frequency`](crate::graph::Scheduling) all later ticks shift by what it ran over; under
//!   [`Scheduling::Phase`](crate::graph::Scheduling) they do not. Waiting for a message shifts nothing by itself.
//! - A sender that is gone may have a safe output. It then stands at the end of the window as if it were a message, without
//!   a number, from the moment at which its receiver learns of it; what is waited for does not change by it.
//! - With `advance`, the due time is not waited for, unless a sender is dead: then nothing else would hold the node back.
//!
//! ```
//! use parallax_model::tree::Tree;
//! use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
//! use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
//! use parallax_runtime::registry::{NodeKind, Registry};
//! use parallax_runtime::schedule::{Inbox, Wait};
//!
//! #[derive(Tree, Clone, Default)]
//! struct Number { value: f64 }
//! impl Message for Number { const NAME: &'static str = "example/Number"; }
//! const IN: Port<Number> = Port::new("source");
//!
//! struct Echo;
//! impl Node for Echo {
//!     type Output = Number;
//!     fn step(&mut self, step: &Step<'_>) -> Result<Number, NodeError> {
//!         Ok(step.inputs().first().map_or(Number { value: 1.0 }, |_| step.latest(IN).message))
//!     }
//! }
//!
//! let registry = Registry::new()
//!     .with("source", NodeKind::new(|_| Ok(Echo)))
//!     .with("echo", NodeKind::new(|_| Ok(Echo)).input(IN));
//! let mut connection = ConnectionSpec::new("source", "echo");
//! connection.blocking = true;
//! let graph = GraphSpec {
//!     name: "example".into(),
//!     supervisor: "echo".into(),
//!     nodes: vec![NodeSpec::new("source", "source", 100.0), NodeSpec::new("echo", "echo", 100.0)],
//!     connections: vec![connection],
//!     plant: None,
//! }
//! .validate(&registry)?;
//!
//! let mut inbox = Inbox::new(&graph, 1);
//! assert_eq!(inbox.gate().ready(), Wait::Message { input: 0, seq: 0 });
//! inbox.arrive(0, 0, 0, 2_000, &[7.0])?;
//! assert_eq!(inbox.gate().ready(), Wait::Until(2_000));
//! let step = inbox.begin(2_000)?;
//! assert_eq!(step.latest(IN).message.value, 7.0);
//! inbox.end(5_000)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod gate;
mod inbox;
mod input;
mod verify;

pub use gate::{GateError, Resumption, StepGate, Wait};
pub use inbox::Inbox;
pub use input::{Account, Arrival};
pub use verify::{Deviation, DeviationKind, ScheduleCheck, verify};
