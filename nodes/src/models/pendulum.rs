//! A pendulum on the shaft of a DC motor: a disc with an off-centre mass.
//!
//! After the paper's appendix C. The angle θ is zero upright and grows counter-clockwise:
//!
//! ```text
//! J θ̈ = u K/R + m g l sin θ − b θ̇ − θ̇ K²/R − c sign θ̇
//! ```
//!
//! `u K/R` is the torque of the motor at rest, `θ̇ K²/R` what its back electromotive force takes from it. Integrated with
//! the Runge–Kutta method of fourth order, in steps of [`STEP`].

use parallax_model::integrate::rk4;
use parallax_model::{Model, Scalar, Tree};

/// Gravitational acceleration, m/s².
pub const GRAVITY: f64 = 9.81;
/// The paper's integration step, s.
pub const STEP: f64 = 0.01;

/// Constants of a pendulum.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Params<T> {
    /// Moment of inertia J about the shaft, kg m².
    pub inertia: T,
    /// Mass m of the off-centre weight, kg.
    pub mass: T,
    /// Distance l of its centre from the shaft, m.
    pub length: T,
    /// Viscous friction b, N m s/rad.
    pub damping: T,
    /// Motor constant K, N m/A or V s/rad.
    pub motor: T,
    /// Resistance R of the winding, Ω.
    pub resistance: T,
    /// Coulomb friction c, N m.
    pub friction: T,
}

impl Default for Params<f64> {
    /// A small laboratory pendulum: swings at 1.8 Hz when it hangs; 4.8 V hold it level.
    fn default() -> Self {
        Self {
            inertia: 1.6e-4,
            mass: 0.0509,
            length: 0.0415,
            damping: 1.43e-5,
            motor: 0.0333,
            resistance: 7.73,
            friction: 9.75e-4,
        }
    }
}

/// Where the pendulum is.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct State<T> {
    /// Angle θ from upright, rad; not wrapped.
    pub angle: T,
    /// Angular speed, rad/s.
    pub speed: T,
}

/// What acts on the pendulum.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Input<T> {
    /// Voltage u across the motor, V.
    pub voltage: T,
}

/// What is measured.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Output<T> {
    /// Angle from upright, rad; not wrapped.
    pub angle: T,
}

/// The time derivative of the state.
#[inline(always)]
pub fn derivative<T: Scalar>(p: &Params<T>, x: &State<T>, u: &Input<T>) -> State<T> {
    // What the state does not enter is divided once for the four derivatives of a Runge–Kutta step.
    let (per_inertia, motor) = (T::constant(1.0) / p.inertia, p.motor / p.resistance);
    let constant = u.voltage * motor;
    let gravity = p.mass * p.length * GRAVITY * x.angle.sin();
    let viscous = x.speed * (p.damping + p.motor * motor);
    let coulomb = p.friction * x.speed.sign();
    State { angle: x.speed, speed: (constant + gravity - viscous - coulomb) * per_inertia }
}

/// Kinetic and potential energy, J; the potential is zero at the height of the shaft.
#[inline(always)]
pub fn energy<T: Scalar>(p: &Params<T>, x: &State<T>) -> T {
    p.inertia * x.speed * x.speed * 0.5 + p.mass * p.length * GRAVITY * x.angle.cos()
}

/// The pendulum as a [`Model`].
#[derive(Clone, Copy, Debug)]
pub struct Pendulum;

impl Model for Pendulum {
    const NAME: &'static str = "pendulum";
    type Params<T: Scalar> = Params<T>;
    type State<T: Scalar> = State<T>;
    type Input<T: Scalar> = Input<T>;
    type Output<T: Scalar> = Output<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Params<T>, x: State<T>, u: Input<T>, dt: T) -> (State<T>, Output<T>) {
        let x = rk4(|x: &State<T>| derivative(p, x, &u), x, dt);
        (x, Output { angle: x.angle })
    }
}
