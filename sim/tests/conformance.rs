//! The simulated clock shows the behaviours that every executor must show.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_runtime::conformance::{ExecutorUnderTest, registry, suite};
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::recording::Recording;
use parallax_runtime::time::Nanos;
use parallax_sim::Executor;

struct Simulated {
    seed: u64,
}

impl ExecutorUnderTest for Simulated {
    fn run(&self, graph: &GraphSpec, duration: Nanos) -> Recording {
        let graph = graph.validate(&registry()).unwrap();
        Executor::new(graph, self.seed).record(duration).unwrap()
    }
}

#[test]
fn the_simulated_clock_conforms() {
    for seed in 0..5 {
        suite(&Simulated { seed });
    }
}
