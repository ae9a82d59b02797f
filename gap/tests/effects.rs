//! Every effect of the library, hidden in a world with formulas of its own, and found by the diagnosis.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Diagnosis, Options, diagnose_experiment};
use parallax_model::system::System;

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
    let answers: Vec<_> =
        report.which.iter().take(4).map(|w| (&w.class, w.probability, &w.effects)).collect();
    assert!(leader.class.contains(&label), "{label}: the answers are {answers:?}");
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
    parameter: Hidden { gravity: 2.5, ..Hidden::default() } => "parameter" at "parameter:g" with [("value", 12.31)];
    payload: Hidden { mass: 0.08, ..Hidden::default() } => "payload" at "joint:shaft" with [("mass", 0.08)];
    second_order_lag: Hidden { lag: 0.04, damping: 0.5, ..Hidden::default() }
        => "lag" at "input:u" with [("time_constant", 0.04), ("damping", 0.5)];
    rate_limit: Hidden { rate: Some(9.0), ..Hidden::default() } => "rate_limit" at "input:u" with [("rate", 9.0)];
    backlash: Hidden { play: 0.6, ..Hidden::default() } => "backlash" at "input:u" with [("gap", 0.6)];
    stribeck: Hidden { forward: 0.02, backward: 0.02, breakaway: (0.04, 1.0), ..Hidden::default() }
        => "stribeck" at "joint:shaft" with [("coulomb", 0.02), ("extra", 0.04)];
    load_friction: Hidden { gear: 0.12, ..Hidden::default() } => "load_friction" at "joint:shaft" with [("ratio", 0.12)];
    quadratic_drag: Hidden { drag: 0.004, ..Hidden::default() }
        => "quadratic_drag" at "joint:shaft" with [("coefficient", 0.004)];
    cogging: Hidden { poles: (0.03, 7.0), ..Hidden::default() }
        => "cogging" at "joint:shaft" with [("amplitude", 0.03), ("wavenumber", 7.0)];
    gravity_tilt: Hidden { tilt: 0.1, ..Hidden::default() } => "gravity_tilt" at "joint:shaft" with [("angle", 0.1)];
    spring: Hidden { spring: (0.15, 0.3), ..Hidden::default() }
        => "spring" at "joint:shaft" with [("stiffness", 0.15), ("rest", 0.3)];
    periodic_disturbance: Hidden { vibration: (0.03, 4.3), ..Hidden::default() }
        => "periodic_disturbance" at "joint:shaft" with [("amplitude", 0.03), ("frequency", 4.3)];
    end_stop: Hidden { wall: 3.0, ..Hidden::default() }
        => "end_stop" at "joint:shaft" with [("limit", 0.8), ("stiffness", 3.0)];
    scale: Hidden { scale: 0.12, ..Hidden::default() } => "scale" at "output:angle" with [("scale", 1.12)];
    reversed: Hidden { scale: -2.0, ..Hidden::default() } => "scale" at "output:angle" with [("scale", -1.0)];
    drift: Hidden { drift: 0.01, ..Hidden::default() } => "drift" at "output:angle" with [("rate", 0.01)];
    sensor_lag: Hidden { filter: 0.05, ..Hidden::default() }
        => "sensor_lag" at "output:angle" with [("time_constant", 0.05)];
    clock_skew: Hidden { skew: 0.005, ..Hidden::default() } => "clock_skew" at "output:angle" with [("skew", 0.005)];
}

#[test]
fn flexibility() {
    let (stiffness, ratio) = (8.0, 0.3);
    let hidden = Hidden { flexible: Some((stiffness, 0.02, ratio)), ..Hidden::default() };
    is_found(hidden, "flexibility", "joint:shaft", &[]);
    // One sensor sees the resonance: stiffness over the two inertias in series. How these divide shows in little else.
    let report = diagnosed(hidden, 7).report;
    let found = |name: &str| report.which[0].effects[0].parameters[name].value;
    let square = |stiffness: f64, ratio: f64| stiffness / (ratio * (1.0 - ratio));
    let (seen, truth) = (square(found("stiffness"), found("ratio")), square(stiffness, ratio));
    assert!((seen / truth - 1.0).abs() < 0.05, "the resonance's square is {seen}, not {truth}");
}

#[test]
fn an_effect_that_the_system_states_is_no_gap() {
    let hidden = Hidden { input_delay: 0.03, ..Hidden::default() };
    let stated = |delay: f64| {
        let entry = format!(
            "[[effect]]\nname = \"delay\"\nplace = \"input:u\"\nparameters = {{ delay = {delay} }}\n"
        );
        let system =
            System::parse(&format!("{SYSTEM}\n{entry}"), "corrected.toml").expect("the system is valid");
        let equations = system.equations().expect("the equations are complete");
        diagnose_experiment(
            equations,
            record(hidden, 7, DURATION),
            "pendulum",
            &Options::default(),
            &|_, _| (),
        )
        .expect("it can be diagnosed")
        .report
    };
    let report = stated(0.03);
    assert!(!report.gap.detected, "{}", report.summary);
    // A wrong value is still a gap.
    let report = stated(0.01);
    assert!(report.gap.detected, "{}", report.summary);
}

#[test]
fn nothing_hidden_is_no_gap() {
    for seed in [1, 2] {
        let report = diagnosed(Hidden::default(), seed).report;
        assert!(!report.gap.detected, "seed {seed}: {}", report.summary);
    }
}

#[test]
fn friction_that_builds_up_is_dry_friction() {
    let report = diagnosed(Hidden { bristle: 1.6, ..Hidden::default() }, 7).report;
    let effect = &report.which[0].effects[0];
    assert_eq!(
        (effect.name.as_str(), effect.place.as_str()),
        ("coulomb", "joint:shaft"),
        "{}",
        report.summary
    );
    let force = effect.parameters["force"].value;
    assert!((force / (1.6 * 0.05) - 1.0).abs() < 0.2, "{force}");
}

#[test]
fn gusts_are_none_of_these() {
    let report = diagnosed(Hidden { gust: 0.15, ..Hidden::default() }, 7).report;
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
