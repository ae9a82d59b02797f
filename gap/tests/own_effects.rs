//! An effect that a system's file adds is tried beside the library's, found, and written back.

use parallax_gap::diagnosis::{Options, diagnose};
use parallax_gap::options::Pattern;
use parallax_model::system::System;
use parallax_runtime::recording::log::{Log, Role, Signal};

/// An axis on a spring, near a magnet that its file knows of and takes to be without pull.
const SYSTEM: &str = r#"format = 1
name = "axis"

[parameters]
M = { value = 2.0, unit = "kg" }
k = { value = 3.0, unit = "N/V", calibrate = [1.0, 9.0] }
b = { value = 4.0, unit = "N s/m" }
s = { value = 30.0, unit = "N/m" }

[inputs]
u = { signal = "voltage" }

[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(k*u - b*v - s*q)/M" }

[outputs]
position = { value = "q", unit = "m" }

[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "k*u", load = "-s*q" }

[effects.magnet]
place = "joint:axis"
adds = "-pull*(q - 0.2)/(0.01 + (q - 0.2)^2)"
parameters = { pull = { value = 0.0, low = -3.0, high = 3.0, unit = "N m" } }
"#;

/// The machine, in steps of a tenth of a millisecond.
fn log(pull: f64) -> Log {
    let (h, mut q, mut v, mut noise) = (1e-4, 0.0_f64, 0.0_f64, 3_u32);
    let (mut times, mut commands, mut readings) = (Vec::new(), Vec::new(), Vec::new());
    let command = |t: f64| 4.0 * (1.3 * t).sin() + 2.5 * (3.7 * t + 1.0).sin() + 1.5 * (9.1 * t).cos();
    for step in 0..120_000 {
        let t = step as f64 * h;
        if step % 100 == 0 {
            let mut sum = -6.0;
            for _ in 0..12 {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                sum += f64::from(noise) / f64::from(u32::MAX);
            }
            times.push(i64::from(step) * 100_000);
            commands.push(command(t));
            readings.push(q + 2e-4 * sum);
        }
        let u = *commands.last().expect("commanded");
        let away = q - 0.2;
        v += h * (3.0 * u - 4.0 * v - 30.0 * q - pull * away / (0.01 + away * away)) / 2.0;
        q += h * v;
    }
    let signals = vec![
        Signal::new("voltage", Role::Command, "V", times.clone(), commands),
        Signal::new("position", Role::Measurement, "m", times, readings),
    ];
    Log { title: "near a magnet".into(), signals, ..Log::default() }
}

#[test]
fn an_effect_of_ones_own_is_found_and_written_back() {
    let system = System::parse(SYSTEM, "axis.toml").expect("valid");
    let pattern = |text: &str| text.parse::<Pattern>().expect("a pattern");
    let only = ["magnet", "coulomb", "viscous", "spring", "delay@input", "bias"].map(pattern).to_vec();
    let options = Options { only, ..Options::default() };
    let found = diagnose(&system, &log(0.6), &options, &|_, _| ()).expect("diagnosed");
    let leader = &found.report.which[0];
    assert_eq!(leader.effects.len(), 1, "{leader:?}");
    let effect = &leader.effects[0];
    assert_eq!((effect.name.as_str(), effect.place.as_str()), ("magnet", "joint:axis"));
    let pull = &effect.parameters["pull"];
    assert!((pull.value - 0.6).abs() < 0.03 && pull.unit == "N m", "{pull:?}");
    assert!(leader.probability > 0.9, "{}", leader.probability);

    let text = system.corrected(SYSTEM, &found.calibrated, &found.effects).expect("it can be written");
    let again = System::parse(&text, "axis.corrected.toml").expect("valid");
    let index = again.own[0].parameters[0].index;
    assert!((again.parameters[index].value - 0.6).abs() < 0.03, "{text}");
    assert!(again.effects.is_empty(), "it is no effect of the library");
}
