//! The world: a simulated pendulum that stands in for the hardware.
//!
//! It is written apart from the models on purpose, with an integrator, constants and friction of its own, so that the
//! diagnosis cannot find its own formulas again.
//!
//! It integrates to the stamps of the commands, not to its own wake-ups: the state that it keeps is that at the last
//! command's stamp, and what it shows at the start of a step is predicted from there. A command that arrives late is
//! therefore still applied from its stamp on, and the scheduler's jitter does not become a delay of the plant.

use std::f64::consts::PI;

use parallax_runtime::node::{Node, NodeContext, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};

use super::hidden::{HiddenEffect, Machine};
use super::messages::{Voltage, WorldState};

/// The commands.
pub const MOTOR: Port<Voltage> = Port::new("motor");
/// How many commands it looks back on, so that none is missed when it wakes up late.
pub const COMMANDS: usize = 16;

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
    NodeKind::new(move |context| Ok(World::new(effect(context)?)))
        .input(MOTOR)
        .initial(&WorldState { angle: PI, speed: 0.0, stamp: 0.0 })
        .stand_in()
}

/// The world.
#[derive(Clone, Debug)]
pub struct World {
    /// As of the last command's stamp.
    kept: Pendulum,
    /// Commands that are known but do not act yet at the kept time, oldest first.
    pending: Pending,
    last_seq: Option<u64>,
}

impl World {
    /// A pendulum that hangs still at the run's start, with one hidden effect.
    pub fn new(effect: HiddenEffect) -> Self {
        Self { kept: Pendulum::new(effect, PI, 0.0), pending: Pending::new(), last_seq: None }
    }

    /// Takes a command that was sent at a time; commands come in the order of their sending.
    fn command(&mut self, sent: Nanos, voltage: f64) {
        let acts = sent.saturating_add(self.kept.delay());
        if self.pending.is_full() {
            // Cannot happen with delays below the pending commands' span; the oldest is then applied at once.
            self.pending.take_first(&mut self.kept);
        }
        self.pending.push(acts, voltage);
        // Everything that acts before this command's stamp is known by now.
        self.pending.advance(&mut self.kept, sent);
    }

    /// The pendulum at a time, given the commands so far.
    fn at(&self, time: Nanos) -> Pendulum {
        let (mut pendulum, mut pending) = (self.kept, self.pending);
        pending.advance(&mut pendulum, time);
        pendulum
    }
}

impl Node for World {
    type Output = WorldState;

    fn step(&mut self, step: &Step<'_>) -> Result<WorldState, NodeError> {
        for received in step.window(MOTOR) {
            // Initial messages have no number; what an earlier window held was taken then.
            if received.seq <= self.last_seq {
                continue;
            }
            self.last_seq = received.seq;
            self.command(received.sent, received.message.voltage);
        }
        let now = self.at(step.start);
        Ok(WorldState { angle: now.mark(), speed: now.speed, stamp: to_seconds(step.start) })
    }
}

/// Commands that wait for their time, in a ring without allocation.
#[derive(Clone, Copy, Debug)]
struct Pending {
    entries: [(Nanos, f64); Self::MOST],
    first: usize,
    count: usize,
}

impl Pending {
    /// More than 40 ms of delay hold at any sensible rate.
    const MOST: usize = 64;

    const fn new() -> Self {
        Self { entries: [(0, 0.0); Self::MOST], first: 0, count: 0 }
    }

    fn is_full(&self) -> bool {
        self.count == Self::MOST
    }

    fn push(&mut self, acts: Nanos, voltage: f64) {
        self.entries[(self.first + self.count) % Self::MOST] = (acts, voltage);
        self.count += 1;
    }

    /// Moves the pendulum to when the first command acts, and applies it.
    fn take_first(&mut self, pendulum: &mut Pendulum) {
        let (acts, voltage) = self.entries[self.first];
        pendulum.advance(acts);
        pendulum.command = voltage;
        self.first = (self.first + 1) % Self::MOST;
        self.count -= 1;
    }

    /// Moves the pendulum to a time, applying on the way what acts before or at it.
    fn advance(&mut self, pendulum: &mut Pendulum, until: Nanos) {
        while self.count > 0 && self.entries[self.first].0 <= until {
            self.take_first(pendulum);
        }
        pendulum.advance(until);
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
}

impl Pendulum {
    fn new(effect: HiddenEffect, angle: f64, speed: f64) -> Self {
        Self { effect, time: 0, angle, speed, command: 0.0, lagged: 0.0 }
    }

    fn delay(&self) -> Nanos {
        match self.effect {
            HiddenEffect::Delay { delay } | HiddenEffect::Machine(Machine { delay, .. }) => {
                from_seconds(delay)
            }
            _ => 0,
        }
    }

    /// Where the camera's mark is, rad.
    fn mark(&self) -> f64 {
        match self.effect {
            HiddenEffect::Bias { bias } => self.angle + bias,
            _ => self.angle,
        }
    }

    /// Integrates to a time under the present command. A time that is past changes nothing.
    fn advance(&mut self, until: Nanos) {
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

    /// Half a drift, a kick, half a drift: symmetric, so of second order, and steady in energy.
    fn step(&mut self, h: f64) {
        self.angle += 0.5 * h * self.speed;

        let viscous = match self.effect {
            HiddenEffect::Viscous { coefficient } => VISCOUS + coefficient,
            HiddenEffect::Machine(Machine { viscous, .. }) => viscous,
            _ => VISCOUS,
        };
        let (inertia, motor) = match self.effect {
            HiddenEffect::Machine(Machine { inertia, motor, .. }) => (inertia, motor),
            _ => (INERTIA, MOTOR_CONSTANT),
        };
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

#[cfg(test)]
mod tests;
