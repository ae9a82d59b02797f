//! Friction: forces against the motion of a joint.

use crate::Scalar;

/// The motion of a joint at one instant.
#[derive(Clone, Copy, Debug)]
pub struct JointMotion<T> {
    /// Position, in the joint's unit (rad or m).
    pub position: T,
    /// Speed (rad/s or m/s).
    pub velocity: T,
    /// Speed below which the sign of the velocity is smoothed. Dry friction is discontinuous at rest, which
    /// neither a fixed-step integrator nor a derivative survives.
    pub smoothing: f64,
}

impl<T: Scalar> JointMotion<T> {
    /// −1 to 1: the direction of motion, smoothed around rest.
    fn direction(&self) -> T {
        (self.velocity / self.smoothing).tanh()
    }
}

pub(super) fn viscous<T: Scalar>(coefficient: T, motion: &JointMotion<T>) -> T {
    -(coefficient * motion.velocity)
}

/// Coulomb's law, F = −c sgn(v) (Olsson et al. 1998, "Friction models and friction compensation", section 2).
pub(super) fn coulomb<T: Scalar>(force: T, motion: &JointMotion<T>) -> T {
    -(force * motion.direction())
}

/// Coulomb's law with a force of its own in each direction.
pub(super) fn asymmetric<T: Scalar>(forward: T, backward: T, motion: &JointMotion<T>) -> T {
    let force = T::select(motion.velocity.gt(T::constant(0.0)), forward, backward);
    -(force * motion.direction())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moving(velocity: f64) -> JointMotion<f64> {
        JointMotion { position: 0.0, velocity, smoothing: 1e-3 }
    }

    #[test]
    fn friction_opposes_motion_and_vanishes_at_null() {
        for v in [-2.0, -0.1, 0.1, 2.0] {
            assert!(viscous(0.3, &moving(v)) * v < 0.0);
            assert!(coulomb(0.3, &moving(v)) * v < 0.0);
            assert!(asymmetric(0.3, 0.1, &moving(v)) * v < 0.0);
            assert_eq!(viscous(0.0, &moving(v)).abs() + coulomb(0.0, &moving(v)).abs(), 0.0);
        }
        assert!((asymmetric(0.3, 0.1, &moving(1.0)) + 0.3).abs() < 1e-12);
        assert!((asymmetric(0.3, 0.1, &moving(-1.0)) - 0.1).abs() < 1e-12);
    }
}
