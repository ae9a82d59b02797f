//! The functions of the normal and gamma distributions that delays need.

use std::f64::consts::{PI, SQRT_2};

/// Density of the standard normal distribution.
#[inline]
pub fn normal_density(z: f64) -> f64 {
    (-0.5 * z * z).exp() / (2.0 * PI).sqrt()
}

/// Distribution function of the standard normal distribution; exact to relative 1e-15 in the lower tail too.
#[inline]
pub fn normal_cdf(z: f64) -> f64 {
    0.5 * libm::erfc(-z / SQRT_2)
}

/// Quantile of the standard normal distribution at `p` in (0, 1); ∓∞ at and beyond the ends.
///
/// Acklam's rational approximation (relative error 1.2e-9), refined by one step of Halley's method.
pub fn normal_quantile(p: f64) -> f64 {
    const A: [f64; 6] = [
        -3.969_683_028_665_376e1,
        2.209_460_984_245_205e2,
        -2.759_285_104_469_687e2,
        1.383_577_518_672_69e2,
        -3.066_479_806_614_716e1,
        2.506_628_277_459_239,
    ];
    const B: [f64; 5] = [
        -5.447_609_879_822_406e1,
        1.615_858_368_580_409e2,
        -1.556_989_798_598_866e2,
        6.680_131_188_771_972e1,
        -1.328_068_155_288_572e1,
    ];
    const C: [f64; 6] = [
        -7.784_894_002_430_293e-3,
        -3.223_964_580_411_365e-1,
        -2.400_758_277_161_838,
        -2.549_732_539_343_734,
        4.374_664_141_464_968,
        2.938_163_982_698_783,
    ];
    const D: [f64; 4] =
        [7.784_695_709_041_462e-3, 3.224_671_290_700_398e-1, 2.445_134_137_142_996, 3.754_408_661_907_416];
    const TAIL: f64 = 0.02425;
    if p.is_nan() {
        return f64::NAN;
    }
    if p <= 0.0 {
        return f64::NEG_INFINITY;
    }
    if p >= 1.0 {
        return f64::INFINITY;
    }
    let polynomial = |c: &[f64], x: f64| c.iter().fold(0.0, |sum, c| sum * x + c);
    let tail = |p: f64| {
        let q = (-2.0 * p.ln()).sqrt();
        polynomial(&C, q) / (polynomial(&D, q) * q + 1.0)
    };
    let z = if p < TAIL {
        tail(p)
    } else if p > 1.0 - TAIL {
        -tail(1.0 - p)
    } else {
        let q = p - 0.5;
        let r = q * q;
        q * polynomial(&A, r) / (polynomial(&B, r) * r + 1.0)
    };
    // In the upper half the complement keeps the digits.
    let error = if z <= 0.0 { normal_cdf(z) - p } else { (1.0 - p) - normal_cdf(-z) };
    let step = error / normal_density(z);
    let refined = z - step / (1.0 + 0.5 * z * step);
    if refined.is_finite() { refined } else { z }
}

/// The regularised lower incomplete gamma function P(a, x), for `a` > 0: the distribution function at `x` of the gamma
/// distribution of shape `a` and scale 1. Absolute error below 1e-12 up to shapes of 1e4, below 1e-6 beyond.
///
/// Series and continued fraction (Abramowitz and Stegun 6.5.29 and 6.5.31, the latter by Lentz's method); beyond a shape
/// of 1e4, where they need thousands of terms, the cube root of a gamma variable counts as normal (Wilson and Hilferty
/// 1931).
pub fn gamma_cdf(a: f64, x: f64) -> f64 {
    if x.is_nan() || x <= 0.0 {
        return 0.0;
    }
    if x == f64::INFINITY {
        return 1.0;
    }
    if a > LARGE_SHAPE {
        return normal_cdf(3.0 * a.sqrt() * ((x / a).cbrt() - 1.0 + 1.0 / (9.0 * a)));
    }
    let factor = (a * x.ln() - x - libm::lgamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        for _ in 0..10_000 {
            n += 1.0;
            term *= x / n;
            sum += term;
            if term < sum * 1e-16 {
                break;
            }
        }
        (sum * factor).min(1.0)
    } else {
        let tiny = 1e-300;
        let mut b = x + 1.0 - a;
        let (mut c, mut d) = (1.0 / tiny, 1.0 / b);
        let mut h = d;
        for i in 1..10_000 {
            let i = f64::from(i);
            let an = -i * (i - a);
            b += 2.0;
            d = an * d + b;
            d = 1.0 / if d.abs() < tiny { tiny } else { d };
            c = b + an / c;
            c = if c.abs() < tiny { tiny } else { c };
            h *= d * c;
            if (d * c - 1.0).abs() < 1e-16 {
                break;
            }
        }
        (1.0 - factor * h).clamp(0.0, 1.0)
    }
}

/// Shapes beyond which the normal approximation of the cube root is used.
const LARGE_SHAPE: f64 = 1e4;

/// Density at `x` of the gamma distribution of shape `a` and scale 1.
pub fn gamma_density(a: f64, x: f64) -> f64 {
    if x.is_nan() || x < 0.0 {
        return 0.0;
    }
    ((a - 1.0) * x.ln() - x - libm::lgamma(a)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        // Tables of the standard normal and of chi-square distributions (chi-square of k: shape k/2 at x/2).
        assert!((normal_cdf(1.959_963_984_540_054) - 0.975).abs() < 1e-15);
        assert!((normal_quantile(0.975) - 1.959_963_984_540_054).abs() < 1e-13);
        assert!((normal_quantile(1e-300) + 37.047_096).abs() < 1e-4);
        assert!((gamma_cdf(0.5, 3.841_458_820_694_124 / 2.0) - 0.95).abs() < 1e-12);
        assert!((gamma_cdf(5.0, 18.307_038_053_275_14 / 2.0) - 0.95).abs() < 1e-12);
        assert!((gamma_cdf(1.0, 2.0) - (1.0 - (-2.0_f64).exp())).abs() < 1e-14);
        assert!((gamma_density(1.0, 2.0) - (-2.0_f64).exp()).abs() < 1e-15);
    }

    #[test]
    fn the_quantile_inverts_the_distribution() {
        for i in 1..2000 {
            let p = f64::from(i) / 2000.0;
            assert!((normal_cdf(normal_quantile(p)) - p).abs() < 1e-14, "{p}");
        }
        assert_eq!((normal_quantile(0.0), normal_quantile(1.0)), (f64::NEG_INFINITY, f64::INFINITY));
    }

    #[test]
    fn large_shapes_go_over_smoothly() {
        let (below, above) = (LARGE_SHAPE, LARGE_SHAPE * (1.0 + 1e-12));
        for i in -40..=40 {
            let x = LARGE_SHAPE + f64::from(i) * 10.0;
            assert!((gamma_cdf(below, x) - gamma_cdf(above, x)).abs() < 1e-6, "{x}");
        }
    }
}
