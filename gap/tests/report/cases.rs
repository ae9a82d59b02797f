//! Made-up diagnoses, one for each kind of answer.

use std::collections::BTreeMap;

use parallax_gap::closed_loop::{ClosedLoop, Controlled, LoopScore};
use parallax_gap::explain::{Explanation, Fate, Worse};
use parallax_gap::maps::{Bin, Map};
use parallax_gap::readings::{LogDensity, ReadingEffect};
use parallax_gap::report::{
    Absorbed, Calibration, Confusable, FittedEffect, Gap, HowFar, Interrupted, Interval, NotTestable,
    Overlay, Report, Split, Unexplained, Value, Where, Which, sentence,
};
use parallax_gap::whiteness::Whiteness;

/// An effect with parameters as (name, value, std, unit).
pub(crate) fn effect(name: &str, place: &str, parameters: &[(&str, f64, f64, &str)]) -> FittedEffect {
    let parameters: BTreeMap<String, Value> = parameters
        .iter()
        .map(|&(name, value, std, unit)| (name.to_owned(), Value { value, std, unit: unit.to_owned() }))
        .collect();
    FittedEffect { name: name.to_owned(), place: place.to_owned(), parameters }
}

fn which(effect: FittedEffect, class: &[&str], probability: f64) -> Which {
    let class = class.iter().map(|name| (*name).to_owned()).collect();
    Which { effects: vec![effect], class, probability }
}

fn interval(value: f64, low: f64, high: f64) -> Interval {
    Interval { value, low, high }
}

fn calibration(name: &str, nominal: f64, value: f64, std: f64, unit: &str) -> Calibration {
    let significant = (value - nominal).abs() > 2.0 * std;
    Calibration {
        name: name.to_owned(),
        nominal,
        value,
        std,
        unit: unit.to_owned(),
        significant,
        at_bound: false,
    }
}

/// Ten parts whose means follow from their number.
fn map(by: &str, unit: &str, p_value: f64, share: f64, mean: impl Fn(f64) -> f64) -> Map {
    let bin = |k: u32| {
        let k = f64::from(k);
        Bin { low: k - 5.0, high: k - 4.0, count: 80, mean: mean(k), energy: 0.6 + 0.1 * k }
    };
    let bins = (0..10).map(bin).collect();
    Map { output: "angle".to_owned(), by: by.to_owned(), unit: unit.to_owned(), bins, p_value, share }
}

