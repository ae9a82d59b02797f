//! `parallax run`: a graph in real time, one process for each node.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use parallax_runtime::launch::{
    self, Crossing, End, InputReport, LaunchSpec, LinkReport, NodeReport, RecordingReport, Rotate, RunError,
    RunOptions, RunReport,
};
use parallax_runtime::recording::Packing;
use parallax_runtime::time::{Nanos, to_seconds};

use super::args::{NodeChange, Play, duration, graph_spec, make_parent};
use super::failure::{Failure, Outcome, Sort};
use super::info::clock;
use super::printer::Printer;
use super::{output, python};

/// How a recording is packed, where it is said.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Packed {
    None,
    Zstd,
}

impl From<Packed> for Packing {
    fn from(packed: Packed) -> Self {
        match packed {
            Packed::None => Self::Plain,
            Packed::Zstd => Self::Zstd,
        }
    }
}

#[derive(Args)]
pub(crate) struct Arguments {
    /// A graph.toml, or `pendulum`, `pendulum-simulated` or `quadrotor-simulated`.
    graph: String,
    /// How long to run; without it, until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = duration, allow_negative_numbers = true)]
    duration: Option<Nanos>,
    /// Seed of the nodes' random streams.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The recording to write.
    #[arg(long, value_name = "FILE.mcap")]
    out: Option<PathBuf>,
    /// Go on in a new file (run.1.mcap, run.2.mcap, ...) at a size or after a time, such as 500MB or 10min.
    #[arg(long, value_name = "SIZE|TIME", value_parser = rotate)]
    rotate: Option<Rotate>,
    /// Pack the recording; without it, by zstd where messages have data, such as pictures.
    #[arg(long, value_name = "HOW")]
    packing: Option<Packed>,
    /// Let this group read the recording, by name or number; without it, only you may.
    #[arg(long, value_name = "GROUP")]
    group: Option<String>,
    /// Record to out/GRAPH/recording.mcap.
    #[arg(long, conflicts_with = "out")]
    record: bool,
    /// Change a node: its rate, core or a parameter of its kind.
    #[arg(long = "node", value_name = "NODE.KEY=VALUE")]
    changes: Vec<NodeChange>,
    /// Let a node send what a command file says (CSV: time,NODE.LEAF), such as `parallax experiment` writes.
    #[arg(long, value_name = "NODE=FILE")]
    play: Vec<Play>,
    /// How the nodes are run: process or thread, core, real-time policy, waiting, deadlines, restarts, safe outputs
    /// (docs/real-time.md). Without it, the launch.toml beside the graph.toml, if there is one.
    #[arg(long, value_name = "FILE")]
    launch: Option<PathBuf>,
    /// Change a launch setting of a node, or of all nodes, before the file: agent.policy=fifo, defaults.restart=always.
    #[arg(long = "set", value_name = "NODE.SETTING=VALUE")]
    settings: Vec<String>,
    /// Which machine of the launch settings this is, where the graph runs on several (docs/several-machines.md).
    #[arg(long, value_name = "NAME")]
    host: Option<String>,
    /// Run the nodes as threads of one process: --set defaults.run_as=thread.
    #[arg(long)]
    threads: bool,
    /// Ask for SCHED_FIFO and locked memory: --set defaults.policy=fifo --set defaults.lock_memory=true.
    #[arg(long)]
    real_time: bool,
    /// How long before its time a step polls instead of sleeping, for nodes with a core of their own:
    /// --set defaults.wait=spin-then-block --set defaults.spin=SECONDS.
    #[arg(long, value_name = "SECONDS", value_parser = duration, allow_negative_numbers = true)]
    spin: Option<Nanos>,
    /// Leave nodes without a core to the system instead of spreading them over the cores.
    #[arg(long)]
    no_spread: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let spec = graph_spec(&arguments.graph, &arguments.changes, &arguments.play)?;
    let out = match &arguments.out {
        None if arguments.record => Some(PathBuf::from("out").join(&spec.name).join("recording.mcap")),
        out => out.clone(),
    };
    if let Some(out) = &out {
        make_parent(out)?;
    } else if let Some(group) = &arguments.group {
        return Err(Failure::input(anyhow!(
            "--group {group} names who may read the recording, and none is made; add --record or --out FILE.mcap"
        )));
    }
    let bar = bar(&spec.name, arguments.duration);
    let launch = launch_spec(arguments)?;
    let folder = Path::new(&arguments.graph).parent().filter(|_| graph_is_a_file(&arguments.graph));
    let programs = python::programs(&spec, &launch, folder).map_err(Failure::input)?;
    let (defaults, printer) = (RunOptions::default(), Printer::new(&bar));
    // An interpreter takes seconds to load its packages and to compile.
    let patience = if programs.is_empty() { defaults.patience } else { Duration::from_secs(120) };
    let options = RunOptions {
        duration: arguments.duration,
        seed: arguments.seed,
        recording: out.clone(),
        rotate: arguments.rotate,
        packing: arguments.packing.map(Packing::from).unwrap_or_default(),
        launch,
        host: arguments.host.clone(),
        programs,
        patience,
        spread: !arguments.no_spread,
        progress: Some(watch(&bar)),
        warn: Some(warn(&printer)),
        events: Some(tell(&printer)),
        ..defaults
    };
    // With the run's own share of it the last line is printed.
    drop(printer);
    let report = launch::run(&spec, &crate::cli::python::registry(), options).map_err(sort)?;
    bar.finish_and_clear();
    if arguments.json {
        output::json(&report)?;
    } else {
        print(&report);
        if let Some(recording) = &report.recording {
            let files: Vec<String> = recording.files.iter().map(|file| file.display().to_string()).collect();
            output::line(format!(
                "recorded to {}: {:.1} MiB",
                files.join(", "),
                recording.bytes as f64 / 1_048_576.0
            ));
        }
    }
    let outcome = ended(&report)?;
    match report.recording.as_ref().map(RecordingReport::complete) {
        Some(false) => {
            Err(Failure::runtime(anyhow!("the run went on to its end, but its recording has holes")))
        }
        _ => Ok(outcome),
    }
}

