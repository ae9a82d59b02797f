//! A flexible residual: a sum of bumps over state, command or time, standing for a cause that has no name.

use crate::Scalar;
use crate::system::Point;

/// What a feature looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Variable {
    /// A state, by index.
    State(usize),
    /// A command, by index.
    Input(usize),
    /// Seconds since the recording's start.
    Time,
}

/// One term of a residual.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Feature {
    /// A triangle of height 1 at `centre`, falling to zero `width` away.
    Bump {
        /// What it looks at.
        of: Variable,
        /// Where it peaks.
        centre: f64,
        /// Where it ends, from the peak.
        width: f64,
    },
    /// sin(k x + phase) of an angle x in rad.
    Wave {
        /// What it looks at.
        of: Variable,
        /// Waves per turn.
        count: f64,
        /// Phase (rad).
        phase: f64,
    },
    /// How far bristles are bent, as a share of what they bend at most: an [`ExtraState`](super::ExtraState) that only a
    /// [`Target::Hysteresis`] has.
    Bristles {
        /// Over how long a way they bend, in the joint's unit.
        deflection: f64,
    },
}

/// What a residual is added to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The derivative of a state, by index.
    State(usize),
    /// A reading, by index.
    Output(usize),
    /// The dry friction of a joint, by index: the force against the direction of its motion.
    Friction(usize),
    /// The force of bristles against the motion of a joint, by index.
    Hysteresis(usize),
}

/// A weighted sum of features, added somewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct Residual {
    /// Where it is added.
    pub target: Target,
    /// Its terms; each has a weight among the plant's extra parameters.
    pub features: Vec<Feature>,
}

impl Residual {
    /// Whether it is a force on a joint.
    pub(super) fn is_force(&self) -> bool {
        matches!(self.target, Target::Friction(_) | Target::Hysteresis(_))
    }

    /// The sum at a point.
    pub(super) fn value<T: Scalar>(&self, weights: &[T], point: &Point<'_, T>) -> T {
        self.features
            .iter()
            .zip(weights)
            .fold(T::constant(0.0), |sum, (feature, weight)| sum + *weight * feature.value(point))
    }
}

impl Feature {
    fn value<T: Scalar>(&self, point: &Point<'_, T>) -> T {
        match *self {
            Feature::Bump { of, centre, width } => {
                let distance = ((of.value(point) - centre) / width).abs();
                (-distance + 1.0).max(T::constant(0.0))
            }
            Feature::Wave { of, count, phase } => (of.value(point) * count + phase).sin(),
            // Its joint reads the state.
            Feature::Bristles { .. } => T::constant(0.0),
        }
    }
}

impl Variable {
    fn value<T: Scalar>(self, point: &Point<'_, T>) -> T {
        match self {
            Variable::State(index) => point.states[index],
            Variable::Input(index) => point.inputs[index],
            Variable::Time => point.time,
        }
    }
}
