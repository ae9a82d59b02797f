//! `parallax info`: what is in a recording, a folder of logs, a graph or a system.

mod graph;
mod log;
mod recording;

pub(crate) use recording::clock;
mod system;

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_runtime::import;
use parallax_runtime::recording::Recording;

use super::args::graph_spec;
use super::failure::{Failure, Outcome, Sort};

#[derive(Args)]
pub(crate) struct Arguments {
    /// A recording (.mcap), a folder with recording.toml, a system.toml, a graph.toml, or the name of a graph, such as `pendulum`.
    what: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What a path holds.
enum Kind {
    Folder,
    System,
    Graph,
    Recording,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let (path, json) = (&arguments.what, arguments.json);
    match kind(path)? {
        Kind::Folder => log::show(&import::folder(path).input()?, json)?,
        Kind::System => system::show(&import::read_system(path).input()?, json)?,
        Kind::Graph => graph::show(&graph_spec(&path.to_string_lossy(), &[], &[])?, json)?,
        Kind::Recording => {
            let recording = Recording::read(path).input()?;
            if recording.is_imported() {
                log::show(&recording.log(), json)?;
            } else {
                recording::show(&recording, json)?;
            }
        }
    }
    Ok(Outcome::Done)
}

fn kind(path: &Path) -> Result<Kind, Failure> {
    if path.is_dir() {
        let system_only = path.join("system.toml").exists() && !path.join(import::MANIFEST).exists();
        return Ok(if system_only { Kind::System } else { Kind::Folder });
    }
    if !path.exists() {
        if path.to_str().is_some_and(|name| parallax_nodes::GRAPHS.contains(&name)) {
            return Ok(Kind::Graph);
        }
        let graphs = parallax_nodes::GRAPHS.join(", ");
        return Err(Failure::input(anyhow!(
            "{} does not exist; check the path, or give the name of a graph: {graphs}",
            path.display()
        )));
    }
    if path.extension().is_none_or(|extension| extension != "toml") {
        return Ok(Kind::Recording);
    }
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("{} cannot be read", path.display()))
        .map_err(Failure::input)?;
    // What cannot be parsed is left to the reader of systems, which says where.
    let table: toml::Table = text.parse().unwrap_or_default();
    Ok(if table.contains_key("node") || table.contains_key("supervisor") {
        Kind::Graph
    } else if table.contains_key("signal") || path.file_name().is_some_and(|name| name == import::MANIFEST) {
        Kind::Folder
    } else {
        Kind::System
    })
}
