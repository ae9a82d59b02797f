//! Ready-made models and nodes.
//!
//! [`models`] holds the mathematics of robots: pure functions generic over the scalar. [`pendulum`] is a graph of nodes
//! around a simulated world, [`pid`] a controller for any graph. [`registry()`] names every kind of node.
//!
//! ```
//! use parallax_nodes::{pendulum, registry};
//!
//! let graph = pendulum::graph().validate(&registry()).unwrap();
//! assert_eq!(graph.nodes().len(), 5);
//! ```

pub mod models;
pub mod pendulum;
pub mod pid;
mod registry;

pub use registry::registry;
