//! Commands that are late on average, under a noise beside which none of them shows: the spread that goes with their mean tells whether
//! they are all late by the same time, by chance, or lost now and then.

use crate::axis::{labelled, pushed, pushed_and_shaken};
use parallax_gap::explain::{Explanation, Fate};
use parallax_gap::report::Report;

/// Standard deviation of what the sensor adds (m).
const NOISE: f64 = 0.004;

fn probability(report: &Report, label: &str) -> f64 {
    report.which.iter().filter(|which| labelled(which) == label).map(|which| which.probability).sum()
}

fn explained<'a>(report: &'a Report, label: &str) -> &'a Explanation {
    report.explanations.iter().find(|of| of.effect == label).expect("it was asked for")
}

#[test]
fn the_same_delay_of_all_is_a_delay() {
    let report = pushed(NOISE, |_, _| 0.016);
    assert_eq!(labelled(&report.which[0]), "delay@input:u", "{}", report.summary);
    for other in ["jitter@input:u", "drops@input:u"] {
        assert!(probability(&report, other) < 0.1, "{other} {:?}", report.which);
    }
    let (delay, jitter) = (explained(&report, "delay@input:u"), explained(&report, "jitter@input:u"));
    assert_eq!((&delay.fate, &jitter.fate), (&Fate::Leads, &Fate::Loses));
    assert_eq!(jitter.winner, "delay@input:u");
    assert!(jitter.evidence.is_some_and(|evidence| evidence < 0.0), "{jitter:?}");
}

#[test]
fn times_that_are_late_and_never_early_scatter_about_their_mean() {
    let report = pushed(NOISE, |_, draw| 0.02 * draw.abs());
    assert_eq!(labelled(&report.which[0]), "jitter@input:u", "{:?}", report.which);
    let spread = &report.which[0].effects[0].parameters["spread"];
    // Half a normal distribution.
    let truth = 0.02 * (1.0 - 2.0 / std::f64::consts::PI).sqrt();
    assert!((spread.value - truth).abs() < 2.0 * spread.std, "{spread:?}, not {truth}");
    assert!(probability(&report, "delay@input:u") < 0.5, "{:?}", report.which);
    let (delay, jitter) = (explained(&report, "delay@input:u"), explained(&report, "jitter@input:u"));
    assert_eq!((&delay.fate, &jitter.fate), (&Fate::Loses, &Fate::Leads));
    assert!(delay.evidence.is_some_and(|evidence| evidence < 0.0), "{delay:?}");
}

#[test]
fn commands_that_are_lost_now_and_then_scatter_by_more_than_their_mean() {
    let report = pushed(0.5 * NOISE, |_, draw| if draw > 0.84 { 0.02 } else { 0.0 });
    assert_eq!(labelled(&report.which[0]), "drops@input:u", "{:?}", report.which);
}

#[test]
fn a_few_lost_commands_beside_a_force_are_known_by_being_lost_as_a_whole() {
    let report = pushed_and_shaken(0.003, 4.0, &[9, 23]);
    let both = "drops@input:u + periodic_disturbance@joint:axis";
    assert_eq!(labelled(&report.which[0]), both, "{:?}", report.which);
    let report = pushed_and_shaken(0.003, 4.0, &[]);
    assert_eq!(labelled(&report.which[0]), "periodic_disturbance@joint:axis", "{:?}", report.which);
}
