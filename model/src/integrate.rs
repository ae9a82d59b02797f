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
    let half = dt * 0.5;
    let copy = |x: &X| x.zip(x, &mut |x, _| x);
    let add = |a: &X, b: &X| a.zip(b, &mut |a, b| T::compiled(|| a + b));
    let (mut at, mut ends, mut middle) = (copy(&x), copy(&x), copy(&x));
    // One place that calls `f`, so that it is inlined here, and what its four runs share is computed once.
    for stage in 0..4 {
        // Only a traced program keeps the call; on numbers this is `f(&at)`.
        let slope = call::<T, X, X>("derivative", at, |x| T::compiled(|| f(&x)));
        match stage {
            0 => {
                at = along(&x, &slope, half);
                ends = slope;
            }
            1 => {
                at = along(&x, &slope, half);
                middle = slope;
            }
            2 => {
                at = along(&x, &slope, dt);
                middle = add(&middle, &slope);
            }
            _ => {
                let sum =
                    add(&ends, &slope).zip(&middle, &mut |ends, middle| T::compiled(|| ends + middle * 2.0));
                at = along(&x, &sum, dt / 6.0);
            }
        }
    }
    at
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
    x.zip(slope, &mut |x, slope| T::compiled(|| x + slope * dt))
}
