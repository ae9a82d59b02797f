//! `parallax experiment`: the commands that would tell apart what a diagnosis could not.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_gap::excitation::{Design, Limit, Wishes, propose};
use parallax_gap::options::Options;
use parallax_gap::report::{MadeFrom, Report};
use parallax_nodes::command_file::CommandFile;
use parallax_runtime::time::{Nanos, to_seconds};
use serde_json::json;

use super::args::{duration, make_parent};
use super::diagnose::Loaded;
use super::failure::{Failure, Outcome, Sort};
use super::output;

/// Answers that are told apart where no class holds several effects: those that are at least so likely.
const LIKELY: f64 = 0.02;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The folder that `parallax diagnose` wrote, or the report.json in it.
    diagnosis: PathBuf,
    /// The command file to write (CSV); by default experiment.csv in the diagnosis' folder.
    #[arg(long, value_name = "FILE.csv")]
    out: Option<PathBuf>,
    /// How long the experiment lasts; by default as long as the log, 20 s at most.
    #[arg(long, value_name = "SECONDS", value_parser = duration, allow_negative_numbers = true)]
    duration: Option<Nanos>,
    /// A range that a command or an output must keep; by default the log's range, twice as wide for outputs. Repeatable.
    #[arg(long, value_name = "SIGNAL=LOW:HIGH")]
    limit: Vec<Limit>,
    /// Tell this effect from the others named so, instead of what the diagnosis found alike. Repeatable.
    #[arg(long, value_name = "EFFECT@PLACE")]
    effect: Vec<String>,
    /// Seed of phases and switching times.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let file = match arguments.diagnosis.is_dir() {
        true => arguments.diagnosis.join("report.json"),
        false => arguments.diagnosis.clone(),
    };
    let report = read(&file)?;
    let asked = !arguments.effect.is_empty();
    let effects = if asked { arguments.effect.clone() } else { alike(&report) };
    if !asked && effects.len() < 2 {
        let leader = effects.first().map_or_else(String::new, |effect| format!(": {effect} stands alone"));
        output::line(format!("the diagnosis leaves nothing to tell apart{leader}"));
        return Ok(Outcome::Negative);
    }
    let Some(made_from) = &report.made_from else {
        return Err(Failure::input(anyhow!(
            "{} does not say which recording it was made from; run `parallax diagnose` again",
            file.display()
        )));
    };
    let design = designed(arguments, made_from, &effects)?;
    let out = arguments.out.clone().unwrap_or_else(|| file.with_file_name("experiment.csv"));
    make_parent(&out)?;
    std::fs::write(&out, commands(&design).to_string())
        .with_context(|| format!("{} cannot be written", out.display()))
        .map_err(Failure::input)?;
    if arguments.json {
        let commands: Vec<_> = design
            .commands
            .iter()
            .map(|c| json!({ "signal": c.signal, "unit": c.unit, "samples": c.held.times.len() }))
            .collect();
        let reach: Vec<_> = design
            .reach
            .iter()
            .map(|(output, low, high)| json!({ "output": output, "low": low, "high": high }))
            .collect();
        output::json(&json!({
            "effects": design.effects, "pair": design.pair, "out": out, "separation": design.separation,
            "commands": commands, "reach": reach, "promise": design.promise(),
        }))?;
    } else {
        print(&design, &out, made_from);
    }
    // What asks for another sensor tells nothing with these, unless it is for the rest.
    let tells = design.narrows() && (design.sensor.is_none() || !design.alike.is_empty());
    Ok(if tells { Outcome::Done } else { Outcome::Negative })
}

fn read(file: &Path) -> Result<Report, Failure> {
    let text = std::fs::read_to_string(file)
        .with_context(|| {
            format!("{} cannot be read; give the folder that `parallax diagnose` wrote", file.display())
        })
        .map_err(Failure::input)?;
    serde_json::from_str(&text)
        .with_context(|| format!("{} is no report of `parallax diagnose`", file.display()))
        .map_err(Failure::input)
}

/// What the diagnosis could not tell apart: the likeliest class of several effects, or the likeliest answers.
fn alike(report: &Report) -> Vec<String> {
    if let Some(class) = report.confusable.first() {
        return class.effects.clone();
    }
    let answers =
        report.which.iter().filter(|answer| answer.probability >= LIKELY && !answer.effects.is_empty());
    answers
        .map(|answer| {
            let labels: Vec<String> = answer.effects.iter().map(|effect| effect.label()).collect();
            labels.join(" + ")
        })
        .collect()
}

fn designed(arguments: &Arguments, made_from: &MadeFrom, effects: &[String]) -> Result<Design, Failure> {
    if made_from.recordings.is_empty() {
        return Err(Failure::input(anyhow!("the report names no recording; run `parallax diagnose` again")));
    }
    let loaded =
        Loaded::read(&made_from.recordings, made_from.system.as_deref(), (made_from.from, made_from.to))?;
    let (equations, experiment) = loaded.bound()?;
    let wishes = Wishes {
        duration: arguments.duration.map(to_seconds),
        limits: arguments.limit.clone(),
        seed: arguments.seed,
    };
    let options = Options { horizon: made_from.horizon, seed: made_from.seed, ..Options::default() };
    let bar = output::progress("designing an experiment", 0);
    let design = propose(equations, experiment, &loaded.title(), effects, &options, &wishes).input()?;
    bar.finish_and_clear();
    Ok(design)
}

/// The design as a command file.
fn commands(design: &Design) -> CommandFile {
    let mut file = CommandFile {
        title: format!("{}; tells apart {}", design.description, design.effects.join(", ")),
        ..CommandFile::default()
    };
    for command in &design.commands {
        file.times.clone_from(&command.held.times);
        file.signals.push((command.signal.clone(), command.held.values.clone()));
        if !command.unit.is_empty() {
            file.units.insert(command.signal.clone(), command.unit.clone());
        }
    }
    file
}

fn print(design: &Design, out: &Path, made_from: &MadeFrom) {
    output::line(format!("to tell apart  {}", design.effects.join(", ")));
    output::line(format!("experiment     {design}"));
    output::line(format!(
        "nearest pair   {} and {}: {:.1} noise units apart, right in {:.1} % of cases",
        design.pair.0,
        design.pair.1,
        design.separation,
        100.0 * design.probability()
    ));
    for (name, low, high) in &design.reach {
        output::line(format!("foreseen       {name} goes from {low:.4} to {high:.4}"));
    }
    output::line(format!("written to     {}", out.display()));
    let nodes: Vec<&str> =
        design.commands.iter().filter_map(|c| c.signal.split_once('.').map(|(node, _)| node)).collect();
    if !nodes.is_empty() {
        let mut play: Vec<String> =
            nodes.iter().map(|node| format!("--play {node}={}", out.display())).collect();
        play.dedup();
        output::line(format!(
            "play it        parallax run GRAPH {} --duration {} --record",
            play.join(" "),
            design.duration.ceil()
        ));
    }
    let system = made_from.system.as_ref().map_or_else(String::new, |s| format!("--system {} ", s.display()));
    let first: Vec<String> = made_from.recordings.iter().map(|r| r.display().to_string()).collect();
    output::line(format!("then           parallax diagnose {system}{} NEW_RECORDING", first.join(" ")));
    if made_from.from.is_some() || made_from.to.is_some() {
        output::line(
            "               the earlier recordings were cut by --from or --to, which would cut the new one as well",
        );
    }
}
