//! Integration of differential equations over states that are trees.

use crate::control::{call, repeat};
use crate::scalar::Scalar;
use crate::tree::Tree;

/// One step of the classical fourth-order Runge–Kutta method for `dx/dt = f(x)`.
///
/// `dt` is in seconds; a derivative has the state's structure, in its units per second. Inputs are what `f` captures and
/// are constant during the step. (E. Hairer, S. Nørsett, G. Wanner, *Solving Ordinary Differential Equations I*, II.1.)
///
/// The derivative is one function of the traced program and is called four times.
///
/// ```
/// use parallax_model::integrate::rk4;
///
/// let x = rk4(|x: &f64| -x, 1.0, 0.1);
/// assert!((x - (-0.1f64).exp()).abs() < 1e-7);
/// ```
#[inline(always)]
pub fn rk4<T: Scalar, X: Tree<T>>(f: impl Fn(&X) -> X, x: X, dt: T) -> X {
    // Only a traced program keeps the call; on numbers this is `f(&x)`.
    let slope = |x: X| call::<T, X, X>("derivative", x, |x| f(&x));
    let half = dt * 0.5;
    let k1 = slope(x.zip(&x, &mut |x, _| x));
    let k2 = slope(along(&x, &k1, half));
    let k3 = slope(along(&x, &k2, half));
    let k4 = slope(along(&x, &k3, dt));
    let middle = k2.zip(&k3, &mut |a, b| a + b);
    let ends = k1.zip(&k4, &mut |a, b| a + b);
    let sum = ends.zip(&middle, &mut |ends, middle| ends + middle * 2.0);
    along(&x, &sum, dt / 6.0)
}

/// `steps` steps of [`rk4`] that together cover `dt` seconds; a loop in a traced program.
///
/// # Panics
///
/// When `steps` is zero.
#[inline(always)]
pub fn rk4_steps<T: Scalar, X: Tree<T>>(f: impl Fn(&X) -> X, x: X, dt: T, steps: usize) -> X {
    assert!(steps > 0, "rk4_steps needs at least one step");
    let dt = dt / steps as f64;
    repeat(steps, x, |x| rk4(&f, x, dt))
}

/// `x + slope · dt`
#[inline(always)]
fn along<T: Scalar, X: Tree<T>>(x: &X, slope: &X, dt: T) -> X {
    x.zip(slope, &mut |x, slope| x + slope * dt)
}
