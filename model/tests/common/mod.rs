//! A motor-driven arm that uses most of what a model can: nested trees, friction with a kink, a limit, RK4.

use parallax_model::integrate::rk4;
use parallax_model::{Model, Scalar, Tree};

#[derive(Tree, Clone, Copy, Debug)]
pub(crate) struct Friction<T> {
    pub(crate) viscous: T,
    pub(crate) coulomb: T,
}

#[derive(Tree, Clone, Copy, Debug)]
pub(crate) struct ArmParams<T> {
    pub(crate) inertia: T,
    pub(crate) load: T,
    pub(crate) friction: Friction<T>,
    pub(crate) motor: T,
}

#[derive(Tree, Clone, Copy, Debug)]
pub(crate) struct ArmState<T> {
    pub(crate) angle: T,
    pub(crate) speed: T,
    pub(crate) current: T,
}

pub(crate) struct Arm;

impl Model for Arm {
    const NAME: &'static str = "arm";
    type Params<T: Scalar> = ArmParams<T>;
    type State<T: Scalar> = ArmState<T>;
    type Input<T: Scalar> = T;
    type Output<T: Scalar> = T;

    fn step<T: Scalar>(p: &ArmParams<T>, x: ArmState<T>, voltage: T, dt: T) -> (ArmState<T>, T) {
        let voltage = voltage.clamp(T::constant(-12.0), T::constant(12.0));
        let state = rk4(
            |x: &ArmState<T>| {
                let friction = p.friction.viscous * x.speed + p.friction.coulomb * x.speed.sign();
                ArmState {
                    angle: x.speed,
                    speed: (p.motor * x.current + p.load * x.angle.sin() - friction) / p.inertia,
                    current: (voltage - x.current - p.motor * x.speed) * 10.0,
                }
            },
            x,
            dt,
        );
        (state, state.angle)
    }
}
