//! Every effect of the library, hidden in a world with formulas of its own, and found by the diagnosis.

mod support;

use parallax_gap::diagnosis::{Diagnosis, Options, diagnose_experiment};
use parallax_model::system::System;
use support::{Hidden, SYSTEM, record};

/// Long enough for three blocks of held-out time.
const DURATION: f64 = 12.0;

fn diagnosed(hidden: Hidden, seed: u64) -> Diagnosis {
    let system = System::parse(SYSTEM, "pendulum.toml").expect("the system is valid");
    let equations = system.equations().expect("the equations are complete");
    let experiment = record(hidden, seed, DURATION);
    diagnose_experiment(equations, experiment, "pendulum", &Options::default(), &|_, _| ())
        .expect("it can be diagnosed")
}

/// The effect leads, with these parameters, and closes the gap on held-out time.
fn is_found(hidden: Hidden, name: &str, place: &str, parameters: &[(&str, f64)]) {
    let label = format!("{name}@{place}");
    let report = diagnosed(hidden, 7).report;
    assert!(report.gap.detected, "{label}: not detected, p = {}", report.gap.p_value);
    let leader = &report.which[0];
    assert!(leader.class.contains(&label), "{label}: the answer is {:?}", leader.class);
    let closed = report.how_far.closed_by_effect.value;
    assert!(closed > 0.9, "{label}: closes only {closed}");
    // A class is named by its simplest member; the values are the truth's where it is the one that is named.
    let Some(effect) = leader.effects.iter().find(|e| e.name == name && e.place == place) else { return };
    for (parameter, truth) in parameters {
        let found = &effect.parameters[*parameter];
        let allowed = 3.0 * found.std + 0.05 * truth.abs();
        assert!(
            (found.value - truth).abs() <= allowed,
            "{label}: {parameter} is {} ± {}, not {truth}",
            found.value,
            found.std
        );
    }
}

/// One test for each effect, so that a failing one names itself.
macro_rules! found {
    ($($test:ident: $hidden:expr => $name:literal at $place:literal with $parameters:expr;)*) => {
        $(#[test]
        fn $test() {
            is_found($hidden, $name, $place, &$parameters);
        })*
    };
}

found! {
    delay: Hidden { input_delay: 0.03, ..Hidden::default() } => "delay" at "input:u" with [("delay", 0.03)];
    lag: Hidden { lag: 0.06, ..Hidden::default() } => "lag" at "input:u" with [("time_constant", 0.06)];
    offset: Hidden { offset: 0.4, ..Hidden::default() } => "offset" at "input:u" with [("offset", 0.4)];
    saturation: Hidden { limit: Some(1.2), ..Hidden::default() }
        => "saturation" at "input:u" with [("low", -1.2), ("high", 1.2)];
    deadband: Hidden { deadband: 0.4, ..Hidden::default() } => "deadband" at "input:u" with [("width", 0.4)];
    viscous: Hidden { viscous: 0.012, ..Hidden::default() }
        => "viscous" at "joint:shaft" with [("coefficient", 0.012)];
    coulomb: Hidden { forward: 0.03, backward: 0.03, ..Hidden::default() }
        => "coulomb" at "joint:shaft" with [("force", 0.03)];
    asymmetric_friction: Hidden { forward: 0.05, backward: 0.015, ..Hidden::default() }
        => "asymmetric_friction" at "joint:shaft" with [("forward", 0.05), ("backward", 0.015)];
    bias: Hidden { bias: 0.08, ..Hidden::default() } => "bias" at "output:angle" with [("bias", 0.08)];
    parameter: Hidden { mass: 0.08, ..Hidden::default() } => "parameter" at "parameter:m" with [("value", 0.33)];
}

#[test]
fn nothing_hidden_is_no_gap() {
    for seed in [1, 2] {
        let report = diagnosed(Hidden::default(), seed).report;
        assert!(!report.gap.detected, "seed {seed}: {}", report.summary);
    }
}

#[test]
fn a_wall_is_none_of_these() {
    let report = diagnosed(Hidden { wall: 3.0, ..Hidden::default() }, 7).report;
    assert!(report.gap.detected, "p = {}", report.gap.p_value);
    for answer in &report.which {
        assert!(
            report.unexplained.probability > answer.probability,
            "{:?} has {}, the unknown {}",
            answer.class,
            answer.probability,
            report.unexplained.probability
        );
    }
}
