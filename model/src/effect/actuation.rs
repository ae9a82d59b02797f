//! Effects between a command and what acts on the plant.
//!
//! The functions that end in `_step` carry a state along a held command: they give the mean of what acts over an
//! interval and its value at the end, exactly, so that intervals need not be short for the effect's sake.

use super::Effect;
use crate::Scalar;

/// A command that bends towards its limits: low + s ln(1 + e^((u−low)/s)) − s ln(1 + e^((u−high)/s)), the difference
/// of two smooth ramps (softplus: Dugas et al. 2001). Zero softness is the hard saturation.
pub(super) fn soft_saturation<T: Scalar>(low: T, high: T, softness: T, command: T) -> T {
    // The floor keeps the quotient finite; with infinite limits it must stay so too.
    let s = softness + 1e-9;
    let zero = T::constant(0.0);
    // How far the smooth ramp lies above max(x, 0).
    let excess = |x: T| s * ((-(x.abs() / s)).exp() + 1.0).ln();
    let hard = command.clamp(low, high);
    let far = T::constant(1e300);
    let below = T::select(low.lt(-far), zero, excess(command - low));
    let above = T::select(high.gt(far), zero, excess(command - high));
    hard + below - above
}

/// The dead zone of half width `width`: what exceeds it passes, less the width (Tao & Kokotović, "Adaptive Control of
/// Systems with Actuator and Sensor Nonlinearities", 1996, chapter 2).
pub(super) fn deadband<T: Scalar>(width: T, command: T) -> T {
    command - command.clamp(-width, width)
}

/// A supply with inner resistance: what it can give falls in proportion to what is asked, u (1 − c |u|).
pub(super) fn load_sag<T: Scalar>(coefficient: T, command: T) -> T {
    command * (-(coefficient * command.abs()) + 1.0)
}

/// A command that weakens with the supply: u (V/V_nominal)^exponent. A motor's force goes with the first power, a
/// propeller's thrust with the second or less, as its controller compensates. `ratio` is V/V_nominal.
#[must_use]
pub fn sag<T: Scalar>(exponent: T, ratio: f64, command: T) -> T {
    command * T::constant(ratio).powf(exponent)
}

/// The mean of a first-order lag's output over a step with a held command, and its value at the end.
///
/// `state` is the lag's output at the start and `dt` the step in seconds. Exact for a held command
/// (the solution of τ v̇ = u − v), smooth in τ down to zero, where the lag vanishes: no stiff equation is left.
#[must_use]
pub fn lag_step<T: Scalar>(time_constant: T, state: T, command: T, dt: T) -> (T, T) {
    // A zero time constant divides by zero; the floor is far below any step and keeps the derivative:
    // the mean is u + (v − u) τ/dt (1 − e^{−dt/τ}), whose slope at zero is (v − u)/dt.
    let floor = T::constant(1e-9);
    let tau = time_constant + floor;
    let decay = (-(dt / tau)).exp();
    let end = command + (state - command) * decay;
    let mean = command + (state - command) * (tau / dt) * (-decay + 1.0);
    (mean, end)
}

/// The same for a second-order lag, τ² v̈ + 2 ζ τ v̇ + v = u: its mean, its value and its rate (per second) at the end.
///
/// `state` is value and rate at the start. The solution of the linear equation in closed form for every damping ζ
/// (e.g. Ogata, "Modern Control Engineering", section 5-3); the mean follows from integrating the equation once.
#[must_use]
pub fn lag_second_order_step<T: Scalar>(
    time_constant: T,
    damping: T,
    state: (T, T),
    command: T,
    dt: T,
) -> (T, (T, T)) {
    let tau = time_constant + 1e-9;
    let (error, rate) = (state.0 - command, state.1);
    let x = dt / tau;
    // With w = √(1 − ζ²): e^{−ζx} cos(wx) and e^{−ζx} sin(wx)/w, continued over ζ = 1 as functions of w².
    let square = -(damping * damping) + 1.0;
    let decay = (-(damping * x)).exp();
    let z = square * x * x;
    let edge = T::constant(0.01);
    let near_cos = z * (z * (z * (-1.0 / 720.0) + 1.0 / 24.0) - 0.5) + 1.0;
    let near_sin = z * (z * (z * (-1.0 / 5040.0) + 1.0 / 120.0) - 1.0 / 6.0) + 1.0;
    let angle = z.max(edge).sqrt();
    // Beyond critical damping the growth of cosh is below the decay: both exponents together are negative.
    let growth = (-z).max(edge).sqrt();
    let slow = (growth - damping * x).min(T::constant(0.0)).exp() * 0.5;
    let fast = (-growth - damping * x).exp() * 0.5;
    let is_near = z.abs().lt(edge);
    let oscillates = z.gt(T::constant(0.0));
    let pick = |near: T, under: T, over: T| T::select(is_near, near, T::select(oscillates, under, over));
    let c = pick(decay * near_cos, decay * angle.cos(), slow + fast);
    // sin(wx)/w = x · sin(√z)/√z.
    let s = x * pick(decay * near_sin, decay * angle.sin() / angle, (slow - fast) / growth);
    // e(t) = e₀ (c + ζ s) + ė₀ τ s;  τ ė(t) = −e₀ s + ė₀ τ (c − ζ s).
    let end = error * (c + damping * s) + rate * tau * s;
    let end_rate = rate * (c - damping * s) - error * s / tau;
    let mean = command - (tau * tau * (end_rate - rate) + damping * tau * (end - error) * 2.0) / dt;
    (mean, (command + end, end_rate))
}

