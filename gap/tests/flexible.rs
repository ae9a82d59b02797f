//! A pendulum that its motor drives through a spring, read by a noisy sensor: the swing shows in single readings only, and
//! short windows with free states make it good. Integrated here by small steps.

use std::f64::consts::TAU;

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What is believed of it: one mass.
const SYSTEM: &str = r#"
format = 1
name = "pendulum"

[parameters]
J = { value = 0.02, unit = "kg m^2" }
mgl = { value = 0.5, unit = "N m", calibrate = [0.4, 0.6] }
b = { value = 0.03, unit = "N m s/rad", calibrate = [0.0, 0.2] }
K = { value = 0.5, unit = "N m/V", calibrate = [0.4, 0.6] }

[inputs]
u = { signal = "voltage" }

[state]
q = { derivative = "w", initial = "angle" }
w = { derivative = "(K*u - mgl*sin(q) - b*w)/J" }

[outputs]
angle = { value = "q", unit = "rad" }

[joints]
shaft = { position = "q", velocity = "w", inertia = "J", drive = "K*u", load = "-mgl*sin(q)" }
"#;

const PERIOD: f64 = 0.01;
const SAMPLES: usize = 2000;
const NOISE: f64 = 0.0038;

/// A chirp from 0.4 to 10 Hz, held over two readings; the spring has `stiffness` (N m/rad), and a third of the inertia beyond it.
fn record(seed: u64, stiffness: f64) -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    const STEPS: usize = 500;
    let step = PERIOD / STEPS as f64;
    let duration = SAMPLES as f64 * PERIOD;
    let (near, far, damping) = (0.013, 0.007, 0.027);
    // Of the measured side, and of the motor.
    let (mut angle, mut speed, mut motor, mut motor_speed, mut voltage) = (0.0_f64, 0.0, 0.0, 0.0, 0.0);
    let (mut stamps, mut sent, mut commands, mut readings) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for k in 0..SAMPLES {
        let time = k as f64 * PERIOD;
        let stamp = (time * 1e9).round() as i64;
        if k % 2 == 0 {
            let growth = 25.0_f64.ln() / duration;
            voltage = 0.685 * (TAU * 0.4 * (growth * time).exp_m1() / growth).sin();
            sent.push(stamp);
            commands.push(voltage);
        }
        let noise: f64 = StandardNormal.sample(&mut random);
        stamps.push(stamp);
        readings.push(angle + NOISE * noise);
        for _ in 0..STEPS {
            let spring = stiffness * (motor - angle) + damping * (motor_speed - speed);
            speed += step * (spring - 0.53 * angle.sin() - 0.025 * speed) / near;
            motor_speed += step * (0.51 * voltage - spring) / far;
            angle += step * speed;
            motor += step * motor_speed;
        }
    }
    let signals = vec![
        Signal::new("voltage", Role::Command, "V", sent, commands),
        Signal::new("angle", Role::Measurement, "rad", stamps, readings),
    ];
    Log { title: "pendulum".into(), signals, ..Log::default() }
}

/// A slide of two masses whose spring is soft beside the rate of its sensor, and is known.
const SLIDE: &str = r#"
format = 1
name = "slide"

[parameters]
M = { value = 95.0, unit = "kg", calibrate = [60.0, 140.0] }
Fv = { value = 200.0, unit = "N s/m", calibrate = [0.0, 600.0] }

[inputs]
u = { signal = "force" }

