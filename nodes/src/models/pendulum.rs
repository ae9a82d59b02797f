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

use parallax_model::integrate::{Length, Slope, rk4_inlined};
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

/// What the equation of motion needs of the parameters.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Constants<T> {
    /// 1/J, 1/(kg m²).
    pub per_inertia: T,
    /// Torque at rest for each volt K/R, N m/V.
    pub motor: T,
    /// Largest torque of the weight m g l, N m.
    pub gravity: T,
    /// Viscous friction and back electromotive force b + K²/R, N m s/rad.
    pub viscous: T,
    /// Coulomb friction c, N m.
    pub friction: T,
}

impl<T: Scalar> Constants<T> {
    /// Of a pendulum with these parameters.
    #[inline(always)]
    pub fn new(p: &Params<T>) -> Self {
        let motor = p.motor / p.resistance;
        Self {
            per_inertia: T::constant(1.0) / p.inertia,
            motor,
            gravity: p.mass * p.length * GRAVITY,
            viscous: p.damping + p.motor * motor,
            friction: p.friction,
        }
    }

    /// The time derivative of the state.
    #[inline(always)]
    pub fn derivative(&self, x: &State<T>, u: &Input<T>) -> State<T> {
        let constant = u.voltage * self.motor;
        let gravity = self.gravity * x.angle.sin();
        let viscous = x.speed * self.viscous;
        let coulomb = self.friction * x.speed.sign();
        State { angle: x.speed, speed: (constant + gravity - viscous - coulomb) * self.per_inertia }
    }

    /// The state after one step of the integrator under a constant input.
    #[inline(always)]
    pub fn step(&self, x: State<T>, u: Input<T>, length: &Length<T>) -> State<T> {
        rk4_inlined(&Driven { constants: *self, input: u }, x, length)
    }
}

/// A pendulum under a constant input.
struct Driven<T> {
    constants: Constants<T>,
    input: Input<T>,
}

impl<T: Scalar> Slope<State<T>> for Driven<T> {
    #[inline(always)]
    fn slope(&self, x: &State<T>) -> State<T> {
        self.constants.derivative(x, &self.input)
    }
}

/// The time derivative of the state.
#[inline(always)]
pub fn derivative<T: Scalar>(p: &Params<T>, x: &State<T>, u: &Input<T>) -> State<T> {
    Constants::new(p).derivative(x, u)
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
        let x = Constants::new(p).step(x, u, &Length::new(dt));
        (x, Output { angle: x.angle })
    }
}
