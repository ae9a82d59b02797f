//! One suite of behaviours that every executor must show, whatever drives its clock.
//!
//! An executor is put behind [`ExecutorUnderTest`]; [`BEHAVIOURS`] then run small graphs of the nodes in [`registry`] on it
//! and judge the recordings. Real clocks wake up late, so a behaviour never asks for exact times: it asks that the
//! recorded schedule is one that the rules allow ([`verify`](crate::schedule::verify)), and that what the rules promise
//! can be seen in it.

mod behaviours;
mod nodes;

pub use behaviours::BEHAVIOURS;
pub use nodes::{IN, Number, registry};

use crate::graph::GraphSpec;
use crate::recording::Recording;
use crate::time::Nanos;

/// Runs graphs of the nodes in [`registry`].
pub trait ExecutorUnderTest {
    /// Runs `graph` for `duration` with [`registry`] and gives back what happened.
    fn run(&self, graph: &GraphSpec, duration: Nanos) -> Recording;
}

/// A behaviour: panics when the executor does not show it.
pub type Behaviour = fn(&dyn ExecutorUnderTest);

/// Runs all behaviours, one after the other, and names each that fails.
///
/// # Panics
///
/// When a behaviour is not shown.
pub fn suite(executor: &(impl ExecutorUnderTest + std::panic::RefUnwindSafe)) {
    let mut failed = Vec::new();
    for (name, behaviour) in BEHAVIOURS {
        if std::panic::catch_unwind(|| behaviour(executor)).is_err() {
            failed.push(*name);
        }
    }
    assert!(failed.is_empty(), "behaviours that the executor does not show: {}", failed.join(", "));
}
