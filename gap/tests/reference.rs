//! Effects against an integrator of their own: tiny steps, masses in absolute coordinates, queues of commands, hard
//! limits; nothing of it is the library's.

use crate::rotor::{equations, experiment, predictions, simulator};
use parallax_model::effect::{Effect, PlaceKind};

/// What the world does besides the rotor's equations.
#[derive(Clone, Copy, PartialEq)]
enum Truth {
    Nothing,
    Delay(f64),
    LateReading(f64),
    Skew(f64),
    SkewedReading(f64),
    SecondOrder(f64, f64),
    RateLimit(f64),
    Backlash(f64),
    Stribeck(f64, f64, f64),
    TwoMasses(f64, f64, f64),
    SwingingMass(f64, f64, f64),
    SensorLag(f64),
    FastestSpeed(f64),
    AddedMass(f64),
    Tilt(f64),
}

/// Position and speed at the stamps of the experiment's readings.
fn world(truth: Truth) -> Vec<f64> {
    let experiment = experiment();
    let held = &experiment.inputs[0];
    let (inertia, gain, mass, length, drag) = (0.0125, 0.12, 0.25, 0.2, 0.004);
    let h = 2e-6;
    let (mut q, mut v, mut air) = (0.1, 0.4, 0.2);
    // The far side of a spring, in absolute coordinates.
    let (mut far, mut far_speed) = (q, v);
    let (mut moved, mut moved_rate, mut shown) = (held.values[0], 0.0, q);
    let mut wanted: Vec<(f64, usize)> = experiment.samples.iter().map(|s| (s.stamp, s.output)).collect();
    for (stamp, output) in &mut wanted {
        match truth {
            Truth::LateReading(delay) if *output == 0 => *stamp -= delay,
            Truth::SkewedReading(skew) if *output == 0 => *stamp /= 1.0 + skew,
            _ => {}
        }
    }
    let mut read = vec![f64::NAN; wanted.len()];
    // The walk begins with whatever is first: a reading, or a command that acts.
    let acts = if let Truth::Delay(delay) = truth { delay } else { 0.0 };
    let begin = wanted.iter().map(|(at, _)| *at).fold(acts, f64::min);
    for k in 0..=260_000_usize {
        let t = begin + h * k as f64;
        if read.iter().all(|value| !value.is_nan()) {
            break;
        }
        for (value, (at, output)) in read.iter_mut().zip(&wanted) {
            if value.is_nan() && t >= *at {
                // Back to the instant itself.
                let past = t - at;
                let y =
                    if matches!(truth, Truth::SensorLag(_)) && *output == 0 { shown } else { q - past * v };
                *value = if *output == 0 { y } else { v };
            }
        }
        let sent = match truth {
            Truth::Delay(delay) => t - delay,
            Truth::Skew(skew) => t / (1.0 + skew),
            _ => t,
        };
        let u = held.at(sent + 1e-9);
        let u = match truth {
            Truth::SecondOrder(tau, damping) => {
                moved_rate += h * (u - moved - 2.0 * damping * tau * moved_rate) / (tau * tau);
                moved += h * moved_rate;
                moved
            }
            Truth::RateLimit(rate) => {
                moved += (u - moved).clamp(-rate * h, rate * h);
                moved
            }
            Truth::Backlash(gap) => {
                moved = moved.clamp(u - 0.5 * gap, u + 0.5 * gap);
                moved
            }
            _ => u,
        };
        let drive = gain * u;
        let angle = if let Truth::Tilt(angle) = truth { q + angle } else { q };
        let mut weight = -mass * 9.81 * length * angle.sin();
        let mut inertia = inertia;
        if let Truth::AddedMass(added) = truth {
            inertia += added * length * length;
            weight -= added * 9.806_65 * length * q.sin();
        }
        let mut load = weight - drag * (v - air);
        if let Truth::Stribeck(coulomb, extra, speed) = truth {
            // The direction as smooth as the simulators' is here.
            let direction = 2.0 / (1.0 + (-2.0 * v / 0.3).exp()) - 1.0;
            load -= direction * (coulomb + extra * (-(v / speed) * (v / speed)).exp());
        }
        let acceleration = match truth {
            Truth::TwoMasses(stiffness, damping, ratio) | Truth::SwingingMass(stiffness, damping, ratio) => {
                let spring = stiffness * (far - q) + damping * (far_speed - v);
                let pushed = if matches!(truth, Truth::TwoMasses(..)) { drive } else { 0.0 };
                far_speed += h * (pushed - spring) / (inertia * ratio);
                far += h * far_speed;
                (drive - pushed + spring + load) / (inertia * (1.0 - ratio))
            }
            _ => (drive + load) / inertia,
        };
        v += h * acceleration;
        if let Truth::FastestSpeed(limit) = truth {
            v = v.min(limit);
        }
        q += h * v;
        air -= h * air / 0.5;
        if let Truth::SensorLag(tau) = truth {
            shown += h * (q - shown) / tau;
        }
    }
    read
}

