//! A small quadrotor under its on-board attitude control: the Crazyflie 2.0.
//!
//! After the paper's appendix D, with constants identified by J. Förster, *System Identification of the Crazyflie 2.0
//! Nano Quadrocopter* (ETH Zürich, 2015). How the printed equations are read:
//!
//! - The body-frame velocity is `v_b = Rᵀ v`; the second transpose, printed on `v`, is a misprint.
//! - `ω` in the drag is the sum of the four rotors' speeds, as its own formula with the factor 4 says; the thrust's
//!   factor 4 likewise makes `a_p`, `b_p` and `c_p` constants of one rotor.
//! - The effective PWM is not given but defined by the thrust; it is the upper root of that quadratic. Below the
//!   quadratic's lowest point, which only a thrust pointing down reaches, the root is taken as zero.
//!
//! Yaw keeps its value: its dynamics are neglected.

use parallax_model::integrate::{Slope, rk4};
use parallax_model::{Model, Scalar, Tree};

/// Gravitational acceleration, m/s².
pub const GRAVITY: f64 = 9.81;
/// The paper's integration step, s.
pub const STEP: f64 = 0.01;

/// A vector in the world's frame, z up.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Vector<T> {
    /// East or forward.
    pub x: T,
    /// North or left.
    pub y: T,
    /// Up.
    pub z: T,
}

/// Roll, pitch and yaw, rad: the attitude is `R_z(yaw) R_y(pitch) R_x(roll)`.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Attitude<T> {
    /// φ, about the body's x axis.
    pub roll: T,
    /// θ, about the body's y axis.
    pub pitch: T,
    /// ψ, about the body's z axis.
    pub yaw: T,
}

/// Constants of a quadrotor. Thrusts are in N, PWM signals in counts from 0 to 65535.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Params<T> {
    /// Mass m, kg.
    pub mass: T,
    /// Gain k_c of the attitude control.
    pub attitude_gain: T,
    /// Time constant τ_c of the attitude control, s.
    pub attitude_time: T,
    /// Horizontal drag κ_xy, N s²/(m rad).
    pub drag_xy: T,
    /// Vertical drag κ_z, N s²/(m rad).
    pub drag_z: T,
    /// Rate a_m of the thrust state, 1/s.
    pub motor_rate: T,
    /// Gain b_m from PWM to the thrust state, 1/s.
    pub motor_gain: T,
    /// Thrust c_m for each unit of the thrust state, N.
    pub thrust_state: T,
    /// Thrust d_m for each count of PWM, N.
    pub thrust_direct: T,
    /// Thrust of one rotor over effective PWM, quadratic part a_p, N.
    pub pwm_quadratic: T,
    /// Linear part b_p, N.
    pub pwm_linear: T,
    /// Constant part c_p, N.
    pub pwm_constant: T,
    /// Speed of one rotor over effective PWM, linear part a_r, rad/s.
    pub rotor_linear: T,
    /// Constant part b_r, rad/s.
    pub rotor_constant: T,
}

impl Default for Params<f64> {
    /// Förster's motor, PWM and rotor constants (appendix D) and drag; the mass is that of a bare Crazyflie with markers.
    fn default() -> Self {
        Self {
            mass: 0.03,
            attitude_gain: 1.0,
            attitude_time: 0.15,
            drag_xy: 9.18e-7,
            drag_z: 1.03e-6,
            motor_rate: -15.47,
            motor_gain: 1.0,
            thrust_state: 1.43e-4,
            thrust_direct: 2.89e-7,
            pwm_quadratic: 2.13e-11,
            pwm_linear: 1.03e-6,
            pwm_constant: 5.49e-4,
            rotor_linear: 0.041,
            rotor_constant: 380.83,
        }
    }
}

/// Where the quadrotor is.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct State<T> {
    /// Position p in the world's frame, m.
    pub position: Vector<T>,
    /// Velocity v in the world's frame, m/s.
    pub velocity: Vector<T>,
    /// Attitude η.
    pub attitude: Attitude<T>,
    /// Thrust state Ω, counts s.
    pub thrust: T,
}

/// What is commanded.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Input<T> {
    /// Motor signal Θ of all rotors, counts.
    pub pwm: T,
    /// Reference of the roll angle, rad.
    pub roll: T,
    /// Reference of the pitch angle, rad.
    pub pitch: T,
}

/// What motion capture measures.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Output<T> {
    /// Position, m.
    pub position: Vector<T>,
    /// Attitude.
    pub attitude: Attitude<T>,
}

/// Total thrust of the four rotors along the body's z axis at the thrust state Ω, N: `c_m Ω + d_m Θ`.
#[inline(always)]
pub fn thrust<T: Scalar>(p: &Params<T>, state: T, pwm: T) -> T {
    p.thrust_state * state + p.thrust_direct * pwm
}

