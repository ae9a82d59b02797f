//! Holds a system against the signals of a recording.

use super::System;
use super::error::{Location, Suggestion, SystemError};
use super::parts::Initial;

impl System {
    /// Every signal that the system names: what names it (such as "input `u`"), its line and the signal.
    pub fn signals(&self) -> Vec<(String, usize, &str)> {
        let mut named = Vec::new();
        for input in &self.inputs {
            let what = format!("input `{}`", input.name);
            if let Some(supply) = &input.supply {
                named.push((format!("the supply of {what}"), input.line, supply.signal.as_str()));
            }
            for other in &input.others {
                named.push((what.clone(), input.line, other.as_str()));
            }
            named.push((what, input.line, input.signal.as_str()));
        }
        for state in &self.states {
            if let Initial::Signal(signal) = &state.initial {
                named.push((
                    format!("the initial value of state `{}`", state.name),
                    state.line,
                    signal.as_str(),
                ));
            }
        }
        for output in &self.outputs {
            named.push((format!("output `{}`", output.name), output.line, output.signal.as_str()));
        }
        named
    }

    /// Checks that a recording with these signals (name and unit) has all that the system names, and that each
    /// output's unit is its signal's. A unit that either leaves empty is not compared.
    ///
    /// # Errors
    ///
    /// [`SystemError::MissingSignal`] or [`SystemError::UnitMismatch`], with the line of the entry.
    pub fn check_signals(&self, recorded: &[(&str, &str)]) -> Result<(), SystemError> {
        let names = || recorded.iter().map(|(name, _)| *name);
        for (within, line, signal) in self.signals() {
            if !names().any(|name| name == signal) {
                return Err(SystemError::MissingSignal {
                    at: Location::new(&self.file, line),
                    within: within.into(),
                    signal: signal.into(),
                    suggestion: Suggestion::nearest(signal, names()),
                    available: names().collect::<Vec<_>>().join(", ").into(),
                });
            }
        }
        for output in &self.outputs {
            let unit = recorded.iter().find(|(name, _)| *name == output.signal).map_or("", |(_, unit)| unit);
            if !unit.is_empty() && !output.unit.is_empty() && unit != output.unit {
                return Err(SystemError::UnitMismatch {
                    at: Location::new(&self.file, output.line),
                    output: output.name.as_str().into(),
                    unit: output.unit.as_str().into(),
                    signal: output.signal.as_str().into(),
                    recorded: unit.into(),
                });
            }
        }
        Ok(())
    }
}
