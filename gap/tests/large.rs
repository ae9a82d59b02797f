//! Commands that are late where they are large are told from commands that are late, and from commands that are late by chance: the
//! first is no effect of the library, and said to be there.

use crate::axis::{labelled, pushed};

/// Standard deviation of what the sensor adds (m).
const NOISE: f64 = 0.0005;

#[test]
fn what_befalls_large_commands_is_outside_the_library() {
    let report = pushed(NOISE, |push, _| if push.abs() > 1.1 { 0.06 } else { 0.0 });
    assert!(report.unexplained.probability > 0.9, "{}", report.summary);
    let hint = report.unexplained.hint.as_deref().expect("it is known to be there");
    let numbers: Vec<f64> = hint.split([' ', ',']).filter_map(|word| word.parse().ok()).collect();
    let near = numbers.iter().zip([0.06, -1.1, 1.1]).all(|(found, truth)| (found / truth - 1.0).abs() < 0.05);
    assert!(numbers.len() == 3 && near, "{hint}");
    assert!(report.summary.contains(hint), "{}", report.summary);
}

#[test]
fn what_befalls_all_is_an_effect() {
    let report = pushed(NOISE, |_, _| 0.06);
    assert_eq!(labelled(&report.which[0]), "delay@input:u", "{}", report.summary);
    assert!(report.which[0].probability > 0.9 && report.unexplained.hint.is_none(), "{}", report.summary);
}

#[test]
fn chance_is_an_effect_as_well() {
    let report = pushed(NOISE, |_, draw| 0.02 * draw.abs());
    assert_eq!(labelled(&report.which[0]), "jitter@input:u", "{}", report.summary);
    assert!(report.which[0].probability > 0.9 && report.unexplained.hint.is_none(), "{}", report.summary);
}
