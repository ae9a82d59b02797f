//! What is in an imported log.

use parallax_runtime::recording::log::{Log, Signal};
use parallax_runtime::time::to_seconds;
use serde_json::{Value, json};

use crate::cli::failure::Failure;
use crate::cli::output::{self, number};

pub(super) fn show(log: &Log, as_json: bool) -> Result<(), Failure> {
    if as_json {
        let constants: serde_json::Map<String, Value> =
            log.constants.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        return output::json(&json!({
            "kind": "log", "title": log.title, "license": log.license, "constants": constants,
            "duration_s": duration(log), "signals": log.signals.iter().map(describe).collect::<Vec<_>>(),
            "notes": log.notes,
        }));
    }
    output::line(format!("{}: {} signals over {:.3} s", log.title, log.signals.len(), duration(log)));
    if !log.license.is_empty() {
        output::line(format!("licence: {}", log.license));
    }
    for (name, value) in &log.constants {
        output::line(format!("constant {name} = {value}"));
    }
    signals(log);
    Ok(())
}

fn duration(log: &Log) -> f64 {
    log.span().map_or(0.0, |(first, last)| to_seconds(last - first))
}

/// The signals as a table, and the notes.
pub(super) fn signals(log: &Log) {
    let rows: Vec<Vec<String>> = log
        .signals
        .iter()
        .map(|signal| {
            let low = signal.values.iter().copied().fold(f64::INFINITY, f64::min);
            let high = signal.values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            vec![
                signal.name.clone(),
                signal.role.to_string(),
                signal.unit.clone(),
                signal.values.len().to_string(),
                signal.rate().map_or_else(String::new, |rate| format!("{rate:.2}")),
                if signal.values.is_empty() { String::new() } else { number(low) },
                if signal.values.is_empty() { String::new() } else { number(high) },
            ]
        })
        .collect();
    output::table(&["signal", "role", "unit", "samples", "rate (Hz)", "smallest", "largest"], &rows);
    for note in &log.notes {
        output::line(format!("note: {note}"));
    }
}

/// A signal for scripts.
pub(super) fn describe(signal: &Signal) -> Value {
    let (start, end) =
        signal.span().map_or((None, None), |(a, b)| (Some(to_seconds(a)), Some(to_seconds(b))));
    json!({
        "name": signal.name, "role": signal.role, "unit": signal.unit, "samples": signal.values.len(),
        "rate_hz": signal.rate(), "start_s": start, "end_s": end,
    })
}
