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

/// How many times likelier under outliers a reading must be than under noise, once there are outliers, and the deviation in units of
/// the local noise below which it never counts.
const LIKELIER: f64 = 10.0;
const NEAREST: f64 = 4.0;

/// Rounds in which suspects are looked at again, and how many in a row may be outliers.
const ROUNDS: usize = 8;
const IN_A_ROW: usize = 3;

/// Marks lone readings far from their neighbours, beside those that are `marked` already. `floor` is the least noise that is
/// believed, `far` the deviation in units of the local noise from which a reading is suspicious.
///
/// The largest goes first: it is replaced by what its neighbours say, so that it does not spoil theirs. A jump, which
/// two readings share, stays.
fn mark_lone(local: &mut Local, marked: &mut [bool], scale: &[f64], far: f64) {
    let n = local.value.len();
    for _ in 0..8 {
        let residuals = local.residuals();
        let size = |k: usize| residuals.get(k).copied().flatten().map_or(0.0, f64::abs);
        let mut suspects: Vec<usize> = (1..n.saturating_sub(1))
            .filter(|&k| {
                let lone = size(k) > LONE * size(k - 1).max(size(k + 1));
                size(k) > far * scale[k] && lone && !marked[k]
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
}

/// Marks lone readings far from their neighbours.
pub(super) fn mark(local: &mut Local, floor: f64) -> Vec<bool> {
    let mut marked = vec![false; local.value.len()];
    let scale = scales(&local.residuals(), floor);
    mark_lone(local, &mut marked, &scale, FAR);
    marked
}

/// Marks what is likely to be an outlier where such readings lie so `far` (a standard deviation) from the noise of `std` at this
/// `rate`: those that follow each other closely as well, and those that are not so far. `local` is as it was read.
///
/// Whatever is far from its neighbours is suspected first, and acquitted where it is near what those say that are not suspected.
pub(super) fn mark_again(local: &mut Local, floor: f64, rate: f64, (std, far): (f64, f64)) -> Vec<bool> {
    let n = local.value.len();
    let scale = scales(&local.residuals(), floor);
    let odds = (LIKELIER * (1.0 - rate) / rate * far / std).max(1.0);
    let most = (2.0 * odds.ln()).sqrt().max(NEAREST);
    let mut marked = vec![false; n];
    for _ in 0..ROUNDS {
        let is_far = |k: usize| local.residual_without(k, &marked).is_some_and(|(r, _)| r.abs() > most * scale[k]);
        let again: Vec<bool> = (0..n).map(is_far).collect();
        if again == marked {
            break;
        }
        marked = again;
    }
    // Many in a row are no outliers: beside a jump, what lies before it and what lies behind it do not fit.
    for row in marked.chunk_by_mut(|a, b| a == b).filter(|row| row.len() > IN_A_ROW) {
        row.fill(false);
    }
    let instead = |k: usize| {
        let (residual, factor) = local.residual_without(k, &marked)?;
        Some(local.value[k] - residual * factor)
    };
    let replaced: Vec<Option<f64>> = (0..n).map(|k| if marked[k] { instead(k) } else { None }).collect();
    for (value, instead) in local.value.iter_mut().zip(replaced) {
        *value = instead.unwrap_or(*value);
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
