//! `parallax join`: the parts of a recording that went on in new files, made one again.

use std::path::PathBuf;

use clap::Args;
use parallax_runtime::recording::{self, join};
use parallax_runtime::time::to_seconds;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The parts, in the order of time: run.mcap run.1.mcap run.2.mcap.
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
    Ok(Outcome::Done)
}
