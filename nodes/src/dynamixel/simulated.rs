//! A servo that exists in equations only, for the graph whose real one is `servo/dynamixel`.
//!
//! A gear motor: `J dω/dt = k i − d ω`, with the current that the mode asks for, or that a voltage drives through the
//! winding: `i = (u U − k ω) / R`. Position mode is a proportional controller on the voltage, as in the servo.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::table::Mode;
use super::{COMMAND, Command, State};

/// What may stand in a graph. What only the real servo needs (`port`, `id`, ...) may stand there too and changes nothing.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default)]
pub struct Simulation {
    /// What is controlled.
    pub mode: Mode,
    /// Inertia at the output, kg m².
    pub inertia: f64,
    /// Viscous friction at the output, N m s/rad.
    pub damping: f64,
    /// Torque constant at the output, N m/A.
    pub torque_constant: f64,
    /// Resistance of the winding, Ω.
    pub resistance: f64,
    /// Supply, V.
    pub supply: f64,
    /// Position gain, share of the supply per rad.
    pub gain: f64,
    /// Largest current, A.
    pub max_current: f64,
}

impl Default for Simulation {
    fn default() -> Self {
        // Near the XL330-M288: 0.52 N m and 1.47 A stalled at 5 V, 103 turns a minute without a load.
        Self {
            mode: Mode::Position,
            inertia: 1.5e-3,
            damping: 11e-3,
            torque_constant: 0.354,
            resistance: 3.4,
            supply: 5.0,
            gain: 2.5,
            max_current: 1.47,
        }
    }
}

/// Parameters of the simulated servo.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Constants<T = f64> {
    /// 1 in position mode, else 0.
    position_mode: T,
    /// 1 in current mode, else 0.
    current_mode: T,
    inertia: T,
    damping: T,
    torque_constant: T,
    resistance: T,
    supply: T,
    gain: T,
    max_current: T,
    period: T,
}

/// State of the simulated servo.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion<T = f64> {
    /// rad.
    position: T,
    /// rad/s.
    velocity: T,
    /// A.
    current: T,
}

/// The simulated servo.
#[derive(Clone, Copy, Debug)]
pub struct SimulatedServo;

/// The kind `servo/simulated`.
pub(super) fn kind() -> NodeKind {
    NodeKind::model::<SimulatedServo>(|context| {
        let s: Simulation = context.parameters()?;
        let positive = [
            ("inertia", s.inertia),
            ("resistance", s.resistance),
            ("supply", s.supply),
            ("max_current", s.max_current),
        ];
        if let Some((name, value)) = positive.iter().find(|(_, value)| !(*value > 0.0 && value.is_finite())) {
            return Err(context.parameter_error(format!("`{name}` is {value}; it must be positive")));
        }
        let flag = |mode: Mode| f64::from(u8::from(s.mode == mode));
        let constants = Constants {
            position_mode: flag(Mode::Position),
            current_mode: flag(Mode::Current),
            inertia: s.inertia,
            damping: s.damping,
            torque_constant: s.torque_constant,
            resistance: s.resistance,
            supply: s.supply,
            gain: s.gain,
            max_current: s.max_current,
            period: 1.0 / context.rate,
        };
        Ok((constants, Motion::default()))
    })
    .input(COMMAND)
}

/// Integration steps in one step of the node.
const SUBSTEPS: usize = 8;

impl NodeModel for SimulatedServo {
    const NAME: &'static str = "servo";
    type Params<T: Scalar> = Constants<T>;
    type State<T: Scalar> = Motion<T>;
    type Output<T: Scalar> = State<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Constants<T>, state: Motion<T>, step: &NodeStep<'_, T>) -> (Motion<T>, State<T>) {
        let Command { goal, torque } = step.latest::<Command<T>>(COMMAND.name()).message;
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        // A goal that is no number leaves the motor without torque; only such a thing differs from itself.
        let driven = T::select(goal.eq(goal), T::select(torque.gt(T::constant(0.5)), one, zero), zero);
        let goal = T::select(goal.eq(goal), goal, zero);
        let shown = State {
            position: state.position,
            velocity: state.velocity,
            current: state.current,
            torque: driven,
            errors: zero,
            stamp: step.due,
        };
        let dt = p.period / SUBSTEPS as f64;
        let Motion { mut position, mut velocity, mut current } = state;
        for _ in 0..SUBSTEPS {
            let share = p.position_mode * p.gain * (goal - position)
                + (one - p.position_mode) * (one - p.current_mode) * goal;
            let voltage = share.clamp(-one, one) * p.supply;
            let through = (voltage - p.torque_constant * velocity) / p.resistance;
            let wanted = p.current_mode * goal + (one - p.current_mode) * through;
            current = driven * wanted.clamp(-p.max_current, p.max_current);
            // Semi-implicit: friction never drives, whatever the period.
            let pushed = velocity + dt * p.torque_constant * current / p.inertia;
            velocity = pushed / (one + dt * p.damping / p.inertia);
            position += dt * velocity;
        }
        (Motion { position, velocity, current }, shown)
    }
}
