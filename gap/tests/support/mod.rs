//! A pendulum with hidden effects, for tests: integrator and formulas of its own, none of them the library's.

use parallax_gap::experiment::{Experiment, Held, Sample};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The nominal belief about the pendulum: hanging down at zero.
pub(crate) const SYSTEM: &str = r#"
format = 1
name = "pendulum"

[parameters]
J = { value = 0.0125, unit = "kg m^2", calibrate = [0.005, 0.03], std = 0.001 }
k = { value = 0.12, unit = "N m/V", calibrate = [0.04, 0.3], std = 0.006 }
m = { value = 0.25, unit = "kg" }
l = { value = 0.2, unit = "m" }
b = { value = 0.004, unit = "N m s/rad" }
g = { value = 9.81, unit = "m/s^2" }

[inputs]
u = { signal = "voltage" }

[state]
q = { derivative = "w", initial = "angle" }
w = { derivative = "(k*u - m*g*l*sin(q) - b*w)/J" }

[outputs]
angle = { value = "q", unit = "rad", wrap = 6.283185307179586 }

[joints]
shaft = { position = "q", velocity = "w", inertia = "J", drive = "k*u", load = "-m*g*l*sin(q)", lever = "l" }
"#;

/// What is hidden in the world. Null values everywhere: nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Hidden {
    pub(crate) input_delay: f64,
    pub(crate) lag: f64,
    pub(crate) offset: f64,
    pub(crate) limit: Option<f64>,
    pub(crate) deadband: f64,
    /// Where a command has hardly begun to act: it does so little by little.
    pub(crate) soft_deadband: f64,
    /// Where a command bends towards its limit, as a hyperbolic tangent.
    pub(crate) bend: f64,
    pub(crate) viscous: f64,
    pub(crate) forward: f64,
    pub(crate) backward: f64,
    pub(crate) bias: f64,
    pub(crate) mass: f64,
    /// Another gravity.
    pub(crate) gravity: f64,
    /// A one-sided wall: stiffness beyond 0.8 rad.
    pub(crate) wall: f64,
    /// Torque for each rad by which the joint has turned without reversing, up to 0.05 rad: friction that remembers where
    /// it last reversed.
    pub(crate) bristle: f64,
    /// Torque of gusts: a third of a second each, at no even times.
    pub(crate) gust: f64,
    /// Damping of the lag, which then is of second order.
    pub(crate) damping: f64,
    /// Fastest change of the command.
    pub(crate) rate: Option<f64>,
    /// Full play between the command and what it moves.
    pub(crate) play: f64,
    /// Dry friction beyond the forward and backward ones at rest, and the speed at which it has fallen by e.
    pub(crate) breakaway: (f64, f64),
    /// Dry friction as a share of the torque that the shaft transmits.
    pub(crate) gear: f64,
    /// Drag with the square of speed.
    pub(crate) drag: f64,
    /// Torque of the poles and their number.
    pub(crate) poles: (f64, f64),
    /// Tilt of the base (rad).
    pub(crate) tilt: f64,
    /// Stiffness of a spring and where it rests.
    pub(crate) spring: (f64, f64),
    /// Torque of a vibration and its frequency (Hz).
    pub(crate) vibration: (f64, f64),
    /// The sensor's scale beyond one.
    pub(crate) scale: f64,
    /// Growth of the sensor's error per second.
    pub(crate) drift: f64,
    /// Time constant of the sensor's filter.
    pub(crate) filter: f64,
    /// What the sensor's clock gains per second.
    pub(crate) skew: f64,
    /// Stiffness, damping and rotor's share of a drive through a spring.
    pub(crate) flexible: Option<(f64, f64, f64)>,
}