/// A servo whose commands arrive late.
pub(crate) fn one_effect() -> Report {
    let delay = effect("delay", "input:goal", &[("delay", 0.0412, 0.0011, "s")]);
    let friction = [("backward", -0.061, 0.02, "N m"), ("forward", 0.084, 0.019, "N m")];
    Report {
        summary:
            "Commands reach the joint 41 ms late (delay@input:goal); this closes 99.6 % of the gap that \
                  calibration leaves."
                .to_owned(),
        system: "servo arm".to_owned(),
        recordings: vec!["chirp on goal, 20 s".to_owned(), "steps, 12 s".to_owned()],
        gap: Gap { detected: true, p_value: 1e-12, score: 6.3 },
        rests_s: None,
        calibration: vec![
            calibration("kt", 0.32, 0.334, 0.004, "N m/A"),
            calibration("b", 0.018, 0.0184, 0.0007, "N m s"),
            calibration("m2", 0.4, 0.402, 0.013, "kg"),
        ],
        where_: vec![
            Where { place: "input:goal".to_owned(), share: 0.91, probability: 0.98 },
            Where { place: "joint:shaft".to_owned(), share: 0.22, probability: 0.011 },
            Where { place: "output:angle".to_owned(), share: 0.08, probability: 0.002 },
        ],
        which: vec![
            which(delay, &["delay@input:goal", "lag@input:goal"], 0.97),
            which(
                effect("asymmetric_friction", "joint:shaft", &friction),
                &["asymmetric_friction@joint:shaft"],
                0.011,
            ),
            Which {
                effects: vec![
                    effect("coulomb", "joint:shaft", &[("force", 0.07, 0.02, "N m")]),
                    effect("offset", "input:goal", &[("offset", 0.012, 0.006, "rad")]),
                ],
                class: vec!["coulomb@joint:shaft + offset@input:goal".to_owned()],
                probability: 0.006,
            },
            Which { effects: vec![], class: vec!["no gap".to_owned()], probability: 1e-9 },
            which(
                effect("bias", "output:angle", &[("bias", 0.002, 0.004, "rad")]),
                &["bias@output:angle"],
                1e-11,
            ),
        ],
        timing: None,
        nodes: None,
        maps: vec![
            map("speed of joint:shaft", "", 0.005, 0.31, |k| (k - 4.5) / 9.0),
            map("frequency", "Hz", 0.005, 0.12, |_| 0.0),
            map("time", "s", 0.4, 0.01, |_| 0.01),
        ],
        readings: vec![],
        unexplained: Unexplained {
            probability: 0.01,
            share: 0.02,
            hint: None,
            innovations: white(1.1, 0.9, 0.4),
        },
        absorbed: vec![Absorbed { effect: "viscous@joint:shaft".to_owned(), by: "b".to_owned() }],
        not_testable: vec![NotTestable {
            effect: "cogging@joint:shaft".to_owned(),
            reason: "the log covers 0.2 turns".to_owned(),
        }],
        confusable: vec![Confusable {
            effects: vec!["delay@input:goal".to_owned(), "lag@input:goal".to_owned()],
            separate_by: "a chirp above 5 Hz on goal".to_owned(),
            experiment: None,
        }],
        how_far: HowFar {
            horizon_s: 0.25,
            nominal: 14.2,
            refitted: 6.3,
            with_effect: 1.08,
            black_box: 1.05,
            noise_floor: 1.0,
            closed_total: interval(0.9992, 0.998, 0.9997),
            closed_by_effect: interval(0.9957, 0.992, 0.998),
            split: vec![],
        },
        closed_loop: None,
        corrected_system: Some("out/servo/system.corrected.toml".to_owned()),
        explanations: Vec::new(),
        interrupted: None,
        made_from: None,
    }
}

/// A servo with two causes, which stood still for a while.
pub(crate) fn two_effects() -> Report {
    let mut report = one_effect();
    report.rests_s = Some(17.25);
    report.which[0].effects.push(effect("coulomb", "joint:shaft", &[("force", 0.07, 0.02, "N m")]));
    report.which[0].class = vec!["delay@input:goal + coulomb@joint:shaft".to_owned()];
    let part = |effect: &str, share| Split { effect: effect.to_owned(), share };
    report.how_far.split = vec![part("delay@input:goal", 0.71), part("coulomb@joint:shaft", 0.2857)];
    report.summary = sentence::summary(&report);
    report
}

/// A reading in steps, which no prediction can follow.
pub(crate) fn steps() -> Report {
    let mut report = one_effect();
    let found = effect("quantization", "output:angle", &[("step", 0.0073, 0.0001, "rad")]);
    report.readings = vec![ReadingEffect {
        name: found.name.clone(),
        place: found.place.clone(),
        parameters: found.parameters.clone(),
        evidence: -4000.0,
        significant: true,
        log_density: LogDensity { without: -1.4, with: -0.3, best: -0.2 },
        share: Some(0.917),
    }];
    report.which = vec![which(found, &["quantization@output:angle"], 0.94)];
    report.how_far.closed_by_effect = interval(0.0, 0.0, 0.0);
    report.summary = sentence::summary(&report);
    report
}

