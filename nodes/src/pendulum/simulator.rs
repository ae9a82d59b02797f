//! The pendulum as a simulator for identification: smooth in everything that a fit moves, delays included.
//!
//! Message k is the state at tick k. A step brings it there from the tick before, under the commands at the times at which
//! they were received, not at ticks, as straight lines. So predictions change smoothly with a delay of the
//! commands, and exact derivatives by it exist. Dry friction is resolved within the step: the
//! shaft slides, comes to rest, and stays there or turns back. Integrating `sign θ̇` instead would be wrong by a step's
//! impulse at every reversal, and its derivative would know nothing of reversals.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Voltage, WorldState};
use crate::line::lines;
use crate::models::pendulum::{Constants, Params, State};

/// The commands.
pub const MOTOR: Port<Voltage> = Port::new("motor");

/// Parameters of the simulator.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Parameters<T = f64> {
    /// The pendulum of appendix C.
    pub pendulum: Params<T>,
    /// Added to every command, V.
    pub offset: T,
    /// Tilt of the shaft's frame: the weight pulls as if the angle were larger by this, rad.
    pub tilt: T,
    /// By which share Coulomb friction is larger forwards, and smaller backwards.
    pub asymmetry: T,
    /// By which share it is larger at rest (Stribeck).
    pub stiction: T,
    /// The speed at which that has fallen to 1/e, rad/s.
    pub stribeck_speed: T,
    /// Drag that grows with the square of the speed, N m s²/rad².
    pub drag: T,
    /// Time from tick to tick, s: the integration step.
    pub period: T,
}

/// What may stand in a graph: all constants, and the first state.
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
    offset: f64,
    tilt: f64,
    asymmetry: f64,
    stiction: f64,
    stribeck_speed: f64,
    drag: f64,
    angle: f64,
    speed: f64,
}

impl Default for Settings {
    fn default() -> Self {
        let Params { inertia, mass, length, damping, motor, resistance, friction } = Params::default();
        Self {
            inertia,
            mass,
            length,
            damping,
            motor,
            resistance,
            friction,
            offset: 0.0,
            tilt: 0.0,
            asymmetry: 0.0,
            stiction: 0.0,
            stribeck_speed: 1.0,
            drag: 0.0,
            angle: std::f64::consts::PI,
            speed: 0.0,
        }
    }
}

/// The simulator.
#[derive(Clone, Copy, Debug)]
pub struct Simulator;

/// The kind `pendulum/simulator`: hangs still at first, unless its parameters say otherwise.
pub fn kind() -> NodeKind {
    NodeKind::model::<Simulator>(|context| {
        let s: Settings = context.parameters()?;
        if !(s.inertia > 0.0 && s.resistance > 0.0 && s.stribeck_speed > 0.0) {
            let problem = "`inertia`, `resistance` and `stribeck_speed` must be positive";
            return Err(context.parameter_error(problem));
        }
        let Settings { inertia, mass, length, damping, motor, resistance, friction, .. } = s;
        let parameters = Parameters {
            pendulum: Params { inertia, mass, length, damping, motor, resistance, friction },
            offset: s.offset,
            tilt: s.tilt,
            asymmetry: s.asymmetry,
            stiction: s.stiction,
            stribeck_speed: s.stribeck_speed,
            drag: s.drag,
            period: 1.0 / context.rate,
        };
        Ok((parameters, State { angle: s.angle, speed: s.speed }))
    })
    .input(MOTOR)
    .initial(&WorldState { angle: std::f64::consts::PI, speed: 0.0, stamp: 0.0 })
}

/// What a step needs of the parameters.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Prepared<T> {
    pendulum: Constants<T>,
    /// Drag over inertia.
    drag: T,
    /// Coulomb friction over inertia, forwards and backwards, rad/s².
    forward: T,
    backward: T,
    stiction: T,
    /// 1/v² of the Stribeck speed.
    per_square: T,
    half: T,
    sixth: T,
    /// 12/h³.
    moment: T,
}

