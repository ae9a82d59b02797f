//! Running graphs for tests that look at them or speak to them.

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use parallax::runtime::launch::{LiveRun, Phase, RunReport};

pub(crate) fn parallax(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
    command.args(arguments);
    command
}

/// A run that does not outlive its test.
pub(crate) struct Run(Option<Child>);

impl Drop for Run {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            // The test has failed: its nodes end without their launcher.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Run {
    pub(crate) fn interrupt(&self) {
        let id = rustix::process::Pid::from_child(self.0.as_ref().unwrap());
        rustix::process::kill_process(id, rustix::process::Signal::INT).unwrap();
    }

    pub(crate) fn finish(mut self) -> RunReport {
        let output = self.0.take().unwrap().wait_with_output().unwrap();
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)))
    }
}

/// A run of a graph, and its name: the process of its launcher.
pub(crate) fn start(graph: &str, more: &[&str]) -> (Run, String) {
    let mut command = parallax(&["run", graph, "--json"]);
    let run = command.args(more).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let name = run.id().to_string();
    (Run(Some(run)), name)
}

pub(crate) fn eventually<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{what} does not come");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The run, once all its nodes make steps.
pub(crate) fn under_way(name: &str) -> LiveRun {
    let run = eventually("the run", || LiveRun::find(Some(name)).ok());
    eventually("the first steps", || {
        let sample = run.sample();
        let snapshot = run.snapshot(&sample, &sample);
        (snapshot.phase == Phase::Running && snapshot.nodes.iter().all(|node| node.steps > 5)).then_some(())
    });
    run
}
