//! Images as messages: [`Image`] and [`CompressedImage`], whose pixels are the message's [data](crate::data).
//!
//! They are recorded as `sensor_msgs/Image` and `sensor_msgs/CompressedImage` of ROS 2, which Foxglove and rviz show.
//!
//! ```
//! use parallax_runtime::data::{DataNode, DataSpace};
//! use parallax_runtime::image::{Encoding, Image};
//! use parallax_runtime::node::{NodeError, Step};
//! use parallax_runtime::registry::NodeKind;
//!
//! /// Grey that becomes brighter.
//! struct Camera;
//! impl DataNode for Camera {
//!     type Output = Image;
//!     fn step(&mut self, step: &Step<'_>, data: &mut DataSpace<'_>) -> Result<Image, NodeError> {
//!         let image = Image::new(640, 480, Encoding::Mono8);
//!         data.take(image.bytes())?.fill(step.seq as u8);
//!         Ok(image)
//!     }
//! }
//!
//! let kind = NodeKind::with_data(640 * 480, |_| Ok(Camera));
//! assert_eq!(kind.output().name, "sensor_msgs/Image");
//! ```

use parallax_model::tree::Tree;

use crate::node::Message;

/// How the pixels of an [`Image`] lie in its data, named as in ROS 2 (`sensor_msgs/image_encodings.hpp`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Red, green and blue, a byte each.
    Rgb8,
    /// The same with opacity.
    Rgba8,
    /// Blue, green and red, a byte each.
    Bgr8,
    /// The same with opacity.
    Bgra8,
    /// Grey, a byte.
    Mono8,
    /// Grey, two bytes, the lower one first.
    Mono16,
    /// Depth in millimetres, two bytes, the lower one first.
    Depth16,
    /// Depth in metres, a float of four bytes.
    Depth32,
    /// Brightness of each pixel and colour of each pair, as most cameras on USB send it.
    Yuyv,
}

impl Encoding {
    /// All of them. The place of one is its number in a message; new ones are added at the end.
    pub const ALL: [Self; 9] = [
        Self::Rgb8,
        Self::Rgba8,
        Self::Bgr8,
        Self::Bgra8,
        Self::Mono8,
        Self::Mono16,
        Self::Depth16,
        Self::Depth32,
        Self::Yuyv,
    ];

    /// Its name in ROS 2.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rgb8 => "rgb8",
            Self::Rgba8 => "rgba8",
            Self::Bgr8 => "bgr8",
            Self::Bgra8 => "bgra8",
            Self::Mono8 => "mono8",
            Self::Mono16 => "mono16",
            Self::Depth16 => "16UC1",
            Self::Depth32 => "32FC1",
            Self::Yuyv => "yuv422_yuy2",
        }
    }

    /// Bytes of a pixel.
    pub fn bytes(self) -> u32 {
        match self {
            Self::Mono8 => 1,
            Self::Mono16 | Self::Depth16 | Self::Yuyv => 2,
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Rgba8 | Self::Bgra8 | Self::Depth32 => 4,
        }
    }
}

/// An image whose pixels are its data, row by row from the top.
#[derive(Tree, Debug, Clone, Copy, Default, PartialEq)]
pub struct Image {
    /// Rows.
    pub height: f64,
    /// Pixels of a row.
    pub width: f64,
    /// The place of its [`Encoding`] among [all](Encoding::ALL).
    pub encoding: f64,
    /// Bytes from one row to the next.
    pub step: f64,
}

impl Message for Image {
    const NAME: &'static str = "sensor_msgs/Image";
}

impl Image {
    /// An image of this size without gaps between its rows.
    pub fn new(width: u32, height: u32, encoding: Encoding) -> Self {
        let place = Encoding::ALL.iter().position(|known| *known == encoding).unwrap_or(0);
        let step = f64::from(width) * f64::from(encoding.bytes());
        Self { height: height.into(), width: width.into(), encoding: place as f64, step }
    }

    /// Its encoding; `None` when the message names none that is known.
    pub fn encoding(&self) -> Option<Encoding> {
        let place = self.encoding as usize;
        Encoding::ALL.get(place).copied().filter(|_| self.encoding == place as f64)
    }

    /// Bytes of all its rows.
    pub fn bytes(&self) -> usize {
        (self.height * self.step) as usize
    }
}

/// How a [`CompressedImage`] is compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// JPEG.
    Jpeg,
    /// PNG.
    Png,
    /// WebP.
    Webp,
}

impl Format {
    /// All of them. The place of one is its number in a message; new ones are added at the end.
    pub const ALL: [Self; 3] = [Self::Jpeg, Self::Png, Self::Webp];

    /// Its name in ROS 2.
    pub fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "jpeg",
            Self::Png => "png",
            Self::Webp => "webp",
        }
    }
}

/// An image as a file of its format, which is its data.
#[derive(Tree, Debug, Clone, Copy, Default, PartialEq)]
pub struct CompressedImage {
    /// The place of its [`Format`] among [all](Format::ALL).
    pub format: f64,
}

impl Message for CompressedImage {
    const NAME: &'static str = "sensor_msgs/CompressedImage";
}

impl CompressedImage {
    /// An image of this format.
    pub fn new(format: Format) -> Self {
        let place = Format::ALL.iter().position(|known| *known == format).unwrap_or(0);
        Self { format: place as f64 }
    }

    /// Its format; `None` when the message names none that is known.
    pub fn format(&self) -> Option<Format> {
        let place = self.format as usize;
        Format::ALL.get(place).copied().filter(|_| self.format == place as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_knows_its_size_and_encoding() {
        let image = Image::new(640, 480, Encoding::Bgr8);
        assert_eq!((image.bytes(), image.encoding()), (640 * 480 * 3, Some(Encoding::Bgr8)));
        assert_eq!(Image { encoding: 1.5, ..image }.encoding(), None);
        assert_eq!(Image { encoding: -3.0, ..image }.encoding(), None);
        assert_eq!(CompressedImage::new(Format::Png).format(), Some(Format::Png));
    }
}
