//! The agent: swings the pendulum up, balances it, and keeps shaking it so that the data tell causes apart.
//!
//! It goes through a schedule of energies: small swings, large swings, the upright position, full turns. An energy
//! controller (K. J. Åström and K. Furuta, *Swinging up a pendulum by energy control*, 2000) drives the pendulum to each,
//! a linear controller balances it near the top, and a sum of sines from 0.3 to 6 Hz, of an amplitude that comes and
//! goes, is added throughout.

use std::f64::consts::TAU;

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;
use rand::RngExt;
use serde::Deserialize;

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

/// What may stand in a graph.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The largest voltage that it asks for, V.
    pub limit: f64,
    /// Root mean square of the excitation at its strongest, V; 0 for none.
    pub excitation: f64,
    /// Whether it only balances, without a schedule.
    pub balance_only: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { limit: 4.0, excitation: 2.4, balance_only: false }
    }
}

/// Parameters of the agent.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// The largest voltage that it asks for, V.
    pub limit: T,
    /// Root mean square of the excitation at its strongest, V.
    pub excitation: T,
    /// 1 when it only balances, without a schedule, else 0.
    pub balance_only: T,
    /// Phases of the excitation's sines, rad.
    pub phase: [T; FREQUENCIES.len()],
    /// What it believes of the pendulum.
    pub model: Params<T>,
}

/// The agent.
#[derive(Clone, Copy, Debug)]
pub struct Agent;

/// The kind `pendulum/agent`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Agent>(|context| {
        let Settings { limit, excitation, balance_only } = context.parameters()?;
        if !(limit > 0.0 && excitation >= 0.0) {
            return Err(context.parameter_error("`limit` must be positive and `excitation` not negative"));
        }
        let mut random = context.random();
        let phase = std::array::from_fn(|_| random.random_range(0.0..TAU));
        let balance_only = if balance_only { 1.0 } else { 0.0 };
        Ok((Parameters { limit, excitation, balance_only, phase, model: Params::default() }, ()))
    })
    .input(ESTIMATOR)
    .settable(Parameter::new("limit", "V").positive())
    .settable(Parameter::new("excitation", "V").at_least(0.0))
    .settable(Parameter::new("balance_only", "").at_least(0.0).at_most(1.0))
}

/// The sum of sines at a time, V.
#[inline(always)]
fn excitation<T: Scalar>(p: &Parameters<T>, time: T) -> T {
    let sum = FREQUENCIES
        .iter()
        .zip(&p.phase)
        .fold(T::constant(0.0), |sum, (frequency, phase)| sum + (time * (TAU * frequency) + *phase).sin());
    // Comes and goes over seven seconds, so that small and large commands both occur.
    let envelope = (time * (TAU / 7.0)).sin() * 0.4 + 0.6;
    p.excitation * envelope * sum * (2.0 / FREQUENCIES.len() as f64).sqrt()
}

/// The energy to go to at a time, as a fraction of that upright.
#[inline(always)]
fn level<T: Scalar>(p: &Parameters<T>, time: T) -> T {
    let place = (time.max(T::constant(0.0)) / HOLD).floor();
    let turns = (place / LEVELS.len() as f64).floor();
    let place = place - turns * LEVELS.len() as f64;
    let scheduled = LEVELS.iter().enumerate().fold(T::constant(LEVELS[0]), |level, (index, &other)| {
        T::select(place.eq(T::constant(index as f64)), T::constant(other), level)
    });
    T::select(p.balance_only.gt(T::constant(0.5)), T::constant(1.0), scheduled)
}

impl NodeModel for Agent {
    const NAME: &'static str = "agent";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Voltage<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Voltage<T>) {
        let Estimate { angle, speed, .. } = step.latest::<Estimate<T>>(ESTIMATOR.name()).message;
        let shake = excitation(p, step.start);
        let level = level(p, step.start);
        let near_the_top = angle.abs().lt(T::constant(0.4)) & speed.abs().lt(T::constant(5.0));
        // The weight tips over with mgl θ, which 4.8 V per rad balance; the rest brings it back.
        let balance = -(angle * 16.0 + speed * 1.4) + shake * 0.4;
        let top = p.model.mass * p.model.length * GRAVITY;
        let missing = level - energy(&p.model, &State { angle, speed }) / top;
        // Smooth in the speed: at a turning point neither direction adds energy.
        let push = (missing * 6.0).clamp(T::constant(-3.0), T::constant(3.0));
        let swing = push * (speed / 2.0).tanh() + shake;
        let voltage = T::select(level.eq(T::constant(1.0)) & near_the_top, balance, swing);
        ((), Voltage { voltage: voltage.clamp(-p.limit, p.limit) })
    }
}
