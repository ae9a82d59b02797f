//! What raw readings say of their noise, held to a model that predicts them.
//!
//! Readings are compared with their neighbours before anything is known of the machine, and motion with corners, such as
//! that of a first-order plant under a command in steps, looks like noise and outliers. A model that predicts the same
//! readings better than their alleged noise allows proves otherwise: an innovation contains all of a reading's error.

use super::Raw;
use crate::experiment::Experiment;
use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::median;

/// Share of the alleged variance below which the innovations' mean square contradicts it.
const LESS: f64 = 0.7;

/// Size, in the sensor's noise, below which the median innovation at alleged outliers says that they are none.
const NEAR: f64 = 3.0;

/// Outputs whose alleged noise or outliers one of the fitted models contradicts.
pub(crate) fn contradicted(setup: &Setup, raw: &Raw, recorded: &Experiment, fits: &[&Fit]) -> Vec<usize> {
    let effects = raw.effects();
    let system = setup.equations.system();
    let alleged = |output: usize, name: &str| {
        let place = format!("output:{}", system.outputs[output].name);
        effects.iter().any(|e| e.significant && e.name == name && e.place == place)
    };
    let outputs: Vec<usize> =
        (0..system.outputs.len()).filter(|o| alleged(*o, "noise") || alleged(*o, "outliers")).collect();
    if outputs.is_empty() {
        return outputs;
    }
    let plain = Setup::new(setup.equations.clone(), recorded.clone(), Some(setup.horizon));
    let believed = raw.believed(&setup.equations);
    let errors = |fit: &Fit| {
        let simulator = library::simulator(&plain, &fit.hypothesis, fit.residuals.clone());
        let all: Vec<Segment> = plain.train.iter().chain(&plain.test).cloned().collect();
        walk_plain(&simulator, &all, &plain.noise, &fit.innovation.noise, fit.theta())
    };
    let passes: Vec<_> = fits.iter().map(|fit| errors(fit)).collect();
    let is_contradicted = |output: usize| {
        let stamps = recorded.output(output).0;
        let suspects: Vec<f64> = raw.outliers(output).into_iter().map(|k| stamps[k]).collect();
        passes.iter().any(|pass| {
            let own = (0..pass.readings()).filter(|k| pass.output[*k] == output);
            let suspect = |k: &usize| suspects.binary_search_by(|s| s.total_cmp(&pass.stamp[*k])).is_ok();
            let (at, others): (Vec<usize>, Vec<usize>) = own.partition(suspect);
            let size = |k: &usize| pass.innovation[*k].abs();
            let mean_square =
                others.iter().map(|k| size(k).powi(2)).sum::<f64>() / others.len().max(1) as f64;
            let no_noise = alleged(output, "noise") && mean_square < LESS * believed[output].powi(2);
            let typical = median(&mut at.iter().map(size).collect::<Vec<_>>());
            let no_outliers =
                alleged(output, "outliers") && !at.is_empty() && typical < NEAR * plain.output_noise[output];
            no_noise || no_outliers
        })
    };
    outputs.into_iter().filter(|output| is_contradicted(*output)).collect()
}
