//! `parallax task`: whole tasks, from a recording to a policy that runs. The Python package does them, because policies are
//! trained in JAX; this starts it, and says so where it is absent.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, anyhow};
use clap::{Args, ValueEnum};
use parallax_model::Tree;
use parallax_model::tree::leaf_names;
use parallax_nodes::pendulum::hidden::{HiddenEffect, Machine};
use parallax_nodes::pendulum::sight;
use parallax_nodes::pendulum::view::{Stand, View};
use parallax_nodes::quadrotor;
use parallax_runtime::launch::signals::Signals;
use serde_json::{Map, Value, json};

use super::failure::{Failure, Outcome, Sort};
use super::{output, python};

/// Asks what a task's machine was, when the task is done.
pub(crate) const MACHINE_COMMAND: &str = "task-machine";

#[derive(Args)]
pub(crate) struct Arguments {
    /// The Python interpreter with the package `parallax` and its extra `train`; without it that of the active virtual
    /// environment, or python3.
    #[arg(long, value_name = "FILE")]
    interpreter: Option<PathBuf>,
    /// The task and its options: `pendulum` or `quadrotor`, or `pendulum --help`.
    #[arg(required = true, trailing_var_arg = true, allow_hyphen_values = true, value_name = "TASK")]
    task: Vec<String>,
}

#[derive(Args)]
pub(crate) struct MachineArguments {
    /// Which task's.
    #[arg(long, value_enum)]
    task: Task,
    #[arg(long)]
    seed: u64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Task {
    Pendulum,
    Quadrotor,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let interpreter = python::interpreter(arguments.interpreter.as_ref());
    let advice = "give one by --interpreter, or activate its environment";
    python::check(&interpreter, "a task trains its policies in Python", advice).map_err(Failure::input)?;
    let program = std::env::current_exe().context("where this program is").map_err(Failure::runtime)?;
    // Ctrl-C reaches both: the task ends what it does, and this waits for it.
    let _signals = Signals::watch().runtime()?;
    let status = Command::new(&interpreter)
        .args(["-m", "parallax.task"])
        .args(&arguments.task)
        .env("PARALLAX_BIN", program)
        .status()
        .with_context(|| format!("{} cannot be started", interpreter.display()))
        .map_err(Failure::runtime)?;
    match status.code() {
        Some(0) => Ok(Outcome::Done),
        Some(130) => Ok(Outcome::Interrupted),
        Some(2) => Err(Failure::input(anyhow!("the task could not begin; see above"))),
        _ => Err(Failure::runtime(anyhow!("the task failed ({status}); see above"))),
    }
}

pub(crate) fn machine(arguments: &MachineArguments) -> Result<Outcome, Failure> {
    let parameters: Vec<(String, f64)> = match arguments.task {
        Task::Pendulum => {
            let truth = HiddenEffect::Machine(Machine::draw(arguments.seed)).truth();
            let parameters = truth.into_iter().flat_map(|truth| truth.parameters);
            parameters
                .map(|(name, value, _)| (name.to_owned(), value))
                .chain(cameras(arguments.seed))
                .collect()
        }
        Task::Quadrotor => {
            let parameters = quadrotor::hidden::Machine::draw(arguments.seed).parameters();
            parameters.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()
        }
    };
    let values: Map<String, Value> =
        parameters.into_iter().map(|(name, value)| (name, json!(value))).collect();
    output::json(&values)?;
    Ok(Outcome::Done)
}

/// The maps of a machine's two cameras, named as the nodes that hold what is identified of them.
fn cameras(seed: u64) -> Vec<(String, f64)> {
    let mut named = Vec::new();
    for (camera, stand) in [("camera", Stand::Front), ("side", Stand::Side)] {
        for (coordinate, map) in ["u", "v"].into_iter().zip(View::draw(seed, stand).maps()) {
            let names = leaf_names::<f64, sight::Map>();
            let values = map.to_vec();
            named.extend(
                names
                    .iter()
                    .zip(values)
                    .map(|(name, value)| (format!("{camera}.{coordinate}.{name}"), value)),
            );
        }
    }
    named
}
