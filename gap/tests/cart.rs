//! A cart under a speed controller, with dry friction, whose speed is read late. Integrated here by steps of its own.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What is believed of it: nothing rubs, and both sensors show the present.
const SYSTEM: &str = r#"
format = 1
name = "cart"

[parameters]
m = { value = 2.0, unit = "kg", calibrate = [0.5, 8.0] }
b = { value = 1.0, unit = "N s/m", calibrate = [0.0, 10.0] }

[inputs]
F = { signal = "force" }

[state]
x = { derivative = "v", initial = "position" }
v = { derivative = "(F - b*v)/m", initial = "speed" }

[outputs]
position = { value = "x", unit = "m" }
speed = { value = "v", unit = "m/s" }

[joints]
cart = { position = "x", velocity = "v", inertia = "m", drive = "F" }
"#;

const SAMPLES: usize = 3000;
const PERIOD: f64 = 0.01;
const POSITION_NOISE: f64 = 0.001;
const SPEED_NOISE: f64 = 0.01;

/// 2.6 kg, 1.3 N s/m, dry friction of `friction` (N) that also holds at rest, the speed read `late` (s).
fn record(seed: u64, friction: f64, late: f64) -> Log {
    const STEPS: usize = 50;
    const MASS: f64 = 2.6;
    let step = PERIOD / STEPS as f64;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = |size: f64, random: &mut ChaCha8Rng| {
        let normal: f64 = StandardNormal.sample(random);
        size * normal
    };
    let (mut x, mut v, mut goal, mut sum) = (0.0_f64, 0.0_f64, 0.0, 0.0_f64);
    let mut speeds = vec![0.0; (late / step).round() as usize + 1];
    let (mut stamps, mut forces, mut positions, mut readings) = (vec![], vec![], vec![], vec![]);
    for k in 0..SAMPLES {
        let position = x + noise(POSITION_NOISE, &mut random);
        let shown = speeds[speeds.len() - 1 - (late / step).round() as usize];
        let speed = shown + noise(SPEED_NOISE, &mut random);
        if random.random_bool(0.012) {
            goal = random.random_range(-0.6..0.6);
        }
        let error = goal - speed;
        sum = (sum + error * PERIOD).clamp(-1.0, 1.0);
        let force = 12.0 * error + 10.0 * sum;
        stamps.push((k as f64 * PERIOD * 1e9).round() as i64);
        forces.push(force);
        positions.push(position);
        readings.push(speed);
        for _ in 0..STEPS {
            let moving = v + step * (force - 1.3 * v) / MASS;
            v = moving.signum() * (moving.abs() - step * friction / MASS).max(0.0);
            x += step * v;
            speeds.push(v);
        }
    }
    let signals = vec![
        Signal::new("force", Role::Command, "N", stamps.clone(), forces),
        Signal::new("position", Role::Measurement, "m", stamps.clone(), positions),
        Signal::new("speed", Role::Measurement, "m/s", stamps, readings),
    ];
    Log { title: "cart".into(), signals, ..Log::default() }
}

/// Friction that is larger near standstill explains a little more, as friction that holds at rest is smoothed by the model; by
/// a further force that is not told from nothing, for which nothing is named.
#[test]
fn dry_friction_beside_a_late_reading_has_no_more_than_it_needs() {
    let system = System::parse(SYSTEM, "cart.toml").expect("the system is valid");
    let report = diagnose(&system, &record(1, 2.0, 0.03), &Options::default(), &|_, _| ())
        .expect("it can be diagnosed")
        .report;
    // Neither comes first: each explains something that the other one does not.
    let mut effects: Vec<_> = report.which[0].effects.iter().collect();
    effects.sort_by_key(|effect| effect.label());
    let named: Vec<String> = effects.iter().map(|effect| effect.label()).collect();
    assert_eq!(named, ["coulomb@joint:cart", "delay@output:speed"], "{}", report.summary);
    let value = |effect: usize, name: &str| effects[effect].parameters[name].value;
    assert!((value(0, "force") - 2.0).abs() < 0.05, "{}", report.summary);
    assert!((value(1, "delay") - 0.03).abs() < 0.002, "{}", report.summary);
    assert!(report.how_far.closed_by_effect.value > 0.98, "{}", report.summary);
}
