//! Steps along the ridge of a spring inside a joint.
//!
//! Readings tell how fast such a spring swings and how soon it stops, `stiffness / s` and `damping / s` with
//! `s = ratio · (1 − ratio)`, far better than how it splits the inertia. In the effect's own parameters that is a bent
//! ridge, along which a Gauss–Newton step hardly moves. Here a step in `ratio` takes the other two along.

use nalgebra::{DMatrix, DVector};

use crate::hypothesis::{Fitted, Slot};

/// Where the three parameters of a spring inside a joint are in θ.
#[derive(Clone, Copy, Debug)]
pub struct Ridge {
    carried: [usize; 2],
    ratio: usize,
}

/// What an inertia split at `ratio` swings with, in units of the whole.
fn reduced(ratio: f64) -> f64 {
    (ratio * (1.0 - ratio)).max(1e-4)
}

impl Ridge {
    /// The springs among fitted parameters.
    #[must_use]
    pub fn of(fitted: &[Fitted]) -> Vec<Ridge> {
        let find = |effect, parameter, name: &str| {
            let slot = Slot::Effect { effect, parameter };
            fitted.iter().position(|f| f.slot == slot && f.name.ends_with(name))
        };
        let spring = |f: &Fitted| match f.slot {
            Slot::Effect { effect, parameter: 2 } => Some(Ridge {
                carried: [find(effect, 0, "stiffness")?, find(effect, 1, "damping")?],
                ratio: find(effect, 2, "ratio")?,
            }),
            _ => None,
        };
        fitted.iter().filter_map(spring).collect()
    }

    /// Takes a Hessian and a gradient by θ to those by coordinates in which the ridge is straight, the same at `theta`.
    pub fn straighten(&self, theta: &[f64], hessian: &mut DMatrix<f64>, gradient: &mut DVector<f64>) {
        let ratio = theta[self.ratio];
        let slope = if ratio * (1.0 - ratio) > 1e-4 { (1.0 - 2.0 * ratio) / reduced(ratio) } else { 0.0 };
        let mut turn = DMatrix::identity(theta.len(), theta.len());
        for j in self.carried {
            turn[(j, self.ratio)] = theta[j] * slope;
        }
        *hessian = turn.transpose() * &*hessian * &turn;
        *gradient = turn.transpose() * &*gradient;
    }

    /// What a step from `theta` in those coordinates, as it stands in `trial`, is in θ.
    pub fn bend(&self, theta: &[f64], trial: &mut [f64]) {
        let change = reduced(trial[self.ratio]) / reduced(theta[self.ratio]);
        for j in self.carried {
            trial[j] *= change;
        }
    }

    /// `theta` at another ratio, with the same swing.
    #[must_use]
    pub fn at(&self, theta: &[f64], ratio: f64) -> Vec<f64> {
        let mut other = theta.to_vec();
        other[self.ratio] = ratio;
        self.bend(theta, &mut other);
        other
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ridge_is_straight_where_the_swing_is_the_same() {
        let ridge = Ridge { carried: [0, 1], ratio: 2 };
        let theta = [800.0, 3.0, 0.3, 7.0];
        let swing = |theta: &[f64]| {
            let s = theta[2] * (1.0 - theta[2]);
            (theta[0] / s, theta[1] / s)
        };
        let elsewhere = ridge.at(&theta, 0.85);
        assert!((swing(&elsewhere).0 / swing(&theta).0 - 1.0).abs() < 1e-12);
        assert!((swing(&elsewhere).1 / swing(&theta).1 - 1.0).abs() < 1e-12);
        assert_eq!((elsewhere[2], elsewhere[3]), (0.85, 7.0));

        // A loss of the swing alone: in straight coordinates a step in the ratio does not change it.
        let loss = |theta: &[f64]| (swing(theta).0 - 3000.0).powi(2) + (swing(theta).1 - 10.0).powi(2);
        let plain = |theta: &[f64], j: usize, step: f64| {
            let mut theta = theta.to_vec();
            theta[j] += step;
            theta
        };
        let bent = |theta: &[f64], j: usize, step: f64| {
            let mut trial = plain(theta, j, step);
            ridge.bend(theta, &mut trial);
            trial
        };
        type Moved<'a> = &'a dyn Fn(&[f64], usize, f64) -> Vec<f64>;
        let numeric = |at: Moved<'_>| -> Vec<f64> {
            let half = |j: usize, step: f64| {
                (loss(&at(&theta, j, step)) - loss(&at(&theta, j, -step))) / (2.0 * step)
            };
            (0..4).map(|j| half(j, 1e-5 * theta[j])).collect()
        };
        let mut gradient = DVector::from_vec(numeric(&plain));
        let mut hessian = DMatrix::identity(4, 4);
        ridge.straighten(&theta, &mut hessian, &mut gradient);
        for (exact, numeric) in gradient.iter().zip(numeric(&bent)) {
            assert!((exact - numeric).abs() < 1e-5 * gradient.norm(), "{exact} against {numeric}");
        }
        assert!(gradient[2].abs() < 1e-6 * gradient.norm());
    }
}
