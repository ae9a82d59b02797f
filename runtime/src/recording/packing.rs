//! How a recording is packed.

use mcap::{Compression, WriteOptions};
use serde::{Deserialize, Serialize};

use super::Description;

/// Of zstd's levels the fastest one: the recorder has to keep up, and pictures of few colours are small at any level.
const LEVEL: u32 = 1;

/// How the chunks of a recording are packed; they are read alike. It is the recorder's work, not that of the nodes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Packing {
    /// By zstd where messages have [data](crate::data), such as pictures; otherwise not at all.
    #[default]
    Suited,
    /// Not at all.
    Plain,
    /// By zstd.
    Zstd,
}

impl Packing {
    /// As a file that is written has it.
    pub(super) fn of(self, options: WriteOptions, description: &Description) -> WriteOptions {
        let packed = match self {
            Self::Suited => description.nodes.iter().any(|node| node.data > 0),
            Self::Plain => false,
            Self::Zstd => true,
        };
        match packed {
            // Packed by the thread that writes: chunks are small.
            true => {
                options.compression(Some(Compression::Zstd)).compression_level(LEVEL).compression_threads(0)
            }
            false => options.compression(None),
        }
    }
}
