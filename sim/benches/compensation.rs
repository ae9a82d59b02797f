//! What compensation is worth: mean squares of the errors of predicted and of filtered estimates at the time at which they act,
//! with 50 ms from a picture to the command that follows from it (figure 5b of the paper). Under the simulated clock, and in
//! real time with a process for each node.
//!
//! ```sh
//! cargo bench -p parallax-sim --bench compensation
//! ```

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench prints, and stops where it cannot go on"
)]

#[path = "../tests/support/delayed.rs"]
mod delayed;

use std::process::ExitCode;

use parallax_runtime::launch::{NODE_COMMAND, RunOptions, node_main, run};
use parallax_runtime::recording::Recording;
use parallax_runtime::time::SECOND;
use parallax_sim::Executor;

const SECONDS: i64 = 20;

fn main() -> ExitCode {
    // The launcher starts this program again for every node.
    let mut arguments = std::env::args().skip(1);
    if arguments.next().as_deref() == Some(NODE_COMMAND) {
        return node_main(arguments, &delayed::kinds());
    }
    let spec = delayed::graph();
    println!("{:<24} {:>10} {:>12} {:>12} {:>8}", "mean square error", "", "filtered", "predicted", "ratio");
    for seed in 1..=5 {
        let graph = spec.validate(&delayed::kinds()).unwrap();
        report(
            &format!("simulated, seed {seed}"),
            &Executor::new(graph, seed).record(SECONDS * SECOND).unwrap(),
        );
    }
    for turn in 1..=3 {
        let path = std::env::temp_dir().join(format!("compensation_{}_{turn}.mcap", std::process::id()));
        let options = RunOptions {
            duration: Some(SECONDS * SECOND),
            recording: Some(path.clone()),
            ..RunOptions::default()
        };
        let report_of_run = run(&spec, &delayed::kinds(), options).unwrap();
        if let Some(failure) = report_of_run.failure() {
            println!("real time, run {turn}: {failure}");
            return ExitCode::FAILURE;
        }
        report(&format!("real time, run {turn}"), &Recording::read(&path).unwrap());
        std::fs::remove_file(&path).unwrap();
    }
    ExitCode::SUCCESS
}

fn report(name: &str, recording: &Recording) {
    let (predicted, filtered) =
        (delayed::errors(recording, "estimator"), delayed::errors(recording, "filtered"));
    for (what, index) in [("rad^2", 0), ("rad^2/s^2", 1)] {
        let (p, f) = (predicted[index], filtered[index]);
        println!("{name:<24} {what:>10} {f:>12.3e} {p:>12.3e} {:>8.4}", p / f);
    }
}
