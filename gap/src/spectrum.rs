//! Lines that stand out of innovations: where to start the search for a periodic cause.
//!
//! A sinusoid's frequency has a narrow minimum in any loss, as wide as one over the length of the log, so that no
//! fixed list of starts finds it; the innovations of the model without it show where it is.

/// Most lines that are given.
const LINES: usize = 4;

/// The strongest frequencies (Hz) of values stamped at these times (s), about one `period` apart.
#[must_use]
pub fn frequencies(stamps: &[f64], values: &[f64], period: f64) -> Vec<f64> {
    let (Some(first), Some(last)) = (stamps.first(), stamps.last()) else { return Vec::new() };
    let (from, span) = (first.min(*last), (last - first).abs());
    let count = ((span / period) as usize + 1).next_power_of_two();
    // Twice as long: a line between two bins loses less than a tenth.
    let mut bins = vec![(0.0, 0.0); (2 * count).clamp(2, 1 << 16)];
    for (stamp, value) in stamps.iter().zip(values) {
        let at = ((stamp - from) / period).round();
        if at >= 0.0 && (at as usize) < bins.len() && value.is_finite() {
            bins[at as usize].0 += value;
        }
    }
    let n = bins.len();
    transform(&mut bins);
    let power: Vec<f64> = bins[..n / 2].iter().map(|(a, b)| a * a + b * b).collect();
    // Less than two periods in the log is a trend.
    let least = (2.0 * n as f64 * period / span.max(period)).ceil() as usize;
    peaks(&power, least, 4).into_iter().map(|bin| bin as f64 / (n as f64 * period)).collect()
}

/// The strongest wavenumbers N of sin(N x + φ) in values at these positions.
#[must_use]
pub fn wavenumbers(positions: &[f64], values: &[f64]) -> Vec<f64> {
    let (low, high) = positions
        .iter()
        .filter(|x| x.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(*x), high.max(*x)));
    let range = high - low;
    if !(range > 0.0 && range.is_finite()) {
        return Vec::new();
    }
    // Steps that resolve a line over this range, up to 64 waves over it or 48 per turn.
    let step = std::f64::consts::PI / range;
    let most = (64.0 * std::f64::consts::TAU / range).max(48.0);
    let count = ((most / step).ceil() as usize).min(4096);
    let power: Vec<f64> = (0..count)
        .map(|k| {
            let wavenumber = step * k as f64;
            let (mut sine, mut cosine) = (0.0, 0.0);
            for (x, value) in positions.iter().zip(values) {
                if x.is_finite() && value.is_finite() {
                    let (s, c) = (wavenumber * x).sin_cos();
                    sine += s * value;
                    cosine += c * value;
                }
            }
            sine * sine + cosine * cosine
        })
        .collect();
    peaks(&power, 2, 2).into_iter().map(|k| step * k as f64).collect()
}

/// Indices of the largest local maxima from `least` on, at least `apart` from each other.
fn peaks(power: &[f64], least: usize, apart: usize) -> Vec<usize> {
    let mut found: Vec<usize> = (least.max(1)..power.len().saturating_sub(1))
        .filter(|&k| power[k] > power[k - 1] && power[k] >= power[k + 1])
        .collect();
    found.sort_by(|a, b| power[*b].total_cmp(&power[*a]));
    let mut kept: Vec<usize> = Vec::new();
    for k in found {
        if kept.len() < LINES && kept.iter().all(|other| k.abs_diff(*other) >= apart) {
            kept.push(k);
        }
    }
    kept
}

/// The discrete Fourier transform in place, for a power of two of complex numbers (Cooley & Tukey 1965).
fn transform(values: &mut [(f64, f64)]) {
    let n = values.len();
    let bits = n.trailing_zeros();
    for k in 0..n {
        let mirrored = k.reverse_bits() >> (usize::BITS - bits);
        if mirrored > k {
            values.swap(k, mirrored);
        }
    }
    let mut length = 2;
    while length <= n {
        let angle = -std::f64::consts::TAU / length as f64;
        for start in (0..n).step_by(length) {
            for k in 0..length / 2 {
                let (sin, cos) = (angle * k as f64).sin_cos();
                let (a, b) = (values[start + k], values[start + k + length / 2]);
                let turned = (b.0 * cos - b.1 * sin, b.0 * sin + b.1 * cos);
                values[start + k] = (a.0 + turned.0, a.1 + turned.1);
                values[start + k + length / 2] = (a.0 - turned.0, a.1 - turned.1);
            }
        }
        length *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_found() {
        let stamps: Vec<f64> = (0..1500).map(|k| f64::from(k) * 0.01).collect();
        let values: Vec<f64> = stamps
            .iter()
            .enumerate()
            .map(|(k, t)| {
                (2.0 * std::f64::consts::PI * 7.3 * t + 1.0).sin() + ((k * 7919) % 13) as f64 / 13.0
            })
            .collect();
        let found = frequencies(&stamps, &values, 0.01);
        assert!((found[0] - 7.3).abs() < 0.04, "{found:?}");
        let positions: Vec<f64> = stamps.iter().map(|t| 2.0 * (1.7 * t).sin()).collect();
        let values: Vec<f64> = positions.iter().map(|x| (6.0 * x + 0.4).sin()).collect();
        let found = wavenumbers(&positions, &values);
        assert!((found[0] - 6.0).abs() < 0.5, "{found:?}");
        assert!(frequencies(&[], &[], 0.01).is_empty() && wavenumbers(&[1.0, 1.0], &[0.0, 1.0]).is_empty());
    }
}
