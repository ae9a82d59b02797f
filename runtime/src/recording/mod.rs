//! Messages and schedule of one run.

pub mod log;