/// A size such as `500MB` or a time such as `10min`.
fn rotate(text: &str) -> Result<Rotate, String> {
    const UNITS: [(&str, f64); 9] = [
        ("kB", 1e3),
        ("MB", 1e6),
        ("GB", 1e9),
        ("KiB", 1024.0),
        ("MiB", 1_048_576.0),
        ("GiB", 1_073_741_824.0),
        ("s", 1.0),
        ("min", 60.0),
        ("h", 3600.0),
    ];
    let form = || "it must be a size such as 500MB or 2GiB, or a time such as 90s, 10min or 1h".to_owned();
    let digits = text.find(|c: char| c.is_ascii_alphabetic()).ok_or_else(form)?;
    let number: f64 = text[..digits].trim().parse().map_err(|_| form())?;
    let rotate = match UNITS.iter().find(|(name, _)| name.eq_ignore_ascii_case(&text[digits..])) {
        Some(("s" | "min" | "h", factor)) => Rotate::Time((number * factor * 1e9) as Nanos),
        Some((_, factor)) => Rotate::Bytes((number * factor) as u64),
        None => return Err(form()),
    };
    match rotate {
        Rotate::Bytes(bytes) if bytes < 100_000 => {
            Err("a file of less than 100kB holds little but its head".into())
        }
        Rotate::Time(time) if time < 1_000_000_000 => Err("a file holds a second at least".into()),
        rotate => Ok(rotate),
    }
}

/// Whether a graph is a file, and not one that comes with Parallax.
fn graph_is_a_file(graph: &str) -> bool {
    parallax_nodes::graph(graph).is_none()
}

