//! Where normalised innovations squared should lie.

use parallax_runtime::delay::special::gamma_cdf;

/// The share of innovations inside of the band.
const INSIDE: f64 = 0.95;

/// For 1 to `most` values: the central 95 % of the χ² distribution with so many degrees of freedom.
pub(crate) fn bands(most: usize) -> Vec<[f64; 2]> {
    let tail = 0.5 * (1.0 - INSIDE);
    (1..=most).map(|count| [quantile(count, tail), quantile(count, 1.0 - tail)]).collect()
}

/// Below this value lies the share `p` of the χ² distribution.
fn quantile(count: usize, p: f64) -> f64 {
    let half = 0.5 * count as f64;
    let (mut low, mut high) = (0.0, 10.0 * half + 100.0);
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if gamma_cdf(half, 0.5 * middle) < p { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bands_are_those_of_the_tables() {
        // NIST/SEMATECH e-Handbook of Statistical Methods, 1.3.6.7.4.
        let tables = [[0.001, 5.024], [0.051, 7.378], [0.216, 9.348], [0.484, 11.143]];
        for (band, table) in bands(4).iter().zip(tables) {
            assert!(
                (band[0] - table[0]).abs() < 6e-4 && (band[1] - table[1]).abs() < 6e-4,
                "{band:?} {table:?}"
            );
        }
    }
}