/// The motor signal that carries the weight of a level quadrotor at rest, counts: with `Ω = −b_m Θ/a_m` the thrust is
/// `m g`.
#[inline(always)]
pub fn hover_pwm<T: Scalar>(p: &Params<T>) -> T {
    p.mass * GRAVITY / (p.thrust_direct - p.thrust_state * p.motor_gain / p.motor_rate)
}

/// The motor signal at which four rotors give this thrust at rest, counts: the upper root of
/// `f = 4 (a_p Θ² + b_p Θ + c_p)`.
#[inline(always)]
pub fn effective_pwm<T: Scalar>(p: &Params<T>, thrust: T) -> T {
    let discriminant = p.pwm_linear * p.pwm_linear - p.pwm_quadratic * (p.pwm_constant - thrust * 0.25) * 4.0;
    (discriminant.max(T::constant(0.0)).sqrt() - p.pwm_linear) / (p.pwm_quadratic * 2.0)
}

/// The sum of the four rotors' speeds, rad/s: `4 (a_r Θ_eff + b_r)`.
#[inline(always)]
pub fn rotor_speed<T: Scalar>(p: &Params<T>, thrust: T) -> T {
    (p.rotor_linear * effective_pwm(p, thrust) + p.rotor_constant) * 4.0
}

/// The rows of the rotation from the body's to the world's frame.
#[inline(always)]
pub fn rotation<T: Scalar>(a: &Attitude<T>) -> [[T; 3]; 3] {
    rotation_towards(a.roll, a.pitch, sine_and_cosine(a.yaw))
}

/// A call of its own: with all six inside, the derivative would be too large to be inlined into a kernel.
#[inline(always)]
fn sine_and_cosine<T: Scalar>(angle: T) -> (T, T) {
    T::compiled(|| (angle.sin(), angle.cos()))
}

/// As [`rotation`], from the yaw's sine and cosine.
#[inline(always)]
fn rotation_towards<T: Scalar>(roll: T, pitch: T, (sy, cy): (T, T)) -> [[T; 3]; 3] {
    let ((sr, cr), (sp, cp)) = (sine_and_cosine(roll), sine_and_cosine(pitch));
    [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
}

/// A function of its own, because a closure that is called several times stays a call, even in a kernel.
#[inline(always)]
fn dot<T: Scalar>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The state without the yaw, which keeps its value: its sine and cosine are those of the whole step.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct Moving<T> {
    position: Vector<T>,
    velocity: Vector<T>,
    roll: T,
    pitch: T,
    thrust: T,
}

/// What a derivative needs of the parameters, as few operations as they allow.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Constants<T> {
    per_mass: T,
    attitude_rate: T,
    drag_xy: T,
    drag_z: T,
    motor_rate: T,
    motor_gain: T,
    thrust_state: T,
    thrust_direct: T,
    /// The discriminant of the effective PWM: constant and by the thrust.
    discriminant: T,
    by_thrust: T,
    /// The rotors' speed: constant and by the discriminant's root.
    rotor: T,
    by_root: T,
}

impl<T: Scalar> Constants<T> {
    /// Of these parameters.
    #[inline(always)]
    pub fn new(p: &Params<T>) -> Self {
        let per_two = T::constant(0.5) / p.pwm_quadratic;
        Self {
            per_mass: T::constant(1.0) / p.mass,
            attitude_rate: p.attitude_gain / p.attitude_time,
            drag_xy: p.drag_xy,
            drag_z: p.drag_z,
            motor_rate: p.motor_rate,
            motor_gain: p.motor_gain,
            thrust_state: p.thrust_state,
            thrust_direct: p.thrust_direct,
            discriminant: p.pwm_linear * p.pwm_linear - p.pwm_quadratic * p.pwm_constant * 4.0,
            by_thrust: p.pwm_quadratic,
            rotor: (p.rotor_constant - p.rotor_linear * p.pwm_linear * per_two) * 4.0,
            by_root: p.rotor_linear * per_two * 4.0,
        }
    }
}

impl<T: Scalar> Moving<T> {
    #[inline(always)]
    fn of(State { position, velocity, attitude: Attitude { roll, pitch, .. }, thrust }: &State<T>) -> Self {
        Self { position: *position, velocity: *velocity, roll: *roll, pitch: *pitch, thrust: *thrust }
    }

    #[inline(always)]
    fn with_yaw(self, yaw: T) -> State<T> {
        let Moving { position, velocity, roll, pitch, thrust } = self;
        State { position, velocity, attitude: Attitude { roll, pitch, yaw }, thrust }
    }

