//! `parallax new`: files to begin with.

mod fill;
mod graph;
mod node;
mod template;

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use parallax_model::system::System;
use parallax_runtime::import;
use parallax_runtime::recording::Recording;
use parallax_runtime::recording::log::Log;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;
use template::Template;

#[derive(Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// A commented system.toml: what your simulator believes of a machine.
    System(SystemArguments),
    /// A commented graph.toml, for `parallax sim` and `parallax run`.
    Graph(graph::Arguments),
    /// A node of your own, in Rust or in Python, with a graph that it plugs into.
    Node(node::Arguments),
}

#[derive(Args)]
struct SystemArguments {
    /// What it resembles. With --from, what the signals look like; otherwise `joint`.
    #[arg(long, value_enum)]
    template: Option<Template>,
    /// A log (a folder with recording.toml, or a recording): its signals are bound, with their units.
    #[arg(long, value_name = "LOG")]
    from: Option<PathBuf>,
    /// The file to write.
    #[arg(long, value_name = "FILE", default_value = "system.toml")]
    out: PathBuf,
    /// The name of the system.
    #[arg(long)]
    name: Option<String>,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        What::System(arguments) => system(arguments),
        What::Graph(arguments) => graph::run(arguments),
        What::Node(arguments) => node::run(arguments),
    }
}

fn system(arguments: &SystemArguments) -> Result<Outcome, Failure> {
    let out = &arguments.out;
    let log = arguments.from.as_deref().map(read).transpose()?;
    let template = match (arguments.template, &log) {
        (Some(template), _) => template,
        (None, Some(log)) => Template::of(log),
        (None, None) => Template::Joint,
    };
    let name = arguments.name.clone().unwrap_or_else(|| {
        let from = arguments.from.as_ref().and_then(|path| path.file_stem());
        from.map_or_else(|| template.name().to_owned(), |stem| stem.to_string_lossy().into_owned())
    });
    let text = fill::fill(template, &name, log.as_ref()).map_err(Failure::input)?;
    // What was made is whole, and goes with the log.
    let system = System::parse(&text, &out.display().to_string()).runtime()?;
    system.equations().runtime()?;
    if let Some(log) = &log {
        let signals = log.signals.iter().map(|signal| (signal.name.as_str(), signal.unit.as_str()));
        system.check_signals(&signals.collect::<Vec<_>>()).runtime()?;
    }
    write_new(&[(out.clone(), text)])?;
    output::line(format!("{} written, of the template `{}`", out.display(), template.name()));
    let log = arguments.from.as_deref().map_or("LOG".into(), |path| path.display().to_string());
    output::line(format!(
        "\nNext: correct its numbers, then\n  parallax info {out}\n  parallax diagnose --system {out} {log}",
        out = out.display()
    ));
    Ok(Outcome::Done)
}

fn read(path: &Path) -> Result<Log, Failure> {
    if import::is_folder(path) {
        import::folder(path).input()
    } else {
        Ok(Recording::read(path).input()?.log())
    }
}

/// Writes all files, with their folders; none where one of them exists.
fn write_new(files: &[(PathBuf, String)]) -> Result<(), Failure> {
    if let Some((path, _)) = files.iter().find(|(path, _)| path.exists()) {
        return Err(Failure::input(anyhow!(
            "{} exists already, and is not overwritten; choose another place with --out",
            path.display()
        )));
    }
    for (path, text) in files {
        make_parent(path)?;
        std::fs::write(path, text)
            .with_context(|| format!("{} cannot be written", path.display()))
            .map_err(Failure::input)?;
    }
    Ok(())
}
