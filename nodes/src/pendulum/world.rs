//! The world: a simulated pendulum that stands in for the hardware.
//!
//! It is written apart from the models on purpose, with an integrator, constants and friction of its own, so that the
//! diagnosis cannot find its own formulas again.
//!
//! It integrates to the stamps of the commands, not to its own wake-ups, as all that stands in for hardware here.

use std::f64::consts::PI;

use parallax_runtime::node::{Node, NodeContext, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};
use serde::Deserialize;

use super::hidden::{HiddenEffect, Machine};
use super::messages::{Voltage, WorldState};
use crate::stand_in::{Machine as StandInMachine, StandIn};

/// The commands.
pub const MOTOR: Port<Voltage> = Port::new("motor");

/// The integration step, s.
const STEP: f64 = 1e-4;

// The true constants. Moment of inertia and motor constant differ a little from what the nominal simulator believes, as
// a data sheet does; the others are right.

/// Moment of inertia about the shaft, kg m².
const INERTIA: f64 = 1.62e-4;
/// Motor constant, N m/A or V s/rad.
const MOTOR_CONSTANT: f64 = 0.0337;
/// Resistance of the winding, Ω.
const RESISTANCE: f64 = 7.73;
/// Viscous friction, N m s/rad.
const VISCOUS: f64 = 1.43e-5;
/// Weight times the distance of its centre from the shaft, N m.
pub(super) const WEIGHT: f64 = 0.0207;

/// The kind `pendulum/world`, hiding what `effect` gives for the world that is built.
pub(super) fn kind(
    effect: impl Fn(&NodeContext) -> Result<HiddenEffect, NodeError> + Send + Sync + 'static,
) -> NodeKind {
    NodeKind::new(move |context| Ok(World::new(effect(context)?).begun(&Settings::read(context)?)))
        .input(MOTOR)
        .initial(&WorldState { angle: PI, speed: 0.0, stamp: 0.0 })
        .stand_in()
}

/// What may stand in a graph: what people do with the machine. What it is stays hidden.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The angle from upright at the run's start, rad.
    pub angle: f64,
    /// The speed at the run's start, rad/s.
    pub speed: f64,
    /// At most [`MOST_TAPS`], in any order.
    pub taps: Vec<Tap>,
}

/// A tap with a finger, too short for anything to move meanwhile.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tap {
    /// When, s from the run's start; after it.
    pub time: f64,
    /// The impulse about the shaft, N m s: it changes the speed by itself over the moment of inertia.
    pub impulse: f64,
}

/// The most taps of a run: a world is copied whenever it is looked at.
pub const MOST_TAPS: usize = 8;

impl Default for Settings {
    /// It hangs still, and nobody touches it.
    fn default() -> Self {
        Self { angle: PI, speed: 0.0, taps: Vec::new() }
    }
}

impl Settings {
    fn read(context: &NodeContext) -> Result<Self, NodeError> {
        let settings: Self = context.parameters()?;
        if settings.taps.len() > MOST_TAPS {
            let count = settings.taps.len();
            return Err(context.parameter_error(format!("`taps` has {count} entries; at most {MOST_TAPS}")));
        }
        if let Some(tap) = settings.taps.iter().find(|tap| tap.time.is_nan() || tap.time <= 0.0) {
            return Err(context.parameter_error(format!(
                "a tap's `time` is {}: it must come after the run's start, 0 s",
                tap.time
            )));
        }
        Ok(settings)
    }
}

/// The world.
#[derive(Clone, Debug)]
pub struct World(StandIn<Pendulum>);

impl World {
    /// A pendulum that hangs still at the run's start, with one hidden effect.
    pub fn new(effect: HiddenEffect) -> Self {
        Self(StandIn::new(Pendulum::new(effect, PI, 0.0)))
    }

    /// The same one, with other hands on it.
    fn begun(self, settings: &Settings) -> Self {
        let mut pendulum = self.0.at(0);
        (pendulum.angle, pendulum.speed) = (settings.angle, settings.speed);
        for (own, tap) in pendulum.taps.iter_mut().zip(&settings.taps) {
            *own = (from_seconds(tap.time), tap.impulse);
        }
        pendulum.taps.sort_by_key(|(time, _)| *time);
        Self(StandIn::new(pendulum))
    }
}

impl Node for World {
    type Output = WorldState;

    fn step(&mut self, step: &Step<'_>) -> Result<WorldState, NodeError> {
        let now = self.0.step(step, MOTOR);
        Ok(WorldState { angle: now.mark(), speed: now.speed, stamp: to_seconds(step.start) })
    }
}

