//! Looking from one end of the box to the other where a search would end.
//!
//! Some losses jump: by a delay a message comes in time for a step, or not. A search comes to rest at such an edge before what
//! else it moves is at its best, for every step that would be better all round crosses it. Along one parameter, with the others
//! where a Gauss–Newton model has its minimum under that, what lies behind shows.

use nalgebra::{DMatrix, DVector};

use super::{Bounds, Local};

/// At so many places of each parameter it is looked.
const PLACES: usize = 12;
/// The others stay within this share of the box's width of where they are, as far as the data do not tell.
const WEAK: f64 = 0.3;

/// Points along these parameters of a box that is closed, by the model `local` at `point`.
pub(super) fn along(point: &[f64], local: &Local, bounds: &Bounds, swept: &[usize]) -> Vec<Vec<f64>> {
    let n = point.len();
    let (low, high) = (bounds.low(), bounds.high());
    let information = DMatrix::from_row_slice(n, n, &local.information);
    let mut found = Vec::new();
    for &swept in swept.iter().filter(|&&i| i < n && (high[i] - low[i]).is_finite()) {
        let others: Vec<usize> = (0..n).filter(|&i| i != swept).collect();
        let weak = |i: usize| (bounds.scale(i, point[i]) * WEAK).powi(-2);
        let inner = DMatrix::from_fn(n - 1, n - 1, |i, j| {
            let own = if i == j { weak(others[i]) } else { 0.0 };
            information[(others[i], others[j])] + own
        });
        let Some(factor) = inner.cholesky() else { continue };
        let follow = factor.solve(&DVector::from_fn(n - 1, |i, _| information[(others[i], swept)]));
        let shift = factor.solve(&DVector::from_fn(n - 1, |i, _| local.gradient[others[i]]));
        for place in 0..PLACES {
            let share = (place as f64 + 0.5) / PLACES as f64;
            let mut moved = point.to_vec();
            moved[swept] = low[swept] + share * (high[swept] - low[swept]);
            let by = moved[swept] - point[swept];
            for ((&other, slope), shift) in others.iter().zip(follow.iter()).zip(shift.iter()) {
                moved[other] -= slope * by + shift;
            }
            bounds.clamp(&mut moved);
            found.push(moved);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn behind_an_edge_the_others_are_where_they_belong() {
        // (x + y − 0.9)² + (y − 0.3)², times a thousand, seen from (0.2, 0.6): under x the best y is (1.2 − x)/2.
        let residuals = [0.2 + 0.6 - 0.9, 0.6 - 0.3];
        let local = Local {
            cost: 0.0,
            information: [1.0, 1.0, 1.0, 2.0].map(|value| 1e3 * value).to_vec(),
            gradient: vec![1e3 * residuals[0], 1e3 * (residuals[0] + residuals[1])],
        };
        let points = along(&[0.2, 0.6], &local, &Bounds::unit(2), &[0]);
        assert_eq!(points.len(), PLACES);
        for point in points {
            assert!((point[1] - 0.5 * (1.2 - point[0])).abs() < 0.01, "{point:?}");
        }
    }
}
