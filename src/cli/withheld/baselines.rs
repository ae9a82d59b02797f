//! Other methods on the same cases, each in a file of its own.

use std::sync::atomic::AtomicBool;

use parallax_gap::bind::bind;
use parallax_gap::innovation::walk;
use parallax_gap::library;
use parallax_gap::quantify::{closed, predict, refine_step};
use parallax_gap::search::Fit;
use parallax_gap::setup::Setup;
use parallax_model::system::System;
use parallax_runtime::recording::log::Log;
use serde::{Deserialize, Serialize};

mod acceleration;
mod along;
mod criterion;
mod refit;
mod residual;
mod simulation;

/// What another method said of a case.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct BaselineResult {
    /// Whether it says that there is a gap.
    pub(crate) detected: bool,
    /// Single effects, the best first; none for a method that names nothing.
    pub(crate) ranking: Vec<String>,
    /// Share of the nominal held-out gap that it closes.
    pub(crate) closed: Option<f64>,
    /// How long it took (s).
    pub(crate) seconds: f64,
    /// Why it failed.
    pub(crate) error: Option<String>,
}

/// Another method.
pub(crate) struct Baseline {
    /// Its name in the results.
    pub(crate) name: &'static str,
    /// Whether it names effects; one that does not is scored by the gap that it closes.
    pub(crate) names: bool,
    /// What it says of a case; nothing of use once the last is set.
    pub(crate) answer: fn(&System, &Log, &AtomicBool) -> anyhow::Result<BaselineResult>,
}

/// All methods.
pub(crate) const ALL: [Baseline; 4] = [
    Baseline { name: "full simulation error and BIC", names: true, answer: simulation::answer },
    Baseline { name: "acceleration regression and BIC", names: true, answer: acceleration::answer },
    Baseline { name: "nominal refit only", names: false, answer: refit::answer },
    Baseline { name: "black-box residual", names: false, answer: residual::answer },
];

/// The system bound to the recording, as the diagnosis begins.
fn setup(system: &System, log: &Log) -> anyhow::Result<Setup> {
    let (equations, experiment) = bind(system, log)?;
    let mut setup = Setup::new(equations, experiment, None);
    refine_step(&mut setup);
    Ok(setup)
}

/// Share of the nominal system's held-out gap that a fit closes.
fn closed_from_nominal(setup: &Setup, null: &Fit, fit: &Fit) -> f64 {
    let simulator = library::simulator(setup, &null.hypothesis, Vec::new());
    let stated: Vec<f64> = null.hypothesis.fitted.iter().map(|f| f.null).collect();
    let noise = walk(&simulator, &setup.train, &setup.noise, &null.innovation.noise, &stated).refit_noise(
        &setup.noise.scale,
        &null.innovation.noise,
        &setup.noise.limits,
        setup.noise.process_floor,
    );
    let before = predict(setup, &simulator, &stated, &noise);
    let simulator = library::simulator(setup, &fit.hypothesis, fit.residuals.clone());
    closed(&before, &predict(setup, &simulator, fit.estimate(), &fit.innovation.noise), 1).value
}