/// The mean of a rate-limited command over a step with a held command, and its value at the end: |v̇| ≤ rate.
///
/// An infinite rate changes nothing.
#[must_use]
pub fn rate_limit_step<T: Scalar>(rate: T, state: T, command: T, dt: T) -> (T, T) {
    let distance = command - state;
    // The time it takes to arrive; where there is nowhere to go it takes none, whatever the rate.
    let arrival = T::select(distance.eq(T::constant(0.0)), T::constant(0.0), distance.abs() / rate);
    let arrives = arrival.le(dt);
    let way = distance.sign() * rate * dt;
    let mean = T::select(arrives, command - distance * (arrival / dt) * 0.5, state + way * 0.5);
    (mean, T::select(arrives, command, state + way))
}

/// What backlash of width `gap` (the full play) leaves of a command: the play operator, which holds its output until
/// the command pushes against either side (Visintin, "Differential Models of Hysteresis", 1994, section III.2).
#[must_use]
pub fn play_step<T: Scalar>(gap: T, state: T, command: T) -> T {
    let half = gap * 0.5;
    state.max(command - half).min(command + half)
}

impl Effect {
    /// How many numbers the effect keeps of a command's history.
    #[must_use]
    pub const fn memory(self) -> usize {
        match self {
            Effect::Lag | Effect::RateLimit | Effect::Backlash => 1,
            Effect::LagSecondOrder => 2,
            _ => 0,
        }
    }