/// A diagnosis that was asked about every fate of an effect.
pub(crate) fn asked() -> Report {
    let fitted = |effect: &str, fate, evidence| Explanation {
        effect: effect.to_owned(),
        fate,
        winner: "delay@input:goal".to_owned(),
        evidence: Some(evidence),
        against_no_effect: Some(418.25),
        error: Some(1.531),
        winner_error: Some(1.08),
        parameters: [("time_constant".to_owned(), Value { value: 0.037, std: 0.0021, unit: "s".to_owned() })]
            .into(),
        worse: vec![Worse { quantity: "goal".to_owned(), from: 0.35, to: 0.7, readings: 0.12, share: 0.62 }],
    };
    let plain = |effect: &str, fate| Explanation {
        evidence: None,
        against_no_effect: None,
        error: None,
        winner_error: None,
        parameters: Default::default(),
        worse: Vec::new(),
        ..fitted(effect, fate, 0.0)
    };
    Report {
        explanations: vec![
            Explanation { worse: Vec::new(), ..fitted("delay@input:goal", Fate::Leads, 0.0) },
            fitted("delay@output:angle", Fate::Alike, -0.3),
            fitted("lag@input:goal", Fate::Loses, -57.4),
            plain("viscous@joint:shaft", Fate::Absorbed { by: "b".to_owned() }),
            plain("cogging@joint:shaft", Fate::NotTestable { reason: "the log covers 0.2 turns".to_owned() }),
        ],
        ..one_effect()
    }
}

/// A diagnosis that was interrupted before everything was tried.
pub(crate) fn interrupted() -> Report {
    let names = ["an unknown cause", "backlash@input:goal", "cogging@joint:shaft", "several effects at once"];
    let not_tried = names.map(str::to_owned).into();
    let mut report = Report { interrupted: Some(Interrupted { not_tried }), ..one_effect() };
    report.summary = sentence::summary(&report);
    report
}

fn white(slow: f64, uneven: f64, score: f64) -> Option<Whiteness> {
    Some(Whiteness { slow, uneven, score })
}

/// Everything as the system says.
pub(crate) fn no_gap() -> Report {
    let mut report = one_effect();
    report.summary =
        "No gap: after calibration the system predicts these recordings down to the noise.".to_owned();
    report.gap = Gap { detected: false, p_value: 0.43, score: 1.02 };
    report.which.retain(|which| which.effects.is_empty());
    report.which[0].probability = 0.96;
    report.where_.clear();
    report.maps.clear();
    report.confusable.clear();
    report.unexplained = Unexplained { probability: 0.004, share: 0.0, hint: None, innovations: None };
    report.how_far = HowFar {
        horizon_s: 0.25,
        nominal: 1.31,
        refitted: 1.02,
        with_effect: 1.02,
        black_box: 1.02,
        noise_floor: 1.0,
        closed_total: interval(0.94, 0.81, 1.0),
        closed_by_effect: interval(f64::NAN, f64::NAN, f64::NAN),
        split: vec![],
    };
    report.corrected_system = None;
    report
}

/// A cause that no named effect fits.
pub(crate) fn none_of_these() -> Report {
    let mut report = one_effect();
    report.summary = "There is a gap at joint:shaft, and none of the named effects is its cause.".to_owned();
    report.which[0].probability = 0.08;
    report.unexplained =
        Unexplained { probability: 0.88, share: 0.74, hint: None, innovations: white(2.8, 5.2, 19.0) };
    report.how_far.with_effect = 4.9;
    report.how_far.closed_by_effect = interval(0.4, 0.12, 0.55);
    report
}

/// Nothing in any list.
pub(crate) fn empty() -> Report {
    Report {
        summary: String::new(),
        recordings: vec![],
        calibration: vec![],
        where_: vec![],
        maps: vec![],
        which: vec![],
        absorbed: vec![],
        not_testable: vec![],
        confusable: vec![],
        closed_loop: None,
        corrected_system: None,
        explanations: Vec::new(),
        interrupted: None,
        made_from: None,
        ..one_effect()
    }
}

