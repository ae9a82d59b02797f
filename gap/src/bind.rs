//! Binds a system to a log: which signal is which input and output, and whether they can be compared.

use parallax_model::system::{Equations, System, SystemError};
use parallax_runtime::recording::log::{Log, Role, Signal, UnknownSignal};

use crate::experiment::{Experiment, Held, Sample, SupplyVoltage};

/// Why a system and a log do not fit together.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// The system's equations are not complete.
    #[error(transparent)]
    System(Box<SystemError>),
    /// An input or output names a signal that the recording lacks.
    #[error("{file}: {kind} `{name}` is bound to a signal that the recording does not have: {source}")]
    Signal {
        /// The system's file.
        file: String,
        /// `input` or `output`.
        kind: &'static str,
        /// The key in the file.
        name: String,
        /// What is missing, and what there is.
        source: Box<UnknownSignal>,
    },
    /// An input is bound to a signal that cannot drive it.
    #[error(
        "{file}: input `{name}` is bound to `{signal}`, a {role}; inputs are driven by signals of role command or context, or by a reference that is bound on purpose"
    )]
    Role {
        /// The system's file.
        file: String,
        /// The key in the file.
        name: String,
        /// The signal.
        signal: String,
        /// Its role.
        role: &'static str,
    },
    /// An output and its signal have different units.
    #[error(
        "{file}: output `{name}` is in `{expected}`, but its signal `{signal}` is recorded in `{found}`; convert one of them, or correct the label"
    )]
    Unit {
        /// The system's file.
        file: String,
        /// The key in the file.
        name: String,
        /// The signal.
        signal: String,
        /// The output's unit.
        expected: String,
        /// The signal's unit.
        found: String,
    },
    /// Too little data to fit anything.
    #[error("recording `{title}`: output `{name}` has {count} samples; a diagnosis needs at least {needed}")]
    TooShort {
        /// The recording.
        title: String,
        /// The output.
        name: String,
        /// Its samples.
        count: usize,
        /// How many there should be.
        needed: usize,
    },
    /// No recording was given.
    #[error("no recording was given; a diagnosis needs at least one")]
    Nothing,
    /// The system compares nothing.
    #[error("{file}: the system has no [outputs], so there is nothing to compare with the recording")]
    NoOutputs {
        /// The system's file.
        file: String,
    },
}

impl From<SystemError> for BindError {
    fn from(error: SystemError) -> Self {
        BindError::System(Box::new(error))
    }
}

/// Binds a system to several recordings: the system with the first one's constants, and the recordings one after the
/// other, each with its own.
///
/// # Errors
///
/// [`BindError`] when one of them does not fit.
pub fn bind_all(system: &System, logs: &[Log]) -> Result<(Equations, Experiment), BindError> {
    let mut bound = logs.iter().map(|log| bind(system, log)).collect::<Result<Vec<_>, _>>()?;
    if bound.len() == 1 {
        return Ok(bound.remove(0));
    }
    let names = |equations: &Equations| -> Vec<String> {
        equations.system().parameters.iter().map(|p| p.name.clone()).collect()
    };
    let Some((equations, _)) = bound.first().cloned() else { return Err(BindError::Nothing) };
    // Constants may come in another order. What the equations use is in each recording, or binding it has failed.
    let (order, usual) = (names(&equations), equations.nominal());
    let recordings = bound
        .into_iter()
        .zip(logs)
        .map(|((own, experiment), log)| {
            let (own_names, values) = (names(&own), own.nominal());
            let value = |(name, usual): (&String, &f64)| {
                own_names.iter().position(|n| n == name).map_or(*usual, |k| values[k])
            };
            (log.title.clone(), experiment, order.iter().zip(&usual).map(value).collect())
        })
        .collect();
    Ok((equations, Experiment::join(recordings)))
}

/// Fewest samples of an output from which a gap can be told from noise.
const FEWEST_SAMPLES: usize = 50;

/// The system with the recording's constants, and the recording's signals in the system's order.
///
/// Times are seconds since the first sample of the recording.
///
/// # Errors
///
/// [`BindError`] when names, roles or units do not fit, or the log is too short.
pub fn bind(system: &System, log: &Log) -> Result<(Equations, Experiment), BindError> {
    let file = || system.file.clone();
    if system.outputs.is_empty() {
        return Err(BindError::NoOutputs { file: file() });
    }
    let equations = system.with_constants(&log.constants)?.equations()?;
    let start = log.span().map_or(0, |(first, _)| first);
    let seconds = |time: i64| (time - start) as f64 * 1e-9;
    let find = |kind, name: &str, signal: &str| -> Result<&Signal, BindError> {
        log.signal(signal).map_err(|source| BindError::Signal {
            file: file(),
            kind,
            name: name.into(),
            source: Box::new(source),
        })
    };
    let mut experiment = Experiment::default();
    for input in &system.inputs {
        let names = [&input.signal].into_iter().chain(&input.others);
        let signals = names.map(|name| find("input", &input.name, name)).collect::<Result<Vec<_>, _>>()?;
        if let Some(signal) = signals.iter().find(|signal| signal.role == Role::Measurement) {
            return Err(BindError::Role {
                file: file(),
                name: input.name.clone(),
                signal: signal.name.clone(),
                role: signal.role.name(),
            });
        }
        let held = |signal: &&Signal| Held {
            times: signal.times.iter().map(|t| seconds(*t)).collect(),
            values: signal.values.clone(),
        };
        let signal = signals[0];
        experiment.inputs.push(Held::mean(signals.iter().map(held).collect()));
        experiment.input_units.push(signal.unit.clone());
        experiment.given.push(signal.role == Role::Context);
        let supply = input.supply.as_ref().map(|stated| {
            let signal = find("the supply of input", &input.name, &stated.signal)?;
            let voltage = Held {
                times: signal.times.iter().map(|t| seconds(*t)).collect(),
                values: signal.values.clone(),
            };
            Ok::<_, BindError>(SupplyVoltage { voltage, nominal: stated.nominal })
        });
        experiment.supplies.push(supply.transpose()?);
    }
    for (index, output) in system.outputs.iter().enumerate() {
        let signal = find("output", &output.name, &output.signal)?;
        if !output.unit.is_empty() && !signal.unit.is_empty() && output.unit != signal.unit {
            return Err(BindError::Unit {
                file: file(),
                name: output.name.clone(),
                signal: signal.name.clone(),
                expected: output.unit.clone(),
                found: signal.unit.clone(),
            });
        }
        if signal.values.len() < FEWEST_SAMPLES {
            return Err(BindError::TooShort {
                title: log.title.clone(),
                name: output.name.clone(),
                count: signal.values.len(),
                needed: FEWEST_SAMPLES,
            });
        }
        let samples = signal.times.iter().zip(&signal.values);
        experiment.samples.extend(samples.map(|(t, v)| Sample {
            stamp: seconds(*t),
            output: index,
            value: *v,
        }));
        experiment.wraps.push(output.wrap);
    }
    experiment.samples.sort_by(|a, b| a.stamp.total_cmp(&b.stamp).then(a.output.cmp(&b.output)));
    Ok((equations, experiment))
}
