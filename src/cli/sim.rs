//! `parallax sim`: a graph under a simulated clock.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use indicatif::ProgressBar;
use parallax_runtime::data::Data;
use parallax_runtime::recording::{
    Change, Description, Fault, Loss, NoSink, Recording, RecordingSink, RecordingWriter, SinkError, StepView,
};
use parallax_runtime::time::{Nanos, to_seconds};
use parallax_sim::{ChangePlan, Executor, SimError};
use serde_json::json;

use super::args::{NodeChange, Play, duration, graph_spec, make_parent, validate_with};
use super::failure::{Failure, Outcome, Sort};
use super::{output, python};

#[derive(Args)]
pub(crate) struct Arguments {
    /// A graph.toml, or `pendulum`, `pendulum-simulated` or `quadrotor-simulated`.
    graph: String,
    /// Simulated seconds.
    #[arg(long, value_name = "SECONDS", default_value = "20", value_parser = duration, allow_negative_numbers = true)]
    duration: Nanos,
    /// Seed of all randomness: one seed gives one run, bit for bit.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The recording to write.
    #[arg(long, value_name = "FILE.mcap")]
    out: Option<PathBuf>,
    /// Simulated seconds a second; without it, as fast as possible.
    #[arg(long, value_name = "FACTOR", allow_negative_numbers = true)]
    real_time_factor: Option<f64>,
    /// Change a node: its rate, core or a parameter of its kind.
    #[arg(long = "node", value_name = "NODE.KEY=VALUE")]
    changes: Vec<NodeChange>,
    /// Let a node send what a command file says (CSV: time,NODE.LEAF), such as `parallax experiment` writes.
    #[arg(long, value_name = "NODE=FILE")]
    play: Vec<Play>,
    /// Set parameters and reset states in the middle of the run: a plan (TOML: [[change]] node, step or time, set or reset),
    /// or a recording whose changes are made again before the same steps.
    #[arg(long = "changes", value_name = "FILE.toml|FILE.mcap")]
    plan: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let spec = graph_spec(&arguments.graph, &arguments.changes, &arguments.play)?;
    let folder =
        Path::new(&arguments.graph).parent().filter(|_| parallax_nodes::graph(&arguments.graph).is_none());
    let registry = python::simulated(&spec, folder).map_err(Failure::input)?;
    let graph = validate_with(&spec, &registry)?;
    let mut executor = Executor::new(graph, arguments.seed);
    if let Some(factor) = arguments.real_time_factor {
        executor = executor.real_time_factor(factor);
    }
    if let Some(path) = &arguments.plan {
        executor = executor.changes(plan(path)?);
    }
    let bar = output::progress("simulating", arguments.duration.unsigned_abs());
    let outcome = match &arguments.out {
        Some(out) => {
            make_parent(out)?;
            let description = Description::new(executor.graph(), executor.clock());
            let writer = RecordingWriter::create(out, &description).input()?;
            let mut sink = Watched { sink: writer, bar: bar.clone() };
            let outcome = executor.run(arguments.duration, &mut sink).map_err(sort)?;
            sink.sink.finish(arguments.duration).runtime()?;
            outcome
        }
        None => {
            executor.run(arguments.duration, &mut Watched { sink: NoSink, bar: bar.clone() }).map_err(sort)?
        }
    };
    bar.finish_and_clear();

    if outcome.changes_left > 0 {
        eprintln!("warning: {} changes are planned for steps that were never made", outcome.changes_left);
    }
    let faults: Vec<String> = outcome.faults.iter().map(describe).collect();
    if arguments.json {
        let connections: Vec<_> = outcome
            .connections
            .iter()
            .map(|c| {
                json!({ "connection": c.connection, "sent": c.sent, "in_flight": c.in_flight,
                        "consumed": c.account.consumed, "superseded": c.account.superseded })
            })
            .collect();
        output::json(&json!({
            "graph": executor.graph().spec().name, "seed": arguments.seed, "out": arguments.out,
            "duration_s": to_seconds(arguments.duration), "steps": outcome.steps,
            "connections": connections, "faults": faults,
        }))?;
    } else {
        output::line(format!(
            "{}: {} steps in {} simulated seconds, seed {}",
            executor.graph().spec().name,
            outcome.steps,
            to_seconds(arguments.duration),
            arguments.seed
        ));
        let rows: Vec<Vec<String>> = outcome
            .connections
            .iter()
            .map(|c| {
                let counts = [c.sent, c.account.consumed, c.account.superseded, c.in_flight];
                [vec![c.connection.clone()], counts.map(|count| count.to_string()).to_vec()].concat()
            })
            .collect();
        output::table(&["connection", "sent", "consumed", "superseded", "in flight"], &rows);
        if let Some(out) = &arguments.out {
            output::line(format!("recorded to {}", out.display()));
        }
    }
    if faults.is_empty() {
        Ok(Outcome::Done)
    } else {
        Err(Failure::runtime(anyhow::anyhow!(faults.join("; "))))
    }
}

