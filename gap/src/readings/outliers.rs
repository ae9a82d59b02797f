//! Readings that lie far from their neighbours, one at a time.

use super::local::Local;
use super::peak::{Peak, peak};
use crate::statistics::median;

/// Deviations in units of the local noise from which a reading is suspicious.
const FAR: f64 = 6.0;

/// Readings around one whose scatter is the local noise.
const AROUND: usize = 100;

/// How much larger the residual of a lone outlier is than those of its neighbours: 1.5 exactly.
const LONE: f64 = 1.2;

/// Marks lone readings far from their neighbours. `floor` is the least noise that is believed.
///
/// The largest goes first: it is replaced by what its neighbours say, so that it does not spoil theirs. A jump, which
/// two readings share, stays.
pub(super) fn mark(local: &mut Local, floor: f64) -> Vec<bool> {
    let n = local.value.len();
    let mut marked = vec![false; n];
    let scale = scales(&local.residuals(), floor);
    for _ in 0..8 {
        let residuals = local.residuals();
        let size = |k: usize| residuals.get(k).copied().flatten().map_or(0.0, f64::abs);
        let mut suspects: Vec<usize> = (1..n.saturating_sub(1))
            .filter(|&k| {
                let lone = size(k) > LONE * size(k - 1).max(size(k + 1));
                size(k) > FAR * scale[k] && lone && !marked[k]
            })
            .collect();
        if suspects.is_empty() {
            break;
        }
        suspects.sort_by(|a, b| size(*b).total_cmp(&size(*a)).then(a.cmp(b)));
        let mut touched = vec![false; n];
        for k in suspects {
            // What was replaced nearby in this round has changed this one's neighbours.
            if touched[k.saturating_sub(3)..(k + 4).min(n)].iter().any(|t| *t) {
                continue;
            }
            let Some((residual, factor)) = local.residual(k) else { continue };
            local.value[k] -= residual * factor;
            (marked[k], touched[k]) = (true, true);
        }
    }
    marked
}

/// The local noise of each reading.
fn scales(residuals: &[Option<f64>], floor: f64) -> Vec<f64> {
    let all: Vec<f64> = residuals.iter().map(|r| r.map_or(0.0, f64::abs)).collect();
    let typical = 1.4826 * median(&mut all.clone());
    let blocks: Vec<f64> = all.chunks(AROUND).map(|b| 1.4826 * median(&mut b.to_vec())).collect();
    (0..all.len())
        .map(|k| {
            let here = k / AROUND;
            let around = blocks[here.saturating_sub(1)..(here + 2).min(blocks.len())].iter();
            around.copied().fold(floor.max(0.5 * typical), f64::max)
        })
        .collect()
}

/// Density of a residual under noise of `std` and, at a `rate`, of `far` instead; its logarithm.
pub(super) fn log_mixture(residual: f64, rate: f64, std: f64, far: f64) -> f64 {
    let log = |s: f64| -0.5 * (residual / s).powi(2) - (s * std::f64::consts::TAU.sqrt()).ln();
    let (near, wide) = ((1.0 - rate).ln() + log(std), rate.ln() + log(far));
    let most = near.max(wide);
    most + ((near - most).exp() + (wide - most).exp()).ln()
}

/// The rate's posterior, given the noise and the size of outliers.
pub(super) fn rate(residuals: &[f64], independence: f64, std: f64, far: f64) -> Peak {
    peak(1e-4, 0.5, |rate| {
        independence * residuals.iter().map(|r| log_mixture(*r, rate, std, far)).sum::<f64>()
    })
}
