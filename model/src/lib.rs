//! What a node computes, written once and read several ways.
//!
//! The key types: [`Scalar`], the number a model is generic over.

// The derived code names this crate by its full path, also inside it.
extern crate self as parallax_model;

pub mod dual;
pub mod scalar;
pub mod system;
pub mod tree;

pub use dual::Dual;
pub use scalar::Scalar;
pub use tree::Tree;
