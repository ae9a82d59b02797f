//! Forces of position and time on a joint.

use super::JointMotion;
use crate::Scalar;

/// Cogging of a motor or unevenness of a gear: A sin(N θ + φ), locked to position (Hanselman, "Brushless
/// Permanent-Magnet Motor Design", chapter 9).
pub(super) fn cogging<T: Scalar>(amplitude: T, wavenumber: T, phase: T, motion: &JointMotion<T>) -> T {
    amplitude * (wavenumber * motion.position + phase).sin()
}

/// Hooke's law towards a rest position, F = −k (q − rest).
pub(super) fn spring<T: Scalar>(stiffness: T, rest: T, motion: &JointMotion<T>) -> T {
    -(stiffness * (motion.position - rest))
}

/// A spring that hardens: F = −k (q − rest)³, the cubic term of Duffing's equation (Guckenheimer & Holmes 1983, section
/// 2.2).
pub(super) fn cubic_spring<T: Scalar>(stiffness: T, rest: T, motion: &JointMotion<T>) -> T {
    let deflection = motion.position - rest;
    -(stiffness * deflection * deflection * deflection)
}

/// A stop that pushes back in proportion to how far the joint is beyond it: F = −k max(q − limit, 0).
pub(super) fn upper_stop<T: Scalar>(limit: T, stiffness: T, motion: &JointMotion<T>) -> T {
    -(stiffness * beyond(motion.position - limit))
}

/// The same below a limit: F = k max(limit − q, 0).
pub(super) fn lower_stop<T: Scalar>(limit: T, stiffness: T, motion: &JointMotion<T>) -> T {
    stiffness * beyond(limit - motion.position)
}

fn beyond<T: Scalar>(depth: T) -> T {
    depth.max(T::constant(0.0))
}

/// A machine or a wave nearby: A sin(2π f t + φ).
pub(super) fn periodic<T: Scalar>(amplitude: T, frequency: T, phase: T, motion: &JointMotion<T>) -> T {
    amplitude * (frequency * motion.time * std::f64::consts::TAU + phase).sin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forces_have_their_formulas() {
        let m = JointMotion {
            position: 1.2,
            velocity: 0.0,
            drive: None,
            load: None,
            time: 0.25,
            smoothing: 1e-3,
        };
        assert!((cogging(0.5, 3.0, 0.1, &m) - 0.5 * 3.7_f64.sin()).abs() < 1e-12);
        assert!((spring(2.0, 0.2, &m) + 2.0).abs() < 1e-12);
        assert!((upper_stop(1.0, 10.0, &m) + 2.0).abs() < 1e-12);
        assert_eq!(upper_stop(1.3, 10.0, &m), 0.0);
        assert!((lower_stop(1.5, 10.0, &m) - 3.0).abs() < 1e-12);
        assert_eq!(lower_stop(f64::NEG_INFINITY, 0.0, &m), 0.0);
        assert!((periodic(2.0, 1.0, 0.0, &m) - 2.0).abs() < 1e-12);
    }
}
