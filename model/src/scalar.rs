//! The number type a model is generic over.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, DivAssign, Mul, MulAssign, Neg, Not, Sub, SubAssign};

/// A number that a model computes with: `f64`, a dual number, a traced value, later an array of lanes.
///
/// Comparison gives a [`Scalar::Mask`], never a `bool`: a branch on a value is written with
/// [`Scalar::select`], so that the same source can be traced, differentiated and run on lanes. A bare `if` does not
/// compile:
///
/// ```compile_fail,E0369
/// fn larger<T: parallax_model::Scalar>(x: T, y: T) -> T {
///     if x < y { y } else { x }
/// }
/// ```
///
/// ```
/// fn larger<T: parallax_model::Scalar>(x: T, y: T) -> T {
///     T::select(x.lt(y), y, x)
/// }
/// assert_eq!(larger(1.0, 2.0), 2.0);
/// ```
pub trait Scalar:
    Copy
    + Debug
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + DivAssign
    + Add<f64, Output = Self>
    + Sub<f64, Output = Self>
    + Mul<f64, Output = Self>
    + Div<f64, Output = Self>
{
    /// The result of a comparison.
    type Mask: Copy
        + Debug
        + BitAnd<Output = Self::Mask>
        + BitOr<Output = Self::Mask>
        + Not<Output = Self::Mask>;

    /// Whether structured control ([`crate::control`]) is written down instead of run: true for the traced scalar only.
    const STRUCTURED: bool = false;

    /// A number that depends on nothing.
    fn constant(value: f64) -> Self;
    /// The same number, read by the machine's own instructions. Lanes that are only handed on are otherwise copied as
    /// memory, through every struct on their way.
    #[inline(always)]
    fn loaded(&self) -> Self {
        *self
    }

    /// Sine of an angle in radians.
    fn sin(self) -> Self;
    /// Cosine of an angle in radians.
    fn cos(self) -> Self;
    /// Tangent of an angle in radians.
    fn tan(self) -> Self;
    /// Arcsine, in radians.
    fn asin(self) -> Self;
    /// Arccosine, in radians.
    fn acos(self) -> Self;
    /// Arctangent, in radians.
    fn atan(self) -> Self;
    /// Angle of the point (`x`, `self`) in radians.
    fn atan2(self, x: Self) -> Self;
    /// Natural exponential.
    fn exp(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Square root. Its derivative at zero is zero, not infinite: a select between branches must not give NaN.
    fn sqrt(self) -> Self;
    /// Hyperbolic tangent.
    fn tanh(self) -> Self;
    /// `self` to the power of `exponent`.
    fn powf(self, exponent: Self) -> Self;
    /// `self` to a whole power.
    fn powi(self, exponent: i32) -> Self;
    /// Absolute value; derivative zero at zero.
    fn abs(self) -> Self;
    /// −1, 0 or 1, with `sign(0) = 0` (unlike `f64::signum`).
    fn sign(self) -> Self;
    /// Largest whole number not above `self`; derivative zero.
    fn floor(self) -> Self;

    /// `self < other`
    fn lt(self, other: Self) -> Self::Mask;
    /// `self <= other`
    fn le(self, other: Self) -> Self::Mask;
    /// `self == other`
    fn eq(self, other: Self) -> Self::Mask;
    /// `self > other`
    fn gt(self, other: Self) -> Self::Mask {
        other.lt(self)
    }
    /// `self >= other`
    fn ge(self, other: Self) -> Self::Mask {
        other.le(self)
    }
    /// `then` where `mask` holds, else `otherwise`.
    fn select(mask: Self::Mask, then: Self, otherwise: Self) -> Self;

    /// Whether the mask holds wherever it is asked for (true) or nowhere (false), as far as that is known: what is not needed
    /// need not be computed. See [`crate::control::when`].
    fn decided(mask: Self::Mask) -> Option<bool> {
        let _ = mask;
        None
    }

    /// The smaller of two.
    fn min(self, other: Self) -> Self {
        Self::select(self.lt(other), self, other)
    }
    /// The larger of two.
    fn max(self, other: Self) -> Self {
        Self::select(other.lt(self), self, other)
    }
    /// `self` held within `[low, high]`.
    fn clamp(self, low: Self, high: Self) -> Self {
        self.max(low).min(high)
    }

    /// A loop over flat lists of numbers; [`crate::control::scan`] is the form for structs.
    ///
    /// Runs `body(carry, x, y)` `length` times: it updates `carry`, reads the next `xs.len() / length` numbers and
    /// fills the next `ys.len() / length`.
    ///
    /// # Panics
    ///
    /// When `xs` or `ys` cannot be divided evenly among the steps.
    fn scan_values(
        length: usize,
        carry: &mut [Self],
        xs: &[Self],
        ys: &mut [Self],
        mut body: impl FnMut(&mut [Self], &[Self], &mut [Self]),
    ) {
        let (nx, ny) = (share(xs.len(), length), share(ys.len(), length));
        for step in 0..length {
            body(carry, &xs[step * nx..(step + 1) * nx], &mut ys[step * ny..(step + 1) * ny]);
        }
    }

    /// The same computation on each of `length` elements; [`crate::control::map`] is the form for structs.
    ///
    /// Runs `body(x, y)` for every element: it reads `xs.len() / length` numbers and fills `ys.len() / length`.
    ///
    /// # Panics
    ///
    /// When `xs` or `ys` cannot be divided evenly among the elements.
    fn map_values(length: usize, xs: &[Self], ys: &mut [Self], mut body: impl FnMut(&[Self], &mut [Self])) {
        let (nx, ny) = (share(xs.len(), length), share(ys.len(), length));
        for step in 0..length {
            body(&xs[step * nx..(step + 1) * nx], &mut ys[step * ny..(step + 1) * ny]);
        }
    }

    /// A named function, written once however often it is called; [`crate::control::call`] is the form for structs.
    fn call_values(name: &str, xs: &[Self], ys: &mut [Self], body: impl FnOnce(&[Self], &mut [Self])) {
        let _ = name;
        body(xs, ys);
    }

    /// Does `work` on the instructions that this number computes with: what is inlined into it is compiled for them.
    /// Only lanes have any of their own.
    #[inline(always)]
    fn compiled<W: Inlined>(work: W) -> W::Output {
        work.run()
    }
}

/// A piece of work that [`Scalar::compiled`] compiles for the instructions of its numbers.
///
/// A short closure is one. A long one is not inlined everywhere, however often that went well: the compiler weighs it anew with every
/// change around it, and what it leaves a call computes several times slower. So what is long is a type, whose `run` is marked
/// `#[inline(always)]`, which a closure cannot be.
pub trait Inlined {
    /// What the work gives.
    type Output;
    /// Does the work. Mark it `#[inline(always)]`.
    fn run(self) -> Self::Output;
}

impl<R, F: FnOnce() -> R> Inlined for F {
    type Output = R;
    #[inline(always)]
    fn run(self) -> R {
        self()
    }
}

/// How many of `count` numbers belong to each of `length` steps.
///
/// # Panics
///
/// When they cannot be divided evenly.
pub(crate) fn share(count: usize, length: usize) -> usize {
    if length == 0 {
        assert_eq!(count, 0, "a loop of no steps has no numbers to divide");
        return 0;
    }
    assert_eq!(count % length, 0, "{count} numbers cannot be divided evenly among {length} steps");
    count / length
}

/// The assigning operators (`+=` ...), from the plain ones.
macro_rules! assign_operators {
    ([$($generics:tt)*] $scalar:ty) => {
        $crate::scalar::assign_operators!(@one [$($generics)*] $scalar, AddAssign, add_assign, +);
        $crate::scalar::assign_operators!(@one [$($generics)*] $scalar, SubAssign, sub_assign, -);
        $crate::scalar::assign_operators!(@one [$($generics)*] $scalar, MulAssign, mul_assign, *);
        $crate::scalar::assign_operators!(@one [$($generics)*] $scalar, DivAssign, div_assign, /);
    };
    (@one [$($generics:tt)*] $scalar:ty, $operator:ident, $method:ident, $sign:tt) => {
        impl<$($generics)*> std::ops::$operator for $scalar {
            #[inline(always)]
            fn $method(&mut self, other: Self) {
                *self = *self $sign other;
            }
        }
    };
}
pub(crate) use assign_operators;

impl Scalar for f64 {
    type Mask = bool;

    fn constant(value: f64) -> Self {
        value
    }
    fn sin(self) -> Self {
        f64::sin(self)
    }
    fn cos(self) -> Self {
        f64::cos(self)
    }
    fn tan(self) -> Self {
        f64::tan(self)
    }
    fn asin(self) -> Self {
        f64::asin(self)
    }
    fn acos(self) -> Self {
        f64::acos(self)
    }
    fn atan(self) -> Self {
        f64::atan(self)
    }
    fn atan2(self, x: Self) -> Self {
        f64::atan2(self, x)
    }
    fn exp(self) -> Self {
        f64::exp(self)
    }
    fn ln(self) -> Self {
        f64::ln(self)
    }
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
    fn tanh(self) -> Self {
        f64::tanh(self)
    }
    fn powf(self, exponent: Self) -> Self {
        f64::powf(self, exponent)
    }
    fn powi(self, exponent: i32) -> Self {
        f64::powi(self, exponent)
    }
    fn abs(self) -> Self {
        f64::abs(self)
    }
    fn sign(self) -> Self {
        if self == 0.0 { 0.0 } else { f64::signum(self) }
    }
    fn floor(self) -> Self {
        f64::floor(self)
    }
    fn lt(self, other: Self) -> bool {
        self < other
    }
    fn le(self, other: Self) -> bool {
        self <= other
    }
    fn eq(self, other: Self) -> bool {
        self == other
    }
    fn select(mask: bool, then: Self, otherwise: Self) -> Self {
        if mask { then } else { otherwise }
    }
    fn decided(mask: bool) -> Option<bool> {
        Some(mask)
    }
}