[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(u - Fv*v)/M" }

[outputs]
position = { value = "q", unit = "m" }

[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "u" }

[[effect]]
name = "flexibility"
place = "joint:axis"
parameters = { stiffness = 26000.0, damping = 40.0, ratio = 0.2917 }
"#;

/// The slide under a chirp from 0.5 to 10 Hz, read every 5 ms: 68 kg that 28 kg drive.
fn record_slide(seed: u64) -> Log {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (samples, period, steps) = (2000, 0.005, 50);
    let (step, duration) = (period / f64::from(steps), f64::from(samples) * period);
    let (mut position, mut speed, mut motor, mut motor_speed) = (0.0, 0.0, 0.0, 0.0);
    let (mut stamps, mut commands, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..samples {
        let time = f64::from(k) * period;
        let growth = 20.0_f64.ln() / duration;
        let force = 400.0 * (TAU * 0.5 * (growth * time).exp_m1() / growth).sin();
        let noise: f64 = StandardNormal.sample(&mut random);
        stamps.push((time * 1e9).round() as i64);
        commands.push(force);
        readings.push(position + 2e-4 * noise);
        for _ in 0..steps {
            let spring = 26000.0 * (motor - position) + 40.0 * (motor_speed - speed);
            speed += step * (spring - 180.0 * speed) / 68.0;
            motor_speed += step * (force - spring) / 28.0;
            position += step * speed;
            motor += step * motor_speed;
        }
    }
    let signals = vec![
        Signal::new("force", Role::Command, "N", stamps.clone(), commands),
        Signal::new("position", Role::Measurement, "m", stamps, readings),
    ];
    Log { title: "slide".into(), signals, ..Log::default() }
}

/// A force bends it further than one that swings as fast as readings come: how far it may be bent where a stretch begins goes with its
/// stiffness.
#[test]
fn a_soft_spring_that_is_stated_is_no_gap() {
    let system = System::parse(SLIDE, "system.toml").unwrap();
    let report = diagnose(&system, &record_slide(4), &Options::default(), &|_, _| ()).unwrap().report;
    assert!(!report.gap.detected, "{}", report.summary);
    let mass = report.calibration.iter().find(|moved| moved.name == "M").unwrap();
    assert!((mass.value - 96.0).abs() < 0.2, "the mass is {}", mass.value);
}

#[test]
fn a_spring_that_swings_within_the_windows_is_named() {
    let system = System::parse(SYSTEM, "system.toml").unwrap();
    let found = diagnose(&system, &record(5, 42.0), &Options::default(), &|_, _| ()).unwrap();
    let answer = &found.report.which[0];
    let named: Vec<_> = answer.effects.iter().map(|e| (e.name.as_str(), e.place.as_str())).collect();
    assert_eq!(named, [("flexibility", "joint:shaft")], "{:#?}", found.report.which);
}

/// A heavy axis that is believed to be one mass.
const AXIS: &str = r#"
format = 1
name = "axis"

[parameters]
M = { value = 95.0, unit = "kg", calibrate = [60.0, 140.0] }
d = { value = 200.0, unit = "N s/m", calibrate = [0.0, 600.0] }

[inputs]
u = { signal = "force" }

[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(u - d*v)/M" }

[outputs]
position = { value = "q", unit = "m" }

[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "u" }
"#;

/// Twenty seconds of that axis, whose motor carries a quarter of the mass and drives the rest through a soft spring, under a loop over the
/// carriage that it cannot follow: it rings between the limits of its force.
fn ring() -> Log {
    const STEPS: usize = 100;
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let step = PERIOD / STEPS as f64;
    let (carriage, motor, stiffness, damping) = (73.0, 24.0, 27_000.0, 40.0);
    let (mut x, mut v, mut x_motor, mut v_motor) = (0.0_f64, 0.0, 0.0, 0.0);
    let (mut stamps, mut commands, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..SAMPLES {
        let time = k as f64 * PERIOD;
        let goal = 0.08 * (TAU * 0.21 * time).sin() + 0.04 * (TAU * 0.67 * time + 1.0).sin();
        let force = (13_700.0 * (goal - x) - 1600.0 * v).clamp(-600.0, 600.0);
        let noise: f64 = StandardNormal.sample(&mut random);
        stamps.push((time * 1e9).round() as i64);
        commands.push(force);
        readings.push(x + 0.0001 * noise);
        for _ in 0..STEPS {
            let spring = stiffness * (x_motor - x) + damping * (v_motor - v);
            v += step * (spring - 190.0 * v) / carriage;
            v_motor += step * (force - spring) / motor;
            x += step * v;
            x_motor += step * v_motor;
        }
    }
    let signals = vec![
        Signal::new("force", Role::Command, "N", stamps.clone(), commands),
        Signal::new("position", Role::Measurement, "m", stamps, readings),
    ];
    Log { title: "axis".into(), signals, ..Log::default() }
}

#[test]
fn a_loop_that_is_closed_over_a_soft_spring_rings_and_it_is_found() {
    let system = System::parse(AXIS, "axis.toml").expect("valid");
    let found = diagnose(&system, &ring(), &Options::default(), &|_, _| ()).expect("diagnosed");
    let report = found.report;
    let [only] = &report.which[0].effects[..] else { panic!("{}", report.summary) };
    assert_eq!(only.label(), "flexibility@joint:axis", "{}", report.summary);
    assert!(report.which[0].probability > 0.9, "{}", report.summary);
    let stiffness = &only.parameters["stiffness"];
    assert!((stiffness.value / 27_000.0 - 1.0).abs() < 0.1, "{stiffness:?}");
}