impl<T: Scalar> Prepared<T> {
    /// Acceleration at a voltage, with a constant one of friction.
    #[inline(always)]
    fn acceleration(&self, angle: T, speed: T, tilt: T, voltage: T, friction: T) -> T {
        let c = &self.pendulum;
        let torque = voltage * c.motor + c.gravity * (angle + tilt).sin() - c.viscous * speed;
        torque * c.per_inertia - self.drag * speed * speed.abs() - friction
    }
}

impl NodeModel for Simulator {
    const NAME: &'static str = "simulator";
    const PREPARED: usize = <Prepared<f64> as Tree<f64>>::LEAVES;

    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = State<T>;
    type Output<T: Scalar> = WorldState<T>;

    #[inline(always)]
    fn prepare<T: Scalar>(p: &Parameters<T>, prepared: &mut [T]) {
        let pendulum = Constants::new(&p.pendulum);
        let friction = pendulum.friction * pendulum.per_inertia;
        let one = T::constant(1.0);
        Prepared {
            drag: p.drag * pendulum.per_inertia,
            forward: friction * (p.asymmetry + 1.0),
            backward: friction * (one - p.asymmetry),
            stiction: p.stiction,
            per_square: one / (p.stribeck_speed * p.stribeck_speed),
            half: p.period * 0.5,
            sixth: p.period / 6.0,
            moment: T::constant(12.0) / (p.period * p.period * p.period),
            pendulum,
        }
        .write_to(prepared);
    }

    #[inline(always)]
    fn step<T: Scalar>(
        p: &Parameters<T>,
        state: State<T>,
        step: &NodeStep<'_, T>,
    ) -> (State<T>, WorldState<T>) {
        let c: Prepared<T> = Prepared::read_from(step.prepared);
        let (h, zero) = (p.period, T::constant(0.0));
        let [(mean, lean)] = lines(step, MOTOR.name(), h, c.moment, [zero]);
        let volts = [mean - lean + p.offset, mean + p.offset, mean + lean + p.offset];
        let State { angle, speed } = state;

        // As if it went on sliding the way it does: Runge and Kutta's method under a constant friction.
        let sticky = c.stiction * (-(speed * speed * c.per_square)).exp() + 1.0;
        let (forward, backward) = (c.forward * sticky, c.backward * sticky);
        let way = speed.sign();
        let friction = way * T::select(speed.gt(zero), forward, backward);
        let a1 = c.acceleration(angle, speed, p.tilt, volts[0], friction);
        let v2 = speed + a1 * c.half;
        let a2 = c.acceleration(angle + speed * c.half, v2, p.tilt, volts[1], friction);
        let v3 = speed + a2 * c.half;
        let a3 = c.acceleration(angle + v2 * c.half, v3, p.tilt, volts[1], friction);
        let v4 = speed + a3 * h;
        let a4 = c.acceleration(angle + v3 * h, v4, p.tilt, volts[2], friction);
        let slid = speed + (a1 + (a2 + a3) * 2.0 + a4) * c.sixth;
        let reached = angle + (speed + (v2 + v3) * 2.0 + v4) * c.sixth;

        // Where it comes to rest within the step: from then on what pulls it, less the friction of that way, if more.
        let rests = (slid * way).le(zero);
        let pull = (slid - speed) / h + friction;
        let braking = (friction - pull).abs().max(T::constant(1e-9));
        let until_rest = (speed.abs() / braking).min(h);
        let rest = h - until_rest;
        let holds = T::select(pull.gt(zero), forward, backward);
        let turned = pull.sign() * (pull.abs() - holds).max(zero);
        let speed = T::select(rests, turned * rest, slid);
        let shift = (friction + turned - pull) * rest * rest * 0.5;
        let angle = T::select(rests, reached + shift, reached);

        // The first tick shows the first state.
        let first = step.seq.le(zero);
        let angle = T::select(first, state.angle, angle);
        let speed = T::select(first, state.speed, speed);
        (State { angle, speed }, WorldState { angle, speed, stamp: step.start })
    }
}
