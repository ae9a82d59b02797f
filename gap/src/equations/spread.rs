//! How far the states that effects bring with them may be from rest where a stretch of a recording begins.

use parallax_model::plant::Plant;

/// Deflection as a share of what the force bends a spring by at most, as a stretch begins anywhere in the motion; and its rate as a share
/// of that of a free swing as wide: a force that bends a spring rarely does so as fast.
const BENT: f64 = 0.5;
const SWING: f64 = 0.4;

/// The standard deviation of one such state, at the start of a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Spread {
    /// The same whatever θ is, in the unit of the state.
    Fixed(f64),
    /// A spring inside a joint, bent as far as a force bends it.
    Bent {
        /// Index of the effect among the plant's.
        effect: usize,
        /// Whether it is the rate of the deflection (rad/s or m/s), and not the deflection itself (rad or m).
        rate: bool,
        /// The force (N m or N).
        force: f64,
        /// The joint's inertia (kg m² or kg).
        inertia: f64,
        /// As far as it may be bent at least, however stiff it is, and at most (rad or m).
        least: f64,
        /// See `least`.
        most: f64,
    },
}

impl Spread {
    /// The standard deviation where effects have these extra parameters.
    pub(super) fn at(&self, plant: &Plant, extra: &[f64]) -> f64 {
        match *self {
            Spread::Fixed(std) => std,
            Spread::Bent { effect, rate, force, inertia, least, most } => {
                let own = plant.own(&plant.effects()[effect], extra);
                let stiffness = own.first().copied().unwrap_or(0.0).max(0.0);
                let bent = (BENT * force / stiffness).min(most).max(least);
                // Of equal halves of the inertia.
                let turns = (BENT * force / bent / (0.25 * inertia)).sqrt();
                if rate { SWING * bent * turns } else { bent }
            }
        }
    }
}
