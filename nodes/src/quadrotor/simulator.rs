//! The quadrotor as a simulator for identification: smooth in everything that a fit moves, delays included.
//!
//! Message k is the state at tick k. A step brings it there from the tick before, under the commands at the times at which
//! they were received, as straight lines.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Command, Motion};
use crate::line::lines;
use crate::models::quadrotor::{self, Attitude, Constants, Input, Params, State, Vector, hover_pwm};

/// The commands.
pub const PID: Port<Command> = Port::new("pid");

/// Parameters of the simulator.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// The quadrotor.
    pub quadrotor: Params<T>,
    /// Time from tick to tick, s: the integration step.
    pub period: T,
}

/// What may stand in a graph: what identification moves, and the first state. Its rotors carry its weight at first.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    mass: f64,
    attitude_gain: f64,
    attitude_time: f64,
    drag_xy: f64,
    drag_z: f64,
    position: [f64; 3],
    velocity: [f64; 3],
    attitude: [f64; 3],
}

impl Default for Settings {
    fn default() -> Self {
        let Params { mass, attitude_gain, attitude_time, drag_xy, drag_z, .. } = Params::default();
        let [position, velocity, attitude] = [[1.0, 0.0, 1.0], [0.0; 3], [0.0; 3]];
        Self { mass, attitude_gain, attitude_time, drag_xy, drag_z, position, velocity, attitude }
    }
}

/// The simulator.
#[derive(Clone, Copy, Debug)]
pub struct Simulator;

/// The kind `quadrotor/simulator`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Simulator>(|context| {
        let s: Settings = context.parameters()?;
        if !(s.mass > 0.0 && s.mass.is_finite() && s.attitude_time > 0.0) {
            return Err(context.parameter_error("`mass` and `attitude_time` must be positive"));
        }
        let Settings { mass, attitude_gain, attitude_time, drag_xy, drag_z, .. } = s;
        let quadrotor = Params { mass, attitude_gain, attitude_time, drag_xy, drag_z, ..Params::default() };
        let vector = |[x, y, z]: [f64; 3]| Vector { x, y, z };
        let [roll, pitch, yaw] = s.attitude;
        let state = State {
            position: vector(s.position),
            velocity: vector(s.velocity),
            attitude: Attitude { roll, pitch, yaw },
            thrust: hover_pwm(&quadrotor) * quadrotor.motor_gain / -quadrotor.motor_rate,
        };
        Ok((Parameters { quadrotor, period: 1.0 / context.rate }, state))
    })
    .input(PID)
}

/// What a step needs of the parameters.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Prepared<T> {
    quadrotor: Constants<T>,
    /// The motor signal that carries the weight, counts.
    hover: T,
    /// 12/h³.
    moment: T,
}

impl NodeModel for Simulator {
    const NAME: &'static str = "simulator";
    const PREPARED: usize = <Prepared<f64> as Tree<f64>>::LEAVES;

    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = State<T>;
    type Output<T: Scalar> = Motion<T>;

    #[inline(always)]
    fn prepare<T: Scalar>(p: &Parameters<T>, prepared: &mut [T]) {
        Prepared {
            quadrotor: Constants::new(&p.quadrotor),
            hover: hover_pwm(&p.quadrotor),
            moment: T::constant(12.0) / (p.period * p.period * p.period),
        }
        .write_to(prepared);
    }

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, state: State<T>, step: &NodeStep<'_, T>) -> (State<T>, Motion<T>) {
        let c: Prepared<T> = Prepared::read_from(step.prepared);
        let zero = T::constant(0.0);
        // Before the first command the rotors carry its weight.
        let [pwm, roll, pitch] = lines(step, PID.name(), p.period, c.moment, [c.hover, zero, zero]);
        let mean = Input { pwm: pwm.0, roll: roll.0, pitch: pitch.0 };
        let lean = Input { pwm: pwm.1, roll: roll.1, pitch: pitch.1 };
        let next = quadrotor::step_along(&c.quadrotor, state, mean, lean, p.period);
        // The first tick shows the first state.
        let first = step.seq.le(zero);
        let shown = state.zip(&next, &mut |now, next| T::select(first, now, next));
        let State { position, velocity, attitude, .. } = shown;
        (shown, Motion { position, velocity, attitude, stamp: step.start })
    }
}
