//! A system as it may be believed, bound to one recording: what the machine is replaced by.

use std::sync::Arc;

use parallax_model::plant::Plant;
use parallax_model::system::{EffectEntry, System};
use parallax_runtime::recording::log::Log;

use super::ClosedLoopError;
use super::start::Start;
use super::world::{Machine, Sensor, World};
use crate::bind::bind;
use crate::equations::EquationsSimulator;
use crate::experiment::Experiment;
use crate::library::extra_std;
use crate::setup::Setup;

/// A recording as the diagnosis sees it under the system that was given.
pub(super) struct Seen {
    pub(super) log: Log,
    /// All readings and commands, in seconds from the first stamp.
    pub(super) experiment: Experiment,
    /// The system with this recording's constants.
    system: System,
    setup: Setup,
}

impl Seen {
    pub(super) fn new(system: &System, log: &Log, horizon: Option<f64>) -> Result<Self, ClosedLoopError> {
        let (equations, experiment) = bind(system, log)?;
        let system = equations.system().clone();
        let mut setup = Setup::new(equations, experiment.clone(), horizon);
        crate::quantify::refine_step(&mut setup);
        // The constants are in the system by now; what a diagnosis finds of them must not be undone.
        let log = Log { constants: Vec::new(), ..log.clone() };
        Ok(Self { log, experiment, system, setup })
    }

    /// Median time between the readings of the fastest output (s).
    pub(super) fn period(&self) -> f64 {
        self.setup.period
    }

    /// Standard deviation of an output's noise.
    pub(super) fn noise(&self, output: usize) -> f64 {
        self.setup.output_noise[output]
    }

    /// The last stamp (s).
    pub(super) fn end(&self) -> f64 {
        self.experiment.span().1
    }
}

/// A system in the machine's place, along one recording.
pub(super) struct Variant<'a> {
    seen: &'a Seen,
    plant: Plant,
    machine: Arc<Machine>,
}

impl<'a> Variant<'a> {
    /// The system with these values and effects.
    pub(super) fn new(
        seen: &'a Seen,
        values: &[(String, f64)],
        effects: &[EffectEntry],
    ) -> Result<Self, ClosedLoopError> {
        let system = seen.system.with_corrections(values, effects);
        let equations = system.equations()?;
        let setup = &seen.setup;
        let mut smoothing: Vec<f64> = setup.joints.iter().map(|joint| joint.smoothing).collect();
        for entry in &system.effects {
            let joint = entry.place.strip_prefix("joint:").and_then(|name| system.joint(name));
            if let (Some(joint), Some(stated)) = (joint, entry.smoothing) {
                smoothing[joint] = stated;
            }
        }
        let plant = Plant::new(equations, &[], Vec::new(), smoothing);
        let experiment = &seen.experiment;
        let sensors = setup.output_noise.iter().enumerate();
        let sensors = sensors.map(|(output, noise)| Sensor::of(experiment, output, *noise)).collect();
        let machine = Arc::new(Machine::new(plant.clone(), setup.step, experiment, sensors));
        Ok(Self { seen, plant, machine })
    }

    pub(super) fn machine(&self) -> &Machine {
        &self.machine
    }

    /// The state at `from` (s), as the readings of at most one horizon of the diagnosis tell it under this system, and
    /// none after `to`.
    pub(super) fn start(&self, from: f64, to: f64) -> Result<Start, ClosedLoopError> {
        let setup = &self.seen.setup;
        let simulator =
            EquationsSimulator::new(self.plant.clone(), Vec::new(), &setup.experiment, setup.step)
                .with_extra_std(extra_std(setup, &self.plant));
        let nothing = || ClosedLoopError::Start { title: self.seen.log.title.clone(), from };
        let guess = &setup.train.first().ok_or_else(nothing)?.guess;
        let span = (from, (from + setup.horizon).min(to));
        Start::fit(&simulator, span, (guess.state(from), guess.std()), &setup.output_noise)
            .ok_or_else(nothing)
    }

    /// The machine on its way from `start`; `seed` draws its state and what happens by chance.
    pub(super) fn world(&self, start: &Start, seed: u64) -> World {
        World::new(&self.machine, &self.seen.experiment, start.time, start.draw(seed), seed)
    }
}