/// The launch settings: those of the file, changed by the flags.
fn launch_spec(arguments: &Arguments) -> Result<LaunchSpec, Failure> {
    let beside = || Some(Path::new(&arguments.graph).with_file_name("launch.toml"));
    let found = beside().filter(|path| graph_is_a_file(&arguments.graph) && path.is_file());
    let mut launch = match arguments.launch.clone().or(found) {
        Some(path) => LaunchSpec::read(&path).input()?,
        None => LaunchSpec::default(),
    };
    if let Some(group) = &arguments.group {
        launch.group = Some(group.clone());
    }
    let mut changes = Vec::new();
    if arguments.threads {
        changes.push("defaults.run_as=thread".into());
    }
    if arguments.real_time {
        changes.extend(["defaults.policy=fifo".into(), "defaults.lock_memory=true".into()]);
    }
    if let Some(spin) = arguments.spin {
        changes.push("defaults.wait=spin-then-block".into());
        changes.push(format!("defaults.spin={:?}", to_seconds(spin)));
    }
    changes.extend(arguments.settings.iter().cloned());
    changes.iter().try_for_each(|change| launch.change(change)).input()?;
    Ok(launch)
}

/// A bar that fills over the duration, or turns until Ctrl-C.
pub(crate) fn bar(graph: &str, duration: Option<Nanos>) -> ProgressBar {
    match duration {
        Some(duration) => output::progress(&format!("running {graph}"), duration.unsigned_abs()),
        None => {
            let bar = output::progress(&format!("running {graph} until Ctrl-C"), 0);
            bar.set_style(ProgressStyle::default_spinner());
            bar
        }
    }
}

/// Moves the bar while the run goes on.
pub(crate) fn watch(bar: &ProgressBar) -> Box<dyn FnMut(launch::Progress) -> bool> {
    let bar = bar.clone();
    Box::new(move |progress| {
        bar.set_position(progress.elapsed.max(0).unsigned_abs());
        true
    })
}

/// Says warnings on standard error as they come up.
fn warn(printer: &Arc<Printer>) -> launch::Warner {
    let printer = printer.clone();
    Box::new(move |warning| printer.say(format!("warning: {warning}")))
}

/// Says on standard error what happens to nodes.
fn tell(printer: &Arc<Printer>) -> launch::Watcher {
    let printer = printer.clone();
    Box::new(move |event| printer.say(event.to_string()))
}

/// What the graph says wrong is bad input; what goes wrong on this machine is not.
pub(crate) fn sort(error: RunError) -> Failure {
    match error {
        RunError::Graph(_)
        | RunError::Settings(_)
        | RunError::RecorderElsewhere { .. }
        | RunError::Group { .. }
        | RunError::PrivateForNobody { .. } => Failure::input(error),
        RunError::Interrupted => Failure::interrupted(error),
        _ => Failure::runtime(error),
    }
}

/// What the end of a run means for the command.
pub(crate) fn ended(report: &RunReport) -> Result<Outcome, Failure> {
    match &report.end {
        End::Duration => Ok(Outcome::Done),
        End::Signal => Ok(Outcome::Interrupted),
        End::Node { .. } | End::Host { .. } | End::Link { .. } => {
            let why = report.failure().unwrap_or_else(|| "the run ended before its time".into());
            Err(Failure::runtime(anyhow!(why)))
        }
    }
}

fn print(report: &RunReport) {
    output::line(format!(
        "{}: {:.3} s, started in {}, {:.1} MiB of shared memory",
        report.graph,
        to_seconds(report.duration),
        output::seconds(to_seconds(report.startup)),
        report.shared_memory as f64 / 1_048_576.0
    ));
    let rows: Vec<Vec<String>> = report
        .nodes
        .iter()
        .map(|node| {
            let lost: u64 = node.lost.iter().map(|(_, count)| count).sum();
            let time = |nanos: Nanos| output::seconds(to_seconds(nanos));
            vec![
                node.node.clone(),
                node.core.map_or_else(|| "any".into(), |core| core.to_string()),
                node.steps.to_string(),
                node.overruns.to_string(),
                time(node.lateness.p50),
                time(node.lateness.p99),
                time(node.computation.p50),
                time(node.computation.p99),
                lost.to_string(),
                node.exit.to_string(),
            ]
        })
        .collect();
    output::table(
        &["node", "core", "steps", "overruns", "late", "99 %", "computation", "99 %", "lost", "end"],
        &rows,
    );
    print_messages(report);
    report.link.iter().for_each(print_link);
    report.nodes.iter().flat_map(notes).for_each(output::line);
}

