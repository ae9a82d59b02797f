//! The wall clock shows the behaviours that every executor must show, with processes and with threads.

use parallax_runtime::conformance::{ExecutorUnderTest, registry, suite};
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::launch::{Mode, RunOptions, run};
use parallax_runtime::recording::Recording;
use parallax_runtime::time::Nanos;

use crate::Test;

pub(crate) const TESTS: &[Test] = &[
    ("processes_conform", || suite(&WallClock { mode: Mode::Processes })),
    ("threads_conform", || suite(&WallClock { mode: Mode::Threads })),
];

/// Runs graphs in real time and reads back what was recorded.
struct WallClock {
    mode: Mode,
}

impl ExecutorUnderTest for WallClock {
    fn run(&self, graph: &GraphSpec, duration: Nanos) -> Recording {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        let options = RunOptions {
            duration: Some(duration),
            recording: Some(path.clone()),
            mode: self.mode,
            // Where the system allows it: other programs on a busy machine then delay no step by much.
            real_time: true,
            ..RunOptions::default()
        };
        run(graph, &registry(), options).unwrap();
        Recording::read(&path).unwrap()
    }
}
