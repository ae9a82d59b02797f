//! `parallax import`: a folder of CSV logs becomes a recording.

use std::path::PathBuf;

use clap::Args;
use parallax_runtime::recording::write;
use serde_json::json;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The folder with recording.toml and its CSV files.
    folder: PathBuf,
    /// The recording to write.
    #[arg(long, value_name = "FILE.mcap")]
    out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let log = parallax_runtime::import::folder(&arguments.folder).input()?;
    make_parent(&arguments.out)?;
    write(&arguments.out, &log.recording()).runtime()?;
    let samples: usize = log.signals.iter().map(|signal| signal.values.len()).sum();
    if arguments.json {
        output::json(&json!({ "out": arguments.out, "signals": log.signals.len(), "samples": samples }))?;
    } else {
        let (signals, out) = (log.signals.len(), arguments.out.display());
        output::line(format!("{samples} samples of {signals} signals written to {out}"));
    }
    Ok(Outcome::Done)
}