    /// The time derivative, with the yaw's sine and cosine.
    #[inline(always)]
    fn derivative(&self, c: &Constants<T>, yaw: (T, T), u: &Input<T>) -> Self {
        let thrust = c.thrust_state * self.thrust + c.thrust_direct * u.pwm;
        // [`rotor_speed`] at this thrust.
        let discriminant = c.discriminant + c.by_thrust * thrust;
        let speed = c.rotor + c.by_root * discriminant.max(T::constant(0.0)).sqrt();
        let r = rotation_towards(self.roll, self.pitch, yaw);
        let v = [self.velocity.x, self.velocity.y, self.velocity.z];
        // The columns of the rotation are the body's axes.
        let body = [
            dot([r[0][0], r[1][0], r[2][0]], v),
            dot([r[0][1], r[1][1], r[2][1]], v),
            dot([r[0][2], r[1][2], r[2][2]], v),
        ];
        let sideways = -c.drag_xy * speed;
        let force = [sideways * body[0], sideways * body[1], thrust - c.drag_z * speed * body[2]];
        let acceleration =
            [dot(r[0], force) * c.per_mass, dot(r[1], force) * c.per_mass, dot(r[2], force) * c.per_mass];
        Self {
            position: self.velocity,
            velocity: Vector { x: acceleration[0], y: acceleration[1], z: acceleration[2] - GRAVITY },
            roll: (u.roll - self.roll) * c.attitude_rate,
            pitch: (u.pitch - self.pitch) * c.attitude_rate,
            thrust: c.motor_rate * self.thrust + c.motor_gain * u.pwm,
        }
    }
}

/// The time derivative of the state.
#[inline(always)]
pub fn derivative<T: Scalar>(p: &Params<T>, x: &State<T>, u: &Input<T>) -> State<T> {
    let constants = Constants::new(p);
    Moving::of(x).derivative(&constants, sine_and_cosine(x.attitude.yaw), u).with_yaw(T::constant(0.0))
}

/// What a state moves under whose input is constant.
struct Held<T> {
    constants: Constants<T>,
    yaw: (T, T),
    input: Input<T>,
}

impl<T: Scalar> Slope<Moving<T>> for Held<T> {
    #[inline(always)]
    fn slope(&self, x: &Moving<T>) -> Moving<T> {
        x.derivative(&self.constants, self.yaw, &self.input)
    }
}

/// The state after one step of `dt` seconds of the integrator under a constant input.
#[inline(always)]
pub fn step<T: Scalar>(p: &Params<T>, x: State<T>, u: Input<T>, dt: T) -> State<T> {
    let (constants, yaw) = (Constants::new(p), sine_and_cosine(x.attitude.yaw));
    rk4(Held { constants, yaw, input: u }, Moving::of(&x), dt).with_yaw(x.attitude.yaw)
}

/// A state on its way through a step, from −1 at its beginning to 1 at its end.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
struct OnTheWay<T> {
    moving: Moving<T>,
    way: T,
}

/// What it moves under: an input along a straight line.
struct Along<T> {
    constants: Constants<T>,
    yaw: (T, T),
    mean: Input<T>,
    lean: Input<T>,
    speed: T,
}

impl<T: Scalar> Slope<OnTheWay<T>> for Along<T> {
    #[inline(always)]
    fn slope(&self, x: &OnTheWay<T>) -> OnTheWay<T> {
        let Self { mean, lean, .. } = self;
        let input = Input {
            pwm: mean.pwm + lean.pwm * x.way,
            roll: mean.roll + lean.roll * x.way,
            pitch: mean.pitch + lean.pitch * x.way,
        };
        OnTheWay { moving: x.moving.derivative(&self.constants, self.yaw, &input), way: self.speed }
    }
}

/// As [`step`], under an input that changes along a straight line from `mean − lean` to `mean + lean`.
#[inline(always)]
pub fn step_along<T: Scalar>(
    constants: &Constants<T>,
    x: State<T>,
    mean: Input<T>,
    lean: Input<T>,
    dt: T,
) -> State<T> {
    let yaw = sine_and_cosine(x.attitude.yaw);
    let along = Along { constants: *constants, yaw, mean, lean, speed: T::constant(2.0) / dt };
    let begin = OnTheWay { moving: Moving::of(&x), way: T::constant(-1.0) };
    rk4(along, begin, dt).moving.with_yaw(x.attitude.yaw)
}

/// The quadrotor as a [`Model`].
#[derive(Clone, Copy, Debug)]
pub struct Quadrotor;

impl Model for Quadrotor {
    const NAME: &'static str = "quadrotor";
    type Params<T: Scalar> = Params<T>;
    type State<T: Scalar> = State<T>;
    type Input<T: Scalar> = Input<T>;
    type Output<T: Scalar> = Output<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Params<T>, x: State<T>, u: Input<T>, dt: T) -> (State<T>, Output<T>) {
        let x = step(p, x, u, dt);
        (x, Output { position: x.position, attitude: x.attitude })
    }
}
