//! The nominal simulator as a node: the equations of appendix D, integrated from tick to tick.
//!
//! Message k is the state at tick k, before the commands seen then act; they hold until the next tick.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Command, Motion};
use crate::models::quadrotor::{self, Attitude, Input, Params, State, Vector, hover_pwm};

/// The commands.
pub const PID: Port<Command> = Port::new("pid");

/// Parameters of the plant.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// The quadrotor.
    pub quadrotor: Params<T>,
    /// Time from tick to tick, s: the integration step.
    pub period: T,
}

/// What may stand in a graph.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Mass, kg.
    pub mass: f64,
    /// Where it is at first, m; at rest, its rotors carrying it.
    pub position: [f64; 3],
}

impl Default for Settings {
    fn default() -> Self {
        Self { mass: Params::default().mass, position: [1.0, 0.0, 1.0] }
    }
}

/// The plant.
#[derive(Clone, Copy, Debug)]
pub struct Plant;

/// The kind `quadrotor/plant`: hovers at first.
pub fn kind() -> NodeKind {
    NodeKind::model::<Plant>(|context| {
        let Settings { mass, position: [x, y, z] } = context.parameters()?;
        if !(mass > 0.0 && mass.is_finite()) {
            return Err(context.parameter_error(format!("`mass` is {mass} kg; it must be positive")));
        }
        let quadrotor = Params { mass, ..Params::default() };
        let thrust = hover_pwm(&quadrotor) * quadrotor.motor_gain / -quadrotor.motor_rate;
        let state = State {
            position: Vector { x, y, z },
            velocity: Vector::default(),
            attitude: Attitude::default(),
            thrust,
        };
        Ok((Parameters { quadrotor, period: 1.0 / context.rate }, state))
    })
    .input(PID)
}

impl NodeModel for Plant {
    const NAME: &'static str = "plant";
    const PREPARED: usize = 1;

    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = State<T>;
    type Output<T: Scalar> = Motion<T>;

    #[inline(always)]
    fn prepare<T: Scalar>(p: &Parameters<T>, prepared: &mut [T]) {
        prepared[0] = hover_pwm(&p.quadrotor);
    }

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, state: State<T>, step: &NodeStep<'_, T>) -> (State<T>, Motion<T>) {
        let seen = step.latest::<Command<T>>(PID.name());
        let command = seen.message;
        // Before the first command the rotors carry its weight.
        let pwm = T::select(seen.was_sent(), command.pwm, step.prepared[0]);
        let shown = Motion {
            position: state.position,
            velocity: state.velocity,
            attitude: state.attitude,
            stamp: step.due,
        };
        let input = Input { pwm, roll: command.roll, pitch: command.pitch };
        let next = quadrotor::step(&p.quadrotor, state, input, p.period);
        (next, shown)
    }
}
