//! `parallax identify`: parameters, first states and hidden delays from recordings.

mod file;

use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_runtime::launch::signals::Signals;
use parallax_runtime::recording::Recording;
use parallax_sim::identify::{
    Checkpoint, Estimate, Identified, IdentifyError, Problem, Progress, identified_graph, identify, search,
};
use serde_json::json;

use super::failure::{Failure, Outcome, Sort};
use super::output;
use crate::plot;
use file::File;

/// How often a search is written down.
const EVERY: Duration = Duration::from_secs(5);

#[derive(Args)]
pub(crate) struct Arguments {
    /// Recordings of one graph.
    #[arg(required = true)]
    recordings: Vec<PathBuf>,
    /// What is simulated, what is unknown, what is compared: an identify.toml (docs/identification.md).
    #[arg(long, value_name = "FILE")]
    spec: PathBuf,
    /// The folder for identified.toml (a graph that runs), identified.json, predictions.json and report.html.
    #[arg(long, value_name = "DIR", default_value = "out/identify")]
    out: PathBuf,
    /// Take up the search that was interrupted in the same folder.
    #[arg(long)]
    resume: bool,
    /// Print identified.json instead of the short answer.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let file = File::read(&arguments.spec)?;
    let mut recordings = Vec::new();
    for path in &arguments.recordings {
        let recording = Recording::read(path).input()?;
        if recording.is_imported() {
            return Err(Failure::input(anyhow!(
                "{} is an imported log: it has signals and no graph; diagnose it with a system instead",
                path.display()
            )));
        }
        recordings.push(recording);
    }
    fs::create_dir_all(&arguments.out)
        .with_context(|| format!("the folder {} cannot be made", arguments.out.display()))
        .map_err(Failure::input)?;
    let notes = arguments.out.join("checkpoint.json");
    let signals = Signals::watch().runtime()?;
    let bar = output::progress("identifying", 1000);
    let started = Instant::now();
    let mut written = Instant::now();
    let mut lost = None;
    let mut each = |progress: &Progress<'_>| {
        bar.set_position((1000.0 * progress.share) as u64);
        let stopped = signals.raised();
        if stopped || written.elapsed() > EVERY {
            written = Instant::now();
            lost = write(&notes, &serde_json::to_string(progress.checkpoint).unwrap_or_default()).err();
        }
        if stopped { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let registry = parallax_nodes::registry();
    let found = match arguments.resume {
        true => {
            let checkpoint = read(&notes)?;
            let problem = Problem::new(&recordings, &registry, &file.specification)
                .map_err(|error| file.failure(error))?;
            search(&problem, &file.method, Some(checkpoint), &mut each).map(|found| (problem, found))
        }
        false => identify(&recordings, &registry, &file.specification, &file.method, &mut each),
    };
    bar.finish_and_clear();
    if let Some(lost) = lost {
        return Err(lost);
    }
    let (problem, found) = found.map_err(|error| file.failure(error))?;
    let seconds = started.elapsed().as_secs_f64();
    if found.stop.is_some() && notes.exists() {
        fs::remove_file(&notes).runtime()?;
    }
    let (graph, unwritten) = identified_graph(&problem, &found, &registry);
    write(&arguments.out.join("identified.toml"), &graph.to_toml().runtime()?)?;
    let answer = json!({
        "estimates": found.estimates, "combinations": found.combinations, "remarks": found.remarks,
        "outputs": found.outputs, "covariance": found.covariance, "loss": found.loss, "stop": found.stop,
        "rollouts": found.rollouts, "seconds": seconds, "not_written": unwritten, "humps": found.humps,
    });
    write(
        &arguments.out.join("identified.json"),
        &serde_json::to_string_pretty(&answer).map_err(Failure::runtime)?,
    )?;
    let reconstruction = found.reconstruction(&problem).map_err(Failure::runtime)?;
    write(
        &arguments.out.join("predictions.json"),
        &serde_json::to_string(&json!({ "outputs": reconstruction })).map_err(Failure::runtime)?,
    )?;
    let figures = plot::identified::figures(&found, &reconstruction);
    let title = format!("What was identified of {}", problem.graph().spec().name);
    let names: Vec<String> = arguments.recordings.iter().map(|path| path.display().to_string()).collect();
    plot::write(&arguments.out.join("report.html"), &title, &names.join(", "), figures)?;
    if arguments.json {
        output::json(&answer)?;
    } else {
        print(&found, &unwritten, seconds);
        output::line(format!("written to {}", arguments.out.display()));
    }
    Ok(if found.stop.is_none() { Outcome::Interrupted } else { Outcome::Done })
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    fs::write(path, text)
        .with_context(|| format!("{} cannot be written", path.display()))
        .map_err(Failure::input)
}

fn read(path: &Path) -> Result<Checkpoint, Failure> {
    let text = fs::read_to_string(path)
        .with_context(|| format!("{} cannot be read; nothing was interrupted there", path.display()))
        .map_err(Failure::input)?;
    serde_json::from_str(&text)
        .map_err(|_| IdentifyError::Checkpoint { problem: "it is of another program, or damaged".into() })
        .map_err(Failure::input)
}

fn print(found: &Identified, unwritten: &[String], seconds: f64) {
    let rows: Vec<Vec<String>> = found.estimates.iter().map(row).collect();
    output::table(&["", "estimate", "95 % from", "to", "unit", ""], &rows);
    if !found.combinations.is_empty() {
        output::line("");
        let rows = found.combinations.iter().map(|c| {
            let half = 1.96 * c.std;
            vec![c.text.clone(), number(c.value), number(c.value - half), number(c.value + half)]
        });
        output::table(&["determined", "value", "95 % from", "to"], &rows.collect::<Vec<_>>());
    }
    output::line("");
    let rows = found.outputs.iter().map(|score| {
        vec![
            score.output.clone(),
            number(score.fitted),
            score.held_out.map_or("-".into(), number),
            score.noise.map_or("-".into(), number),
        ]
    });
    output::table(
        &["open-loop error (rms)", "fitted", "held out", "declared noise"],
        &rows.collect::<Vec<_>>(),
    );
    for note in found.remarks.iter().chain(unwritten) {
        output::line(format!("note: {note}"));
    }
    let end = if found.stop.is_none() { "interrupted; " } else { "" };
    output::line(format!("{end}{} rollouts in {seconds:.2} s", found.rollouts));
}

fn row(estimate: &Estimate) -> Vec<String> {
    // A delay in a row is not determined by itself, but its sum with the others may leave less than its bounds.
    let narrowed = estimate.bounds.is_some_and(|bounds| bounds != estimate.interval);
    let [low, high] = match estimate.std {
        Some(_) => estimate.interval.map(number),
        None if narrowed => estimate.interval.map(number),
        None => ["-".into(), "-".into()],
    };
    let note = match (estimate.std, estimate.at_bound) {
        (None, _) if narrowed => "only in a sum",
        (None, _) => "not determined",
        (Some(_), true) => "at its bound",
        _ => "",
    };
    vec![estimate.name.clone(), number(estimate.value), low, high, estimate.unit.clone(), note.into()]
}

fn number(value: f64) -> String {
    parallax_gap::plot::format::number(value, 4)
}
