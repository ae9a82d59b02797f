//! A pendulum that swings to rest by dry friction, read by an encoder, and a log that goes on long after: what stands says once where
//! it stands. Integrated here by small steps, with a friction that holds.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::explain::Fate;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};

const SYSTEM: &str = r#"
format = 1
name = "pendulum"

[parameters]
w2 = { value = 66.0, unit = "1/s^2", calibrate = [30.0, 120.0] }
d = { value = 0.0, unit = "1/s", calibrate = [0.0, 5.0] }

[state]
q = { derivative = "v" }
v = { derivative = "-w2*sin(q) - d*v" }

[outputs]
angle = { value = "q", unit = "rad" }

[joints]
arm = { position = "q", velocity = "v", inertia = "1", load = "-w2*sin(q)" }
"#;

const FRICTION: f64 = 0.2;
/// Steps of the encoder (rad), and how long the log is (s).
const STEP: f64 = 1.6e-4;
const DURATION: f64 = 24.0;

/// Let go at a small angle; it stands after some six seconds.
fn record() -> Log {
    let (period, steps) = (0.01, 1000);
    let step = period / f64::from(steps);
    let (mut angle, mut speed) = (0.08_f64, 0.0_f64);
    let (mut stamps, mut readings) = (Vec::new(), Vec::new());
    for k in 0..(DURATION / period) as usize {
        stamps.push((k as f64 * period * 1e9).round() as i64);
        readings.push((angle / STEP).round() * STEP);
        for _ in 0..steps {
            let pull = -64.0 * angle.sin() - 0.05 * speed;
            if speed == 0.0 && pull.abs() <= FRICTION {
                continue;
            }
            let against = if speed == 0.0 { pull.signum() } else { speed.signum() };
            let next = speed + step * (pull - FRICTION * against);
            // It stands before it turns.
            speed = if next * speed < 0.0 { 0.0 } else { next };
            angle += step * speed;
        }
    }
    let signals = vec![Signal::new("angle", Role::Measurement, "rad", stamps, readings)];
    Log { title: "pendulum".into(), signals, ..Log::default() }
}

#[test]
fn a_long_rest_says_no_more_than_where_the_machine_stands() {
    let system = System::parse(SYSTEM, "pendulum").expect("the system is valid");
    let explain = ["stuck", "quantization", "noise"].map(|name| format!("{name}@output:angle").parse());
    let explain = explain.into_iter().collect::<Result<_, _>>().expect("these are patterns");
    let options = Options { explain, ..Options::default() };
    let found = diagnose(&system, &record(), &options, &|_, _| ()).expect("it diagnoses");
    let report = &found.report;
    let rests = report.rests_s.expect("it rests");
    assert!((12.0..19.0).contains(&rests), "{rests} s");
    // Friction, and the encoder's steps: a reading that repeats is no sensor that sticks.
    let found: Vec<String> =
        report.which[0].effects.iter().map(|effect| format!("{}@{}", effect.name, effect.place)).collect();
    assert_eq!(found, ["coulomb@joint:arm", "quantization@output:angle"], "{}", report.summary);
    let force = &report.which[0].effects[0].parameters["force"];
    assert!((force.value - FRICTION).abs() < (3.0 * force.std).min(0.1 * FRICTION), "{force:?}");
    assert!(report.how_far.closed_by_effect.value > 0.9, "{}", report.summary);
    // What was asked about is answered, also where it is no answer.
    let fate = |label: &str| {
        let all = report.explanations.iter();
        all.filter(|asked| asked.effect == label).map(|asked| asked.fate.clone()).next()
    };
    assert_eq!(fate("quantization@output:angle"), Some(Fate::Leads));
    let not_shown = |label: &str| match fate(label) {
        Some(Fate::NotShown { reason }) => reason,
        other => panic!("{label}: {other:?}"),
    };
    assert!(not_shown("stuck@output:angle").contains("while it moves"));
    assert!(not_shown("noise@output:angle").contains("declares no `noise`"));
}
