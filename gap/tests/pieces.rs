//! Machines that fall apart into pieces which share nothing.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_gap::diagnosis::{Diagnosis, DiagnosisError, Options, diagnose};
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Two servos that are believed to follow their goals at once.
const SYSTEM: &str = r#"
format = 1
name = "two servos"
[inputs]
pan = { signal = "goal_pan" }
tilt = { signal = "goal_tilt" }
[outputs]
pan = { value = "pan", unit = "rad" }
tilt = { value = "tilt", unit = "rad" }
"#;

/// The first one follows 60 ms late, the second one with nine tenths of the way.
fn log() -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let times: Vec<i64> = (0..1000).map(|k| k * 20_000_000).collect();
    let signal = |name: &str, role, values| Signal::new(name, role, "rad", times.clone(), values);
    let goal = |rate: f64, k: i32| {
        (rate * 0.02 * f64::from(k)).sin() + 0.3 * (2.7 * rate * 0.02 * f64::from(k)).sin()
    };
    let goals = |rate: f64| (0..1000).map(|k| goal(rate, k)).collect::<Vec<f64>>();
    let mut noise = || 0.002 * (random.random_range(-1.0..1.0_f64) + random.random_range(-1.0..1.0_f64));
    let pan = (0..1000).map(|k| goal(3.0, (k - 3).max(0)) + noise()).collect();
    let tilt = (0..1000).map(|k| 0.9 * goal(2.0, k) + noise()).collect();
    Log {
        title: "two servos".into(),
        signals: vec![
            signal("goal_pan", Role::Command, goals(3.0)),
            signal("goal_tilt", Role::Command, goals(2.0)),
            signal("pan", Role::Measurement, pan),
            signal("tilt", Role::Measurement, tilt),
        ],
        ..Log::default()
    }
}

fn diagnosed(options: &Options) -> Result<Diagnosis, DiagnosisError> {
    let system = System::parse(SYSTEM, "servos.toml").unwrap();
    diagnose(&system, &log(), options, &|_, _| ())
}

#[test]
fn each_piece_has_a_cause_of_its_own() {
    let report = diagnosed(&Options::default()).unwrap().report;
    let leader = &report.which[0];
    let found =
        |name: &str| leader.effects.iter().find(|e| e.name == name).unwrap_or_else(|| panic!("{leader:?}"));
    assert_eq!(leader.effects.len(), 2, "{leader:?}");
    let (delay, gain) = (&found("delay").parameters["delay"], &found("gain").parameters["gain"]);
    assert!((delay.value - 0.06).abs() < 0.002, "{delay:?}");
    assert!((gain.value - 0.9).abs() < 0.005, "{gain:?}");
    // What one piece cannot tell apart is in the class of the whole.
    assert!(
        leader.class.len() > 1 && leader.class.iter().all(|name| name.contains(" + ")),
        "{:?}",
        leader.class
    );
    assert!(report.how_far.closed_by_effect.value > 0.95, "{:?}", report.how_far);
    let parts: f64 = report.how_far.split.iter().map(|s| s.share).sum();
    assert!((parts - report.how_far.closed_by_effect.value).abs() < 0.05, "{:?}", report.how_far);
    assert!(report.summary.contains("input:pan") && report.summary.contains("tilt"), "{}", report.summary);
}

#[test]
fn only_the_pieces_that_are_asked_for_are_diagnosed() {
    let only = |pattern: &str| Options { only: vec![pattern.parse().unwrap()], ..Options::default() };
    let diagnosis = diagnosed(&only("input:tilt")).unwrap();
    let names: Vec<&str> = diagnosis.report.which[0].effects.iter().map(|e| e.name.as_str()).collect();
    assert_eq!(names, ["gain"]);
    assert_eq!(diagnosis.overlays.iter().map(|o| o.output.as_str()).collect::<Vec<_>>(), ["tilt"]);
    // A name that no piece has is refused as ever.
    let error = diagnosed(&only("input:roll")).unwrap_err().to_string();
    assert!(error.contains("input:roll") && error.contains("no such effect"), "{error}");
}