/// Numbers at the ends of the range, and none at all.
pub(crate) fn extreme() -> Report {
    let mut report = one_effect();
    report.gap = Gap { detected: true, p_value: 0.0, score: 1e300 };
    report.how_far = HowFar {
        horizon_s: f64::INFINITY,
        nominal: f64::INFINITY,
        refitted: 1e300,
        with_effect: 4e8,
        black_box: f64::NAN,
        noise_floor: 1.0,
        closed_total: interval(-1e200, f64::NEG_INFINITY, f64::NAN),
        closed_by_effect: interval(1.0, 1.0, 1.0),
        split: vec![],
    };
    report.calibration.push(calibration("k", 0.0, 1.234e19, 3e17, "N/m"));
    report.calibration.push(calibration("c", f64::NAN, f64::INFINITY, f64::NAN, ""));
    report.which[0].effects[0] =
        effect("delay", "input:goal", &[("delay", 1e308, f64::MAX, "s"), ("x", -1e-300, 0.0, "")]);
    report.which[1].probability = f64::NAN;
    let innovations = white(f64::NAN, 1e300, f64::INFINITY);
    report.unexplained =
        Unexplained { probability: f64::NAN, share: f64::NEG_INFINITY, hint: None, innovations };
    report
}

/// A position in four held-out blocks of three seconds; the prediction before lags behind.
pub(crate) fn overlay() -> Overlay {
    let mut overlay =
        Overlay { output: "angle".to_owned(), unit: "rad".to_owned(), noise: 0.004, ..Overlay::default() };
    // A fixed sequence is noise enough for a picture.
    let mut state = 12_345_u32;
    let mut noise = || {
        let sum: f64 = (0..12)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(state >> 8) / f64::from(1 << 24)
            })
            .sum();
        0.004 * (sum - 6.0)
    };
    let angle = |t: f64| 0.6 * (1.3 * t).sin() + 0.15 * (0.2 * t * t).sin();
    for block in 0..4 {
        for i in 0..600 {
            let t = 2.0 + 8.0 * f64::from(block) + f64::from(i) * 0.005;
            // Each prediction starts from an estimate and drifts off until the next starts.
            let ahead = (t % 0.25) / 0.25;
            overlay.stamp.push(t);
            overlay.measured.push(angle(t) + noise());
            overlay.before.push(angle(t + 0.041 * ahead.sqrt()) + 0.1 * noise());
            overlay.after.push(angle(t + 0.0005 * ahead) + 0.1 * noise());
        }
    }
    overlay
}

/// Series with everything wrong that series can have.
pub(crate) fn broken_overlay() -> Overlay {
    let overlay = overlay();
    let mut broken =
        Overlay { output: "<b>\"speed\" & 'x'\u{1}".to_owned(), unit: "<m/s>".to_owned(), ..overlay };
    broken.measured[10..40].fill(f64::NAN);
    broken.measured[600] = 1e300;
    broken.before[100..200].fill(f64::INFINITY);
    for (i, value) in broken.before[200..400].iter_mut().enumerate() {
        *value = 10f64.powf(i as f64 * 1.5);
    }
    broken.after.truncate(900);
    broken.stamp[1500] = f64::NAN;
    broken.stamp[1800..].iter_mut().for_each(|t| *t -= 40.0);
    broken.noise = f64::NAN;
    broken
}

/// One effect, and a task that needs it.
pub(crate) fn in_closed_loop() -> Report {
    let row = |score: Interval, difference: Interval, agrees| LoopScore {
        score: Some(score),
        difference: Some(difference),
        agrees,
        lost: 0,
        of: 200,
    };
    Report {
        closed_loop: Some(ClosedLoop {
            task: "follow the course".into(),
            cost: "error^2 + 1e-5*force^2".into(),
            unit: "m^2".into(),
            controller: Controlled::Policy,
            episodes: 10,
            horizon_s: 2.0,
            runs: 20,
            miss: Some(0.004),
            recorded: interval(0.0451, 0.0321, 0.0571),
            nominal: row(interval(0.0395, 0.0285, 0.0495), interval(-0.0056, -0.008, -0.003), false),
            refitted: row(interval(0.04, 0.0287, 0.0505), interval(-0.0051, -0.0073, -0.0027), false),
            with_effect: Some(row(
                interval(0.0452, 0.0321, 0.0571),
                interval(0.00001, -0.00004, 0.00006),
                true,
            )),
            closed: Some(interval(0.998, 0.98, 1.0)),
            episode: vec![overlay()],
        }),
        ..one_effect()
    }
}
