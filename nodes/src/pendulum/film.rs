//! The camera with pictures: a film of the pendulum, and the detector that finds its red mark there.
//!
//! ```text
//! world ──> film ──(image)──> camera (detector) ──> estimator
//! ```
//!
//! The film shows a wall with a red poster, the pendulum's disc and arm, and the mark on a circle about the shaft; every pixel is
//! noisy. The detector subtracts the background and takes what is redder than it: the poster is as red as the mark, so
//! that colour alone would not do. The background is the least redness that a pixel has had so far: the mark covers a place only
//! for a while. A mark that has not moved yet belongs to the background; until it is seen somewhere else, the pendulum is
//! taken to hang where it was at first.

use parallax_runtime::data::{DataNode, DataSpace};
use parallax_runtime::image::{Encoding, Image};
use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;
use rand::Rng;

use super::camera;
use super::messages::{Angle, WorldState};
use super::wrapped;

/// The world that it looks at.
pub const WORLD: Port<WorldState> = Port::new("world");
/// The film in which the detector looks.
pub const FILM: Port<Image> = Port::new("film");

/// Pixels of a row.
const WIDTH: usize = 120;
/// Rows.
const HEIGHT: usize = 90;
/// Where the shaft is, px.
const MIDDLE: [f64; 2] = [60.0, 45.0];
/// Distance of the mark from the shaft, px.
const CIRCLE: f64 = 36.0;
/// Radius of the mark, px.
const MARK: f64 = 5.0;
/// How much redder than the background a pixel of the mark is at least, of 255.
const REDDER: i16 = 40;
/// How many pixels' worth of red make a mark: a tenth of it.
const LEAST: f64 = 0.1 * std::f64::consts::PI * MARK * MARK * 160.0;

/// A picture's bytes.
const BYTES: usize = WIDTH * HEIGHT * 3;

/// Where the mark is seen at an angle from upright: column and row, px.
fn place(angle: f64) -> [f64; 2] {
    [MIDDLE[0] - CIRCLE * angle.sin(), MIDDLE[1] - CIRCLE * angle.cos()]
}

/// The camera.
#[derive(Clone, Debug)]
pub struct Film {
    wall: Box<[[f64; 3]]>,
    /// Noise of a pixel, drawn once: every picture shifts it by a number of its own.
    noise: Box<[f64]>,
    random: u64,
}

/// The kind `pendulum/film`.
pub fn film() -> NodeKind {
    NodeKind::with_data(BYTES, |context| {
        let mut random = context.random();
        // Uniform between ±6 levels, as a small sensor has in a room.
        let noise = (0..BYTES).map(|_| f64::from(random.next_u32() % 1201) / 100.0 - 6.0).collect();
        Ok(Film { wall: wall(), noise, random: random.next_u64() | 1 })
    })
    .input(WORLD)
}

/// The wall: brighter to the right, with a dark line, and a red poster beside the mark's circle.
fn wall() -> Box<[[f64; 3]]> {
    let pixel = |index: usize| {
        let (x, y) = (index % WIDTH, index / WIDTH);
        let grey = 120.0 + 0.5 * x as f64 - 0.3 * y as f64;
        match (x, y) {
            (0..=16, 5..=50) => [215.0, 45.0, 40.0],
            (_, 60..=62) => [60.0, 60.0, 66.0],
            _ => [grey, grey, grey + 8.0],
        }
    };
    (0..WIDTH * HEIGHT).map(pixel).collect()
}

/// How much of a pixel lies within a distance of a line or a point, smoothly over one pixel.
fn cover(distance: f64, radius: f64) -> f64 {
    (radius + 0.5 - distance).clamp(0.0, 1.0)
}

