//! The agent: flies a circle at a constant height by tilting towards where the circle leads.

use std::f64::consts::TAU;

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;
use serde::Deserialize;

use super::messages::{Motion, Reference};
use crate::models::quadrotor::GRAVITY;

/// How the quadrotor moves.
pub const MOCAP: Port<Motion> = Port::new("mocap");

/// Parameters of the agent.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de>, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// Radius of the circle, m.
    pub radius: T,
    /// Time for one turn, s.
    pub turn: T,
    /// Height, m.
    pub height: T,
    /// Acceleration for each metre of distance, 1/s².
    pub stiffness: T,
    /// Acceleration for each m/s of wrong speed, 1/s.
    pub damping: T,
    /// Largest angle of roll and pitch, rad.
    pub tilt: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { radius: 1.0, turn: 6.0, height: 1.0, stiffness: 4.0, damping: 3.0, tilt: 0.5 }
    }
}

/// The agent.
#[derive(Clone, Copy, Debug)]
pub struct Agent;

/// The kind `quadrotor/agent`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Agent>(|context| {
        let parameters: Parameters = context.parameters()?;
        if !(parameters.turn > 0.0 && parameters.tilt > 0.0) {
            return Err(context.parameter_error("`turn` and `tilt` must be positive"));
        }
        Ok((parameters, ()))
    })
    .input(MOCAP)
    .settable(Parameter::new("radius", "m").at_least(0.0))
    .settable(Parameter::new("turn", "s").positive())
    .settable(Parameter::new("height", "m"))
    .settable(Parameter::new("stiffness", "1/s^2"))
    .settable(Parameter::new("damping", "1/s"))
    .settable(Parameter::new("tilt", "rad").positive())
}

impl NodeModel for Agent {
    const NAME: &'static str = "agent";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Reference<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Reference<T>) {
        let seen = step.latest::<Motion<T>>(MOCAP.name());
        let motion = seen.message;
        let speed = T::constant(TAU) / p.turn;
        let (sin, cos) = ((speed * step.start).sin(), (speed * step.start).cos());
        let goal = [p.radius * cos, p.radius * sin];
        let goal_velocity = [-p.radius * speed * sin, p.radius * speed * cos];
        let towards = |axis: usize, position: T, velocity: T| {
            (goal[axis] - position) * p.stiffness + (goal_velocity[axis] - velocity) * p.damping
                - goal[axis] * speed * speed
        };
        let ax = towards(0, motion.position.x, motion.velocity.x);
        let ay = towards(1, motion.position.y, motion.velocity.y);
        // In the body's heading; small angles.
        let (sy, cy) = (motion.attitude.yaw.sin(), motion.attitude.yaw.cos());
        let pitch = ((ax * cy + ay * sy) / GRAVITY).clamp(-p.tilt, p.tilt);
        let roll = ((ax * sy - ay * cy) / GRAVITY).clamp(-p.tilt, p.tilt);
        // It stays level until it has been seen.
        let level = |angle: T| T::select(seen.was_sent(), angle, T::constant(0.0));
        ((), Reference { roll: level(roll), pitch: level(pitch), height: p.height })
    }
}
