//! `parallax replay`: a recording's nodes run again on exactly what they consumed.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_runtime::recording::Recording;
use parallax_sim::{ReplayOptions, ReplayReport, replay};
use serde_json::{Value, json};

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The recording.
    recording: PathBuf,
    /// Write what was found as JSON.
    #[arg(long, value_name = "FILE.json")]
    out: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let recording = Recording::read(&arguments.recording).input()?;
    if recording.is_imported() {
        return Err(Failure::input(anyhow!(
            "{} is an imported log: it has signals and no nodes that could run again; diagnose it instead",
            arguments.recording.display()
        )));
    }
    let report = replay(&recording, &crate::cli::python::registry(), &ReplayOptions::default()).input()?;
    // Nothing compared is not the same as nothing different.
    if report.steps() == 0 {
        return Err(Failure::input(anyhow!(
            "{} holds no whole step that could run again; record anew, or copy the file whole",
            arguments.recording.display()
        )));
    }
    if let Some(out) = &arguments.out {
        make_parent(out)?;
        std::fs::write(out, summary(&report).to_string())
            .with_context(|| format!("{} cannot be written", out.display()))
            .map_err(Failure::input)?;
    }
    if arguments.json {
        output::json(&summary(&report))?;
    } else {
        print(&report, recording.truncated.as_deref());
    }
    Ok(if report.is_exact() { Outcome::Done } else { Outcome::Negative })
}

fn summary(report: &ReplayReport) -> Value {
    let nodes: Vec<Value> = report
        .nodes
        .iter()
        .map(|node| {
            let difference = node.first_difference.as_ref().map(
                |d| json!({ "step": d.seq, "leaf": d.leaf, "recorded": d.recorded, "replayed": d.replayed }),
            );
            let deviation =
                node.schedule.deviation.as_ref().map(|d| json!({ "step": d.seq, "problem": d.to_string() }));
            json!({
                "node": node.name, "injected": node.injected, "steps": node.steps, "consumed": node.consumed,
                "differing": node.differing, "first_difference": difference,
                "schedule": { "steps": node.schedule.steps, "deviation": deviation,
                              "largest_lateness_s": node.schedule.largest_lateness as f64 * 1e-9 },
            })
        })
        .collect();
    json!({ "exact": report.is_exact(), "steps": report.steps(), "consumed": report.consumed(),
            "beyond_cut": report.beyond_cut, "nodes": nodes })
}

fn print(report: &ReplayReport, truncated: Option<&str>) {
    if let Some(truncated) = truncated {
        eprintln!("warning: {truncated}");
    }
    let rows: Vec<Vec<String>> = report
        .nodes
        .iter()
        .map(|node| {
            let found = match (&node.first_difference, node.injected) {
                (Some(difference), _) => difference.to_string(),
                (None, true) => "taken from the recording".into(),
                (None, false) => "the same bits".into(),
            };
            let schedule = match &node.schedule.deviation {
                Some(deviation) => deviation.to_string(),
                None => format!("{} steps as recorded", node.schedule.steps),
            };
            vec![node.name.clone(), node.steps.to_string(), node.consumed.to_string(), schedule, found]
        })
        .collect();
    output::table(&["node", "replayed", "consumed", "schedule", "outputs"], &rows);
    if report.beyond_cut > 0 {
        output::line(format!("{} steps at the cut end could not be replayed", report.beyond_cut));
    }
    output::line(if report.is_exact() {
        format!(
            "exact: {} steps ran again on the {} messages that they consumed, and gave the recorded bits",
            report.steps(),
            report.consumed()
        )
    } else {
        let differing: u64 = report.nodes.iter().map(|node| node.differing).sum();
        format!(
            "not exact: {differing} of {} steps gave other outputs, or the schedule breaks its rules",
            report.steps()
        )
    });
}
