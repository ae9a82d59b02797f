//! Keeps the height: from the height wanted and the height seen to the motor signal. Roll and pitch pass through to the
//! on-board attitude control.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::{NodeContext, NodeError, Port};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::tuning::Parameter;
use serde::Deserialize;

use super::messages::{Command, Motion, Reference};
use crate::models::quadrotor::{Params, hover_pwm};

/// How the quadrotor moves.
pub const MOCAP: Port<Motion> = Port::new("mocap");
/// Where the agent wants it to go.
pub const AGENT: Port<Reference> = Port::new("agent");

/// Largest motor signal, counts.
const FULL: f64 = 65535.0;

/// What may stand in a graph.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Counts for each metre of distance.
    pub proportional: f64,
    /// Counts for each metre of distance held for a second.
    pub integral: f64,
    /// Counts for each m/s of vertical speed.
    pub derivative: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { proportional: 25_000.0, integral: 10_000.0, derivative: 15_000.0 }
    }
}

/// Parameters of the controller.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// Counts for each metre of distance.
    pub proportional: T,
    /// Counts for each metre of distance held for a second.
    pub integral: T,
    /// Counts for each m/s of vertical speed.
    pub derivative: T,
    /// Motor signal that carries the weight, counts.
    pub hover: T,
    /// Time from tick to tick, s.
    pub period: T,
}

/// What the controller remembers.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct State<T = f64> {
    /// The distance, held within ±0.5 m s.
    pub integral: T,
}

/// The controller.
#[derive(Clone, Copy, Debug)]
pub struct HeightPid;

/// The kind `quadrotor/pid`.
pub fn kind() -> NodeKind {
    NodeKind::model::<HeightPid>(start)
        .input(MOCAP)
        .input(AGENT)
        .settable(Parameter::new("proportional", "1/m"))
        .settable(Parameter::new("integral", "1/(m s)"))
        .settable(Parameter::new("derivative", "s/m"))
        .settable(Parameter::new("hover", "").at_least(0.0).at_most(FULL))
}

/// What a controller begins with.
pub(super) fn start(context: &NodeContext) -> Result<(Parameters, State), NodeError> {
    let Settings { proportional, integral, derivative } = context.parameters()?;
    let (hover, period) = (hover_pwm(&Params::default()), 1.0 / context.rate);
    Ok((Parameters { proportional, integral, derivative, hover, period }, State { integral: 0.0 }))
}

/// What is commanded when this has been seen, if anything has, and that is wanted.
#[inline(always)]
pub(super) fn control<T: Scalar>(
    p: &Parameters<T>,
    state: State<T>,
    known: T::Mask,
    seen: Motion<T>,
    wanted: Reference<T>,
) -> (State<T>, Command<T>) {
    let distance = T::select(known, wanted.height - seen.position.z, T::constant(0.0));
    let half = T::constant(0.5);
    let integral = (state.integral + distance * p.period).clamp(-half, half);
    let pwm = p.hover + distance * p.proportional + integral * p.integral - seen.velocity.z * p.derivative;
    let pwm = pwm.clamp(T::constant(0.0), T::constant(FULL));
    (State { integral }, Command { pwm, roll: wanted.roll, pitch: wanted.pitch })
}

impl NodeModel for HeightPid {
    const NAME: &'static str = "height_pid";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = State<T>;
    type Output<T: Scalar> = Command<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, state: State<T>, step: &NodeStep<'_, T>) -> (State<T>, Command<T>) {
        let seen = step.latest::<Motion<T>>(MOCAP.name());
        let wanted = step.latest::<Reference<T>>(AGENT.name()).message;
        control(p, state, seen.was_sent(), seen.message, wanted)
    }
}
