//! Data as it comes: several recordings with constants of their own, other rates, gaps, missing samples, unknown starts.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{DiagnosisError, Options, diagnose_all};
use parallax_gap::experiment::Experiment;
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};

/// The pendulum, with a mass that each recording states.
fn system() -> System {
    let text = SYSTEM
        .replace("m = { value = 0.25, unit = \"kg\" }\n", "")
        .replace("- b*w)/J", "- b*w)/(J + (m - 0.25)*l*l)")
        .replace("inertia = \"J\"", "inertia = \"J + (m - 0.25)*l*l\"");
    System::parse(&text, "pendulum.toml").expect("valid")
}

/// A log of the world, shifted in time, of which `keep` says which readings are there.
fn log(title: &str, hidden: Hidden, seed: u64, begin: f64, keep: impl Fn(usize, f64) -> bool) -> Log {
    let Experiment { inputs, samples, .. } = record(hidden, seed, 12.0);
    let stamp = |t: f64| ((t + begin) * 1e9).round() as i64;
    let read: Vec<_> =
        samples.iter().enumerate().filter(|(k, s)| keep(*k, s.stamp)).map(|(_, s)| s).collect();
    let signals = vec![
        Signal::new(
            "voltage",
            Role::Command,
            "V",
            inputs[0].times.iter().map(|t| stamp(*t)).collect(),
            inputs[0].values.clone(),
        ),
        Signal::new(
            "angle",
            Role::Measurement,
            "rad",
            read.iter().map(|s| stamp(s.stamp)).collect(),
            read.iter().map(|s| s.value).collect(),
        ),
    ];
    let mut log = Log { title: title.into(), signals, ..Log::default() };
    log.constants.push(("m".into(), 0.25 + hidden.mass));
    log
}

fn dry(mass: f64) -> Hidden {
    Hidden { forward: 0.03, backward: 0.03, mass, ..Hidden::default() }
}

fn force(report: &Report) -> (f64, f64) {
    let effect = &report.which[0].effects[0];
    assert_eq!(effect.place, "joint:shaft", "{}", report.summary);
    let found = effect.parameters.get("force").or_else(|| effect.parameters.get("coulomb"));
    let found = found.unwrap_or_else(|| panic!("{} is no dry friction", effect.name));
    (found.value, found.std)
}

#[test]
fn recordings_share_their_parameters_and_keep_their_constants() {
    let logs = [
        log("light", dry(0.0), 1, 0.0, |_, _| true),
        // Another rate, another load, two seconds lost, and a clock of its own.
        log("heavy", dry(0.15), 2, 1000.0, |k, t| k % 2 == 0 && !(4.0..6.0).contains(&t)),
        log("third", dry(0.08), 3, 7.0, |k, _| k % 7 != 3),
    ];
    let found = diagnose_all(&system(), &logs, &Options::default(), &|_, _| ()).expect("they fit").report;
    assert!(found.gap.detected);
    assert_eq!(found.recordings, ["light", "heavy", "third"]);
    let (value, std) = force(&found);
    assert!((value - 0.03).abs() < 3.0 * std + 0.002, "{value} ± {std}");
    assert!(found.how_far.closed_by_effect.value > 0.9, "{:?}", found.how_far);

    // More recordings of a machine narrow the answer: here the two halves of one.
    let half = |part: usize| {
        let hidden = Hidden { viscous: 0.01, ..Hidden::default() };
        log("half", hidden, 1, 0.0, move |_, t| (6.0 * part as f64..6.0 * (part + 1) as f64).contains(&t))
    };
    let narrowed = |logs: &[Log]| {
        let only = Options { only: vec!["viscous".parse().expect("a pattern")], ..Options::default() };
        let found = diagnose_all(&system(), logs, &only, &|_, _| ()).expect("they fit").report;
        found.which[0].effects[0].parameters["coefficient"].std
    };
    let alone = narrowed(&[half(0)]).min(narrowed(&[half(1)]));
    let together = narrowed(&[half(0), half(1)]);
    assert!(together < alone, "{together} together, {alone} alone");
}

#[test]
fn no_recording_is_an_error() {
    let Err(DiagnosisError::Bind(error)) = diagnose_all(&system(), &[], &Options::default(), &|_, _| ())
    else {
        panic!("it is accepted");
    };
    assert!(error.to_string().contains("at least one"), "{error}");
}
