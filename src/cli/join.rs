//! `parallax join`: the parts of a recording that went on in new files, and the copies of other machines, made one again.

use std::ops::Range;
use std::path::PathBuf;

use clap::Args;
use parallax_runtime::recording::{self, FaultKind, Recording, join};
use parallax_runtime::time::to_seconds;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The parts, in the order of time: run.mcap run.1.mcap run.2.mcap. After them the copies that other machines kept of what
    /// their own nodes recorded: what is missing is taken from these.
    #[arg(required = true, num_args = 1..)]
    parts: Vec<PathBuf>,
    /// The recording to write.
    #[arg(long, short, value_name = "FILE.mcap")]
    out: PathBuf,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if let Some(part) =
        arguments.parts.iter().find(|part| part.canonicalize().ok() == arguments.out.canonicalize().ok())
        && arguments.out.exists()
    {
        return Err(Failure::input(anyhow::anyhow!(
            "{} is a part and would be written over; give --out another name",
            part.display()
        )));
    }
    let whole = join(&arguments.parts).input()?;
    make_parent(&arguments.out)?;
    recording::write(&arguments.out, &whole).input()?;
    let steps: usize = whole.nodes.iter().map(|track| track.steps.len()).sum();
    output::line(format!(
        "{}: {:.3} s, {steps} steps of {} nodes, from {} parts",
        arguments.out.display(),
        to_seconds(whole.duration),
        whole.nodes.len(),
        arguments.parts.len()
    ));
    if let Some(truncated) = &whole.truncated {
        eprintln!("warning: {truncated}");
    }
    if let Some((node, missing)) = hole(&whole) {
        eprintln!(
            "warning: steps {} to {} of {node} are in no part; if a part was left out, give all of them",
            missing.start,
            missing.end - 1
        );
    }
    Ok(Outcome::Done)
}

/// The first steps that a node made and that are missing: not those that it left out when it was started again.
fn hole(whole: &Recording) -> Option<(&str, Range<u64>)> {
    whole.nodes.iter().find_map(|track| {
        let started_again = |seq: u64| {
            whole.faults.iter().any(|fault| {
                fault.node == track.name
                    && matches!(fault.kind, FaultKind::Restarted { step, .. } if step == seq)
            })
        };
        let mut next = 0;
        track.steps.iter().find_map(|step| {
            let missing = next..step.seq;
            next = step.seq + 1;
            (!missing.is_empty() && !started_again(step.seq)).then_some((track.name.as_str(), missing))
        })
    })
}