/// The effect's predictions stay as close to the world's as the integration step allows.
fn agrees(truth: Truth, effect: Option<(Effect, PlaceKind, usize)>, values: &[f64], tolerance: f64) {
    let experiment = experiment();
    let effects: Vec<_> = effect.into_iter().collect();
    let (found, _) = predictions(&simulator(equations(), &effects, &experiment), values);
    let plain = world(Truth::Nothing);
    let reference = world(truth);
    let one = |values: &[f64], output: usize| -> Vec<f64> {
        values.iter().skip(output).step_by(2).copied().collect()
    };
    for output in 0..2 {
        let (a, b, c) = (one(&found, output), one(&reference, output), one(&plain, output));
        let size = b.iter().zip(&c).map(|(b, c)| (b - c).abs()).fold(0.0, f64::max);
        let scale =
            if truth == Truth::Nothing { b.iter().map(|v| v.abs()).fold(0.0, f64::max) } else { size };
        let error = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error <= tolerance * scale + 1e-4, "output {output}: {error} of {scale}");
    }
}

#[test]
fn the_nominal_rotor() {
    agrees(Truth::Nothing, None, &[], 1e-3);
}

#[test]
fn timing() {
    let at = |kind| Some((Effect::Delay, kind, 0));
    agrees(Truth::Delay(0.0137), at(PlaceKind::Input), &[0.0137], 0.01);
    agrees(Truth::LateReading(0.0071), at(PlaceKind::Output), &[0.0071], 0.01);
    let at = |kind| Some((Effect::ClockSkew, kind, 0));
    agrees(Truth::Skew(0.015), at(PlaceKind::Input), &[0.015], 0.02);
    agrees(Truth::SkewedReading(0.015), at(PlaceKind::Output), &[0.015], 0.02);
}

#[test]
fn actuation() {
    let at = |effect| Some((effect, PlaceKind::Input, 0));
    agrees(Truth::SecondOrder(0.031, 0.4), at(Effect::LagSecondOrder), &[0.031, 0.4], 0.01);
    agrees(Truth::SecondOrder(0.02, 1.6), at(Effect::LagSecondOrder), &[0.02, 1.6], 0.01);
    agrees(Truth::RateLimit(9.7), at(Effect::RateLimit), &[9.7], 0.01);
    agrees(Truth::Backlash(0.31), at(Effect::Backlash), &[0.31], 0.01);
}

#[test]
fn joints() {
    let at = |effect, joint| Some((effect, PlaceKind::Joint, joint));
    agrees(Truth::Stribeck(0.015, 0.02, 0.9), at(Effect::Stribeck, 0), &[0.015, 0.02, 0.9], 0.01);
    for joint in [0, 1] {
        let values = [9.0, 0.03, 0.35];
        agrees(Truth::TwoMasses(9.0, 0.03, 0.35), at(Effect::Flexibility, joint), &values, 0.02);
        agrees(Truth::SwingingMass(9.0, 0.03, 0.35), at(Effect::FlexibilityFar, joint), &values, 0.02);
    }
    agrees(Truth::AddedMass(0.1), at(Effect::Payload, 0), &[0.1], 0.01);
    agrees(Truth::Tilt(0.09), at(Effect::GravityTilt, 1), &[0.09], 0.01);
}

#[test]
fn sensing_and_states() {
    agrees(Truth::SensorLag(0.023), Some((Effect::SensorLag, PlaceKind::Output, 0)), &[0.023], 0.01);
    // A hard bound of a state is met within a step.
    agrees(Truth::FastestSpeed(1.1), Some((Effect::Saturation, PlaceKind::State, 1)), &[-1e6, 1.1], 0.04);
}

/// A stiff spring is no spring: slow motion is right whatever a step can follow.
#[test]
fn a_stiff_joint_moves_as_one() {
    let experiment = experiment();
    let (plain, _) = predictions(&simulator(equations(), &[], &experiment), &[]);
    for effect in [Effect::Flexibility, Effect::FlexibilityFar] {
        let plant = simulator(equations(), &[(effect, PlaceKind::Joint, 0)], &experiment);
        let (stiff, _) = predictions(&plant, &[1e7, 5.0, 0.4]);
        let error = stiff.iter().zip(&plain).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 0.02, "{effect:?}: {error}");
    }
}
