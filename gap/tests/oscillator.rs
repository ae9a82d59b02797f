//! A spring that hardens, driven by a smooth command that was sampled a few times in each swing and is held between its samples:
//! an oscillator as laboratories build them, after Duffing's equation, integrated here by steps of its own.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::report::Report;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What is believed of it: the spring is linear, and the command holds between its samples.
const SYSTEM: &str = r#"
format = 1
name = "oscillator"

[parameters]
k = { value = 160.0, unit = "N/m", calibrate = [50.0, 500.0] }
d = { value = 0.5, unit = "N s/m", calibrate = [0.0, 5.0] }

[inputs]
u = { signal = "force" }

[state]
q = { derivative = "v" }
v = { derivative = "u - k*q - d*v" }

[outputs]
position = { value = "q", unit = "m" }

[joints]
mass = { position = "q", velocity = "v", inertia = "1", drive = "u", load = "-k*q" }
"#;

const PERIOD: f64 = 0.04;
const SAMPLES: usize = 1600;
const NOISE: f64 = 0.001;

/// F = −200 q − `cubic` q³ − 0.8 v beside the command, a sum of sines of 0.4 to 4 Hz, to which `added` is added unseen (N).
fn record(seed: u64, cubic: f64, added: f64) -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let sines: Vec<(f64, f64)> =
        (2..20).map(|k| (0.2 * f64::from(k), random.random_range(0.0..std::f64::consts::TAU))).collect();
    let command =
        |t: f64| sines.iter().map(|(f, p)| 3.0 * (std::f64::consts::TAU * f * t + p).sin()).sum::<f64>();
    let mut normal = || {
        let [a, b]: [f64; 2] = [random.random_range(f64::MIN_POSITIVE..1.0), random.random_range(0.0..1.0)];
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    };
    let (mut q, mut v) = (0.0_f64, 0.0_f64);
    let (mut stamps, mut commands, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    const STEPS: usize = 500;
    let step = PERIOD / STEPS as f64;
    for k in 0..SAMPLES {
        let stamp = k as f64 * PERIOD;
        stamps.push((stamp * 1e9).round() as i64);
        commands.push(command(stamp));
        readings.push(q + NOISE * normal());
        for i in 0..STEPS {
            // Velocity first, in the middle of the step.
            let middle = stamp + (i as f64 + 0.5) * step;
            q += 0.5 * step * v;
            v += step * (command(middle) + added - 200.0 * q - cubic * q.powi(3) - 0.8 * v);
            q += 0.5 * step * v;
        }
    }
    let signals = vec![
        Signal::new("force", Role::Command, "N", stamps.clone(), commands),
        Signal::new("position", Role::Measurement, "m", stamps, readings),
    ];
    Log { title: "oscillator".into(), signals, ..Log::default() }
}

fn diagnosed(log: &Log) -> Report {
    let system = System::parse(SYSTEM, "oscillator.toml").expect("the system is valid");
    let options = Options { horizon: Some(1.0), ..Options::default() };
    diagnose(&system, log, &options, &|_, _| ()).expect("it can be diagnosed").report
}

#[test]
fn a_hardening_spring_is_found_beside_a_command_that_acts_before_its_samples() {
    let report = diagnosed(&record(5, 400.0, 0.0));
    let found = |name: &str, parameter: &str| {
        let effect = report.which[0].effects.iter().find(|effect| effect.name == name);
        effect.unwrap_or_else(|| panic!("no {name}: {}", report.summary)).parameters[parameter].value
    };
    let early = -found("delay", "delay") / PERIOD;
    assert!((0.4..0.6).contains(&early), "the command acts {early} periods early: {}", report.summary);
    let stiffness = found("spring", "cubic_stiffness");
    assert!((stiffness - 400.0).abs() < 20.0, "{}", report.summary);
    assert_eq!(report.which[0].effects.len(), 2, "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.95, "{:?}", report.how_far);
    assert!(report.summary.contains("acts before its stamp"), "{}", report.summary);
}

/// A sine of a third of a wave would do what spring and force do together, with a parameter less: but nothing repeats.
#[test]
fn a_bend_of_less_than_a_wave_is_a_spring_beside_a_force() {
    let report = diagnosed(&record(7, 400.0, 0.8));
    let leader = &report.which[0];
    let found = |name: &str| leader.effects.iter().find(|effect| effect.name == name);
    let spring = found("spring").unwrap_or_else(|| panic!("{}", report.summary));
    let stiffness = spring.parameters["cubic_stiffness"].value;
    assert!((stiffness - 400.0).abs() < 40.0, "{}", report.summary);
    assert!(found("cogging").is_none() && found("delay").is_some(), "{}", report.summary);
}

#[test]
fn a_command_that_acts_before_its_samples_alone_is_a_gap() {
    let report = diagnosed(&record(9, 0.0, 0.0));
    let leader = &report.which[0];
    assert_eq!(leader.class.first().map(String::as_str), Some("delay@input:u"), "{leader:?}");
    let early = -leader.effects[0].parameters["delay"].value / PERIOD;
    assert!((0.4..0.6).contains(&early), "the command acts {early} periods early: {}", report.summary);
}
