//! Parallax runs a robot as a graph of nodes, replays it exactly under a simulated clock, and says where simulation and
//! reality part, why, and how much of the gap a cause explains.
//!
//! This is the library face: one name for each of the crates that the program is made of, and [`command_line`], the program
//! itself, for a program of your own with nodes of your own (`parallax new node`).
//!
//! - [`model`]: what a node computes, and systems described by equations.
//! - [`runtime`]: graphs, schedules, processes and recordings.
//! - [`sim`]: graphs under a simulated clock, and replay.
//! - [`nodes`]: ready-made models and nodes.
//! - [`gap`]: the diagnosis.
//!
//! ```
//! use parallax::nodes::{pendulum, registry};
//! use parallax::sim::{Executor, ReplayOptions, replay};
//!
//! // One simulated second of a swing-up, recorded in memory, and every node run again on what it consumed.
//! let graph = pendulum::graph().validate(&registry())?;
//! let recording = Executor::new(graph, 7).record(1_000_000_000)?;
//! let report = replay(&recording, &registry(), &ReplayOptions::default())?;
//! assert!(report.is_exact());
//!
//! // The same run as named signals, as the diagnosis reads it.
//! let angle = recording.log().signal("camera.angle")?.values.clone();
//! assert_eq!(angle.len(), 100);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod cli;
mod plot;

pub use parallax_gap as gap;
pub use parallax_model as model;
pub use parallax_nodes as nodes;
pub use parallax_runtime as runtime;
pub use parallax_sim as sim;

/// The command line `parallax`, for the program that calls it: all commands, with the kinds of node that `own` adds to those that
/// come along. The launcher starts the same program again for every node of a run, so `main` should do nothing before.
///
/// ```no_run
/// use parallax::runtime::node::{Node, NodeError, Step};
/// use parallax::runtime::registry::NodeKind;
///
/// struct Still;
/// impl Node for Still {
///     type Output = parallax::nodes::pendulum::Voltage;
///     fn step(&mut self, _: &Step<'_>) -> Result<Self::Output, NodeError> {
///         Ok(Self::Output::default())
///     }
/// }
///
/// fn main() -> std::process::ExitCode {
///     parallax::command_line(|kinds| kinds.with("still", NodeKind::new(|_| Ok(Still))))
/// }
/// ```
pub fn command_line(
    own: fn(parallax_runtime::registry::Registry) -> parallax_runtime::registry::Registry,
) -> std::process::ExitCode {
    cli::main(own)
}

/// The pages of the documentation whose Rust is run, as it is shown there.
#[cfg(doctest)]
#[doc = include_str!("../docs/latency.md")]
#[doc = include_str!("../docs/real-time.md")]
pub struct Pages;
