//! Acceleration regression: states follow from the readings, their rates of change from differences, and every effect is
//! fitted to what the nominal equations leave of those rates.

use std::sync::atomic::AtomicBool;

use parallax_gap::filter::{Noise, Pass};
use parallax_gap::innovation::walk;
use parallax_gap::library;
use parallax_gap::setup::Setup;
use parallax_gap::simulator::Simulator;
use parallax_model::system::System;
use parallax_runtime::recording::log::Log;

use super::along::Along;
use super::criterion::{Method, Squares, rank};
use super::{BaselineResult, setup};

pub(super) fn answer(system: &System, log: &Log, stop: &AtomicBool) -> anyhow::Result<BaselineResult> {
    let setup = setup(system, log)?;
    let measured = measured(&setup);
    let residuals = |simulator: &dyn Simulator, theta: &[f64]| error(&setup, &measured, simulator, theta);
    Ok(rank(&setup, &Method { nuisances: Vec::new(), residuals: &residuals }, stop))
}

/// The nominal states that the readings of each segment say.
fn measured(setup: &Setup) -> Vec<Pass> {
    let nominal = library::simulator(setup, &library::hypothesis(setup, &[]), Vec::new());
    let stated: Vec<f64> = library::hypothesis(setup, &[]).fitted.iter().map(|f| f.null).collect();
    // So much process noise that the readings lead: what the filter says is the readings' derivative.
    let loud = Noise { log_process: 0.0, ..setup.noise.initial.clone() };
    let walk = |segment| walk(&nominal, std::slice::from_ref(segment), &setup.noise, &loud, &stated);
    setup.train.iter().map(walk).collect()
}

/// Errors of the rates of change between readings, in units of their natural sizes.
fn error(setup: &Setup, measured: &[Pass], simulator: &dyn Simulator, theta: &[f64]) -> Squares {
    let p = simulator.parameters();
    let mut squares = Squares::new(p);
    let mut run = simulator.run(theta);
    // A hypothesis of a late sensor has its last events before the last stamps.
    let last = run.events().len().saturating_sub(1);
    for (segment, pass) in setup.train.iter().zip(measured) {
        let n = pass.states();
        let start = simulator.start(segment.guess.state(segment.from), segment.guess.std(), segment.from).0;
        let mut along = Along::new(&start, p, 0);
        let at = |stamp: f64| run.events().partition_point(|event| event.time < stamp - 1e-9).min(last);
        let places: Vec<usize> = pass.stamp.iter().map(|stamp| at(*stamp)).collect();
        let mut from = 0;
        for to in 1..pass.stamp.len() {
            let dt = pass.stamp[to] - pass.stamp[from];
            // Readings of several outputs at one time are one state; stretches of the walk do not join.
            if dt < 0.9 * setup.period || dt > 3.0 * setup.period {
                if dt < 0.0 || dt > 3.0 * setup.period {
                    from = to;
                }
                continue;
            }
            along.set(&pass.state[from * n..(from + 1) * n]);
            for index in places[from]..places[to] {
                along.advance(&mut *run, index);
            }
            for (state, scale) in setup.noise.scale.iter().enumerate().filter(|(_, scale)| **scale > 0.0) {
                let unit = dt * scale;
                let off = (pass.state[to * n + state] - along.state(state)) / unit;
                let slope: Vec<f64> = (0..p).map(|j| -along.slope(state, j) / unit).collect();
                if off.is_finite() && slope.iter().all(|s| s.is_finite()) {
                    squares.add(off, &slope);
                }
            }
            from = to;
        }
    }
    squares
}
