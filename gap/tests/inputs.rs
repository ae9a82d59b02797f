//! What a user can get wrong: each error names the place and the remedy.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Options, diagnose};
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal, Source};

/// The log of a pendulum, as an import gives it.
fn log(duration: f64) -> Log {
    let experiment = record(Hidden::default(), 1, duration);
    let signal = |name: &str, role, unit: &str, times: &[f64], values: Vec<f64>| Signal {
        name: name.into(),
        role,
        unit: unit.into(),
        times: times.iter().map(|t| (t * 1e9).round() as i64).collect(),
        values,
        source: Source { file: "log.csv".into(), column: name.into() },
    };
    let held = &experiment.inputs[0];
    let (stamps, values) = experiment.output(0);
    Log {
        title: "a pendulum".into(),
        signals: vec![
            signal("voltage", Role::Command, "V", &held.times, held.values.clone()),
            signal("angle", Role::Measurement, "rad", &stamps, values),
        ],
        ..Log::default()
    }
}

/// The error of a diagnosis of `system` on `log`, which must name all of `parts`.
fn refused(system: &str, log: &Log, parts: &[&str]) {
    let system = System::parse(system, "pendulum.toml").expect("the system is valid");
    let error =
        diagnose(&system, log, &Options::default(), &|_, _| ()).expect_err("it is refused").to_string();
    for part in parts {
        assert!(error.contains(part), "`{error}` lacks `{part}`");
    }
}

#[test]
fn an_unknown_signal_is_named_with_the_nearest_one() {
    let system = SYSTEM.replace("signal = \"voltage\"", "signal = \"voltag\"");
    refused(&system, &log(1.0), &["pendulum.toml", "`u`", "`voltag`", "`voltage`"]);
}

#[test]
fn an_unknown_output_signal_is_named_with_all_there_are() {
    let mut log = log(1.0);
    log.signals[1].name = "encoder".into();
    refused(SYSTEM, &log, &["pendulum.toml", "output `angle`", "encoder", "a pendulum"]);
}

#[test]
fn units_that_differ_are_named() {
    let mut log = log(1.0);
    log.signals[1].unit = "deg".into();
    refused(SYSTEM, &log, &["pendulum.toml", "`angle`", "`rad`", "`deg`", "convert"]);
}

#[test]
fn a_measurement_drives_no_input() {
    let mut log = log(1.0);
    log.signals[0].role = Role::Measurement;
    refused(SYSTEM, &log, &["pendulum.toml", "`u`", "`voltage`", "measurement", "command or context"]);
}

#[test]
fn too_few_samples_are_counted() {
    refused(SYSTEM, &log(0.3), &["a pendulum", "`angle`", "31 samples", "50"]);
}

#[test]
fn a_short_log_names_its_length() {
    refused(SYSTEM, &log(0.6), &["a pendulum", "0.600 s", "Record longer"]);
}

#[test]
fn a_system_that_is_not_finite_names_system_and_recording() {
    let system =
        SYSTEM.replace("(k*u - m*g*l*sin(q) - b*w)/J", "(k*u - m*g*l*sin(q) - b*w)/J + sqrt(-1 - q*q)");
    refused(&system, &log(6.0), &["pendulum.toml", "a pendulum", "not finite"]);
}
