//! The camera with pictures: a film of the pendulum.
//!
//! It shows a wall with a red poster, the pendulum's disc and arm, and the mark on a circle about the shaft; every pixel is
//! noisy. From where it looks is a [`View`], which is hidden where the whole machine is.

use parallax_runtime::data::{DataNode, DataSpace};
use parallax_runtime::image::{Encoding, Image};
use parallax_runtime::node::{NodeContext, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;
use rand::Rng;
use serde::Deserialize;

use super::messages::WorldState;
use super::view::{Stand, View};

/// The world that it looks at.
pub const WORLD: Port<WorldState> = Port::new("world");

/// Pixels of a row.
pub(super) const WIDTH: usize = 120;
/// Rows.
pub(super) const HEIGHT: usize = 90;
/// A picture's bytes.
pub(super) const BYTES: usize = WIDTH * HEIGHT * 3;
/// Radius of the mark, px.
pub(super) const MARK: f64 = 5.0;

/// Parameters of the film.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// Which of the machine's cameras it is: `front` or `side`.
    pub view: Stand,
}

/// The camera.
#[derive(Clone, Debug)]
pub struct Film {
    /// A radius of the mark's circle, px.
    circle: f64,
    /// What each pixel shows of the pendulum's plane: right and up from the shaft, px.
    places: Box<[[f64; 2]]>,
    wall: Box<[[f64; 3]]>,
    /// Noise of a pixel, drawn once: every picture shifts it by a number of its own.
    noise: Box<[f64]>,
    random: u64,
}

/// The kind `pendulum/film`, which looks from where `view` says.
pub(super) fn kind(
    view: impl Fn(&NodeContext, Stand) -> Result<View, NodeError> + Send + Sync + 'static,
) -> NodeKind {
    NodeKind::with_data(BYTES, move |context| {
        let Parameters { view: stand } = context.parameters()?;
        let mut random = context.random();
        // Uniform between ±6 levels, as a small sensor has in a room.
        let noise = (0..BYTES).map(|_| f64::from(random.next_u32() % 1201) / 100.0 - 6.0).collect();
        Ok(Film::new(&view(context, stand)?, noise, random.next_u64() | 1))
    })
    .input(WORLD)
}

/// A pixel of the wall: brighter to the right of the picture, with a dark line, and a red poster beside the mark's circle.
/// The place is in radii of that circle.
fn wall(index: usize, [right, up]: [f64; 2]) -> [f64; 3] {
    let (x, y) = (index % WIDTH, index / WIDTH);
    let grey = 120.0 + 0.5 * x as f64 - 0.3 * y as f64;
    if right < -1.21 && (-0.15..1.12).contains(&up) {
        [215.0, 45.0, 40.0]
    } else if (-0.485..-0.405).contains(&up) {
        [60.0, 60.0, 66.0]
    } else {
        [grey, grey, grey + 8.0]
    }
}

/// The angle at a time, s, shortly after the world told of itself: a camera sees what is there when it looks, and that it
/// woke up late is no delay of what it sees.
fn angle_at(world: &WorldState, time: f64) -> f64 {
    world.angle + world.speed * (time - world.stamp)
}

/// How much of a pixel lies within a distance of a line or a point, smoothly over one pixel.
fn cover(distance: f64, radius: f64) -> f64 {
    (radius + 0.5 - distance).clamp(0.0, 1.0)
}

impl Film {
    /// The film of a camera, before its first picture. `random` is not 0.
    pub(super) fn new(view: &View, noise: Box<[f64]>, random: u64) -> Self {
        let circle = view.scale;
        let place = |index: usize| view.place([(index % WIDTH) as f64, (index / WIDTH) as f64]);
        let pixels = 0..WIDTH * HEIGHT;
        Self {
            circle,
            places: pixels.clone().map(|index| place(index).map(|part| part * circle)).collect(),
            wall: pixels.map(|index| wall(index, place(index))).collect(),
            noise,
            random,
        }
    }

    /// Draws the pendulum at an angle.
    pub(super) fn draw(&mut self, angle: f64, pixels: &mut [u8]) {
        // A permutation of the noise for each picture (G. Marsaglia, *Xorshift RNGs*, 2003).
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let shift = (self.random % BYTES as u64) as usize;
        let (dx, dy) = (-angle.sin(), angle.cos());
        let seen = pixels.chunks_exact_mut(3).zip(&self.wall).zip(&self.places);
        for (index, ((pixel, wall), [px, py])) in seen.enumerate() {
            let along = (px * dx + py * dy).clamp(0.0, self.circle);
            let arm = cover((px - along * dx).hypot(py - along * dy), 1.5);
            let disc = cover(px.hypot(*py), 14.0);
            let dot = cover((px - self.circle * dx).hypot(py - self.circle * dy), MARK);
            for (channel, value) in pixel.iter_mut().enumerate() {
                let mut level = wall[channel];
                level += disc * (90.0 - level);
                level += arm * (50.0 - level);
                level += dot * ([210.0, 40.0, 40.0][channel] - level);
                level += self.noise[(3 * index + channel + shift) % BYTES];
                *value = level.clamp(0.0, 255.0) as u8;
            }
        }
    }
}

impl DataNode for Film {
    type Output = Image;

    fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Image, NodeError> {
        let image = Image::new(WIDTH as u32, HEIGHT as u32, Encoding::Rgb8);
        self.draw(angle_at(&step.latest(WORLD).message, to_seconds(step.start)), data.take(image.bytes())?);
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_looks_late_shows_the_pendulum_where_it_is_then() {
        let world = WorldState { angle: 3.0, speed: -8.0, stamp: 1.5 };
        assert_eq!(angle_at(&world, 1.5), 3.0);
        assert!((angle_at(&world, 1.5005) - 2.996).abs() < 1e-12);
    }
}
