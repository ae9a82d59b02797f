//! Which points of a search are worth going on from.

use crate::fit::{Best, Bounds, LevenbergMarquardt};

/// Where a search has ended, best first.
pub(super) fn ends(search: &LevenbergMarquardt) -> Vec<Best> {
    let mut ends: Vec<Best> = Vec::new();
    for (point, loss) in search.ends() {
        if let Some(loss) = loss.filter(|loss| loss.is_finite()) {
            ends.push(Best { point: point.to_vec(), loss });
        }
    }
    ends.sort_by(|a, b| a.loss.total_cmp(&b.loss));
    ends
}

/// The points whose losses are not far above the least and differ from each other: where the data are all seen, one loss is
/// one minimum.
pub(super) fn distinct(ends: &[Best]) -> Vec<Vec<f64>> {
    let mut kept: Vec<&Best> = Vec::new();
    for end in ends {
        let least = kept.first().map_or(end.loss, |best| best.loss);
        let near = kept.iter().any(|other| (other.loss - end.loss).abs() < 0.5);
        if !near && end.loss <= least + 2.0 * least.abs() + 10.0 {
            kept.push(end);
        }
    }
    kept.into_iter().map(|end| end.point.clone()).collect()
}

/// The first `count` points, best first, that lie apart from each other.
pub(super) fn apart(points: &[Best], count: usize, bounds: &Bounds) -> Vec<Vec<f64>> {
    let mut found: Vec<Vec<f64>> = Vec::new();
    let mut losses: Vec<f64> = Vec::new();
    for Best { point, loss } in points {
        let near = |other: &Vec<f64>| {
            let square = point.iter().zip(other).enumerate().map(|(i, (a, b))| {
                let width = bounds.scale(i, *a);
                ((a - b) / width).powi(2)
            });
            square.sum::<f64>().sqrt() < 1e-3
        };
        // Where not everything is determined, one minimum has many points.
        let same = |other: &f64| (loss - other).abs() <= 1e-3 + 1e-7 * loss.abs();
        if found.len() < count && !found.iter().any(near) && !losses.iter().any(same) {
            found.push(point.clone());
            losses.push(*loss);
        }
    }
    found
}
