//! `parallax top`: a running graph as it is now.

mod page;
mod screen;

use std::collections::VecDeque;
use std::io::IsTerminal;
use std::time::Duration;

use anyhow::anyhow;
use clap::Args;
use parallax_runtime::launch::signals::Signals;
use parallax_runtime::launch::{End, LiveError, LiveRun, Phase, Sample, Snapshot, live_runs};
use parallax_runtime::time::{Nanos, to_seconds};

use super::args::duration;
use super::failure::{Failure, Outcome, Sort};
use super::output;

/// It only reads what the nodes write into shared memory anyhow: the graph does not notice.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The run: its id, the process of its launcher, or the name of its graph. Without it, the only one.
    run: Option<String>,
    /// How often to look.
    #[arg(long, value_name = "SECONDS", value_parser = duration, default_value = "1")]
    interval: Nanos,
    /// The time that rates and percentiles are those of, on the screen.
    #[arg(long, value_name = "SECONDS", value_parser = duration, default_value = "5")]
    window: Nanos,
    /// Print the table once, for the next interval, and end.
    #[arg(long)]
    once: bool,
    /// Print one snapshot as JSON, for the next interval, and end; times are in nanoseconds.
    #[arg(long)]
    json: bool,
    /// List the running graphs and end.
    #[arg(long)]
    list: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if arguments.list {
        return list(arguments.json);
    }
    let run = LiveRun::find(arguments.run.as_deref()).map_err(sort)?;
    if arguments.json || arguments.once {
        let before = run.sample();
        std::thread::sleep(Duration::from_nanos(arguments.interval.unsigned_abs()));
        let snapshot = run.snapshot(&before, &run.sample());
        if arguments.json {
            output::json(&snapshot)?;
        } else {
            page::lines(&snapshot).iter().for_each(|line| output::line(line.text()));
        }
        return Ok(Outcome::Done);
    }
    let signals = Signals::watch().runtime()?;
    let mut past = Past { samples: VecDeque::new(), window: arguments.window };
    let end = if std::io::stdout().is_terminal() {
        screen::show(&run, &mut past, arguments.interval, &signals).runtime()?
    } else {
        print(&run, &mut past, arguments.interval, &signals)
    };
    match end {
        Stopped::Left => Ok(Outcome::Done),
        Stopped::Signal => Ok(Outcome::Interrupted),
        Stopped::Over(last) => {
            page::lines(&last).iter().for_each(|line| output::line(line.text()));
            output::line(over(&last));
            Ok(Outcome::Done)
        }
    }
}

/// Why it does not look any longer.
enum Stopped {
    /// The user has seen enough.
    Left,
    /// A signal came.
    Signal,
    /// The run is over; the last look at it.
    Over(Box<Snapshot>),
}

fn list(json: bool) -> Result<Outcome, Failure> {
    let runs = live_runs().runtime()?;
    if json {
        output::json(&runs)?;
        return Ok(Outcome::Done);
    }
    let row = |run: &parallax_runtime::launch::RunName| {
        vec![run.id.clone(), run.graph.clone(), run.launcher.to_string(), run.nodes.join(", ")]
    };
    let rows: Vec<Vec<String>> = runs.iter().map(row).collect();
    output::table(&["run", "graph", "launcher", "nodes"], &rows);
    Ok(Outcome::Done)
}

/// What was asked for is not there; or shared memory is not.
pub(crate) fn sort(error: LiveError) -> Failure {
    match error {
        LiveError::Channel(_) => Failure::runtime(error),
        _ => Failure::input(anyhow!(error)),
    }
}

/// The samples of the last seconds.
struct Past {
    samples: VecDeque<Sample>,
    window: Nanos,
}

impl Past {
    /// Looks once more; gives what happened in the window that ends now.
    fn look(&mut self, run: &LiveRun) -> Snapshot {
        let now = run.sample();
        // The oldest sample that is still in the window, or the newest before it.
        while self.samples.get(1).is_some_and(|next| now.time() - next.time() >= self.window) {
            self.samples.pop_front();
        }
        let snapshot = run.snapshot(self.samples.front().unwrap_or(&now), &now);
        self.samples.push_back(now);
        snapshot
    }
}

/// Whether nothing more is to come.
fn is_over(phase: Phase) -> bool {
    matches!(phase, Phase::Over | Phase::Abandoned)
}

/// Prints a table at each interval, where there is no terminal to draw on.
fn print(run: &LiveRun, past: &mut Past, interval: Nanos, signals: &Signals) -> Stopped {
    past.look(run);
    loop {
        let mut left = interval;
        while left > 0 && !signals.raised() && !is_over(run.phase()) {
            let nap = left.min(50_000_000);
            std::thread::sleep(Duration::from_nanos(nap.unsigned_abs()));
            left -= nap;
        }
        let snapshot = past.look(run);
        if signals.raised() {
            return Stopped::Signal;
        }
        if is_over(snapshot.phase) {
            return Stopped::Over(Box::new(snapshot));
        }
        page::lines(&snapshot).iter().for_each(|line| output::line(line.text()));
        output::line("");
    }
}

/// The last line: that the run is over, and why.
fn over(last: &Snapshot) -> String {
    let why = match (&last.end, last.phase) {
        (_, Phase::Abandoned) | (None, _) => "its launcher is gone".into(),
        (Some(End::Duration), _) => "its time was over".into(),
        (Some(End::Signal), _) => "somebody stopped it".into(),
        (Some(End::Node { node }), _) => format!("node {node} ended"),
        (Some(End::Host { .. }), _) => "another machine ended, or is gone".into(),
        (Some(End::Link { .. }), _) => "the link to the other machines failed".into(),
    };
    format!("{} ({}) has ended after {:.1} s: {why}", last.graph, last.run, to_seconds(last.elapsed.max(0)))
}
