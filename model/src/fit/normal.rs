//! Random numbers that are named by seed, round and generation.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal, StandardUniform};

/// The stream of one generation. The same arguments give the same numbers on every machine.
pub(super) fn stream(seed: u64, round: u64, generation: u64) -> ChaCha8Rng {
    let mut key = [0u8; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&round.to_le_bytes());
    key[16..24].copy_from_slice(&generation.to_le_bytes());
    key[24..].copy_from_slice(b"fit\0\0\0\0\0");
    ChaCha8Rng::from_seed(key)
}

/// The next standard normal numbers, `count` of them.
pub(super) fn draw(stream: &mut ChaCha8Rng, count: usize) -> Vec<f64> {
    (0..count).map(|_| StandardNormal.sample(stream)).collect()
}

/// A number between 0 and 1.
pub(super) fn even(stream: &mut ChaCha8Rng) -> f64 {
    StandardUniform.sample(stream)
}
