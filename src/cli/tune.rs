//! `parallax set`, `get` and `reset`: parameters and state of a running node.

use std::time::Duration;

use anyhow::anyhow;
use clap::Args;
use parallax_runtime::launch::{AskError, LiveError, Told, read_node, reset_state, set_parameters};
use parallax_runtime::time::{Nanos, to_seconds};
use parallax_runtime::tuning::{Assignment, Parameter};

use super::args::duration;
use super::failure::{Failure, Outcome, Sort};
use super::output;

pub(crate) const SET_HELP: &str = "\
Examples:
  parallax set pendulum motor.rated=2
  parallax set pendulum \"motor.rated=2 V\" --json
  parallax set 12345 pid.low=-1 pid.high=1        both before the same step

A new value takes effect at the start of a step, and the recording says of which, and who set it: a replay sets the same value
before the same step. What a node does not take is refused, and nothing is changed then. `parallax get RUN NODE` lists what a
node takes. A node that is started again gets the values again.

Exit codes:
  0    done
  2    there is no such run, node or parameter, or the node refuses the value
  3    the run did not answer";

#[derive(Args)]
pub(crate) struct Place {
    /// The run: its id, the process of its launcher, or the name of its graph (`parallax top --list`).
    run: String,
    /// How long to wait for the node's next step.
    #[arg(long, value_name = "SECONDS", value_parser = duration, default_value = "10")]
    patience: Nanos,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
pub(crate) struct Set {
    #[command(flatten)]
    place: Place,
    /// What to set: parameters of one node, all before the same step. A unit is compared with the parameter's, not converted.
    #[arg(required = true, value_name = "NODE.PARAMETER=VALUE")]
    values: Vec<String>,
}

#[derive(Args)]
pub(crate) struct Get {
    #[command(flatten)]
    place: Place,
    /// The node.
    node: String,
}

#[derive(Args)]
pub(crate) struct Reset {
    #[command(flatten)]
    place: Place,
    /// The node.
    node: String,
}

impl Place {
    fn patience(&self) -> Duration {
        Duration::from_nanos(self.patience.unsigned_abs())
    }

    /// Says what was changed.
    fn tell(&self, told: &Told) -> Result<Outcome, Failure> {
        if self.json {
            output::json(told)?;
        } else {
            told.changes.iter().for_each(|change| output::line(change.to_string()));
        }
        Ok(Outcome::Done)
    }
}

pub(crate) fn set(arguments: &Set) -> Result<Outcome, Failure> {
    let Set { place, values } = arguments;
    let parsed = values.iter().map(|text| Assignment::parse(text)).collect::<Result<Vec<_>, _>>().input()?;
    let node = parsed[0].0.clone();
    if let Some((other, _)) = parsed.iter().find(|(other, _)| *other != node) {
        return Err(Failure::input(anyhow!(
            "`{node}` and `{other}` are two nodes, whose steps are not the same: set them one after the other"
        )));
    }
    let assignments: Vec<Assignment> = parsed.into_iter().map(|(_, assignment)| assignment).collect();
    let told = set_parameters(Some(&place.run), &node, &assignments, place.patience()).map_err(sort)?;
    place.tell(&told)
}

pub(crate) fn reset(arguments: &Reset) -> Result<Outcome, Failure> {
    let Reset { place, node } = arguments;
    let told = reset_state(Some(&place.run), node, place.patience()).map_err(sort)?;
    place.tell(&told)
}

pub(crate) fn get(arguments: &Get) -> Result<Outcome, Failure> {
    let Get { place, node } = arguments;
    let told = read_node(Some(&place.run), node, place.patience()).map_err(sort)?;
    if place.json {
        output::json(&told)?;
        return Ok(Outcome::Done);
    }
    output::line(format!("{node}, before step {} at {:.3} s", told.step, to_seconds(told.time)));
    let bound = |bound: Option<f64>| bound.map_or_else(String::new, |bound| format!("{bound}"));
    let row = |(parameter, value): &(Parameter, f64)| {
        let Parameter { name, unit, low, high } = parameter;
        // The smallest number above zero is written for people.
        let low = if *low == Some(f64::MIN_POSITIVE) { "above 0".into() } else { bound(*low) };
        vec![name.clone(), value.to_string(), unit.clone(), low, bound(*high)]
    };
    let rows: Vec<Vec<String>> = told.parameters.iter().map(row).collect();
    if !rows.is_empty() {
        output::table(&["parameter", "value", "unit", "at least", "at most"], &rows);
    }
    let rows: Vec<Vec<String>> =
        told.state.iter().map(|(name, value)| vec![name.clone(), value.to_string()]).collect();
    if !rows.is_empty() {
        output::table(&["state", "value"], &rows);
    }
    Ok(Outcome::Done)
}

/// What was asked for cannot be; or the run does not answer.
fn sort(error: AskError) -> Failure {
    match error {
        AskError::Run(LiveError::Channel(_))
        | AskError::Unreachable { .. }
        | AskError::Ended { .. }
        | AskError::Silent { .. } => Failure::runtime(error),
        AskError::Run(_) | AskError::Refused { .. } => Failure::input(error),
    }
}
