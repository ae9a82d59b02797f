//! Random streams: one per purpose and name, all from the run's seed.
//!
//! Streams do not share state, so adding a node or drawing more often in one place changes no number anywhere else.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// What a stream is for. Two purposes never share numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// How long a node's steps take.
    Computation,
    /// How long a connection's messages travel.
    Communication,
    /// What a node draws in its own steps.
    Node,
    /// The seed of something else.
    Seed,
}

/// A seed for something of its own, from which `seed` cannot be told.
pub fn derived(seed: u64, name: &str) -> u64 {
    stream(seed, Purpose::Seed, name).next_u64()
}

/// The stream for `purpose` of the node or connection called `name`. The same arguments give the same numbers, on every
/// machine.
pub fn stream(seed: u64, purpose: Purpose, name: &str) -> ChaCha8Rng {
    let purpose = match purpose {
        Purpose::Computation => 1u64,
        Purpose::Communication => 2,
        Purpose::Node => 3,
        Purpose::Seed => 4,
    };
    let mut key = [0u8; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&purpose.to_le_bytes());
    key[16..24].copy_from_slice(&fnv1a(name.as_bytes()).to_le_bytes());
    key[24..].copy_from_slice(&(name.len() as u64).to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

/// The 64-bit FNV-1a hash (Fowler, Noll, Vo; offset basis and prime of the published 64-bit variant).
pub(crate) fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use rand_chacha::rand_core::Rng;

    use super::*;

    #[test]
    fn a_stream_repeats_and_differs_by_seed_purpose_and_name() {
        let first = stream(1, Purpose::Node, "camera").next_u64();
        assert_eq!(first, stream(1, Purpose::Node, "camera").next_u64());
        assert_ne!(first, stream(2, Purpose::Node, "camera").next_u64());
        assert_ne!(first, stream(1, Purpose::Computation, "camera").next_u64());
        assert_ne!(first, stream(1, Purpose::Node, "motor").next_u64());
    }

    #[test]
    fn the_hash_is_the_published_one() {
        assert_eq!(fnv1a(b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a(b"a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(fnv1a(b"foobar"), 0x8594_4171_f739_67e8);
    }
}
