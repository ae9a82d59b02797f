//! Boxes, and how a search in them stays differentiable and free of walls.

use serde::{Deserialize, Serialize};

use super::FitError;

/// The share of a box's width, at each end, in which the fold is a parabola.
const MARGIN: f64 = 0.05;

/// A lower and an upper bound for every parameter; either may be infinite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    low: Vec<f64>,
    high: Vec<f64>,
}

impl Bounds {
    /// The box between two corners.
    ///
    /// # Errors
    ///
    /// [`FitError::Count`] and [`FitError::Bounds`].
    pub fn new(low: Vec<f64>, high: Vec<f64>) -> Result<Self, FitError> {
        if low.len() != high.len() {
            return Err(FitError::Count { what: "upper bounds", found: high.len(), expected: low.len() });
        }
        match low.iter().zip(&high).position(|(low, high)| low.is_nan() || high.is_nan() || low >= high) {
            Some(index) => Err(FitError::Bounds { index, low: low[index], high: high[index] }),
            None => Ok(Self { low, high }),
        }
    }

    /// From 0 to 1 for each of `count` parameters.
    #[must_use]
    pub fn unit(count: usize) -> Self {
        Self { low: vec![0.0; count], high: vec![1.0; count] }
    }

    /// No bounds.
    #[must_use]
    pub fn none(count: usize) -> Self {
        Self { low: vec![f64::NEG_INFINITY; count], high: vec![f64::INFINITY; count] }
    }

    /// With so many further parameters that have no bounds.
    #[must_use]
    pub fn and_open(mut self, count: usize) -> Self {
        self.low.extend(vec![f64::NEG_INFINITY; count]);
        self.high.extend(vec![f64::INFINITY; count]);
        self
    }

    /// How many parameters there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.low.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.low.is_empty()
    }

    /// The lower bounds.
    #[must_use]
    pub fn low(&self) -> &[f64] {
        &self.low
    }

    /// The upper bounds.
    #[must_use]
    pub fn high(&self) -> &[f64] {
        &self.high
    }

    /// Moves a point into the box.
    pub fn clamp(&self, point: &mut [f64]) {
        for ((x, low), high) in point.iter_mut().zip(&self.low).zip(&self.high) {
            *x = x.clamp(*low, *high);
        }
    }

    /// Whether a point lies in the box.
    #[must_use]
    pub fn contains(&self, point: &[f64]) -> bool {
        let inside = |((x, low), high): ((&f64, &f64), &f64)| low <= x && x <= high;
        point.len() == self.len() && point.iter().zip(&self.low).zip(&self.high).all(inside)
    }

    /// The unit in which a parameter is searched: the box's width, or the size of its start where a side is open.
    #[must_use]
    pub fn scale(&self, index: usize, start: f64) -> f64 {
        let width = self.high[index] - self.low[index];
        if width.is_finite() { width } else { start.abs().max(1.0) }
    }

    /// Checks that a start has the right length and is finite.
    pub(super) fn check(&self, start: &[f64]) -> Result<(), FitError> {
        if start.len() != self.len() {
            return Err(FitError::Count { what: "start values", found: start.len(), expected: self.len() });
        }
        match start.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(FitError::Start { index, value: start[index] }),
            None => Ok(()),
        }
    }

    /// Folds the whole line onto the box: the identity within, a parabola near each end, mirrored beyond. An optimum on
    /// the bound is one within the line, so that the search needs no wall. (N. Hansen, *The CMA Evolution Strategy: A
    /// Tutorial*, 2016, B.5; the shape is that of `BoxConstraintsLinQuadTransformation` in his `cma`.)
    pub(super) fn fold(&self, index: usize, y: f64) -> f64 {
        let (low, high) = (self.low[index], self.high[index]);
        match (low.is_finite(), high.is_finite()) {
            (true, true) => low + (high - low) * fold_unit((y - low) / (high - low)),
            (true, false) => low + (y - low).abs(),
            (false, true) => high - (high - y).abs(),
            (false, false) => y,
        }
    }

    /// A point of the line that is folded onto `x`, which is moved into the box.
    pub(super) fn unfold(&self, index: usize, x: f64) -> f64 {
        let (low, high) = (self.low[index], self.high[index]);
        let x = x.clamp(low, high);
        if !(low.is_finite() && high.is_finite()) {
            return x;
        }
        let u = (x - low) / (high - low);
        let parabola = |u: f64| (4.0 * MARGIN * u).sqrt() - MARGIN;
        let v = match u {
            u if u < MARGIN => parabola(u),
            u if u > 1.0 - MARGIN => 1.0 - parabola(1.0 - u),
            u => u,
        };
        low + (high - low) * v
    }
}

fn fold_unit(u: f64) -> f64 {
    // The line repeats after there and back between −MARGIN and 1 + MARGIN.
    let span = 1.0 + 2.0 * MARGIN;
    let along = (u + MARGIN).rem_euclid(2.0 * span);
    let v = if along > span { 2.0 * span - along } else { along } - MARGIN;
    let parabola = |v: f64| (v + MARGIN) * (v + MARGIN) / (4.0 * MARGIN);
    let x = match v {
        v if v < MARGIN => parabola(v),
        v if v > 1.0 - MARGIN => 1.0 - parabola(1.0 - v),
        v => v,
    };
    x.clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_is_folded_onto_the_box_and_back() {
        let bounds = Bounds::new(vec![2.0], vec![6.0]).unwrap();
        for step in 0..=100 {
            let x = 2.0 + 0.04 * f64::from(step);
            assert!((bounds.fold(0, bounds.unfold(0, x)) - x).abs() < 1e-12);
        }
        for step in -300..300 {
            let (y, next) = (0.05 * f64::from(step), 0.05 * f64::from(step) + 1e-6);
            let (a, b) = (bounds.fold(0, y), bounds.fold(0, next));
            assert!((2.0..=6.0).contains(&a) && (a - b).abs() < 2e-6, "{y}: {a} {b}");
        }
    }
}
