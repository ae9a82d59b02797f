//! How a message stands in a file: as numbers, with or without data, or as an image that viewers know.
//!
//! An image is written as its type of ROS 2 only if that gives back the same message, bit for bit; a node that sends
//! another one under an image's name leaves an image of no size, and its numbers in the frame's name.

use super::cdr::{CdrError, CdrReader, CdrWriter};
use super::ros2msg::{self, Schema};
use crate::data::Data;
use crate::image::{CompressedImage, Encoding, Format, Image};
use crate::node::Layout;
use crate::time::{Nanos, SECOND};

/// How a node's messages stand in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    /// Its leaves.
    Numbers,
    /// Its leaves, and then its data.
    NumbersAndData,
    /// `sensor_msgs/Image`.
    Image,
    /// `sensor_msgs/CompressedImage`.
    CompressedImage,
}

impl Shape {
    /// The shape of messages of this layout, with or without data.
    pub(super) fn of(layout: &Layout, data: bool) -> Self {
        match data {
            false => Self::Numbers,
            true if *layout == Layout::of::<Image>() => Self::Image,
            true if *layout == Layout::of::<CompressedImage>() => Self::CompressedImage,
            true => Self::NumbersAndData,
        }
    }

    /// Whether messages have data.
    pub(super) fn has_data(self) -> bool {
        self != Self::Numbers
    }

    /// What describes the messages to other readers.
    pub(super) fn schema(self, layout: &Layout) -> Schema {
        match self {
            Self::Numbers => ros2msg::message(&layout.name, &layout.leaves, false),
            Self::NumbersAndData => ros2msg::message(&layout.name, &layout.leaves, true),
            Self::Image => ros2msg::image(),
            Self::CompressedImage => ros2msg::compressed_image(),
        }
    }

    /// Writes a message of `node`, sent at `time`.
    pub(super) fn write(self, cdr: &mut CdrWriter, node: &str, time: Nanos, payload: &[f64], data: &[u8]) {
        cdr.begin();
        match self {
            Self::Numbers | Self::NumbersAndData => {
                payload.iter().for_each(|value| cdr.f64(*value));
                if self.has_data() {
                    cdr.blob(data);
                } else if payload.is_empty() {
                    cdr.flag(false);
                }
            }
            Self::Image => {
                let [height, width, step] = [payload[0], payload[1], payload[3]].map(|value| value as u32);
                let encoding = Encoding::ALL.get(payload[2] as usize).copied().unwrap_or(Encoding::Rgb8);
                let place = Encoding::ALL.iter().position(|known| *known == encoding).unwrap_or(0);
                let same = [height.into(), width.into(), place as f64, step.into()];
                if header(cdr, node, time, payload, &same) {
                    [height, width].iter().for_each(|value| cdr.u32(*value));
                    cdr.text(encoding.name());
                    cdr.flag(false);
                    cdr.u32(step);
                } else {
                    [0, 0].iter().for_each(|value| cdr.u32(*value));
                    cdr.text(Encoding::Mono8.name());
                    cdr.flag(false);
                    cdr.u32(0);
                }
                cdr.blob(data);
            }
            Self::CompressedImage => {
                let format = Format::ALL.get(payload[0] as usize).copied().unwrap_or(Format::Jpeg);
                let place = Format::ALL.iter().position(|known| *known == format).unwrap_or(0);
                header(cdr, node, time, payload, &[place as f64]);
                cdr.text(format.name());
                cdr.blob(data);
            }
        }
    }

    /// Reads a message back.
    pub(super) fn read(self, bytes: &[u8], leaves: usize) -> Result<(Vec<f64>, Data), CdrError> {
        let mut cdr = CdrReader::new(bytes)?;
        let (payload, data) = match self {
            Self::Numbers | Self::NumbersAndData => {
                let payload: Vec<f64> = (0..leaves).map(|_| cdr.f64()).collect::<Result<_, _>>()?;
                let data = if self.has_data() { cdr.blob()? } else { &[] };
                if !self.has_data() && leaves == 0 {
                    cdr.flag()?;
                }
                (payload, data)
            }
            Self::Image => {
                let other = read_header(&mut cdr, leaves)?;
                let (height, width, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
                cdr.flag()?;
                let step = cdr.u32()?;
                let place = Encoding::ALL.iter().position(|known| known.name() == encoding);
                let place = place.map_or(f64::NAN, |place| place as f64);
                let payload = vec![height.into(), width.into(), place, step.into()];
                (other.unwrap_or(payload), cdr.blob()?)
            }
            Self::CompressedImage => {
                let other = read_header(&mut cdr, leaves)?;
                let format = cdr.text()?;
                let place = Format::ALL.iter().position(|known| known.name() == format);
                let payload = vec![place.map_or(f64::NAN, |place| place as f64)];
                (other.unwrap_or(payload), cdr.blob()?)
            }
        };
        let data = Data::from(data);
        cdr.end()?;
        Ok((payload, data))
    }
}

/// Between the name of a frame and the numbers of a message that is no image.
const NUMBERS: char = '#';

/// Writes the header of an image; says whether the message is what an image can say. Else its numbers stand here.
fn header(cdr: &mut CdrWriter, node: &str, time: Nanos, payload: &[f64], same: &[f64]) -> bool {
    let exact = payload.iter().zip(same).all(|(value, same)| value.to_bits() == same.to_bits());
    cdr.u32(time.div_euclid(SECOND) as i32 as u32);
    cdr.u32(time.rem_euclid(SECOND) as u32);
    match exact {
        true => cdr.text(node),
        false => {
            let numbers: Vec<String> =
                payload.iter().map(|value| format!("{:016x}", value.to_bits())).collect();
            cdr.text(&format!("{node}{NUMBERS}{}", numbers.join(",")));
        }
    }
    exact
}

/// Reads the header of an image: the numbers of the message, where they stand there.
fn read_header(cdr: &mut CdrReader<'_>, leaves: usize) -> Result<Option<Vec<f64>>, CdrError> {
    cdr.u32()?;
    cdr.u32()?;
    let Some((_, numbers)) = cdr.text()?.split_once(NUMBERS) else { return Ok(None) };
    let number = |text: &str| u64::from_str_radix(text, 16).ok().map(f64::from_bits);
    let numbers: Option<Vec<f64>> = numbers.split(',').map(number).collect();
    Ok(numbers.filter(|numbers| numbers.len() == leaves))
}

#[cfg(test)]
mod tests {
    use super::*;
    use parallax_model::tree::Tree as _;

    #[test]
    fn images_and_what_only_bears_their_name_come_back() {
        let image = Image::new(640, 480, Encoding::Depth16).to_vec();
        let odd = vec![f64::NAN, -1.0, 1e300, 0.5];
        let layout = Layout::of::<Image>();
        let shape = Shape::of(&layout, true);
        assert_eq!((shape, Shape::of(&layout, false)), (Shape::Image, Shape::Numbers));
        let mut cdr = CdrWriter::default();
        for payload in [image, odd] {
            shape.write(&mut cdr, "camera", 1_500_000_000, &payload, &[1, 2, 3]);
            let (read, data) = shape.read(cdr.bytes(), 4).unwrap();
            let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
            assert_eq!((bits(&read), &*data), (bits(&payload), &[1, 2, 3][..]));
        }
        let layout = Layout::of::<CompressedImage>();
        let shape = Shape::of(&layout, true);
        for payload in [1.0, 7.0] {
            shape.write(&mut cdr, "camera", 0, &[payload], &[]);
            assert_eq!(shape.read(cdr.bytes(), 1).unwrap(), (vec![payload], Data::default()));
        }
    }
}