impl Film {
    /// Draws the pendulum at an angle.
    fn draw(&mut self, angle: f64, pixels: &mut [u8]) {
        // A permutation of the noise for each picture (G. Marsaglia, *Xorshift RNGs*, 2003).
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let shift = (self.random % BYTES as u64) as usize;
        let mark = place(angle);
        let (dx, dy) = ((mark[0] - MIDDLE[0]) / CIRCLE, (mark[1] - MIDDLE[1]) / CIRCLE);
        for (index, (pixel, wall)) in pixels.chunks_exact_mut(3).zip(&self.wall).enumerate() {
            let (x, y) = ((index % WIDTH) as f64, (index / WIDTH) as f64);
            let (px, py) = (x - MIDDLE[0], y - MIDDLE[1]);
            let along = (px * dx + py * dy).clamp(0.0, CIRCLE);
            let arm = cover((px - along * dx).hypot(py - along * dy), 1.5);
            let disc = cover(px.hypot(py), 14.0);
            let dot = cover((x - mark[0]).hypot(y - mark[1]), MARK);
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
        let angle = step.latest(WORLD).message.angle;
        let image = Image::new(WIDTH as u32, HEIGHT as u32, Encoding::Rgb8);
        self.draw(angle, data.take(image.bytes())?);
        Ok(image)
    }
}

/// Finds the mark.
#[derive(Clone, Debug)]
pub struct Detector {
    /// The least redness of every pixel so far.
    background: Box<[i16]>,
    /// What was found last.
    last: Angle,
}

/// The kind `pendulum/detector`.
pub fn detector() -> NodeKind {
    let hanging = Angle { angle: -std::f64::consts::PI, stamp: 0.0 };
    NodeKind::new(move |_| Ok(Detector { background: vec![i16::MAX; WIDTH * HEIGHT].into(), last: hanging }))
        .input(FILM)
        .initial(&hanging)
}

/// The kind `pendulum/detector-simulated`: what film and detector do together, as a model of the angle. It stands where the
/// detector stands in a recorded graph, with the film's input, which it does not read.
pub fn simulated() -> NodeKind {
    camera::kind().input(FILM)
}

impl Detector {
    /// Where the mark is in a picture, rad from upright; nothing where none is seen.
    fn find(&mut self, pixels: &[u8]) -> Option<f64> {
        let (mut sum, mut column, mut row) = (0.0, 0.0, 0.0);
        for (index, (pixel, least)) in pixels.chunks_exact(3).zip(&mut self.background).enumerate() {
            let redness = i16::from(pixel[0]) - i16::from(pixel[1].max(pixel[2]));
            *least = redness.min(*least);
            let more = redness - *least;
            if more > REDDER {
                let weight = f64::from(more);
                sum += weight;
                column += weight * (index % WIDTH) as f64;
                row += weight * (index / WIDTH) as f64;
            }
        }
        let (x, y) = (column / sum - MIDDLE[0], row / sum - MIDDLE[1]);
        (sum > LEAST).then(|| wrapped((-x).atan2(-y)))
    }
}

impl Node for Detector {
    type Output = Angle;

    fn step(&mut self, step: &Step<'_>) -> Result<Angle, NodeError> {
        let picture = step.latest(FILM);
        if picture.seq.is_none() {
            return Ok(self.last);
        }
        let pixels = step.latest_data(FILM);
        let wanted = Image::new(WIDTH as u32, HEIGHT as u32, Encoding::Rgb8);
        if picture.message != wanted || pixels.len() != BYTES {
            return Err(NodeError::failed(format!(
                "the picture is {}×{} with {} bytes; the detector looks for a mark in {WIDTH}×{HEIGHT} pixels of rgb8",
                picture.message.width,
                picture.message.height,
                pixels.len()
            )));
        }
        if let Some(angle) = self.find(pixels) {
            self.last.angle = angle;
        }
        self.last.stamp = to_seconds(picture.sent);
        Ok(self.last)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use super::*;

    fn camera() -> Film {
        let noise = (0..BYTES).map(|i| ((i * 7919) % 1201) as f64 / 100.0 - 6.0).collect();
        Film { wall: wall(), noise, random: 12345 }
    }

    fn blind() -> Detector {
        Detector { background: vec![i16::MAX; WIDTH * HEIGHT].into(), last: Angle::default() }
    }

    #[test]
    fn the_mark_is_found_all_around_in_spite_of_the_poster() {
        let (mut film, mut detector, mut pixels) = (camera(), blind(), vec![0; BYTES]);
        let mut look = |angle: f64| {
            film.draw(angle, &mut pixels);
            detector.find(&pixels)
        };
        // Where it was at first it cannot be told from the background.
        assert_eq!(look(PI), None);
        for angle in [2.0, 0.5, -1.0, -2.5] {
            look(angle);
        }
        let mut worst: f64 = 0.0;
        for step in 0..200 {
            let angle = wrapped(f64::from(step) * TAU / 200.0);
            let found = look(angle).expect("seen");
            worst = worst.max(wrapped(found - angle).abs());
        }
        // A quarter of a pixel at the distance of the mark.
        assert!(worst < 0.25 / CIRCLE, "{worst} rad");
    }

    #[test]
    fn colour_alone_would_find_the_poster() {
        let (mut film, mut pixels) = (camera(), vec![0; BYTES]);
        film.draw(PI, &mut pixels);
        let red = |at: usize| {
            let pixel = &pixels[3 * at..3 * at + 3];
            i16::from(pixel[0]) - i16::from(pixel[1].max(pixel[2])) > REDDER
        };
        let poster = (0..WIDTH * HEIGHT).filter(|&at| red(at) && at % WIDTH < 18).count();
        let mark = (0..WIDTH * HEIGHT).filter(|&at| red(at) && at % WIDTH >= 18).count();
        assert!(poster > 5 * mark && mark > 40, "{poster} and {mark} pixels");
    }
}
