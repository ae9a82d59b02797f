//! From where a camera looks at the pendulum: where it sees what lies in the plane in which the mark turns.

use parallax_runtime::random::{Purpose, stream};
use rand::RngExt;
use serde::Deserialize;

use super::sight::Map;

/// A pinhole camera. In the plane of the mark a place is told by two numbers, right and up from the shaft, in radii of
/// the mark's circle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Where the shaft is seen: column and row, px.
    pub middle: [f64; 2],
    /// A radius of the mark's circle at the shaft's distance, px.
    pub scale: f64,
    /// How far to the side the camera stands, rad.
    pub yaw: f64,
    /// How far above, rad.
    pub pitch: f64,
    /// How far it is turned about its own axis, rad.
    pub roll: f64,
    /// How far away it is, in radii of the mark's circle.
    pub distance: f64,
}

/// Which of a machine's cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stand {
    /// It stands before the pendulum.
    #[default]
    Front,
    /// It looks from the side.
    Side,
}

impl View {
    /// Exactly before the pendulum, or from the side.
    pub fn nominal(stand: Stand) -> Self {
        let yaw = match stand {
            Stand::Front => 0.0,
            Stand::Side => 0.9,
        };
        Self { middle: [60.0, 45.0], scale: 36.0, yaw, pitch: 0.0, roll: 0.0, distance: 8.0 }
    }

    /// A camera that nobody has adjusted; equal seeds draw equal ones. All of the mark's circle is in the picture.
    pub fn draw(seed: u64, stand: Stand) -> Self {
        let name = match stand {
            Stand::Front => "hidden camera",
            Stand::Side => "hidden camera at the side",
        };
        let mut random = stream(seed, Purpose::Node, name);
        let nominal = Self::nominal(stand);
        let [column, row] = nominal.middle;
        Self {
            middle: [column + random.random_range(-4.0..4.0), row + random.random_range(-4.0..4.0)],
            scale: random.random_range(29.5..33.0),
            yaw: nominal.yaw + random.random_range(-0.3..0.3),
            pitch: random.random_range(-0.2..0.2),
            roll: random.random_range(-0.1..0.1),
            distance: nominal.distance,
        }
    }

    /// What is seen of a place in the plane, right and up from the shaft by the camera's own axes, and how much farther
    /// than the shaft it is: `[right, up, depth]`, each as what multiplies the place's two numbers.
    fn axes(&self) -> [[f64; 2]; 3] {
        let (yaw, pitch, roll) = (self.yaw.sin_cos(), self.pitch.sin_cos(), self.roll.sin_cos());
        // Turned about the vertical, then about the horizontal, then about the line of sight.
        let right = [yaw.1, 0.0];
        let up = [yaw.0 * pitch.0, pitch.1];
        let depth = [-yaw.0 * pitch.1, pitch.0];
        let turned = |a: f64, b: f64| [0, 1].map(|k: usize| a * right[k] + b * up[k]);
        [turned(roll.1, -roll.0), turned(roll.0, roll.1), depth]
    }

    /// Where a place in the plane is seen: column and row, px.
    pub fn pixel(&self, place: [f64; 2]) -> [f64; 2] {
        let [right, up, depth] = self.axes().map(|axis| axis[0] * place[0] + axis[1] * place[1]);
        let scale = self.scale / (1.0 + depth / self.distance);
        [self.middle[0] + scale * right, self.middle[1] - scale * up]
    }

    /// Which place in the plane is seen at a pixel.
    pub fn place(&self, pixel: [f64; 2]) -> [f64; 2] {
        let [right, up, depth] = self.axes();
        let seen = [(pixel[0] - self.middle[0]) / self.scale, (self.middle[1] - pixel[1]) / self.scale];
        // right · p = seen (1 + depth · p / distance), and so for up: two linear equations.
        let row =
            |axis: [f64; 2], seen: f64| [0, 1].map(|k: usize| axis[k] - seen * depth[k] / self.distance);
        let ([a, b], [c, d]) = (row(right, seen[0]), row(up, seen[1]));
        let determinant = a * d - b * c;
        [(d * seen[0] - b * seen[1]) / determinant, (a * seen[1] - c * seen[0]) / determinant]
    }

    /// Where the mark is seen at an angle from upright: column and row, px.
    pub fn mark(&self, angle: f64) -> [f64; 2] {
        let (sin, cos) = angle.sin_cos();
        self.pixel([-sin, cos])
    }

    /// The maps of column and row that come nearest to this view, all around the circle.
    pub fn maps(&self) -> [Map; 2] {
        /// Angles at which they are compared.
        const ANGLES: usize = 360;
        let mut maps = [Map::default(); 2];
        for step in 0..ANGLES {
            let angle = std::f64::consts::TAU * step as f64 / ANGLES as f64;
            let share = 2.0 / ANGLES as f64;
            for (map, seen) in maps.iter_mut().zip(self.mark(angle)) {
                // Harmonics of a whole turn are orthogonal, so that each stands alone; cos 2θ = 1 − 2 sin² θ.
                let twice = share * seen * (2.0 * angle).cos();
                map.one += 0.5 * share * seen + twice;
                map.sin += share * seen * angle.sin();
                map.cos += share * seen * angle.cos();
                map.sin_sin -= 2.0 * twice;
                map.sin_cos += 2.0 * share * seen * (2.0 * angle).sin();
            }
        }
        maps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_and_pixels_are_each_others_inverse() {
        for seed in 0..50 {
            for stand in [Stand::Front, Stand::Side] {
                let view = View::draw(seed, stand);
                for place in [[0.0, 0.0], [1.0, 0.3], [-0.7, -1.1]] {
                    let back = view.place(view.pixel(place));
                    let off = (back[0] - place[0]).hypot(back[1] - place[1]);
                    assert!(off < 1e-12, "{view:?}: {place:?} came back as {back:?}");
                }
            }
        }
    }

    #[test]
    fn the_mark_is_in_the_picture_and_a_map_follows_it() {
        for seed in 0..200 {
            for stand in [Stand::Front, Stand::Side] {
                let view = View::draw(seed, stand);
                let maps = view.maps();
                for step in 0..100 {
                    let angle = f64::from(step) * 0.063;
                    let (seen, (sin, cos)) = (view.mark(angle), angle.sin_cos());
                    assert!((5.0..115.0).contains(&seen[0]) && (5.0..85.0).contains(&seen[1]), "{view:?}");
                    for (map, seen) in maps.iter().zip(seen) {
                        assert!((map.of(sin, cos) - seen).abs() < 0.5, "{view:?} at {angle}");
                    }
                }
            }
        }
    }
}
