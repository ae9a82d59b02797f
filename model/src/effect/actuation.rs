//! Effects between a command and what acts on the plant.

use crate::Scalar;

pub(super) fn offset<T: Scalar>(offset: T, command: T) -> T {
    command + offset
}

pub(super) fn saturation<T: Scalar>(low: T, high: T, command: T) -> T {
    command.clamp(low, high)
}

/// The dead zone of half width `width`: what exceeds it passes, less the width.
pub(super) fn deadband<T: Scalar>(width: T, command: T) -> T {
    command - command.clamp(-width, width)
}

pub(super) fn lag_step<T: Scalar>(time_constant: T, state: T, command: T, dt: T) -> (T, T) {
    // A zero time constant divides by zero; the floor is far below any step and keeps the derivative:
    // the mean is u + (v − u) τ/dt (1 − e^{−dt/τ}), whose slope at zero is (v − u)/dt.
    let floor = T::constant(1e-9);
    let tau = time_constant + floor;
    let decay = (-(dt / tau)).exp();
    let end = command + (state - command) * decay;
    let mean = command + (state - command) * (tau / dt) * (-decay + 1.0);
    (mean, end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn null_values_change_nothing() {
        for u in [-3.0, 0.0, 0.4] {
            assert_eq!(offset(0.0, u), u);
            assert_eq!(saturation(-3.0, 3.0, u), u);
            assert_eq!(deadband(0.0, u), u);
            let (mean, end) = lag_step(0.0, 0.7, u, 0.01);
            assert!((mean - u).abs() < 1e-6 && (end - u).abs() < 1e-12);
        }
    }

    #[test]
    fn lag_follows_the_exact_step_response() {
        let (tau, dt) = (0.03, 0.002);
        let (mut v, mut integral) = (0.0, 0.0);
        for _ in 0..50 {
            let (mean, end) = lag_step(tau, v, 1.0, dt);
            integral += mean * dt;
            v = end;
        }
        let t: f64 = 50.0 * dt;
        assert!((v - (1.0 - (-t / tau).exp())).abs() < 1e-6);
        assert!((integral - (t - tau * (1.0 - (-t / tau).exp()))).abs() < 1e-6);
    }

    #[test]
    fn deadband_and_saturation_act_where_they_should() {
        assert_eq!(deadband(0.5, 0.4), 0.0);
        assert_eq!(deadband(0.5, 2.0), 1.5);
        assert_eq!(deadband(0.5, -2.0), -1.5);
        assert_eq!(saturation(-1.0, 2.0, 5.0), 2.0);
        assert_eq!(saturation(-1.0, 2.0, -5.0), -1.0);
    }
}
