//! Derives `Tree`.
