//! Motion capture: sees how the quadrotor moves, with noise.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::{NodeContext, NodeError, Port};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::Motion;
use crate::models::quadrotor::{Attitude, Vector};

/// The world that it looks at.
pub const WORLD: Port<Motion> = Port::new("world");

/// How many random numbers a message takes.
pub(super) const NOISES: usize = 9;

/// Standard deviations of the noise.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de>, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// On each coordinate of the position, m.
    pub position: T,
    /// On each coordinate of the velocity, m/s.
    pub velocity: T,
    /// On each angle of the attitude, rad.
    pub attitude: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { position: 5e-4, velocity: 0.01, attitude: 2e-3 }
    }
}

/// Motion capture.
#[derive(Clone, Copy, Debug)]
pub struct Mocap;

/// The kind `quadrotor/mocap`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Mocap>(|context| Ok((settings(context)?, ()))).input(WORLD)
}

/// The noise that a graph asks for.
pub(super) fn settings(context: &NodeContext) -> Result<Parameters, NodeError> {
    let parameters: Parameters = context.parameters()?;
    for noise in [parameters.position, parameters.velocity, parameters.attitude] {
        if !(noise >= 0.0 && noise.is_finite()) {
            return Err(context.parameter_error(format!("a noise of {noise}; it must not be negative")));
        }
    }
    Ok(parameters)
}

impl NodeModel for Mocap {
    const NAME: &'static str = "mocap";
    const NOISE: usize = NOISES;
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Motion<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Motion<T>) {
        ((), noisy(p, step.latest::<Motion<T>>(WORLD.name()).message, step.noise))
    }
}

/// What is seen of a motion, with these standard normal numbers.
#[inline(always)]
pub(super) fn noisy<T: Scalar>(p: &Parameters<T>, motion: Motion<T>, noise: &[T]) -> Motion<T> {
    let Motion { position, velocity, attitude, stamp } = motion;
    let position = shaken(position, p.position, &noise[..3]);
    let velocity = shaken(velocity, p.velocity, &noise[3..6]);
    let attitude = Attitude {
        roll: attitude.roll + p.attitude * noise[6],
        pitch: attitude.pitch + p.attitude * noise[7],
        yaw: attitude.yaw + p.attitude * noise[8],
    };
    Motion { position, velocity, attitude, stamp }
}

/// A function, because a closure that is called several times stays a call, even in a kernel.
#[inline(always)]
fn shaken<T: Scalar>(x: Vector<T>, std: T, noise: &[T]) -> Vector<T> {
    Vector { x: x.x + std * noise[0], y: x.y + std * noise[1], z: x.z + std * noise[2] }
}
