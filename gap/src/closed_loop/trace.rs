//! What the names of a task stand for, and the signals of one closed loop, recorded or simulated.

use std::sync::Arc;

use parallax_model::system::{BoundTask, System, Task};
use parallax_runtime::recording::log::Log;

use super::ClosedLoopError;
use crate::experiment::{Experiment, Held};

/// What an input of the task's equations reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    /// The readings of this output of the machine.
    Reading(usize),
    /// The commands at this input of the machine.
    Command(usize),
    /// The signal of this index among [`Bound::others`]: a goal, a measured circumstance.
    Other(usize),
}

/// A task bound to a machine and its recordings.
#[derive(Clone, Debug)]
pub(super) struct Bound {
    /// The controller and the cost.
    pub(super) equations: BoundTask,
    /// What each input of both reads.
    pub(super) sources: Vec<Source>,
    /// Signals that are neither readings nor commands of the machine.
    pub(super) others: Vec<String>,
    /// The machine's input that each output of the controller commands.
    pub(super) commands: Vec<usize>,
}

impl Bound {
    /// Binds `task` to the machine `system` and the signals that every log has.
    pub(super) fn new(task: &Task, system: &System, logs: &[Log]) -> Result<Self, ClosedLoopError> {
        let signals: Vec<&str> = logs.first().map_or(Vec::new(), |log| {
            let everywhere = |name: &&str| logs.iter().all(|log| log.signal(name).is_ok());
            log.signals.iter().map(|s| s.name.as_str()).filter(everywhere).collect()
        });
        let of_output = |name: &str| system.outputs.iter().position(|o| o.name == name);
        let of_input = |name: &str| system.inputs.iter().position(|i| i.name == name);
        let named = |name: &str| {
            let output = of_output(name).map(|k| system.outputs[k].signal.clone());
            let input = || of_input(name).map(|k| system.inputs[k].signal.clone());
            output.or_else(input).or_else(|| signals.contains(&name).then(|| name.to_owned()))
        };
        let mut known: Vec<&str> = system.outputs.iter().map(|o| o.name.as_str()).collect();
        known.extend(system.inputs.iter().map(|i| i.name.as_str()));
        known.extend(signals.iter().filter(|name| !name.contains('.')));
        let equations = task.bind(&known, named)?;

        let mut others = Vec::new();
        let mut sources = Vec::new();
        for input in &equations.controller.system().inputs[..equations.signals] {
            let output = of_output(&input.name).filter(|k| system.outputs[*k].signal == input.signal);
            let output = output.or_else(|| system.outputs.iter().position(|o| o.signal == input.signal));
            let command = of_input(&input.name).filter(|k| system.inputs[*k].signal == input.signal);
            let command = command.or_else(|| system.inputs.iter().position(|i| i.signal == input.signal));
            sources.push(match (output, command) {
                (Some(output), _) => Source::Reading(output),
                (None, Some(command)) => Source::Command(command),
                (None, None) => {
                    if let Some(source) = logs.iter().find_map(|log| log.signal(&input.signal).err()) {
                        return Err(ClosedLoopError::Signal {
                            file: task.system.file.clone(),
                            line: input.line,
                            name: input.name.clone(),
                            source: Box::new(source),
                        });
                    }
                    let place = others.iter().position(|name| *name == input.signal);
                    Source::Other(place.unwrap_or_else(|| {
                        others.push(input.signal.clone());
                        others.len() - 1
                    }))
                }
            });
        }
        let mut commands = Vec::new();
        for output in &task.system.outputs {
            let input = of_input(&output.name)
                .or_else(|| system.inputs.iter().position(|input| input.signal == output.signal));
            let fault = |problem: String| ClosedLoopError::Command {
                file: task.system.file.clone(),
                line: output.line,
                output: output.name.clone(),
                problem,
            };
            let inputs = || system.inputs.iter().map(|i| i.name.as_str()).collect::<Vec<_>>().join(", ");
            match input {
                None => {
                    return Err(fault(format!(
                        "it is no input of the system `{}` (it has: {})",
                        system.name,
                        inputs()
                    )));
                }
                Some(input) if commands.contains(&input) => {
                    return Err(fault("another output commands the same input".into()));
                }
                Some(input) => commands.push(input),
            }
        }
        Ok(Self { equations, sources, others, commands })
    }

    /// What one recording shows of the closed loop; `experiment` is the log bound to the machine.
    pub(super) fn recorded(&self, experiment: &Experiment, log: &Log) -> Trace {
        let readings = (0..experiment.wraps.len()).map(|output| {
            let (times, values) = experiment.output(output);
            Held { times, values }
        });
        let first = log.span().map_or(0, |(first, _)| first);
        let other = |name: &String| {
            log.signal(name).map_or_else(
                |_| Held::default(),
                |signal| Held {
                    times: signal.times.iter().map(|t| (t - first) as f64 * 1e-9).collect(),
                    values: signal.values.clone(),
                },
            )
        };
        Trace {
            readings: readings.collect(),
            commands: experiment.inputs.clone(),
            others: self.others.iter().map(other).collect(),
        }
    }
}

/// The signals of one closed loop; times in seconds from the recording's first stamp.
#[derive(Clone, Debug)]
pub(super) struct Trace {
    /// One per output of the machine.
    pub(super) readings: Vec<Held>,
    /// One per input of the machine.
    pub(super) commands: Vec<Held>,
    /// One per signal of [`Bound::others`].
    pub(super) others: Arc<[Held]>,
}

impl Trace {
    pub(super) fn channel(&self, source: Source) -> &Held {
        match source {
            Source::Reading(k) => &self.readings[k],
            Source::Command(k) => &self.commands[k],
            Source::Other(k) => &self.others[k],
        }
    }

    /// The readings and commands stamped from `from` on and before `to`, and all others.
    pub(super) fn part(&self, from: f64, to: f64) -> Trace {
        let cut = |held: &Held| {
            let (a, b) = (held.times.partition_point(|t| *t < from), held.times.partition_point(|t| *t < to));
            Held { times: held.times[a..b.max(a)].to_vec(), values: held.values[a..b.max(a)].to_vec() }
        };
        Trace {
            readings: self.readings.iter().map(cut).collect(),
            commands: self.commands.iter().map(cut).collect(),
            others: Arc::clone(&self.others),
        }
    }
}
