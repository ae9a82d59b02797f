//! From numbers between 0 and 1, in which solvers search, to those of models.

use serde::{Deserialize, Serialize};

use super::error::IdentifyError;
use super::spec::{Prior, Transform};
use crate::batch::Place;

/// One number to be found.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Coordinate {
    pub(super) name: String,
    pub(super) unit: String,
    pub(super) sort: Sort,
    /// Where it goes.
    pub(super) places: Vec<Place>,
    /// The recording that it belongs to; absent: all.
    pub(super) recording: Option<usize>,
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) transform: Transform,
    pub(super) start: f64,
    pub(super) prior: Option<Prior>,
}

/// What kind of number it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sort {
    /// A parameter of a node.
    Parameter,
    /// A leaf of a first state.
    State,
    /// A hidden delay, or the mean of one that scatters.
    Delay,
    /// The standard deviation of a hidden delay.
    Spread,
    /// A coefficient that enters linearly.
    Linear,
}

impl Coordinate {
    /// Checks bounds, start and prior.
    pub(super) fn check(&self, whose: &str) -> Result<(), IdentifyError> {
        let wrong = |problem: String| Err(IdentifyError::Value { whose: whose.to_owned(), problem });
        let Self { low, high, start, .. } = *self;
        if !(low.is_finite() && high.is_finite() && low < high) {
            return wrong(format!(
                "the bounds {low} and {high} have to be finite, the first below the second"
            ));
        }
        if !(low <= start && start <= high) {
            return wrong(format!("the start {start} lies outside of {low} to {high}"));
        }
        match self.transform {
            Transform::Log if low <= 0.0 => {
                return wrong(format!("the logarithm needs bounds above zero; the lower one is {low}"));
            }
            Transform::Logit if low <= 0.0 || high >= 1.0 => {
                return wrong(format!("the odds need bounds within 0 and 1; they are {low} and {high}"));
            }
            _ => {}
        }
        if let Some(Prior { mean, std }) = self.prior
            && !(mean.is_finite() && std.is_finite() && std > 0.0 && low <= mean && mean <= high)
        {
            return wrong(format!(
                "the prior {mean} ± {std} needs its mean within the bounds and a spread above 0"
            ));
        }
        Ok(())
    }

    fn forward(&self, x: f64) -> f64 {
        match self.transform {
            Transform::Linear => x,
            Transform::Log => x.ln(),
            Transform::Logit => (x / (1.0 - x)).ln(),
        }
    }

    fn backward(&self, y: f64) -> f64 {
        match self.transform {
            Transform::Linear => y,
            Transform::Log => y.exp(),
            Transform::Logit => 1.0 / (1.0 + (-y).exp()),
        }
    }

    /// The number at `z`, from 0 to 1.
    pub(super) fn value(&self, z: f64) -> f64 {
        let (a, b) = (self.forward(self.low), self.forward(self.high));
        self.backward(a + z * (b - a)).clamp(self.low, self.high)
    }

    /// Where a number lies between the bounds, from 0 to 1.
    pub(super) fn place_of(&self, x: f64) -> f64 {
        let (a, b) = (self.forward(self.low), self.forward(self.high));
        ((self.forward(x) - a) / (b - a)).clamp(0.0, 1.0)
    }

    /// The number's derivative by `z`.
    pub(super) fn slope(&self, z: f64) -> f64 {
        let (a, b) = (self.forward(self.low), self.forward(self.high));
        let x = self.value(z);
        (b - a)
            * match self.transform {
                Transform::Linear => 1.0,
                Transform::Log => x,
                Transform::Logit => x * (1.0 - x),
            }
    }

    /// What a place is given, and how that changes with `z`. A delay's place is where it lies between its bounds.
    pub(super) fn at(&self, z: f64) -> (f64, f64) {
        match self.sort {
            Sort::Delay => (z, 1.0),
            _ => (self.value(z), self.slope(z)),
        }
    }

    /// What a place is given.
    pub(super) fn put(&self, z: f64) -> f64 {
        if self.sort == Sort::Delay { z } else { self.value(z) }
    }

    /// The prior's mean and standard deviation in `z`.
    pub(super) fn prior_of_place(&self) -> Option<(f64, f64)> {
        self.prior.map(|Prior { mean, std }| {
            let middle = self.place_of(mean);
            (middle, std / self.slope(middle))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_and_values_belong_together_on_every_scale() {
        for (transform, low, high) in
            [(Transform::Linear, -2.0, 3.0), (Transform::Log, 1e-5, 1e-2), (Transform::Logit, 0.05, 0.99)]
        {
            let coordinate = Coordinate {
                name: "x".into(),
                unit: String::new(),
                sort: Sort::Parameter,
                places: Vec::new(),
                recording: None,
                low,
                high,
                transform,
                start: low,
                prior: None,
            };
            assert!(coordinate.check("x").is_ok());
            for step in 1..20 {
                let z = f64::from(step) / 20.0;
                let x = coordinate.value(z);
                assert!(low < x && x < high && (coordinate.place_of(x) - z).abs() < 1e-12);
                let h = 1e-6;
                let slope = (coordinate.value(z + h) - coordinate.value(z - h)) / (2.0 * h);
                assert!((coordinate.slope(z) / slope - 1.0).abs() < 1e-6);
            }
        }
    }
}
