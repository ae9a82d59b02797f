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

/// Rounds in which suspects are looked at again, and how many in a row may be outliers.
const ROUNDS: usize = 8;
const IN_A_ROW: usize = 3;

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

/// Marks readings far from their neighbours where there are outliers: those that follow each other closely as well. `local` is as
/// it was read, and gets what their neighbours say in their place.
///
/// Whatever is far from its neighbours is suspected first, and acquitted where it is near what those say that are not suspected.
pub(super) fn mark_again(local: &mut Local, floor: f64) -> Vec<bool> {
    let n = local.value.len();
    let scale = scales(&local.residuals(), floor);
    let mut marked = vec![false; n];
    for round in 0..ROUNDS {
        let is_far =
            |k: usize| local.residual_without(k, &marked).is_some_and(|(r, _)| r.abs() > FAR * scale[k]);
        let mut again: Vec<bool> = (0..n).map(is_far).collect();
        if round == 0 {
            // Two that are off alike make those beside them look worse than themselves.
            let near = |k: usize| again[k.saturating_sub(1)..(k + 2).min(n)].contains(&true);
            again = (0..n).map(near).collect();
        }
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

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const NOISE: f64 = 0.003;

    /// A smooth motion that is noisy, and jumps at the end.
    fn moved() -> (Vec<f64>, Vec<f64>) {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(8);
        let stamp: Vec<f64> = (0..1000).map(|k| 0.01 * f64::from(k)).collect();
        let noisy = |t: &f64| {
            let z: f64 = StandardNormal.sample(&mut random);
            (2.0 * t).sin() + NOISE * z + f64::from(u8::from(*t > 9.0))
        };
        let value = stamp.iter().map(noisy).collect();
        (stamp, value)
    }

    fn of(marked: &[bool]) -> Vec<usize> {
        (0..marked.len()).filter(|k| marked[*k]).collect()
    }

    #[test]
    fn outliers_close_to_each_other_are_all_marked_and_a_jump_is_not() {
        let (stamp, clean) = moved();
        let far: [(usize, f64); 9] = [
            (100, 60.0),
            (300, -45.0),
            (301, 80.0),
            (500, 50.0),
            (502, 50.0),
            (600, 30.0),
            (601, 30.0),
            (700, -70.0),
            (703, 90.0),
        ];
        let mut value = clean.clone();
        far.iter().for_each(|(k, size)| value[*k] += size * NOISE);
        let mut local = Local::new(stamp, value, None);
        let marked = mark_again(&mut local, NOISE);
        assert_eq!(of(&marked), far.map(|(k, _)| k));
        // What stands in their place is what the neighbours say.
        for (k, _) in far {
            assert!(
                (local.value[k] - clean[k]).abs() < 5.0 * NOISE,
                "{k}: {} for {}",
                local.value[k],
                clean[k]
            );
        }
    }
}
