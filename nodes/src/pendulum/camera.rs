//! The camera: sees the angle of the world's mark, with noise.

use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use serde::Deserialize;

use super::messages::{Angle, WorldState};
use super::wrapped;

/// The world that it looks at.
pub const WORLD: Port<WorldState> = Port::new("world");

/// Parameters of the camera.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// Standard deviation of the noise on the angle, rad.
    pub noise: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { noise: 1.5e-3 }
    }
}

/// The camera.
#[derive(Clone, Debug)]
pub struct Camera {
    noise: Normal<f64>,
    random: ChaCha8Rng,
}

/// The kind `pendulum/camera`.
pub fn kind() -> NodeKind {
    NodeKind::new(|context| {
        let Parameters { noise } = context.parameters()?;
        let noise =
            Normal::new(0.0, noise).ok().filter(|normal| normal.std_dev() >= 0.0).ok_or_else(|| {
                context.parameter_error(format!("`noise` is {noise} rad; it must not be negative"))
            })?;
        Ok(Camera { noise, random: context.random() })
    })
    .input(WORLD)
    .initial(&Angle { angle: -std::f64::consts::PI, stamp: 0.0 })
}

impl Node for Camera {
    type Output = Angle;

    fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
        let seen = step.latest(WORLD).message;
        Ok(Angle { angle: wrapped(seen.angle + self.noise.sample(&mut self.random)), stamp: seen.stamp })
    }
}
