//! The detector that finds the pendulum's red mark in a picture.
//!
//! It subtracts the background and takes what is redder than it: the poster on the wall is as red as the mark, so
//! that colour alone would not do. The background is the least redness that a pixel has had so far: the mark covers a place only
//! for a while. A mark that has not moved yet belongs to the background, and is not seen.

use parallax_runtime::image::{Encoding, Image};
use parallax_runtime::node::{Node, NodeError, Port, Step};
use parallax_runtime::registry::NodeKind;
use parallax_runtime::time::to_seconds;

use super::film::{BYTES, HEIGHT, MARK, WIDTH};
use super::sight::{self, Pixel};

/// The film in which it looks.
pub const FILM: Port<Image> = Port::new("film");

/// How much redder than the background a pixel of the mark is at least, of 255.
const REDDER: i16 = 40;
/// How many pixels' worth of red make a mark: a tenth of it.
const LEAST: f64 = 0.1 * std::f64::consts::PI * MARK * MARK * 160.0;

/// Finds the mark.
#[derive(Clone, Debug)]
pub struct Detector {
    /// The least redness of every pixel so far.
    background: Box<[i16]>,
    /// What was found last.
    last: Pixel,
}

/// The kind `pendulum/detector`.
pub fn kind() -> NodeKind {
    NodeKind::new(move |_| Ok(Detector::blind())).input(FILM)
}

/// The kind `pendulum/detector-simulated`: what film and detector do together, as a model of where the mark is. It stands where
/// the detector stands in a recorded graph, with the film's input, which it does not read.
pub fn simulated() -> NodeKind {
    sight::kind().input(FILM)
}

impl Detector {
    /// One that has seen nothing yet.
    fn blind() -> Self {
        Self { background: vec![i16::MAX; WIDTH * HEIGHT].into(), last: Pixel::default() }
    }

    /// Where the mark is in a picture, column and row, px; nothing where none is seen.
    fn find(&mut self, pixels: &[u8]) -> Option<[f64; 2]> {
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
        (sum > LEAST).then(|| [column / sum, row / sum])
    }
}

impl Node for Detector {
    type Output = Pixel;

    fn step(&mut self, step: &Step<'_>) -> Result<Pixel, NodeError> {
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
        if let Some([u, v]) = self.find(pixels) {
            self.last = Pixel { u, v, seen: 1.0, ..self.last };
        }
        self.last.stamp = to_seconds(picture.sent);
        Ok(self.last)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::pendulum::film::Film;
    use crate::pendulum::view::{Stand, View};

    fn film(view: &View) -> Film {
        let noise = (0..BYTES).map(|i| ((i * 7919) % 1201) as f64 / 100.0 - 6.0).collect();
        Film::new(view, noise, 12345)
    }

    #[test]
    fn the_mark_is_found_all_around_from_any_stand_in_spite_of_the_poster() {
        let drawn = (0..4).flat_map(|seed| [View::draw(seed, Stand::Front), View::draw(seed, Stand::Side)]);
        for view in drawn.chain([View::nominal(Stand::Front)]) {
            let (mut film, mut detector, mut pixels) = (film(&view), Detector::blind(), vec![0; BYTES]);
            let mut look = |angle: f64| {
                film.draw(angle, &mut pixels);
                detector.find(&pixels)
            };
            // Where it was at first it cannot be told from the background.
            assert_eq!(look(PI), None);
            for angle in [2.0, 0.5, -1.0, -2.5] {
                look(angle);
            }
            for step in 0..100 {
                let angle = f64::from(step) * 0.063;
                let (found, mark) = (look(angle).expect("seen"), view.mark(angle));
                let off = (found[0] - mark[0]).hypot(found[1] - mark[1]);
                assert!(off < 0.35, "{view:?}: {off} px off at {angle} rad");
            }
        }
    }

    #[test]
    fn colour_alone_would_find_the_poster() {
        let (mut film, mut pixels) = (film(&View::nominal(Stand::Front)), vec![0; BYTES]);
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
