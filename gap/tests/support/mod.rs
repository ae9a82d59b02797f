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
    pub(crate) viscous: f64,
    pub(crate) forward: f64,
    pub(crate) backward: f64,
    pub(crate) bias: f64,
    pub(crate) mass: f64,
    /// A one-sided wall: stiffness beyond 0.8 rad. No named effect describes it.
    pub(crate) wall: f64,
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
        9.81,
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
    let (mut q, mut w, mut lagged) = (0.1, 0.0, 0.0);
    let steps = (duration / h).round() as usize;
    let every = (period / h).round() as usize;
    for k in 0..=steps {
        let t = k as f64 * h;
        if k % every == 0 {
            held.times.push(t);
            held.values.push(command(t));
            let noise = 0.0015 * normal(&mut random);
            let angle = (q + hidden.bias + noise + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU)
                - std::f64::consts::PI;
            samples.push(Sample { stamp: t, output: 0, value: angle });
        }
        let late = t - hidden.input_delay;
        let index = ((late / period + 1e-9).floor().max(0.0)) as usize;
        let mut u = held.values[index.min(held.values.len() - 1)];
        u += hidden.offset;
        if let Some(limit) = hidden.limit {
            u = u.max(-limit).min(limit);
        }
        if u.abs() <= hidden.deadband {
            u = 0.0;
        } else {
            u -= hidden.deadband * u.signum();
        }
        if hidden.lag > 0.0 {
            lagged += h * (u - lagged) / hidden.lag;
            u = lagged;
        }
        let mut torque = gain * u - mass * gravity * length * q.sin() - (friction + hidden.viscous) * w;
        if hidden.wall > 0.0 && q > 0.8 {
            torque -= hidden.wall * (q - 0.8);
        }
        // Dry friction that may hold: it takes at most what would stop the joint within the step.
        let inertia_now = inertia + if hidden.mass == 0.0 { 0.0 } else { hidden.mass * length * length };
        let free = w + h * torque / inertia_now;
        let dry = if free > 0.0 { hidden.forward } else { hidden.backward };
        let most = h * dry / inertia_now;
        w = if free.abs() <= most { 0.0 } else { free - most * free.signum() };
        q += h * w;
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
