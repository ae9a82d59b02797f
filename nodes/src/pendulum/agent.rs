//! The agent: swings the pendulum up, balances it, and keeps shaking it so that the data tell causes apart.
//!
//! It goes through a schedule of energies: small swings, large swings, the upright position, full turns. An energy
//! controller (K. J. Åström and K. Furuta, *Swinging up a pendulum by energy control*, 2000) drives the pendulum to each,
//! a linear controller balances it near the top, and a sum of sines from 0.3 to 6 Hz, of an amplitude that comes and
//! goes, is added throughout.

use parallax_runtime::node::{Node, NodeContext, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;
use rand::RngExt;
use serde::Deserialize;

use std::f64::consts::TAU;

use super::messages::{Estimate, Voltage};
use crate::models::pendulum::{GRAVITY, Params, State, energy};

/// Where the pendulum is.
pub const ESTIMATOR: Port<Estimate> = Port::new("estimator");

/// Frequencies of the excitation, Hz: none is a multiple of another, so that the sum does not repeat within a run.
const FREQUENCIES: [f64; 8] = [0.31, 0.57, 0.97, 1.61, 2.43, 3.37, 4.61, 5.93];
/// The energies to go to, one after the other, as fractions of that upright; −1 hangs still, 1 is at rest upright.
const LEVELS: [f64; 6] = [0.2, 1.0, -0.6, 1.5, -0.2, 0.6];
/// How long each energy is held, s.
const HOLD: f64 = 2.5;

/// Parameters of the agent.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// The largest voltage that it asks for, V.
    pub limit: f64,
    /// Root mean square of the excitation at its strongest, V; 0 for none.
    pub excitation: f64,
    /// Whether it only balances, without a schedule.
    pub balance_only: bool,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { limit: 4.0, excitation: 2.4, balance_only: false }
    }
}

/// The agent.
#[derive(Clone, Debug)]
pub struct Agent {
    parameters: Parameters,
    model: Params<f64>,
    phases: [f64; FREQUENCIES.len()],
}

/// The kind `pendulum/agent`.
pub fn kind() -> NodeKind {
    NodeKind::new(Agent::new).input(ESTIMATOR)
}

impl Agent {
    fn new(context: &NodeContext) -> Result<Self, NodeError> {
        let parameters: Parameters = context.parameters()?;
        if !(parameters.limit > 0.0 && parameters.excitation >= 0.0) {
            return Err(context.parameter_error("`limit` must be positive and `excitation` not negative"));
        }
        let mut random = context.random();
        let phases = std::array::from_fn(|_| random.random_range(0.0..TAU));
        Ok(Self { parameters, model: Params::default(), phases })
    }

    /// The sum of sines at a time, V.
    fn excitation(&self, time: f64) -> f64 {
        let sum: f64 = FREQUENCIES
            .iter()
            .zip(&self.phases)
            .map(|(frequency, phase)| (TAU * frequency * time + phase).sin())
            .sum();
        // Comes and goes over seven seconds, so that small and large commands both occur.
        let envelope = 0.6 + 0.4 * (TAU * time / 7.0).sin();
        self.parameters.excitation * envelope * sum * (2.0 / FREQUENCIES.len() as f64).sqrt()
    }
}

impl Node for Agent {
    type Output = Voltage;

    fn step(&mut self, step: &Step<'_>) -> Result<Voltage, NodeError> {
        let Estimate { angle, speed, .. } = step.latest(ESTIMATOR).message;
        let time = to_seconds(step.start);
        let top = self.model.mass * self.model.length * GRAVITY;
        let level = match self.parameters.balance_only {
            true => 1.0,
            false => LEVELS[(time / HOLD).max(0.0) as usize % LEVELS.len()],
        };
        let near_the_top = angle.abs() < 0.4 && speed.abs() < 5.0;
        let voltage = if level == 1.0 && near_the_top {
            // The weight tips over with mgl θ, which 4.8 V per rad balance; the rest brings it back.
            -(16.0 * angle + 1.4 * speed) + 0.4 * self.excitation(time)
        } else {
            let missing = level - energy(&self.model, &State { angle, speed }) / top;
            // Smooth in the speed: at a turning point neither direction adds energy.
            (6.0 * missing).clamp(-3.0, 3.0) * (speed / 2.0).tanh() + self.excitation(time)
        };
        Ok(Voltage { voltage: voltage.clamp(-self.parameters.limit, self.parameters.limit) })
    }
}
