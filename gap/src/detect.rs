//! Whether there is a gap at all: a score test over the whole library, calibrated as the maximum of many.
//!
//! Under the null model the whitened innovations are independent standard normal. Each effect's sensitivities span a
//! few directions; the squared length of the innovations along them is χ² distributed. The smallest of the
//! p-values over all effects is compared with its distribution under simulated nulls.

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::signature::{Nuisance, orthonormal};

/// Simulated nulls from which the maximum is calibrated.
const NULLS: usize = 4000;

/// The probability, by chance alone, of a score as high as the highest one.
///
/// `groups` holds, for each candidate, its sensitivities (readings × parameters).
#[must_use]
pub fn p_value(nuisance: &Nuisance, groups: &[DMatrix<f64>], seed: u64) -> f64 {
    let bases: Vec<DMatrix<f64>> =
        groups.iter().map(|g| orthonormal(&nuisance.project_columns(g))).filter(|b| b.ncols() > 0).collect();
    if bases.is_empty() {
        return 1.0;
    }
    let columns: Vec<DVector<f64>> =
        bases.iter().flat_map(|b| b.column_iter().map(|c| c.into_owned())).collect();
    let joint = orthonormal(&DMatrix::from_columns(&columns));
    let seen = joint.transpose() * &nuisance.innovations;
    let maps: Vec<DMatrix<f64>> = bases.iter().map(|b| b.transpose() * &joint).collect();
    // All maps in one, all draws in one: a single product instead of thousands.
    let rows: Vec<usize> = maps.iter().map(DMatrix::nrows).collect();
    let mut all = DMatrix::zeros(rows.iter().sum(), joint.ncols());
    let mut first = 0;
    for map in &maps {
        all.rows_mut(first, map.nrows()).copy_from(map);
        first += map.nrows();
    }
    let smallest = |along: &[f64]| {
        let mut first = 0;
        let tails = rows.iter().map(|count| {
            let own = &along[first..first + count];
            first += count;
            log_chi_square_tail(own.iter().map(|v| v * v).sum(), *count)
        });
        tails.fold(0.0, f64::min)
    };
    let observed = smallest((&all * &seen).as_slice());
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let draws = DMatrix::from_fn(joint.ncols(), NULLS, |_, _| StandardNormal.sample(&mut random));
    let along = all * draws;
    let mut nulls: Vec<f64> = along.as_slice().par_chunks(along.nrows()).map(smallest).collect();
    nulls.sort_by(f64::total_cmp);
    let below = nulls.partition_point(|v| *v <= observed);
    if below >= 20 {
        return below as f64 / NULLS as f64;
    }
    // Beyond what was simulated the tail is that of independent tests, as many as match the simulated 1 % point.
    let at = NULLS / 100;
    let effective = 0.01 / nulls[at].exp();
    (effective.max(1.0) * observed.exp()).clamp(f64::MIN_POSITIVE, 20.0 / NULLS as f64)
}

/// Share of a false alarm's probability that is spent on the evidence; the score test has the rest.
const SPENT: f64 = 0.01;

/// The probability, by chance alone, of a score this high or of an evidence this strong.
///
/// A score test looks at readings in units of what the null model takes for noise, and a large gap is taken for much
/// noise. The evidence for a gap against none has an expectation of at most 1 where there is none, so that it exceeds
/// 1/α with a probability of at most α (Markov; Vovk & Wang 2021, e-values), and its tempered form all the more.
#[must_use]
pub fn by_either(score: f64, log_evidence: f64) -> f64 {
    let by_evidence = ((-log_evidence).exp() / SPENT).max(f64::MIN_POSITIVE);
    ((1.0 + SPENT) * score.min(by_evidence)).min(1.0)
}

