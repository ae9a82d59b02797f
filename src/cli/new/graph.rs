//! `parallax new graph`: a commented graph.toml that runs as it is.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::{Args, ValueEnum};
use parallax_nodes::pendulum;
use parallax_runtime::graph::GraphSpec;

use super::write_new;
use crate::cli::args::validate;
use crate::cli::failure::{Failure, Outcome, Sort};
use crate::cli::output;

#[derive(Args)]
pub(super) struct Arguments {
    /// What it resembles.
    #[arg(long, value_enum, default_value_t)]
    template: GraphTemplate,
    /// The file to write.
    #[arg(long, value_name = "FILE", default_value = "graph.toml")]
    out: PathBuf,
    /// The name of the graph; without it, the template's.
    #[arg(long)]
    name: Option<String>,
}

/// A graph to begin with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum GraphTemplate {
    /// A pendulum that is swung up, with a world that stands in for the hardware, a camera and an estimator.
    #[default]
    Pendulum,
    /// A quadrotor that flies a circle: a loop of models.
    Quadrotor,
}

/// Who is the agent of the pendulum's graph.
pub(super) const AGENT: &str = include_str!("templates/graph/agent.toml");

impl GraphTemplate {
    fn text(self) -> &'static str {
        match self {
            Self::Pendulum => include_str!("templates/graph/pendulum.toml"),
            Self::Quadrotor => include_str!("templates/graph/quadrotor.toml"),
        }
    }
}

/// The text of a graph: its name, how it is used, line by line, and its agent.
pub(super) fn fill(template: GraphTemplate, name: &str, commands: &[String], agent: &str) -> String {
    let commands: Vec<String> = commands.iter().map(|line| format!("#     {line}")).collect();
    template
        .text()
        .replace("@use@", &commands.join("\n"))
        .replace("@agent@", agent.trim_end())
        .replace("@plant@", pendulum::SYSTEM)
        .replace("@name@", name)
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let out = &arguments.out;
    let of_template = arguments.template.to_possible_value().map(|value| value.get_name().to_owned());
    let name = arguments.name.clone().or(of_template).unwrap_or_default();
    word("graph", &name)?;
    let recording = Path::new("out").join(&name).join("recording.mcap").display().to_string();
    let file = out.display().to_string();
    let mut commands = vec![
        format!("parallax sim {file} --out out/{name}/sim.mcap"),
        format!("parallax run {file} --duration 10 --record"),
        format!("parallax info {recording}"),
    ];
    // A loop of models holds its own plant.
    commands.push(match arguments.template {
        GraphTemplate::Pendulum => format!("parallax diagnose {recording}"),
        GraphTemplate::Quadrotor => format!("parallax replay {recording}"),
    });
    let text = fill(arguments.template, &name, &commands, AGENT);
    // What was made is whole.
    let spec = GraphSpec::from_toml(&text).runtime()?;
    validate(&spec)?;
    write_new(&[(out.clone(), text)])?;
    output::line(format!("{file} written"));
    output::line(format!("\nNext:\n  {}", commands.join("\n  ")));
    Ok(Outcome::Done)
}

/// An error unless `name` can name a file and a node.
pub(super) fn word(what: &str, name: &str) -> Result<(), Failure> {
    let legal = name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    if legal {
        return Ok(());
    }
    Err(Failure::input(anyhow!(
        "{name:?} cannot be a {what}'s name: lower-case letters, digits and underscores, and a letter first, such as my_agent"
    )))
}
