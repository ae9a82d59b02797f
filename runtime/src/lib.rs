//! See the crate's description.

pub mod channel;
pub mod import;
pub mod recording;