/// Natural logarithm of P(χ²_k > x).
fn log_chi_square_tail(x: f64, degrees: usize) -> f64 {
    if degrees == 0 || x <= 0.0 {
        return 0.0;
    }
    // The recursion of the upper incomplete gamma function: Q(a + 1, h) = Q(a, h) + h^a e^−h / Γ(a + 1)
    // (Abramowitz & Stegun 6.5.21), from erfc for odd and e^−h for even degrees, in logarithms.
    let h = 0.5 * x;
    let even = degrees.is_multiple_of(2);
    let mut a = if even { 1.0 } else { 0.5 };
    let mut log_q = if even { -h } else { log_erfc(h.sqrt()) };
    // h^a e^−h / Γ(a + 1), with Γ(2) = 1 and Γ(3/2) = √π/2.
    let mut log_term =
        if even { h.ln() - h } else { 0.5 * h.ln() - h - (0.5 * std::f64::consts::PI.sqrt()).ln() };
    while a + 0.25 < 0.5 * degrees as f64 {
        log_q = log_sum(log_q, log_term);
        a += 1.0;
        log_term += h.ln() - a.ln();
    }
    log_q.min(0.0)
}

fn log_sum(a: f64, b: f64) -> f64 {
    let m = a.max(b);
    m + ((a - m).exp() + (b - m).exp()).ln()
}

/// ln erfc(z) for z ≥ 0 (Numerical Recipes, third edition, section 6.2.2: fractional error below 1.2e-7).
fn log_erfc(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.5 * z);
    let polynomial = -z * z - 1.265_512_23
        + t * (1.000_023_68
            + t * (0.374_091_96
                + t * (0.096_784_18
                    + t * (-0.186_288_06
                        + t * (0.278_868_07
                            + t * (-1.135_203_98
                                + t * (1.488_515_87 + t * (-0.822_152_23 + t * 0.170_872_77))))))));
    t.ln() + polynomial
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chi_square_tails_match_tables() {
        // Abramowitz & Stegun, table 26.8: the 5 % and 0.1 % points.
        for (degrees, five, tenth) in [
            (1, 3.841, 10.828),
            (2, 5.991, 13.816),
            (3, 7.815, 16.266),
            (5, 11.070, 20.515),
            (10, 18.307, 29.588),
        ] {
            assert!((log_chi_square_tail(five, degrees).exp() - 0.05).abs() < 2e-4, "{degrees}");
            assert!((log_chi_square_tail(tenth, degrees).exp() - 0.001).abs() < 1e-5, "{degrees}");
        }
        assert!(log_chi_square_tail(2000.0, 1) < -990.0);
    }

    #[test]
    fn strong_evidence_is_a_gap_and_weak_evidence_spends_little() {
        assert!(by_either(0.3, 30.0) < 1e-10);
        // 1 : 100 in favour of a gap is what chance shows more often than it may.
        assert_eq!(by_either(1.0, 100.0_f64.ln()), 1.0);
        for score in [0.005, 0.2] {
            assert!((by_either(score, 0.0) / score - 1.0).abs() < 0.02);
        }
        assert!(by_either(1.0, f64::INFINITY) > 0.0 && by_either(1.0, f64::NEG_INFINITY) == 1.0);
    }

    #[test]
    fn white_innovations_are_no_gap_and_a_signature_is_one() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let rows = 500;
        let mut draw = || DVector::from_fn(rows, |_, _| StandardNormal.sample(&mut random));
        let groups: Vec<DMatrix<f64>> = (0..12).map(|_| DMatrix::from_columns(&[draw(), draw()])).collect();
        let mut below = 0;
        for seed in 0..100 {
            let nuisance = Nuisance::plain(draw());
            below += u32::from(p_value(&nuisance, &groups, seed) < 0.1);
        }
        assert!((3..=20).contains(&below), "{below} of 100 nulls below 0.1");
        let loud = draw() + groups[3].column(0) * 0.4;
        assert!(p_value(&Nuisance::plain(loud), &groups, 1) < 1e-6);
    }
}
