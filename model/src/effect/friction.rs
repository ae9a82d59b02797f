//! Friction: forces against the motion of a joint.

use super::Effect;
use crate::Scalar;

/// The motion of a joint at one instant, and what acts on it.
#[derive(Clone, Copy, Debug)]
pub struct JointMotion<T> {
    /// Position, in the joint's unit (rad or m).
    pub position: T,
    /// Speed (rad/s or m/s).
    pub velocity: T,
    /// The driving force, where the joint states it (N m or N).
    pub drive: Option<T>,
    /// The load's force, where the joint states it (N m or N).
    pub load: Option<T>,
    /// Seconds since the recording's start.
    pub time: T,
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

impl Effect {
    /// Whether it is friction whose direction is that of the motion however slow: without data its smoothing has to be
    /// stated.
    #[must_use]
    pub const fn is_dry(self) -> bool {
        matches!(self, Effect::Coulomb | Effect::Stribeck | Effect::LoadFriction | Effect::AsymmetricFriction)
    }
}

/// F = −b v.
pub(super) fn viscous<T: Scalar>(coefficient: T, motion: &JointMotion<T>) -> T {
    -(coefficient * motion.velocity)
}

/// Coulomb's law, F = −c sgn(v) (Olsson et al. 1998, "Friction models and friction compensation", section 2).
pub(super) fn coulomb<T: Scalar>(force: T, motion: &JointMotion<T>) -> T {
    -(force * motion.direction())
}

/// Stribeck's curve, F = −(c + e exp(−(v/v_s)²)) sgn(v) (Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, "A survey of
/// models, analysis tools and compensation methods for the control of machines with friction", equation 6).
pub(super) fn stribeck<T: Scalar>(coulomb: T, extra: T, speed: T, motion: &JointMotion<T>) -> T {
    // A floor keeps the quotient finite at a speed of zero, where the excess vanishes.
    let ratio = motion.velocity / (speed + 1e-12);
    -((coulomb + extra * (-(ratio * ratio)).exp()) * motion.direction())
}

/// Friction of a gear, in proportion to what it transmits: F = −k |τ_drive − τ_load| sgn(v) (Duclusaud et al. 2024,
/// "Extended friction models for the physics simulation of servo actuators", model M3).
pub(super) fn load<T: Scalar>(ratio: T, motion: &JointMotion<T>) -> Option<T> {
    let load = motion.load.unwrap_or_else(|| T::constant(0.0));
    let transmitted = (motion.drive? - load).abs();
    Some(-(ratio * transmitted * motion.direction()))
}

/// Coulomb's law with a force of its own in each direction.
pub(super) fn asymmetric<T: Scalar>(forward: T, backward: T, motion: &JointMotion<T>) -> T {
    let force = T::select(motion.velocity.gt(T::constant(0.0)), forward, backward);
    -(force * motion.direction())
}

/// Viscous friction with a coefficient of its own in each direction.
pub(super) fn asymmetric_viscous<T: Scalar>(forward: T, backward: T, motion: &JointMotion<T>) -> T {
    let coefficient = T::select(motion.velocity.gt(T::constant(0.0)), forward, backward);
    -(coefficient * motion.velocity)
}

/// Drag of a body in a fluid at high Reynolds number, F = −κ v |v|.
pub(super) fn quadratic<T: Scalar>(coefficient: T, motion: &JointMotion<T>) -> T {
    -(coefficient * motion.velocity * motion.velocity.abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moving(velocity: f64) -> JointMotion<f64> {
        JointMotion {
            position: 0.0,
            velocity,
            drive: Some(0.5),
            load: Some(-0.3),
            time: 0.0,
            smoothing: 1e-3,
        }
    }

    #[test]
    fn friction_opposes_motion_and_vanishes_at_null() {
        for v in [-2.0, -0.1, 0.1, 2.0] {
            let m = moving(v);
            for force in [
                viscous(0.3, &m),
                coulomb(0.3, &m),
                stribeck(0.3, 0.2, 0.1, &m),
                load(0.3, &m).unwrap(),
                asymmetric(0.3, 0.1, &m),
                asymmetric_viscous(0.3, 0.1, &m),
                quadratic(0.3, &m),
            ] {
                assert!(force * v < 0.0);
            }
            for force in [
                viscous(0.0, &m),
                coulomb(0.0, &m),
                stribeck(0.0, 0.0, f64::INFINITY, &m),
                load(0.0, &m).unwrap(),
                asymmetric(0.0, 0.0, &m),
                asymmetric_viscous(0.0, 0.0, &m),
                quadratic(0.0, &m),
            ] {
                assert_eq!(force, 0.0);
            }
        }
        assert!((asymmetric(0.3, 0.1, &moving(1.0)) + 0.3).abs() < 1e-12);
        assert!((asymmetric(0.3, 0.1, &moving(-1.0)) - 0.1).abs() < 1e-12);
        assert!((asymmetric_viscous(0.3, 0.1, &moving(2.0)) + 0.6).abs() < 1e-12);
        assert!((quadratic(0.3, &moving(-2.0)) - 1.2).abs() < 1e-12);
        assert!((load(0.5, &moving(1.0)).unwrap() + 0.4).abs() < 1e-12);
    }

    #[test]
    fn stribeck_falls_from_its_peak_to_coulomb() {
        assert!((stribeck(0.3, 0.2, 0.5, &moving(0.01)) + 0.5).abs() < 1e-3);
        assert!((stribeck(0.3, 0.2, 0.5, &moving(0.5)) + 0.3 + 0.2 * (-1.0_f64).exp()).abs() < 1e-12);
        assert!((stribeck(0.3, 0.2, 0.5, &moving(5.0)) + 0.3).abs() < 1e-12);
        assert!(load(0.1, &JointMotion { drive: None, ..moving(1.0) }).is_none());
        // Without a load the gear transmits the drive.
        let free = JointMotion { load: None, ..moving(1.0) };
        assert_eq!(load(0.1, &free), load(0.1, &JointMotion { load: Some(0.0), ..moving(1.0) }));
    }
}
