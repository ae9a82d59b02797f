//! Integration of differential equations over states that are trees.

use crate::control::{call, repeat};
use crate::scalar::{Inlined, Scalar};
use crate::tree::Tree;

/// The length of an integrator's step, and what follows from it. Prepare it where the length is a parameter.
#[derive(Tree, Clone, Copy, Debug, PartialEq)]
pub struct Length<T> {
    /// The length h, s.
    pub whole: T,
    /// h/2, s.
    pub half: T,
    /// h/6, s.
    pub sixth: T,
}

impl<T: Scalar> Length<T> {
    /// Of a step of `dt` seconds.
    #[inline(always)]
    pub fn new(dt: T) -> Self {
        Self { whole: dt, half: dt * 0.5, sixth: dt / 6.0 }
    }
}

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
pub fn rk4<T: Scalar, X: Tree<T>>(f: impl Slope<X>, x: X, dt: T) -> X {
    step(&f, x, dt)
}

/// As [`rk4`].
#[inline(always)]
fn step<T: Scalar, X: Tree<T>>(f: &impl Slope<X>, x: X, dt: T) -> X {
    let Length { whole, half, sixth } = Length::new(dt);
    let (mut at, mut ends, mut middle) = (copy(&x), copy(&x), copy(&x));
    // One place that calls `f`, so that it is inlined here, and what its four runs share is computed once.
    for stage in 0..4 {
        // Only a traced program keeps the call; on numbers this is `f.slope(&at)`.
        let slope = call::<T, X, X>("derivative", at, |x| T::compiled(At { f, x: &x }));
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
                at = along(&x, &slope, whole);
                middle = add(&middle, &slope);
            }
            _ => at = last(&x, &add(&ends, &slope), &middle, sixth),
        }
    }
    at
}

/// The right side f of a differential equation dx/dt = f(x).
///
/// A closure is one. On lanes, one that is more than a few operations long is better a type, whose method is marked
/// `#[inline(always)]`, which a closure cannot be: see [`Inlined`].
pub trait Slope<X> {
    /// f(x)
    fn slope(&self, x: &X) -> X;
}

impl<X, F: Fn(&X) -> X> Slope<X> for F {
    #[inline(always)]
    fn slope(&self, x: &X) -> X {
        self(x)
    }
}

/// The slope at one point.
struct At<'a, F, X> {
    f: &'a F,
    x: &'a X,
}

impl<X, F: Slope<X>> Inlined for At<'_, F, X> {
    type Output = X;
    #[inline(always)]
    fn run(self) -> X {
        self.f.slope(self.x)
    }
}

/// As [`rk4`], for a short equation that is inlined at all four places, and a step whose length is prepared: faster on
/// lanes, where the loop over the places would go through memory.
#[inline(always)]
pub fn rk4_inlined<T: Scalar, X: Tree<T>>(f: &impl Slope<X>, x: X, length: &Length<T>) -> X {
    let &Length { whole, half, sixth } = length;
    let first = call::<T, X, X>("derivative", copy(&x), |x| T::compiled(At { f, x: &x }));
    let second = call::<T, X, X>("derivative", along(&x, &first, half), |x| T::compiled(At { f, x: &x }));
    let third = call::<T, X, X>("derivative", along(&x, &second, half), |x| T::compiled(At { f, x: &x }));
    let fourth = call::<T, X, X>("derivative", along(&x, &third, whole), |x| T::compiled(At { f, x: &x }));
    last(&x, &add(&first, &fourth), &add(&second, &third), sixth)
}

/// `steps` steps of [`rk4`] that together cover `dt` seconds; a loop in a traced program.
///
/// # Panics
///
/// When `steps` is zero.
#[inline(always)]
pub fn rk4_steps<T: Scalar, X: Tree<T>>(f: impl Slope<X>, x: X, dt: T, steps: usize) -> X {
    assert!(steps > 0, "rk4_steps needs at least one step");
    let dt = dt / steps as f64;
    repeat(steps, x, |x| step(&f, x, dt))
}

/// `x + slope · dt`
#[inline(always)]
fn along<T: Scalar, X: Tree<T>>(x: &X, slope: &X, dt: T) -> X {
    x.zip(slope, &mut |x, slope| T::compiled(|| x + slope * dt))
}

/// `a + b`
#[inline(always)]
fn add<T: Scalar, X: Tree<T>>(a: &X, b: &X) -> X {
    a.zip(b, &mut |a, b| T::compiled(|| a + b))
}

/// The end of the step, from the sums of the outer and of the inner two slopes.
#[inline(always)]
fn last<T: Scalar, X: Tree<T>>(x: &X, ends: &X, middle: &X, sixth: T) -> X {
    let sum = ends.zip(middle, &mut |ends, middle| T::compiled(|| ends + middle * 2.0));
    along(x, &sum, sixth)
}

#[inline(always)]
fn copy<T: Scalar, X: Tree<T>>(x: &X) -> X {
    x.zip(x, &mut |x, _| x)
}
