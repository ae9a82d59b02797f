//! Parallax runs a robot as a graph of nodes, replays it exactly under a simulated clock, and says where simulation and
//! reality part, why, and how much of the gap a cause explains.
//!
//! This is the library face: one name for each of the crates that the program is made of.
//!
//! - [`model`]: what a node computes, and systems described by equations.
//! - [`runtime`]: graphs, schedules, processes and recordings.
//! - [`sim`]: graphs under a simulated clock, and replay.
//! - [`nodes`]: ready-made models and nodes.
//! - [`gap`]: the diagnosis.

pub use parallax_gap as gap;
pub use parallax_model as model;
pub use parallax_nodes as nodes;
pub use parallax_runtime as runtime;
pub use parallax_sim as sim;
