//! Whether how late commands were goes with how large they were: then it is no chance.

use crate::statistics::centred_ranks;

/// Standard deviations of Spearman's rank correlation beyond which it is no chance, and the correlation that it must have.
const BEYOND: f64 = 2.5;
const LEAST: f64 = 0.2;

/// Whether the larger of the commands were later. Values next to each other may be alike in both series, which makes chance
/// correlations larger: of as many independent values as Bartlett's formula says (Bartlett 1946, "On the theoretical specification
/// and sampling properties of autocorrelated time-series", for first-order autocorrelation).
pub(super) fn goes_with_size(late: &[f64], size: &[f64]) -> bool {
    let (late, size) = (centred_ranks(late), centred_ranks(size));
    let along = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let (of_late, of_size) = (along(&late, &late), along(&size, &size));
    if of_late == 0.0 || of_size == 0.0 {
        return false;
    }
    let correlation = along(&late, &size) / (of_late * of_size).sqrt();
    let product = (along(&late, &late[1..]) / of_late) * (along(&size, &size[1..]) / of_size);
    let product = product.clamp(0.0, 0.99);
    let independent = late.len() as f64 * (1.0 - product) / (1.0 + product);
    correlation > LEAST.max(BEYOND / independent.sqrt())
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::goes_with_size;

    /// Smooth by so much from each value to the next.
    fn series(random: &mut ChaCha8Rng, count: usize, smooth: f64) -> Vec<f64> {
        let mut last = 0.0;
        (0..count)
            .map(|_| {
                let z: f64 = StandardNormal.sample(random);
                last = smooth * last + (1.0 - smooth * smooth).sqrt() * z;
                last
            })
            .collect()
    }

    #[test]
    fn chance_that_is_smooth_does_not_go_with_smooth_commands() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        for (count, smooth) in [(40, 0.0), (800, 0.9), (1000, 0.5)] {
            let taken = (0..400).filter(|_| {
                let late = series(&mut random, count, smooth);
                let size: Vec<f64> = series(&mut random, count, smooth).iter().map(|v| v.abs()).collect();
                goes_with_size(&late, &size)
            });
            // 2.5 standard deviations on one side are six of a thousand.
            let taken = taken.count();
            assert!(taken <= 8, "{taken} of 400 of {count} commands");
        }
    }

    #[test]
    fn what_befalls_large_commands_does() {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        for count in [60, 1000] {
            let size: Vec<f64> = (0..count).map(|_| random.random::<f64>()).collect();
            let late: Vec<f64> =
                size.iter().map(|s| f64::from(u8::from(*s > 0.6)) + random.random_range(-0.5..0.5)).collect();
            assert!(goes_with_size(&late, &size));
        }
        assert!(!goes_with_size(&[1.0; 50], &[2.0; 50]), "what never changes tells nothing");
    }
}
