//! Ready-made models and nodes.
//!
//! [`models`] holds the mathematics of robots: pure functions generic over the scalar.

pub mod models;
