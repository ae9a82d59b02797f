//! What a node computes, written once and read several ways.
//!
//! The key types: [`Scalar`], the number a model is generic over.

pub mod scalar;

pub use scalar::Scalar;
