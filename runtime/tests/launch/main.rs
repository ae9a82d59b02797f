//! Runs of real processes and threads, as a user sees them: what is recorded, what is reported, what stays behind.
//!
//! This program is its own node binary: under the hidden subcommand it runs a node.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod allocation;
#[cfg(feature = "conformance")]
mod conformance;
mod data;
mod failures;
mod faults;
mod nodes;
mod programs;
mod recorder;
mod resources;
mod runs;
mod safety;
mod settings;
mod strangers;
mod wall;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;

use parallax_runtime::launch::{NODE_COMMAND, node_main};

#[global_allocator]
static ALLOCATOR: allocation::Counting = allocation::Counting;

type Test = (&'static str, fn());

fn main() -> ExitCode {
    wall::obey();
    let mut arguments = std::env::args().skip(1);
    let first = arguments.next();
    if first.as_deref() == Some(NODE_COMMAND) {
        return node_main(arguments, &nodes::registry());
    }
    if first.as_deref() == Some(failures::LAUNCHER_COMMAND) {
        return failures::launcher(arguments);
    }
    if first.as_deref() == Some(safety::DRIVING_COMMAND) {
        return safety::drive(arguments);
    }
    if first.as_deref() == Some(resources::SMALL_COMMAND) {
        return resources::in_small_memory();
    }
    if first.as_deref() == Some(strangers::STRANGER_COMMAND) {
        return strangers::stranger(arguments);
    }
    if first.as_deref() == Some(programs::OTHER_COMMAND) {
        return programs::other(arguments);
    }
    if first.as_deref() == Some(wall::COMMAND) {
        return wall::jumping(arguments);
    }
    let filter = first.filter(|argument| !argument.starts_with('-')).unwrap_or_default();
    let mut tests: Vec<Test> = [
        runs::TESTS,
        settings::TESTS,
        failures::TESTS,
        faults::TESTS,
        resources::TESTS,
        recorder::TESTS,
        safety::TESTS,
        strangers::TESTS,
        wall::TESTS,
        allocation::TESTS,
        data::TESTS,
        programs::TESTS,
    ]
    .concat();
    #[cfg(feature = "conformance")]
    tests.extend(conformance::TESTS);
    let chosen: Vec<&Test> = tests.iter().filter(|(name, _)| name.contains(&filter)).collect();
    if std::env::args().any(|argument| argument == "--list") {
        chosen.iter().for_each(|(name, _)| println!("{name}: test"));
        return ExitCode::SUCCESS;
    }
    let mut failed = Vec::new();
    for (name, test) in &chosen {
        let before = nodes::shared_memory();
        let start = std::time::Instant::now();
        let passed = catch_unwind(AssertUnwindSafe(test)).is_ok();
        let took = start.elapsed().as_secs_f64();
        let clean = nodes::shared_memory() == before;
        println!("test {name} ... {} ({took:.1} s)", if passed && clean { "ok" } else { "FAILED" });
        if !clean {
            println!("  left in shared memory: {:?}", nodes::shared_memory());
        }
        if !(passed && clean) {
            failed.push(name);
        }
    }
    println!("{} passed, {} failed: {failed:?}", chosen.len() - failed.len(), failed.len());
    if failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
