//! Two tanks, one above the other, read every four seconds: a slow process with a hidden state. Where the upper one is full, a
//! part of what it cannot hold runs into the lower one. Integrated here by small steps, litre by litre.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What is believed of it: tanks that have no rim (outflow after Torricelli).
const SYSTEM: &str = r#"
format = 1
name = "tanks"

[parameters]
upper_out = { value = 0.05, unit = "cm^0.5/s", calibrate = [0.01, 0.2] }
lower_out = { value = 0.05, unit = "cm^0.5/s", calibrate = [0.01, 0.2] }
inflow = { value = 0.05, unit = "cm/s/V" }

[inputs]
pump = { signal = "pump" }

[state]
upper = { derivative = "inflow*pump - upper_out*sqrt(max(upper, 0))", initial = 5.0 }
lower = { derivative = "upper_out*sqrt(max(upper, 0)) - lower_out*sqrt(max(lower, 0))", initial = "level" }

[outputs]
level = { value = "lower", unit = "cm" }
"#;

const PERIOD: f64 = 4.0;
const SAMPLES: usize = 1500;
const NOISE: f64 = 0.02;

/// The upper tank holds `rim` (cm); of what runs over, `share` falls into the lower one.
fn record(seed: u64, rim: f64, share: f64) -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    const STEPS: usize = 400;
    let step = PERIOD / STEPS as f64;
    let (mut upper, mut lower, mut pump) = (5.0_f64, 5.0_f64, 3.0);
    let (mut stamps, mut pumped, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..SAMPLES {
        if random.random_bool(0.03) {
            pump = random.random_range(1.0..5.0);
        }
        stamps.push((k as f64 * PERIOD * 1e9).round() as i64);
        pumped.push(pump);
        let noise: f64 = StandardNormal.sample(&mut random);
        readings.push(lower + NOISE * noise);
        for _ in 0..STEPS {
            let (falls, leaves) = (0.052 * upper.sqrt(), 0.045 * lower.sqrt());
            upper += step * (0.05 * pump - falls);
            lower += step * (falls - leaves) + share * (upper - rim).max(0.0);
            upper = upper.min(rim);
        }
    }
    let signals = vec![
        Signal::new("pump", Role::Command, "V", stamps.clone(), pumped),
        Signal::new("level", Role::Measurement, "cm", stamps, readings),
    ];
    Log { title: "tanks".into(), signals, ..Log::default() }
}

fn diagnosed(log: &Log) -> Report {
    let system = System::parse(SYSTEM, "tanks.toml").expect("the system is valid");
    diagnose(&system, log, &Options::default(), &|_, _| ()).expect("it can be diagnosed").report
}

/// Of a log of overflowing tanks: the parameter of this name of the limit that is named alone.
fn of_limit(report: &Report, parameter: &str) -> f64 {
    let [effect] = &report.which[0].effects[..] else { panic!("{}", report.summary) };
    assert_eq!(format!("{}@{}", effect.name, effect.place), "saturation@state:upper", "{}", report.summary);
    effect.parameters[parameter].value
}

#[test]
fn a_tank_that_overflows_into_the_next_is_found_with_its_rim_and_share() {
    let report = diagnosed(&record(3, 9.0, 0.6));
    let (rim, share) = (of_limit(&report, "high"), of_limit(&report, "share"));
    assert!((rim - 9.0).abs() < 0.2 && (share - 0.6).abs() < 0.05, "{}", report.summary);
    assert!(report.summary.contains("overflows into what it feeds"), "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.9, "{:?}", report.how_far);
}

#[test]
fn a_tank_whose_overflow_is_lost_is_clipped() {
    let report = diagnosed(&record(4, 9.0, 0.0));
    assert!((of_limit(&report, "high") - 9.0).abs() < 0.2, "{}", report.summary);
}

#[test]
fn tanks_that_never_run_over_have_no_gap() {
    let report = diagnosed(&record(5, 1e9, 0.0));
    assert!(!report.gap.detected, "{}", report.summary);
}
