//! What raw readings say of their noise, held to a model that predicts them.
//!
//! Readings are compared with their neighbours before anything is known of the machine, and motion with corners, such as
//! that of a first-order plant under a command in steps, looks like noise and outliers. A model that predicts the same
//! readings better than their alleged noise allows proves otherwise: an innovation contains all of a reading's error.

use super::{Raw, scatter};
use crate::experiment::Experiment;
use crate::innovation::{Segment, walk_plain};
use crate::library;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::{median, root_mean_square};

/// Share of the alleged variance below which the innovations' variance contradicts it, where little is declared.
const LESS: f64 = 0.6;

/// Share of the innovations, the largest, that are not looked at, and the share of a normal distribution's variance that is
/// left without them.
const EVENTS: f64 = 0.02;
const WITHOUT_EVENTS: f64 = 0.86;

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
        fits.iter().zip(&passes).any(|(fit, pass)| {
            let own = (0..pass.readings()).filter(|k| pass.output[*k] == output);
            let suspect = |k: &usize| suspects.binary_search_by(|s| s.total_cmp(&pass.stamp[*k])).is_ok();
            let (at, others): (Vec<usize>, Vec<usize>) = own.partition(suspect);
            let size = |k: &usize| pass.innovation[*k].abs();
            // Single events that the model misses are no noise either.
            let mut sizes: Vec<f64> = others.iter().map(size).collect();
            sizes.sort_by(f64::total_cmp);
            sizes.truncate(((1.0 - EVENTS) * sizes.len() as f64) as usize);
            let declared = system.outputs[output].noise.unwrap_or(0.0);
            let most = less_than(declared * declared, believed[output].powi(2));
            // Or what the model's own doubt leaves of them for the readings, as a filter has it that may ask for more than is declared.
            let left = || scatter::noise_of_readings(&plain, fit, output).powi(2);
            let nearer = |left: f64| 2.0 * left < declared * declared + believed[output].powi(2);
            let no_noise = alleged(output, "noise")
                && (root_mean_square(&sizes).powi(2) < most || (declared > 0.0 && nearer(left())));
            let typical = median(&mut at.iter().map(size).collect::<Vec<_>>());
            let no_outliers =
                alleged(output, "outliers") && !at.is_empty() && typical < NEAR * plain.output_noise[output];
            // Times that scatter make readings noisier only where they change fast. A model that lacks something shows such
            // scatter, too: each speaks for itself.
            (no_noise || no_outliers) && !scatter::times_scatter(setup, fit, output)
        })
    };
    outputs.into_iter().filter(|output| is_contradicted(*output)).collect()
}

/// The innovations' variance below which they are nearer to the declared variance than to the alleged one, which they would
/// contain.
fn less_than(declared: f64, alleged: f64) -> f64 {
    (LESS * alleged).max(0.5 * WITHOUT_EVENTS * (declared + alleged))
}

#[cfg(test)]
mod tests {
    use super::less_than;

    #[test]
    fn the_nearer_of_two_variances_decides() {
        let trimmed = |variance: f64| 0.86 * variance;
        // A fifth more noise than declared: innovations of the declared size deny it, those of the alleged one do not.
        assert!(trimmed(1.0) < less_than(1.0, 1.44) && trimmed(1.44) > less_than(1.0, 1.44));
        // Where nothing is declared, or much less, innovations contain what the model lacks as well.
        assert!((less_than(0.0, 1.0) - 0.6).abs() < 1e-12);
    }
}
