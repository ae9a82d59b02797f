//! `parallax doctor`: what this machine does to nodes that must be on time, and what to change.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use parallax_runtime::doctor::{self, Finding, Machine, Verdict};
use serde_json::json;

use super::failure::{Failure, Outcome};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// How long to measure wake-ups; 0 for not at all.
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
    seconds: f64,
    /// Read the files of another machine, copied to this folder, and measure nothing.
    #[arg(long, value_name = "FOLDER")]
    root: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if !(0.0..=86_400.0).contains(&arguments.seconds) {
        return Err(Failure::input(anyhow::anyhow!("--seconds must be 0 to 86400")));
    }
    let machine = match &arguments.root {
        Some(root) if !root.is_dir() => {
            return Err(Failure::input(anyhow::anyhow!(
                "--root {}: there is no such folder",
                root.display()
            )));
        }
        Some(root) => Machine::at(root),
        None => Machine::this(),
    };
    let mut findings = doctor::examine(&machine);
    let mut wake_ups = None;
    if arguments.root.is_none() && arguments.seconds > 0.0 {
        let bar = output::progress("measuring wake-ups", 1);
        let (finding, delays) = doctor::wake_ups(Duration::from_secs_f64(arguments.seconds));
        bar.finish_and_clear();
        findings.push(finding);
        wake_ups = Some(delays);
    }
    if arguments.json {
        output::json(&json!({ "findings": findings, "wake_ups": wake_ups }))?;
    } else {
        print(&findings);
    }
    let changes = findings.iter().any(|finding| finding.verdict == Verdict::Change);
    Ok(if changes { Outcome::Negative } else { Outcome::Done })
}

fn print(findings: &[Finding]) {
    let word = |verdict: Verdict| match verdict {
        Verdict::Good => "good",
        Verdict::Note => "note",
        Verdict::Unknown => "unknown",
        Verdict::Change => "CHANGE",
    };
    let rows: Vec<Vec<String>> = findings
        .iter()
        .map(|finding| vec![word(finding.verdict).into(), finding.check.into(), finding.found.clone()])
        .collect();
    output::table(&["", "check", "found"], &rows);
    for verdict in [Verdict::Change, Verdict::Note] {
        for finding in findings.iter().filter(|finding| finding.verdict == verdict) {
            output::line(format!("\n{}: {}.", finding.check, finding.advice.trim_end_matches('.')));
            if let Some(command) = &finding.command {
                output::line(format!("    {command}"));
            }
        }
    }
}
