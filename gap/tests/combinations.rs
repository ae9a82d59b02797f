//! Two causes at once, from an integrator that shares nothing with the library.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_gap::report::Report;
use parallax_model::system::System;

fn diagnose(hidden: Hidden, seed: u64) -> Report {
    let equations = System::parse(SYSTEM, "pendulum.toml").expect("valid").equations().expect("complete");
    let experiment = record(hidden, seed, 20.0);
    let found = diagnose_experiment(equations, experiment, "pendulum", &Options::default(), &|_, _| ());
    found.expect("it can be diagnosed").report
}

fn names(report: &Report) -> Vec<String> {
    let mut names: Vec<String> = report.which[0].effects.iter().map(|e| e.name.clone()).collect();
    names.sort_unstable();
    names
}

#[test]
fn dry_friction_beside_a_late_command() {
    let report =
        diagnose(Hidden { forward: 0.03, backward: 0.03, input_delay: 0.04, ..Hidden::default() }, 11);
    let names = names(&report);
    // The world's friction holds entirely at rest, where ours is smoothed: the form that rises there may be nearer.
    assert!(names == ["coulomb", "delay"] || names == ["delay", "stribeck"], "{}", report.summary);
    let value = |parameter: &str| {
        let all = report.which[0].effects.iter().find_map(|e| e.parameters.get(parameter));
        all.unwrap_or_else(|| panic!("{parameter}: {}", report.summary)).value
    };
    let force = if names[0] == "coulomb" { "force" } else { "coulomb" };
    assert!((value(force) - 0.03).abs() < 0.003);
    assert!((value("delay") - 0.04).abs() < 0.004);
    // With one sensor, a command that is late and a reading that is are one answer, whichever is in front.
    let class = &report.which[0].class;
    assert!(class.iter().any(|label| label.contains("delay@input:")), "{class:?}");
}

/// It closes less of the gap than the form of the first one might be off by; but nothing at all is left with it.
#[test]
fn a_small_cause_beside_a_large_one() {
    let report = diagnose(Hidden { offset: 0.004, input_delay: 0.04, ..Hidden::default() }, 13);
    let effects = &report.which[0].effects;
    assert_eq!(effects.len(), 2, "{}", report.summary);
    assert_eq!(effects[0].name, "delay", "{}", report.summary);
    assert!(
        ["offset", "constant_force", "bias", "gravity_tilt"].contains(&&*effects[1].name),
        "{}",
        report.summary
    );
}

#[test]
fn a_single_cause_stays_alone() {
    let report = diagnose(Hidden { lag: 0.06, ..Hidden::default() }, 12);
    assert_eq!(names(&report), ["lag"], "{}", report.summary);
}

/// A constant friction and a constant push are the same, and two.
#[test]
fn friction_that_differs_by_direction_stays_alone() {
    for (forward, backward, seed) in [(0.045, 0.012, 17), (0.01, 0.05, 18)] {
        let report = diagnose(Hidden { forward, backward, ..Hidden::default() }, seed);
        assert_eq!(names(&report), ["asymmetric_friction"], "{}", report.summary);
        let found = |name: &str| report.which[0].effects[0].parameters[name].value;
        let off = (found("forward") - forward).abs().max((found("backward") - backward).abs());
        assert!(off < 0.006, "{}", report.summary);
    }
}

/// No form of the library is quite so; what its nearest form leaves is no second cause.
#[test]
fn a_form_that_is_off_has_nothing_beside_it() {
    let bent = diagnose(Hidden { bend: 1.6, ..Hidden::default() }, 20);
    assert!(["saturation", "supply_sag"].contains(&&*names(&bent).join(" ")), "{}", bent.summary);
    let soft = diagnose(Hidden { soft_deadband: 0.4, ..Hidden::default() }, 24);
    assert_eq!(names(&soft), ["deadband"], "{}", soft.summary);
}

/// A spring that stands for the wave of the poles closes all but a hundredth of what the filter leaves, and far from all of it.
#[test]
fn a_wave_beside_a_sensor_that_is_behind_stays_a_wave() {
    let report = diagnose(Hidden { filter: 0.08, poles: (0.02, 11.0), ..Hidden::default() }, 14);
    let names = names(&report);
    assert!(names.contains(&"cogging".into()) && names.len() == 2, "{}", report.summary);
}

/// Each of the two leaves far more than the noise, so that the first one alone is judged by windows, to which a spring's free states
/// are costly; the two together reach it.
#[test]
fn a_spring_in_the_drive_beside_a_clock_that_gains() {
    let report = diagnose(Hidden { skew: 0.002, flexible: Some((8.0, 0.02, 0.3)), ..Hidden::default() }, 15);
    assert_eq!(names(&report), ["clock_skew", "flexibility"], "{}", report.summary);
}

/// Alone, the sensor's filter is fitted best as one of second order; beside the wall that is more than it needs.
#[test]
fn a_sensor_that_is_behind_beside_a_wall_has_no_more_than_it_needs() {
    let report = diagnose(Hidden { filter: 0.014, wall: 40.0, ..Hidden::default() }, 16);
    assert_eq!(names(&report), ["end_stop", "sensor_lag"], "{}", report.summary);
    let lag = report.which[0].effects.iter().find(|e| e.name == "sensor_lag").expect("it is there");
    assert_eq!(lag.parameters.len(), 1, "{}", report.summary);
}
