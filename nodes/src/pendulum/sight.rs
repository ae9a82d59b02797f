//! A camera that sees the pendulum's mark as a pixel.
//!
//! A mark on a circle is seen as an ellipse; a lens and the camera's distance bend it a little. Both coordinates of the
//! pixel are quadratic in the sine and cosine of the angle, so that their coefficients enter linearly: a fit solves for
//! them instead of searching. The message holds what they multiply, too.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::WorldState;

/// The world that it looks at.
pub const WORLD: Port<WorldState> = Port::new("world");

/// Where the mark is seen.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel<T = f64> {
    /// Column, px.
    pub u: T,
    /// Row, px.
    pub v: T,
    /// sin θ.
    pub sin: T,
    /// cos θ.
    pub cos: T,
    /// sin² θ.
    pub sin_sin: T,
    /// sin θ cos θ.
    pub sin_cos: T,
    /// 1 where the mark has been seen, else 0. A detector in a picture knows nothing of sines and cosines: they are 0 there.
    pub seen: T,
    /// When the picture was taken, seconds since the run's start.
    pub stamp: T,
}

impl Message for Pixel {
    const NAME: &'static str = "pendulum/Pixel";
}

/// A coordinate of the pixel: `one + sin · sin θ + cos · cos θ + sin_sin · sin² θ + sin_cos · sin θ cos θ`, px.
#[derive(Tree, Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de> + Default")]
pub struct Map<T = f64> {
    /// Constant.
    pub one: T,
    /// Of the sine.
    pub sin: T,
    /// Of the cosine.
    pub cos: T,
    /// Of the sine's square.
    pub sin_sin: T,
    /// Of the product.
    pub sin_cos: T,
}

impl<T: Scalar> Map<T> {
    /// The coordinate at an angle, px.
    #[inline(always)]
    pub(super) fn of(&self, sin: T, cos: T) -> T {
        self.one + self.sin * sin + self.cos * cos + self.sin_sin * sin * sin + self.sin_cos * sin * cos
    }

    /// Its derivative by the angle, px/rad.
    #[inline(always)]
    pub(super) fn slope(&self, sin: T, cos: T) -> T {
        let twice = self.sin_sin * sin * cos;
        self.sin * cos - self.cos * sin + twice + twice + self.sin_cos * (cos * cos - sin * sin)
    }
}

/// Parameters of the camera.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de> + Default, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// The column.
    pub u: Map<T>,
    /// The row.
    pub v: Map<T>,
    /// Standard deviation of the noise on both, px.
    pub noise: T,
}

impl Default for Parameters {
    /// A camera in front of the middle of 424×240 px.
    fn default() -> Self {
        let u = Map { one: 212.0, sin: -70.0, ..Map::default() };
        let v = Map { one: 120.0, cos: -70.0, ..Map::default() };
        Self { u, v, noise: 1.0 }
    }
}

/// The camera.
#[derive(Clone, Copy, Debug)]
pub struct Sight;

/// The kind `pendulum/sight`.
pub fn kind() -> NodeKind {
    NodeKind::model::<Sight>(|context| {
        let parameters: Parameters = context.parameters()?;
        let noise = parameters.noise;
        if !(noise >= 0.0 && noise.is_finite()) {
            return Err(context.parameter_error(format!("`noise` is {noise} px; it must not be negative")));
        }
        Ok((parameters, ()))
    })
    .input(WORLD)
}

impl NodeModel for Sight {
    const NAME: &'static str = "sight";
    const NOISE: usize = 2;
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Pixel<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Pixel<T>) {
        let seen = step.latest::<WorldState<T>>(WORLD.name()).message;
        let (sin, cos) = (seen.angle.sin(), seen.angle.cos());
        let pixel = Pixel {
            u: p.u.of(sin, cos) + p.noise * step.noise[0],
            v: p.v.of(sin, cos) + p.noise * step.noise[1],
            sin,
            cos,
            sin_sin: sin * sin,
            sin_cos: sin * cos,
            seen: T::constant(1.0),
            stamp: seen.stamp,
        };
        ((), pixel)
    }
}
