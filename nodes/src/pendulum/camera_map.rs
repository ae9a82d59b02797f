//! The angle at which the pendulum is, from where its mark is in a picture.
//!
//! ```text
//! world ──> film ──(image)──> mark (detector) ──(pixel)──> camera
//! ```
//!
//! Which pixel belongs to which angle is told by a [`Map`] for each coordinate, such as an identification finds. The angle is
//! the one whose pixel is nearest: by the maps without their squares at first, then by Gauss's and Newton's steps.

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::node::Port;
use parallax_runtime::registry::NodeKind;
use serde::Deserialize;

use super::messages::Angle;
use super::sight::{Map, Pixel};
use super::view::{Stand, View};
use super::wrapped;

/// Where the mark is.
pub const MARK: Port<Pixel> = Port::new("mark");

/// Steps towards the nearest pixel: the squares are a few percent, and each step leaves about so much of the error.
const STEPS: usize = 4;

/// Parameters of the map.
#[derive(Tree, Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields, bound = "T: Deserialize<'de> + Default, Parameters<T>: Default")]
pub struct Parameters<T = f64> {
    /// The column.
    pub u: Map<T>,
    /// The row.
    pub v: Map<T>,
}

impl Default for Parameters {
    /// The film's camera exactly before the pendulum.
    fn default() -> Self {
        let [u, v] = View::nominal(Stand::Front).maps();
        Self { u, v }
    }
}

/// The camera, from the mark on.
#[derive(Clone, Copy, Debug)]
pub struct CameraMap;

/// The kind `pendulum/camera-map`.
pub fn kind() -> NodeKind {
    NodeKind::model::<CameraMap>(|context| {
        let parameters: Parameters = context.parameters()?;
        let Parameters { u, v } = parameters;
        let area = u.sin * v.cos - u.cos * v.sin;
        if !(area.is_finite() && area.abs() > 1e-6) {
            return Err(context.parameter_error(
                "by `u` and `v` the mark moves along a line or not at all: `sin` and `cos` of both must span a plane",
            ));
        }
        Ok((parameters, ()))
    })
    .input(MARK)
    .initial(&Angle { angle: -std::f64::consts::PI, stamp: 0.0 })
}

impl NodeModel for CameraMap {
    const NAME: &'static str = "camera_map";
    type Params<T: Scalar> = Parameters<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Angle<T>;

    #[inline(always)]
    fn step<T: Scalar>(p: &Parameters<T>, (): (), step: &NodeStep<'_, T>) -> ((), Angle<T>) {
        let mark = step.latest::<Pixel<T>>(MARK.name()).message;
        // Until the mark is seen, the pendulum is taken to hang.
        let hanging = T::constant(-std::f64::consts::PI);
        let angle = T::select(mark.seen.gt(T::constant(0.5)), nearest(p, mark.u, mark.v), hanging);
        ((), Angle { angle, stamp: mark.stamp })
    }
}

/// The angle whose pixel is nearest, rad within [−π, π).
#[inline(always)]
fn nearest<T: Scalar>(p: &Parameters<T>, u: T, v: T) -> T {
    let (du, dv) = (u - p.u.one, v - p.v.one);
    // The sign of the area: a mirror turns the other way round.
    let area = p.u.sin * p.v.cos - p.u.cos * p.v.sin;
    let sin = (du * p.v.cos - dv * p.u.cos) / area;
    let cos = (dv * p.u.sin - du * p.v.sin) / area;
    let mut angle = sin.atan2(cos);
    for _ in 0..STEPS {
        let (sin, cos) = (angle.sin(), angle.cos());
        let (slope_u, slope_v) = (p.u.slope(sin, cos), p.v.slope(sin, cos));
        let off = slope_u * (u - p.u.of(sin, cos)) + slope_v * (v - p.v.of(sin, cos));
        angle += off / (slope_u * slope_u + slope_v * slope_v);
    }
    wrapped(angle)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_angle_of_a_pixel_is_found_all_around_from_any_stand() {
        for seed in 0..50 {
            for stand in [Stand::Front, Stand::Side] {
                let view = View::draw(seed, stand);
                let [u, v] = view.maps();
                let parameters = Parameters { u, v };
                for step in 0..100 {
                    let angle = wrapped(f64::from(step) * 0.063);
                    let (sin, cos) = angle.sin_cos();
                    let found = nearest(&parameters, u.of(sin, cos), v.of(sin, cos));
                    assert!(wrapped(found - angle).abs() < 1e-4, "{view:?}: {angle} came back as {found}");
                    let [column, row] = view.mark(angle);
                    let seen = nearest(&parameters, column, row);
                    assert!(wrapped(seen - angle).abs() < 0.02, "{view:?}: {angle} is seen as {seen}");
                }
            }
        }
    }
}