/// What became of every message.
fn print_messages(report: &RunReport) {
    let row = |(node, input): (&NodeReport, &InputReport)| {
        let lost = input.lost.iter().map(|(reason, count)| format!("{count} ({})", reason.name()));
        let lost: Vec<String> = lost.collect();
        vec![
            format!("{} -> {}", input.from, node.node),
            input.sent.to_string(),
            input.consumed.to_string(),
            input.superseded.to_string(),
            input.in_flight.to_string(),
            if lost.is_empty() { "0".into() } else { lost.join(", ") },
        ]
    };
    let inputs = report.nodes.iter().flat_map(|node| node.inputs.iter().map(move |input| (node, input)));
    let rows: Vec<Vec<String>> = inputs.map(row).collect();
    if !rows.is_empty() {
        output::table(&["messages", "sent", "consumed", "superseded", "in flight", "lost"], &rows);
    }
}

/// What crossed between this machine and others.
fn print_link(link: &LinkReport) {
    let row = |crossing: &Crossing| {
        let counts =
            [crossing.sent, crossing.held_back, crossing.received, crossing.lost, crossing.malformed];
        let counts = counts.map(|count| count.to_string());
        let size = format!("{:.1} kB", crossing.bytes as f64 / 1e3);
        [vec![crossing.channel.clone()], counts.to_vec(), vec![size]].concat()
    };
    let rows: Vec<Vec<String>> = link.crossings.iter().map(row).collect();
    output::table(&["crossed", "sent", "held back", "received", "lost", "malformed", "size"], &rows);
    link.clocks.iter().map(clock).for_each(output::line);
    if link.silences > 0 {
        output::line(format!("other machines were silent for too long {} times", link.silences));
    }
    if link.rejoined > 0 {
        output::line(format!(
            "other machines were started again and took part again {} times: what they had recorded last and not sent is \
             missing here, and counted as far as it is known; a copy that they kept (--out there) fills it: parallax join",
            link.rejoined
        ));
    }
    link.problem.iter().for_each(|problem| output::line(format!("the link: {problem}")));
}

/// What happened to a node that the table does not tell.
fn notes(node: &NodeReport) -> Vec<String> {
    let mut notes = Vec::new();
    let mut note = |happened: bool, text: String| {
        if happened {
            notes.push(format!("{}: {text}", node.node));
        }
    };
    note(node.restarts > 0, format!("started again {} times", node.restarts));
    note(node.hangs > 0, format!("gave no sign of life {} times", node.hangs));
    note(
        node.late > 0,
        format!(
            "ended {} steps after their deadline, the worst by {}",
            node.late,
            output::seconds(to_seconds(node.late_by))
        ),
    );
    if let Some(first) = &node.non_finite {
        let (count, step, leaf) = (first.count, first.step, &first.leaf);
        note(true, format!("{count} outputs that are no numbers, the first in step {step} at leaf {leaf}"));
    }
    note(node.replaced > 0, format!("sent its safe output {} times in place of others", node.replaced));
    for input in &node.inputs {
        note(
            input.not_sent > 0,
            format!("{} messages of {} were never sent: it was down", input.not_sent, input.from),
        );
        note(
            input.held_back > 0,
            format!("{} messages of {} stayed on their machine: not all cross", input.held_back, input.from),
        );
        note(input.safe > 0, format!("saw the safe output of {} {} times", input.from, input.safe));
    }
    note(node.made_safe.is_some(), "ended on the safe outputs of its senders".into());
    notes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_are_told_apart() {
        assert_eq!(rotate("500MB"), Ok(Rotate::Bytes(500_000_000)));
        assert_eq!(rotate("1.5 GiB"), Ok(Rotate::Bytes(1_610_612_736)));
        assert_eq!(rotate("90s"), Ok(Rotate::Time(90_000_000_000)));
        assert_eq!(rotate("2min"), Ok(Rotate::Time(120_000_000_000)));
        for wrong in ["", "5", "MB", "5 parsecs", "0.1s", "1kB", "-5MB", "nanMB"] {
            assert!(rotate(wrong).is_err(), "{wrong}");
        }
    }
}