/// The pendulum itself.
#[derive(Clone, Copy, Debug)]
struct Pendulum {
    effect: HiddenEffect,
    time: Nanos,
    angle: f64,
    speed: f64,
    /// The command that acts at present, V.
    command: f64,
    /// What a lag has let through of it so far, V.
    lagged: f64,
    /// When somebody taps it, and how hard, N m s; in order, those at time 0 are none.
    taps: [(Nanos, f64); MOST_TAPS],
}

impl Pendulum {
    fn new(effect: HiddenEffect, angle: f64, speed: f64) -> Self {
        Self { effect, time: 0, angle, speed, command: 0.0, lagged: 0.0, taps: [(0, 0.0); MOST_TAPS] }
    }

    /// Where the camera's mark is, rad.
    fn mark(&self) -> f64 {
        match self.effect {
            HiddenEffect::Bias { bias } => self.angle + bias,
            _ => self.angle,
        }
    }

    /// Half a drift, a kick, half a drift: symmetric, so of second order, and steady in energy.
    fn step(&mut self, h: f64) {
        self.angle += 0.5 * h * self.speed;

        let viscous = match self.effect {
            HiddenEffect::Viscous { coefficient } => VISCOUS + coefficient,
            HiddenEffect::Machine(Machine { viscous, .. }) => viscous,
            _ => VISCOUS,
        };
        let (inertia, motor) = self.body();
        let weight = match self.effect {
            HiddenEffect::Weight { mgl } => mgl,
            _ => WEIGHT,
        };
        let voltage = self.voltage(h);
        // A linear equation during the kick, solved exactly: v' = a − d v.
        let damping = (viscous + motor * motor / RESISTANCE) / inertia;
        let push = (motor / RESISTANCE * voltage + weight * self.angle.sin()) / inertia;
        let terminal = push / damping;
        let free = terminal + (self.speed - terminal) * (-damping * h).exp();
        // Dry friction takes what momentum it can, and no more: it holds what it can stop (J. J. Moreau's time stepping).
        let loss = self.dry_friction(free) * h / inertia;
        self.speed = if free.abs() <= loss { 0.0 } else { free - loss.copysign(free) };

        self.angle += 0.5 * h * self.speed;
    }

    /// Moment of inertia, kg m², and motor constant, N m/A.
    fn body(&self) -> (f64, f64) {
        match self.effect {
            HiddenEffect::Machine(Machine { inertia, motor, .. }) => (inertia, motor),
            _ => (INERTIA, MOTOR_CONSTANT),
        }
    }

    /// Moves to a time at which nobody has tapped it before.
    fn swing(&mut self, until: Nanos) {
        if until <= self.time {
            return;
        }
        let span = to_seconds(until - self.time);
        let steps = (span / STEP).ceil().max(1.0);
        let h = span / steps;
        for _ in 0..steps as u64 {
            self.step(h);
        }
        self.time = until;
    }

    /// The voltage that acts on the motor during a step, on average.
    fn voltage(&mut self, h: f64) -> f64 {
        match self.effect {
            HiddenEffect::Lag { time_constant } => {
                let before = self.lagged;
                self.lagged = self.command + (before - self.command) * (-h / time_constant).exp();
                0.5 * (before + self.lagged)
            }
            HiddenEffect::Offset { offset } => self.command + offset,
            HiddenEffect::Saturation { low, high } => self.command.clamp(low, high),
            HiddenEffect::Deadband { width } => (self.command.abs() - width).max(0.0).copysign(self.command),
            _ => self.command,
        }
    }

    /// The largest torque of dry friction when moving, or about to move, this way, N m.
    fn dry_friction(&self, speed: f64) -> f64 {
        match self.effect {
            HiddenEffect::Coulomb { force } | HiddenEffect::Machine(Machine { coulomb: force, .. }) => force,
            HiddenEffect::AsymmetricFriction { forward, .. } if speed > 0.0 => forward,
            HiddenEffect::AsymmetricFriction { backward, .. } => backward,
            _ => 0.0,
        }
    }
}

impl StandInMachine for Pendulum {
    type Command = Voltage;

    fn delay(&self) -> Nanos {
        match self.effect {
            HiddenEffect::Delay { delay } | HiddenEffect::Machine(Machine { delay, .. }) => {
                from_seconds(delay)
            }
            _ => 0,
        }
    }

    fn apply(&mut self, Voltage { voltage }: Voltage) {
        self.command = voltage;
    }

    fn advance(&mut self, until: Nanos) {
        let since = self.time;
        for (time, impulse) in self.taps {
            if since < time && time <= until {
                self.swing(time);
                self.speed += impulse / self.body().0;
            }
        }
        self.swing(until);
    }
}

#[cfg(test)]
mod tests;
