//! See the crate's description.

pub mod channel;
pub mod clock;
#[cfg(feature = "conformance")]
pub mod conformance;
pub mod delay;
pub mod graph;
pub mod import;
pub mod launch;
pub mod node;
pub mod random;
pub mod recording;
pub mod registry;
pub mod schedule;
pub mod time;
