//! The camera: sees the angle of the world's mark, with noise.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Angle, WorldState};
use super::wrapped;

/// The world that it looks at.
pub const WORLD: Port<WorldState> = Port::new("world");

/// Parameters of the camera.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de>, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// Standard deviation of the noise on the angle, rad.
    pub noise: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { noise: 1.5e-3 }
    }
}

/// The camera.
#[derive(Clone, Copy, Debug)]
pub struct Camera;

/// The kind `pendulum/camera`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Camera>(|context| {
        let parameters: Parameters = context.parameters()?;
        let noise = parameters.noise;
        if !(noise >= 0.0 && noise.is_finite()) {
            return Err(context.parameter_error(format!("`noise` is {noise} rad; it must not be negative")));
        }
        Ok((parameters, ()))
    })
    .input(WORLD)
    .initial(&Angle { angle: -std::f64::consts::PI, stamp: 0.0 })
}

impl NodeModel for Camera {
    const NAME: &'static str = "camera";
    const NOISE: usize = 1;
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Angle<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Angle<T>) {
        let seen = step.latest::<WorldState<T>>(WORLD.name()).message;
        ((), Angle { angle: wrapped(seen.angle + p.noise * step.noise[0]), stamp: seen.stamp })
    }
}