/// Twenty seconds at 100 Hz: an excitation of several sines with a changing amplitude, one noisy angle.
pub(crate) fn record(hidden: Hidden, seed: u64, duration: f64) -> Experiment {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (inertia, gain, mass, length, friction, gravity) = (
        0.0125 * (1.0 + 0.02 * normal(&mut random)),
        0.12 * (1.0 + 0.02 * normal(&mut random)),
        0.25 + hidden.mass,
        0.2,
        0.004,
        9.81 + hidden.gravity,
    );
    let phases: Vec<f64> = (0..6).map(|_| random.random_range(0.0..std::f64::consts::TAU)).collect();
    let command = |t: f64| {
        let frequencies = [0.3, 0.7, 1.3, 2.1, 3.4, 5.2];
        let amplitudes = [1.2, 1.0, 0.9, 0.6, 0.6, 0.6];
        let envelope = 0.55 + 0.45 * (0.25 * t).sin();
        envelope
            * (0..6)
                .map(|i| amplitudes[i] * (std::f64::consts::TAU * frequencies[i] * t + phases[i]).sin())
                .sum::<f64>()
    };
    let h = 1e-4;
    let period = 0.01;
    let mut held = Held::default();
    let mut samples = Vec::new();
    let (mut q, mut w, mut lagged, mut lagged_rate) = (0.1, 0.0, 0.0, 0.0);
    let (mut followed, mut played, mut shown) = (0.0_f64, 0.0_f64, 0.1);
    let (mut rotor, mut rotor_speed, mut bristle) = (0.1, 0.0, 0.0_f64);
    let steps = (duration / h).round() as usize;
    let every = (period / h).round() as usize;
    let mut stamped = 0_u32;
    for k in 0..=steps {
        let t = k as f64 * h;
        if k % every == 0 {
            held.times.push(t);
            held.values.push(command(t));
        }
        if t >= f64::from(stamped) * period / (1.0 + hidden.skew) - 1e-9 {
            let seen = if hidden.filter > 0.0 { shown } else { q };
            let noise = 0.0015 * normal(&mut random);
            let seen = (1.0 + hidden.scale) * seen + hidden.bias + hidden.drift * t + noise;
            let angle =
                (seen + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
            samples.push(Sample { stamp: f64::from(stamped) * period, output: 0, value: angle });
            stamped += 1;
        }
        let late = t - hidden.input_delay;
        let index = ((late / period + 1e-9).floor().max(0.0)) as usize;
        let mut u = held.values[index.min(held.values.len() - 1)];
        u += hidden.offset;
        if hidden.soft_deadband > 0.0 {
            u *= 1.0 - (-(u / hidden.soft_deadband).powi(2)).exp();
        }
        if hidden.bend > 0.0 {
            u = hidden.bend * (u / hidden.bend).tanh();
        }
        if let Some(limit) = hidden.limit {
            u = u.max(-limit).min(limit);
        }
        if u.abs() <= hidden.deadband {
            u = 0.0;
        } else {
            u -= hidden.deadband * u.signum();
        }
        if let Some(rate) = hidden.rate {
            followed += (u - followed).max(-rate * h).min(rate * h);
            u = followed;
        }
        if hidden.damping > 0.0 {
            lagged_rate += h * ((u - lagged) / hidden.lag - 2.0 * hidden.damping * lagged_rate) / hidden.lag;
            lagged += h * lagged_rate;
            u = lagged;
        } else if hidden.lag > 0.0 {
            lagged += h * (u - lagged) / hidden.lag;
            u = lagged;
        }
        if hidden.play > 0.0 {
            played = played.max(u - 0.5 * hidden.play).min(u + 0.5 * hidden.play);
            u = played;
        }
        let weight = -mass * gravity * length * (q + hidden.tilt).sin();
        let mut inertia = inertia;
        let mut drive = gain * u;
        let mut gear = hidden.gear * (drive - weight).abs();
        if let Some((stiffness, damping, share)) = hidden.flexible {
            let spring = stiffness * (rotor - q) + damping * (rotor_speed - w);
            rotor_speed += h * (drive - spring) / (share * inertia);
            rotor += h * rotor_speed;
            (drive, gear) = (spring, 0.0);
            inertia *= 1.0 - share;
        }
        let mut torque = drive + weight - (friction + hidden.viscous) * w - hidden.drag * w * w.abs();
        torque += hidden.poles.0 * (hidden.poles.1 * q + 0.6).sin();
        torque -= hidden.spring.0 * (q - hidden.spring.1);
        torque += hidden.vibration.0 * (std::f64::consts::TAU * hidden.vibration.1 * t + 0.9).sin();
        bristle = (bristle + h * w).clamp(-0.05, 0.05);
        torque -= hidden.bristle * bristle;
        if [1.3, 2.9, 6.4, 7.2, 11.8, 13.1, 17.9].iter().any(|from| (*from..from + 0.33).contains(&t)) {
            torque += hidden.gust;
        }
        if hidden.wall > 0.0 && q > 0.8 {
            torque -= hidden.wall * (q - 0.8);
        }
        // Dry friction that may hold: it takes at most what would stop the joint within the step.
        let inertia_now = inertia + if hidden.mass == 0.0 { 0.0 } else { hidden.mass * length * length };
        let free = w + h * torque / inertia_now;
        let mut dry = if free > 0.0 { hidden.forward } else { hidden.backward } + gear;
        if hidden.breakaway.0 > 0.0 {
            dry += hidden.breakaway.0 * (-(w / hidden.breakaway.1).powi(2)).exp();
        }
        let most = h * dry / inertia_now;
        w = if free.abs() <= most { 0.0 } else { free - most * free.signum() };
        q += h * w;
        if hidden.filter > 0.0 {
            shown += h * (q - shown) / hidden.filter;
        }
    }
    Experiment {
        inputs: vec![held],
        input_units: vec!["V".into()],
        samples,
        wraps: vec![Some(std::f64::consts::TAU)],
        ..Experiment::default()
    }
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    let u: f64 = random.random_range(1e-12..1.0);
    let v: f64 = random.random_range(0.0..std::f64::consts::TAU);
    (-2.0 * u.ln()).sqrt() * v.cos()
}
