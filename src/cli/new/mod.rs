//! `parallax new`: files to begin with.

mod fill;
mod graph;
mod node;
mod template;

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use indicatif::ProgressBar;
use parallax_model::system::System;
use parallax_runtime::import;
use parallax_runtime::recording::Recording;
use parallax_runtime::recording::log::Log;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::{output, python};
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
    /// A model of MuJoCo (MJCF): its equations are written down, by way of MJX. Needs the Python package with its extra `mjx`.
    #[arg(long, value_name = "MODEL", conflicts_with_all = ["template", "from"])]
    mjcf: Option<PathBuf>,
    /// With --mjcf: the recorded signal of an actuator or an output, where it is called otherwise.
    #[arg(long, value_name = "NAME=SIGNAL", requires = "mjcf")]
    signal: Vec<String>,
    /// With --mjcf: what is read, as position:JOINT, velocity:JOINT or sensor:SENSOR; without it the positions of all joints.
    #[arg(long, value_name = "NAME=WHAT", requires = "mjcf")]
    output: Vec<String>,
    /// With --mjcf: how far masses, dampings, stiffnesses, armatures and gears may be refitted without that being a cause, as a
    /// share of each, such as 0.2.
    #[arg(long, value_name = "SHARE", requires = "mjcf")]
    calibrate: Option<f64>,
    /// With --mjcf: the Python interpreter with the package `parallax`; without it that of the active virtual environment, or
    /// python3.
    #[arg(long, value_name = "FILE", requires = "mjcf")]
    interpreter: Option<PathBuf>,
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
    if let Some(model) = &arguments.mjcf {
        return written_down(arguments, model);
    }
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

/// A system from a model of MuJoCo, which the Python package unrolls.
fn written_down(arguments: &SystemArguments, model: &Path) -> Result<Outcome, Failure> {
    let out = &arguments.out;
    absent(out)?;
    let interpreter = python::interpreter(arguments.interpreter.as_ref());
    let advice = "give one by --interpreter, or activate its environment";
    python::check(&interpreter, "MJX writes the model's equations down in Python", advice)
        .map_err(Failure::input)?;
    make_parent(out)?;
    let mut command = Command::new(&interpreter);
    command.args(["-m", "parallax.worlds"]).arg(model).arg("--out").arg(out);
    command.args(arguments.name.iter().flat_map(|name| ["--name", name]));
    command.args(arguments.signal.iter().flat_map(|signal| ["--signal", signal]));
    command.args(arguments.output.iter().flat_map(|read| ["--output", read]));
    command.args(arguments.calibrate.iter().flat_map(|share| ["--calibrate".into(), share.to_string()]));
    let bar = ProgressBar::new_spinner().with_message("MJX is traced");
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    let done = command.output().with_context(|| format!("{} cannot be started", interpreter.display()));
    bar.finish_and_clear();
    let done = done.map_err(Failure::runtime)?;
    if !done.status.success() {
        let said = String::from_utf8_lossy(&done.stderr);
        let said =
            said.trim().lines().last().unwrap_or("it said nothing").trim_start_matches("error: ").to_owned();
        return Err(Failure::input(anyhow!("{}: {said}", model.display())));
    }
    let system = import::read_system(out).runtime()?;
    system.equations().runtime()?;
    output::line(format!("{} written, of the equations of {}", out.display(), model.display()));
    for line in String::from_utf8_lossy(&done.stdout).lines().filter(|line| line.starts_with("left out: ")) {
        output::line(line);
    }
    let out = out.display();
    output::line(format!(
        "\nNext: say which parameters may be refitted, then\n  parallax info {out}\n  parallax diagnose --system {out} LOG"
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
    for (path, _) in files {
        absent(path)?;
    }
    for (path, text) in files {
        make_parent(path)?;
        std::fs::write(path, text)
            .with_context(|| format!("{} cannot be written", path.display()))
            .map_err(Failure::input)?;
    }
    Ok(())
}

fn absent(path: &Path) -> Result<(), Failure> {
    if path.exists() {
        let what = format!(
            "{} exists already, and is not overwritten; choose another place with --out",
            path.display()
        );
        return Err(Failure::input(anyhow!(what)));
    }
    Ok(())
}