/// What is to be changed, from a plan or from a recording.
fn plan(path: &Path) -> Result<ChangePlan, Failure> {
    if path.extension().is_some_and(|extension| extension == "mcap") {
        return Ok(ChangePlan::from_recording(&Recording::read(path).input()?));
    }
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("--changes {} cannot be read", path.display()))
        .map_err(Failure::input)?;
    ChangePlan::from_toml(&path.display().to_string(), &text).input()
}

/// A node that cannot be built, or a duration that cannot be, comes from the input.
fn sort(error: SimError) -> Failure {
    match error {
        SimError::Changes(_)
        | SimError::Change { .. }
        | SimError::Build { .. }
        | SimError::RealTimeFactor { .. }
        | SimError::Duration { .. } => Failure::input(error),
        _ => Failure::runtime(error),
    }
}

/// A node's early end in words.
pub(crate) fn describe(fault: &Fault) -> String {
    use parallax_runtime::recording::FaultKind;
    let how = match &fault.kind {
        FaultKind::Failed { message } => format!("failed: {message}"),
        FaultKind::DeadSender { sender } => {
            format!("stopped, because it waited for `{sender}`, which is dead")
        }
        FaultKind::Died { message } => format!("died: {message}"),
        FaultKind::Replaced { step } => format!("sent its safe output in place of that of step {step}"),
        FaultKind::Restarted { step, .. } => format!("was started again at step {step}"),
    };
    format!("node `{}` {how} (at {:.3} s)", fault.node, to_seconds(fault.time))
}

/// Faults in words; what happened to many outputs of a node is told once.
pub(crate) fn describe_all(faults: &[Fault]) -> Vec<String> {
    use parallax_runtime::recording::FaultKind;
    let mut replaced: BTreeMap<&str, (usize, &Fault)> = BTreeMap::new();
    let mut said = Vec::new();
    for fault in faults {
        match fault.kind {
            FaultKind::Replaced { .. } => replaced.entry(&fault.node).or_insert((0, fault)).0 += 1,
            _ => said.push(describe(fault)),
        }
    }
    said.extend(replaced.into_iter().map(|(node, (count, first))| {
        let at = to_seconds(first.time);
        format!("node `{node}` sent its safe output in place of {count} outputs, the first at {at:.3} s")
    }));
    said
}

/// Passes everything on and shows how far the run is.
struct Watched<S> {
    sink: S,
    bar: ProgressBar,
}

impl<S: RecordingSink> RecordingSink for Watched<S> {
    fn message(
        &mut self,
        node: usize,
        seq: u64,
        sent: Nanos,
        payload: &[f64],
        data: &Data,
    ) -> Result<(), SinkError> {
        // A redraw for each message would cost more than the simulation.
        if seq.is_multiple_of(64) {
            self.bar.set_position(sent.max(0).unsigned_abs());
        }
        self.sink.message(node, seq, sent, payload, data)
    }

    fn step(&mut self, node: usize, step: &StepView<'_>) -> Result<(), SinkError> {
        self.sink.step(node, step)
    }

    fn loss(&mut self, loss: &Loss) -> Result<(), SinkError> {
        self.sink.loss(loss)
    }

    fn fault(&mut self, fault: &Fault) -> Result<(), SinkError> {
        self.sink.fault(fault)
    }

    fn change(&mut self, change: &Change) -> Result<(), SinkError> {
        self.sink.change(change)
    }
}
