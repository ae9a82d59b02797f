//! The encoder: reads angle and speed from the shaft, with noise. It stands where camera and estimator stand on the
//! machine, for simulators that need neither.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::{Estimate, WorldState};
use super::wrapped;

/// The world whose shaft it reads.
pub const WORLD: Port<WorldState> = Port::new("world");

/// Parameters of the encoder.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de>, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// Standard deviation of the noise on the angle, rad.
    pub angle_noise: T,
    /// Standard deviation of the noise on the speed, rad/s.
    pub speed_noise: T,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { angle_noise: 1.5e-3, speed_noise: 0.05 }
    }
}

/// The encoder.
#[derive(Clone, Copy, Debug)]
pub struct Encoder;

/// The kind `pendulum/encoder`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Encoder>(|context| {
        let parameters: Parameters = context.parameters()?;
        for noise in [parameters.angle_noise, parameters.speed_noise] {
            if !(noise >= 0.0 && noise.is_finite()) {
                return Err(context.parameter_error(format!("a noise of {noise}; it must not be negative")));
            }
        }
        Ok((parameters, ()))
    })
    .input(WORLD)
    .initial(&Estimate { angle: -std::f64::consts::PI, speed: 0.0, stamp: 0.0 })
}

impl NodeModel for Encoder {
    const NAME: &'static str = "encoder";
    const NOISE: usize = 2;
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Estimate<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Estimate<T>) {
        let seen = step.latest::<WorldState<T>>(WORLD.name()).message;
        let angle = wrapped(seen.angle + p.angle_noise * step.noise[0]);
        let speed = seen.speed + p.speed_noise * step.noise[1];
        ((), Estimate { angle, speed, stamp: seen.stamp })
    }
}
