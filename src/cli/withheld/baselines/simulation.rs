//! Full-simulation error and BIC: every effect is fitted to the whole recording, simulated from its first state.

use std::sync::atomic::AtomicBool;

use parallax_gap::hypothesis::{Fitted, Prior, Slot};
use parallax_gap::setup::Setup;
use parallax_gap::simulator::{Simulator, wrapped};
use parallax_model::system::System;
use parallax_runtime::recording::log::Log;

use super::along::Along;
use super::criterion::{Method, Squares, rank};
use super::{BaselineResult, setup};

/// Residual of a simulation that runs away, in noise units.
const RUNAWAY: f64 = 1e6;

pub(super) fn answer(system: &System, log: &Log, stop: &AtomicBool) -> anyhow::Result<BaselineResult> {
    let setup = setup(system, log)?;
    Ok(rank(
        &setup,
        &Method {
            nuisances: initial(&setup),
            residuals: &|simulator, theta| error(&setup, simulator, theta),
        },
        stop,
    ))
}

/// Where the simulation begins: around what the first readings say.
fn initial(setup: &Setup) -> Vec<Fitted> {
    let Some(first) = setup.train.first() else { return Vec::new() };
    let states = first.guess.state(first.from).iter().zip(first.guess.std()).enumerate();
    states
        .map(|(k, (mean, std))| {
            let std = std.max(1e-9);
            Fitted {
                slot: Slot::Weight(k),
                name: setup.equations.system().states[k].name.clone(),
                unit: String::new(),
                null: *mean,
                prior: Prior::Normal { mean: *mean, std },
                low: mean - 10.0 * std,
                high: mean + 10.0 * std,
                scale: std,
                starts: Vec::new(),
            }
        })
        .collect()
}

/// The errors of one simulation over the whole recording, in noise units.
fn error(setup: &Setup, simulator: &dyn Simulator, theta: &[f64]) -> Squares {
    let (own, p) = (simulator.parameters(), theta.len());
    let mut squares = Squares::new(p);
    let Some(first) = setup.train.first() else { return squares };
    let mut run = simulator.run(&theta[..own]);
    let count = run.events().len();
    let begin = run.events().iter().position(|event| event.time >= first.from).unwrap_or(0);
    let start = simulator.start(&theta[own..], first.guess.std(), first.from).0;
    let mut along = Along::new(&start, own, p - own);
    for index in begin..count {
        if let Some(reading) = run.events()[index].reading {
            let predicted = along.read(&mut *run, index);
            let unit = setup.output_noise[reading.output];
            let off = wrapped(reading.value - predicted, run.wrap(reading.output)) / unit;
            let astray = !(off.is_finite() && off.abs() < RUNAWAY);
            let slope: Vec<f64> = (0..p)
                .map(|j| {
                    Some(along.of_reading(j))
                        .filter(|by| !astray && by.is_finite())
                        .map_or(0.0, |by| -by / unit)
                })
                .collect();
            squares.add(if astray { RUNAWAY } else { off }, &slope);
        }
        if index + 1 < count {
            along.advance(&mut *run, index);
        }
    }
    squares
}
