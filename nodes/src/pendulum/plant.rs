//! The nominal simulator as a node: the equations of appendix C, integrated from tick to tick.
//!
//! Message k is the state at tick k, before the commands seen then act; they hold until the next tick.

use parallax_model::integrate::Length;
use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Voltage, WorldState};
use crate::models::pendulum::{Constants, Input, Params, State};

/// The commands.
pub const MOTOR: Port<Voltage> = Port::new("motor");

/// Parameters of the plant.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// The pendulum.
    pub pendulum: Params<T>,
    /// Time from tick to tick, s: the integration step.
    pub period: T,
}

/// What a step needs of the parameters.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Prepared<T> {
    pendulum: Constants<T>,
    period: Length<T>,
}

/// What may stand in a graph: constants that differ from the nominal ones, and the first state.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    inertia: f64,
    mass: f64,
    length: f64,
    damping: f64,
    motor: f64,
    resistance: f64,
    friction: f64,
    angle: f64,
    speed: f64,
}

impl Default for Settings {
    fn default() -> Self {
        let Params { inertia, mass, length, damping, motor, resistance, friction } = Params::default();
        let (angle, speed) = (std::f64::consts::PI, 0.0);
        Self { inertia, mass, length, damping, motor, resistance, friction, angle, speed }
    }
}

/// The plant.
#[derive(Clone, Copy, Debug)]
pub struct Plant;

/// The kind `pendulum/plant`: hangs still at first, unless its parameters say otherwise.
pub fn kind() -> NodeKind {
    NodeKind::model::<Plant>(|context| {
        let Settings { inertia, mass, length, damping, motor, resistance, friction, angle, speed } =
            context.parameters()?;
        if !(inertia > 0.0 && resistance > 0.0) {
            return Err(context.parameter_error("`inertia` and `resistance` must be positive"));
        }
        let pendulum = Params { inertia, mass, length, damping, motor, resistance, friction };
        Ok((Parameters { pendulum, period: 1.0 / context.rate }, State { angle, speed }))
    })
    .input(MOTOR)
    .initial(&WorldState { angle: std::f64::consts::PI, speed: 0.0, stamp: 0.0 })
}

impl NodeModel for Plant {
    const NAME: &'static str = "plant";
    const PREPARED: usize = <Prepared<f64> as Tree<f64>>::LEAVES;

    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = State<T>;
    type Output<T: Scalar> = WorldState<T>;

    #[inline(always)]
    fn prepare<T: Scalar>(p: &Parameters<T>, prepared: &mut [T]) {
        Prepared { pendulum: Constants::new(&p.pendulum), period: Length::new(p.period) }.write_to(prepared);
    }

    #[inline(always)]
    fn step<T: Scalar>(
        _: &Parameters<T>,
        state: State<T>,
        step: &NodeStep<'_, T>,
    ) -> (State<T>, WorldState<T>) {
        let voltage = step.latest::<Voltage<T>>(MOTOR.name()).message.voltage;
        let shown = WorldState { angle: state.angle, speed: state.speed, stamp: step.due };
        let Prepared { pendulum, period } = Prepared::read_from(step.prepared);
        let next = pendulum.step(state, Input { voltage }, &period);
        (next, shown)
    }
}