    /// The mean of what acts while a command is held for `dt` seconds. `memory` goes on to the end of that time; where the
    /// command has always been the same it is that command, then zero. Effects without one act on the value alone.
    #[must_use]
    pub fn held<T: Scalar>(self, parameters: &[T], memory: &mut [T], command: T, dt: T) -> T {
        match (self, parameters, memory) {
            (Effect::Lag, &[time_constant], [state, ..]) => {
                let (mean, end) = lag_step(time_constant, *state, command, dt);
                *state = end;
                mean
            }
            (Effect::LagSecondOrder, &[time_constant, damping], [state, rate]) => {
                let (mean, end) = lag_second_order_step(time_constant, damping, (*state, *rate), command, dt);
                (*state, *rate) = end;
                mean
            }
            (Effect::RateLimit, &[limit], [state, ..]) => {
                let (mean, end) = rate_limit_step(limit, *state, command, dt);
                *state = end;
                mean
            }
            (Effect::Backlash, &[gap], [state, ..]) => {
                *state = play_step(gap, *state, command);
                *state
            }
            _ => self.input(parameters, command),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Dual;

    #[test]
    fn null_values_change_nothing() {
        for u in [-3.0, 0.0, 0.4] {
            assert_eq!(deadband(0.0, u), u);
            assert_eq!(load_sag(0.0, u), u);
            assert_eq!(sag(0.0, 0.8, u), u);
            assert_eq!(play_step(0.0, 0.7, u), u);
            assert_eq!(soft_saturation(f64::NEG_INFINITY, f64::INFINITY, 0.0, u), u);
            let (mean, end) = rate_limit_step(f64::INFINITY, 0.7, u, 0.01);
            assert_eq!((mean, end), (u, u));
            let (mean, end) = lag_step(0.0, 0.7, u, 0.01);
            assert!((mean - u).abs() < 1e-6 && (end - u).abs() < 1e-12);
            let (mean, (end, rate)) = lag_second_order_step(0.0, 1.0, (0.7, 0.0), u, 0.01);
            assert!((mean - u).abs() < 1e-6 && (end - u).abs() < 1e-12 && rate.abs() < 1e-12);
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
    fn second_order_lag_agrees_with_tiny_steps_at_every_damping() {
        for damping in [0.05, 0.4, 0.99, 1.0, 1.01, 2.5] {
            let (tau, h, dt) = (0.03_f64, 1e-6, 0.011);
            let (mut v, mut w, mut exact, mut sum) = (0.2, -1.0, (0.2, -1.0), 0.0);
            for k in 0..5 {
                let u = [1.0, -0.5, 0.0, 2.0, 0.3][k];
                let (mean, end) = lag_second_order_step(tau, damping, exact, u, dt);
                exact = end;
                let mut integral = 0.0;
                for _ in 0..11_000 {
                    // Midpoint rule.
                    let a = |v: f64, w: f64| (u - v - 2.0 * damping * tau * w) / (tau * tau);
                    let (vm, wm) = (v + 0.5 * h * w, w + 0.5 * h * a(v, w));
                    integral += h * vm;
                    (v, w) = (v + h * wm, w + h * a(vm, wm));
                }
                assert!((mean - integral / dt).abs() < 1e-5, "{damping}: {mean} {}", integral / dt);
                sum += mean;
            }
            assert!((exact.0 - v).abs() < 1e-5 && (exact.1 - w).abs() < 1e-3, "{damping}");
            assert!(sum.is_finite());
        }
    }

    #[test]
    fn derivatives_are_finite_at_the_edges() {
        for damping in [0.3, 1.0, 1.7] {
            let d = |v, i| Dual::<3>::variable(v, i);
            for tau in [0.0, 1e-4, 0.05] {
                let c = Dual::from_value(1.0);
                let state = (Dual::from_value(0.1), Dual::from_value(0.0));
                let (mean, (end, _)) =
                    lag_second_order_step(d(tau, 0), d(damping, 1), state, c, Dual::from_value(0.004));
                assert!(mean.gradient.iter().chain(&end.gradient).all(|g| g.is_finite()), "{damping} {tau}");
            }
        }
        let (mean, end) = rate_limit_step(
            Dual::<1>::variable(2.0, 0),
            Dual::from_value(0.5),
            Dual::from_value(0.5),
            Dual::from_value(0.1),
        );
        assert_eq!((mean.value, mean.gradient, end.gradient), (0.5, [0.0], [0.0]));
    }

    #[test]
    fn a_limited_rate_ramps_and_arrives() {
        let (mean, end) = rate_limit_step(2.0, 0.0, 1.0, 0.25);
        assert!((mean - 0.25).abs() < 1e-12 && (end - 0.5).abs() < 1e-12);
        let (mean, end) = rate_limit_step(2.0, 0.5, 1.0, 0.5);
        assert!((mean - 0.875).abs() < 1e-12 && end == 1.0);
        let (mean, end) = rate_limit_step(2.0, 0.0, -1.0, 0.25);
        assert!((mean + 0.25).abs() < 1e-12 && (end + 0.5).abs() < 1e-12);
    }

    #[test]
    fn play_holds_at_reversals() {
        let mut v = 0.0;
        let path = [0.2, 0.6, 1.0, 0.8, 0.55, 0.4, -0.5].map(|u| {
            v = play_step(0.5, v, u);
            v
        });
        let expected = [0.0, 0.35, 0.75, 0.75, 0.75, 0.65, -0.25];
        assert!(path.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{path:?}");
    }

    #[test]
    fn static_effects_act_where_they_should() {
        assert_eq!(deadband(0.5, 0.4), 0.0);
        assert_eq!(deadband(0.5, 2.0), 1.5);
        assert_eq!(deadband(0.5, -2.0), -1.5);
        assert!((load_sag(0.1, -2.0) + 1.6).abs() < 1e-12);
        assert!((sag(2.0, 0.5, 4.0) - 1.0).abs() < 1e-12);
        // Far inside the command passes, far outside it rests at the limit, at the limit it bends.
        assert!((soft_saturation(-1.0, 2.0, 0.1, 0.5) - 0.5).abs() < 1e-5);
        assert!((soft_saturation(-1.0, 2.0, 0.1, 9.0) - 2.0).abs() < 1e-5);
        assert!((soft_saturation(-1.0, 2.0, 0.1, 2.0) - (2.0 - 0.1 * 2.0_f64.ln())).abs() < 1e-5);
    }
}
