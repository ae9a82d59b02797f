//! Reads a `recording.toml`.

use std::collections::BTreeMap;

use serde::Deserialize;
use toml::Spanned;

use super::error::ImportError;
use crate::recording::log::Role;

/// What a `recording.toml` says, with the line of each signal.
pub(super) struct Manifest {
    pub(super) title: String,
    pub(super) license: String,
    pub(super) constants: Vec<(String, f64)>,
    pub(super) signals: Vec<SignalEntry>,
}

pub(super) struct SignalEntry {
    pub(super) line: usize,
    pub(super) name: String,
    pub(super) role: Role,
    pub(super) unit: String,
    pub(super) file: String,
    pub(super) time: String,
    pub(super) value: String,
}

#[derive(Deserialize)]
struct Version {
    format: Option<Spanned<toml::Value>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    #[allow(dead_code, reason = "it has been checked, but must be a known field")]
    format: i64,
    #[serde(default)]
    title: String,
    #[serde(default)]
    license: String,
    #[serde(default)]
    constants: BTreeMap<String, Spanned<toml::Value>>,
    #[serde(default)]
    signal: Vec<Spanned<RawSignal>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawSignal {
    name: Spanned<String>,
    role: Spanned<String>,
    #[serde(default)]
    unit: String,
    file: String,
    time: String,
    value: String,
}

pub(super) fn read(text: &str, file: &str) -> Result<Manifest, ImportError> {
    let line =
        |byte: usize| text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count() + 1;
    let toml = |error: toml::de::Error| ImportError::Toml {
        file: file.into(),
        line: error.span().map_or(1, |span| line(span.start)),
        message: error.message().trim_end().into(),
    };
    if text.trim().is_empty() {
        return Err(ImportError::Empty {
            file: file.into(),
            remedy: "it should start with `format = 1` and name signals",
        });
    }
    let version: Version = toml::from_str(text).map_err(toml)?;
    match version.format {
        None => return Err(ImportError::MissingFormat { file: file.into() }),
        Some(format) if format.get_ref().as_integer() != Some(1) => {
            return Err(ImportError::UnsupportedFormat {
                file: file.into(),
                line: line(format.span().start),
                found: format.get_ref().to_string(),
            });
        }
        Some(_) => {}
    }

    let raw: Raw = toml::from_str(text).map_err(toml)?;
    let mut constants = Vec::with_capacity(raw.constants.len());
    for (name, value) in raw.constants {
        let number = match value.get_ref() {
            toml::Value::Integer(whole) => Some(*whole as f64),
            toml::Value::Float(number) => Some(*number).filter(|number| number.is_finite()),
            _ => None,
        };
        let bad = || ImportError::BadConstant {
            file: file.into(),
            line: line(value.span().start),
            name: name.clone(),
        };
        constants.push((name.clone(), number.ok_or_else(bad)?));
    }

    let mut lines: BTreeMap<String, usize> = BTreeMap::new();
    let mut signals = Vec::with_capacity(raw.signal.len());
    for signal in raw.signal {
        let RawSignal { name, role, unit, file: csv, time, value } = signal.into_inner();
        let at = line(name.span().start);
        let name = name.into_inner();
        if name.is_empty() {
            let message = "a signal's name is empty; give it one".into();
            return Err(ImportError::Toml { file: file.into(), line: at, message });
        }
        if let Some(first_line) = lines.insert(name.clone(), at) {
            return Err(ImportError::DuplicateSignal { file: file.into(), line: at, name, first_line });
        }
        let role = role.get_ref().parse().map_err(|problem| ImportError::Role {
            file: file.into(),
            line: line(role.span().start),
            signal: name.clone(),
            problem,
        })?;
        signals.push(SignalEntry { line: at, name, role, unit, file: csv, time, value });
    }
    if signals.is_empty() {
        return Err(ImportError::NoSignals { file: file.into() });
    }
    Ok(Manifest { title: raw.title, license: raw.license, constants, signals })
}
