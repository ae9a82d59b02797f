//! Ready-made models and nodes.
//!
//! [`models`] holds the mathematics of robots: pure functions generic over the scalar. [`pendulum`] and [`quadrotor`]
//! are graphs of nodes around them, [`pid`] is a controller for any graph, [`equations`] makes a node from a
//! `system.toml`, [`estimator`] estimates where it is, [`playback`] commands what a file says, [`dynamixel`] drives servos,
//! [`policy`] steps a trained network. [`registry()`] names every kind of node and [`graph`] every graph.
//!
//! ```
//! use parallax_nodes::{pendulum, registry};
//!
//! let graph = pendulum::graph().validate(&registry()).unwrap();
//! assert_eq!(graph.nodes().len(), 5);
//! ```

pub mod command_file;
pub mod dynamixel;
pub mod equations;
pub mod estimator;
mod line;
pub mod models;
pub mod pendulum;
pub mod pid;
pub mod playback;
pub mod policy;
pub mod quadrotor;
mod registry;
mod stand_in;

pub use registry::{GRAPHS, graph, registry};
