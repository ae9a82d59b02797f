//! Starts and stops a graph over and over, and looks for what stays behind.
//!
//! ```sh
//! cargo run --release -p parallax-runtime --example soak -- 1000
//! ```
//!
//! Every third run is one of threads, and in every third a node is killed and comes back. Shared memory, descriptors,
//! threads, children and the memory of this process are counted before and after; more after than before is an error.

use std::process::ExitCode;
use std::time::Instant;

use parallax_model::tree::Tree;
use parallax_runtime::graph::{GraphBuilder, GraphSpec};
use parallax_runtime::launch::{LaunchSpec, NODE_COMMAND, NodeReport, RunOptions, RunReport, node_main, run};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::registry::{NodeKind, Registry};

#[derive(Tree, Clone, Default)]
struct Count<T = f64> {
    count: T,
}
impl Message for Count {
    const NAME: &'static str = "soak/Count";
}

/// Counts; a fragile one dies once, at its third step.
struct Counter {
    fragile: bool,
}
impl Node for Counter {
    type Output = Count;
    fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
        if self.fragile && step.seq == 3 {
            // SAFETY: the call takes an integer and ends this process, which is what is wanted.
            unsafe { libc::raise(libc::SIGKILL) };
        }
        Ok(Count { count: step.seq as f64 })
    }
}

const COUNTER: Port<Count> = Port::new("counter");
struct Echo;
impl Node for Echo {
    type Output = Count;
    fn step(&mut self, step: &Step<'_>) -> Result<Count, NodeError> {
        Ok(step.latest(COUNTER).message)
    }
}

fn registry() -> Registry {
    Registry::new()
        .with("counter", NodeKind::new(|_| Ok(Counter { fragile: false })))
        .with("fragile", NodeKind::new(|_| Ok(Counter { fragile: true })))
        .with("echo", NodeKind::new(|_| Ok(Echo)).input(COUNTER))
}

fn graph(kind: &str) -> GraphSpec {
    let mut graph = GraphBuilder::new("soak");
    let counter = graph.node::<Counter>("counter", kind, 500.0).add();
    let echo = graph.node::<Echo>("echo", "echo", 500.0).add();
    graph.connect(counter, echo, COUNTER).blocking().add();
    graph.supervisor(echo)
}

/// What this process holds: descriptors, threads, children, entries in shared memory; and KiB of memory.
fn held() -> ([usize; 4], usize) {
    let count = |folder: &str| std::fs::read_dir(folder).map_or(0, Iterator::count);
    let own = format!("{}-", std::process::id());
    let shared = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten().map(|entry| entry.path());
    let shared = shared
        .flat_map(|path| match path.is_dir() {
            true => {
                std::fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
            }
            false => vec![path],
        })
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().contains(&own)));
    let children = format!("/proc/self/task/{}/children", std::process::id());
    let children = std::fs::read_to_string(children).map_or(0, |text| text.split_whitespace().count());
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let memory = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let memory = memory.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok()).unwrap_or(0);
    ([count("/proc/self/fd"), count("/proc/self/task"), children, shared.count()], memory)
}

fn once(number: usize) -> Result<RunReport, Box<dyn std::error::Error>> {
    let (kind, settings) = match number % 3 {
        0 => ("counter", ""),
        1 => ("counter", "[defaults]\nrun_as = \"thread\"\n"),
        _ => ("fragile", "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.001\n"),
    };
    // A node that dies comes back in 40 ms or so.
    let duration = if kind == "fragile" { 150_000_000 } else { 10_000_000 };
    let options = RunOptions {
        duration: Some(duration),
        launch: LaunchSpec::from_toml("soak", settings)?,
        ..RunOptions::default()
    };
    Ok(run(&graph(kind), &registry(), options)?)
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let first = arguments.next();
    if first.as_deref() == Some(NODE_COMMAND) {
        return node_main(arguments, &registry());
    }
    let runs: usize = first.and_then(|runs| runs.parse().ok()).unwrap_or(1000);
    let (mut startups, mut restarts, mut failed) = (Vec::new(), 0, 0);
    // What is made once and kept is made by the first of each kind.
    (0..3).for_each(|number| drop(once(number)));
    let (before, start) = (held(), Instant::now());
    for number in 0..runs {
        match once(number) {
            Ok(report) if report.failure().is_none() => {
                startups.push(report.startup);
                restarts += report.nodes.iter().map(|NodeReport { restarts, .. }| restarts).sum::<u64>();
            }
            Ok(report) => {
                failed += 1;
                eprintln!("run {number}: {}", report.failure().unwrap_or_default());
            }
            Err(error) => {
                failed += 1;
                eprintln!("run {number}: {error}");
            }
        }
    }
    let after = held();
    startups.sort_unstable();
    let at = |share: usize| {
        startups
            .get((startups.len() * share / 100).min(startups.len().saturating_sub(1)))
            .copied()
            .unwrap_or(0)
    };
    println!("{runs} runs in {:.1} s, {failed} failed, {restarts} restarts", start.elapsed().as_secs_f64());
    let ms = |nanos: i64| nanos as f64 / 1e6;
    println!(
        "start-up: {:.1} ms at p50, {:.1} ms at p99, {:.1} ms at most",
        ms(at(50)),
        ms(at(99)),
        ms(at(100))
    );
    for (index, what) in ["descriptors", "threads", "children", "entries in shared memory"].iter().enumerate()
    {
        println!("{what}: {} before, {} after", before.0[index], after.0[index]);
    }
    println!("memory of this process: {} KiB before, {} KiB after", before.1, after.1);
    if failed == 0 && before.0 == after.0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
