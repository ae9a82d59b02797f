//! What a machine is told to do: excitation, and the loops that keep some machines where they belong.

use crate::effect::uniform;
use crate::system::{Control, N, State, System};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::f64::consts::TAU;

/// Excitation of one input at every tick, around zero.
pub(crate) fn excitation(
    system: &System,
    input: usize,
    duration: f64,
    poor: bool,
    rng: &mut ChaCha8Rng,
) -> Vec<f64> {
    let ticks = (duration * system.command_rate).ceil() as usize;
    let time = |k: usize| k as f64 / system.command_rate;
    // Loops around heavy machines follow slower references.
    let pace = if system.control == Control::Open { 1.0 } else { 0.5 };
    let size = system.inputs[input].amplitude * uniform(rng, 0.5, 1.45);
    if poor {
        let (f, phase) = (uniform(rng, 0.4, 1.6) * pace, uniform(rng, 0.0, TAU));
        return (0..ticks).map(|k| size * (TAU * f * time(k) + phase).sin()).collect();
    }
    let mut u: Vec<f64> = match rng.random_range(0..3u32) {
        0 => {
            let lines: Vec<[f64; 3]> = (0..6)
                .map(|_| {
                    [
                        rng.sample::<f64, _>(StandardNormal),
                        uniform(rng, 0.1, 4.0) * pace,
                        uniform(rng, 0.0, TAU),
                    ]
                })
                .collect();
            (0..ticks)
                .map(|k| lines.iter().map(|[a, f, p]| a * (TAU * f * time(k) + p).sin()).sum())
                .collect()
        }
        1 => {
            let mut u = Vec::with_capacity(ticks);
            while u.len() < ticks {
                let length = (uniform(rng, 0.1, 0.8) / pace * system.command_rate) as usize + 1;
                let level = uniform(rng, -1.0, 1.0);
                u.extend(std::iter::repeat_n(level, length));
            }
            u.truncate(ticks);
            u
        }
        _ => {
            let (low, high) = (uniform(rng, 0.1, 0.3), uniform(rng, 3.0, 6.0) * pace);
            let sweep = |t: f64| (TAU * (low * t + (high - low) * t * t / 2.0 / duration)).sin();
            (0..ticks)
                .map(|k| sweep(time(k)) * if (TAU * 0.11 * time(k)).sin() > 0.0 { 1.0 } else { 0.5 })
                .collect()
        }
    };
    let rms = (u.iter().map(|x| x * x).sum::<f64>() / ticks as f64).sqrt().max(1e-9);
    u.iter_mut().for_each(|x| *x = (*x * 0.65 * size / rms).clamp(-2.5 * size, 2.5 * size));
    u
}

/// The commands at one tick. Controllers have sensors of their own, without faults.
pub(crate) fn command(system: &System, wish: &[f64; N], s: &State) -> [f64; N] {
    match system.control {
        Control::Open => *wish,
        Control::Axis => [(13_700.0 * (wish[0] - s.q[0]) - 1600.0 * s.v[0]).clamp(-600.0, 600.0), 0.0, 0.0],
        Control::Hover => [
            (30_870.0 + wish[0] - 6000.0 * s.q[2] - 8000.0 * s.v[2]).clamp(0.0, 65_535.0),
            (wish[1] + 0.1 * s.q[1] + 0.15 * s.v[1]).clamp(-0.5, 0.5),
            (wish[2] - 0.1 * s.q[0] - 0.15 * s.v[0]).clamp(-0.5, 0.5),
        ],
    }
}

/// The commands at one tick of an experiment that somebody else designed, as it was designed: open loop. Only a machine
/// that would fly away keeps its loop, and what was designed is added to it.
pub(crate) fn played(system: &System, wish: &[f64; N], s: &State) -> [f64; N] {
    if system.control == Control::Hover {
        let added = std::array::from_fn(|i| wish[i] - system.inputs[i].rest);
        return command(system, &added, s);
    }
    *wish
}
