//! Where the search for a wave begins: beside parameters that are far off as they are stated, what these leave at the frequencies of the
//! commands hides it until they are calibrated; and whatever its phase, between two lines of a spectrum.

use crate::support::{Hidden, SYSTEM, record};
use parallax_gap::diagnosis::{Options, diagnose_experiment};
use parallax_model::system::System;

#[test]
fn a_wave_is_found_whose_frequency_shows_after_calibration_only() {
    let stated = SYSTEM
        .replace("J = { value = 0.0125", "J = { value = 0.018")
        .replace("k = { value = 0.12", "k = { value = 0.17")
        .replace(", std = 0.001", "")
        .replace(", std = 0.006", "");
    let system = System::parse(&stated, "pendulum.toml").expect("the system is valid");
    let equations = system.equations().expect("the equations are complete");
    let hidden = Hidden { vibration: (0.02, 7.7), ..Hidden::default() };
    let found =
        diagnose_experiment(equations, record(hidden, 5, 12.0), "pendulum", &Options::default(), &|_, _| ())
            .expect("it can be");
    let leader = &found.report.which[0];
    assert_eq!(
        leader.class.first().map(String::as_str),
        Some("periodic_disturbance@joint:shaft"),
        "{leader:?}"
    );
    let frequency = &leader.effects[0].parameters["frequency"];
    assert!((frequency.value - 7.7).abs() < 3.0 * frequency.std + 0.01, "{frequency:?}");
}

#[test]
fn a_wave_is_found_whatever_its_phase() {
    let system = System::parse(SYSTEM, "pendulum.toml").expect("the system is valid");
    // Half a turn on is the same wave with the opposite sign.
    for (force, frequency) in [(0.1, 4.02), (-0.1, 4.02)] {
        let equations = system.equations().expect("the equations are complete");
        let hidden = Hidden { vibration: (force, frequency), ..Hidden::default() };
        let log = record(hidden, 5, 20.0);
        let found = diagnose_experiment(equations, log, "pendulum", &Options::default(), &|_, _| ())
            .expect("it can be");
        let leader = &found.report.which[0];
        assert_eq!(leader.class, ["periodic_disturbance@joint:shaft"], "{force} N m at {frequency} Hz");
        let found = &leader.effects[0].parameters["frequency"];
        assert!((found.value - frequency).abs() < 3.0 * found.std + 0.003, "{found:?}");
    }
}
