//! Dual numbers: a value with its gradient.
//!
//! A model evaluated on [`Dual`] gives its derivatives exactly, up to rounding, with respect to the `N` numbers that
//! were made with [`Dual::variable`]. Forward mode: cost grows with `N`, memory does not grow with the computation.
//!
//! At the few points where a derivative is infinite although the value is finite (`sqrt` and fractional powers at
//! zero, `asin` and `acos` at ±1), and at kinks (`abs`, `sign`, `atan2` at the origin), the derivative is zero: a fit
//! must not receive an infinity, nor a NaN from the product of an infinity with a zero.
//!
//! ```
//! use parallax_model::{Dual, Scalar};
//!
//! let x = Dual::<2>::variable(3.0, 0);
//! let y = Dual::<2>::variable(0.5, 1);
//! let z = x * x * y.sin();
//! assert!((z.gradient[0] - 6.0 * 0.5f64.sin()).abs() < 1e-12);
//! assert!((z.gradient[1] - 9.0 * 0.5f64.cos()).abs() < 1e-12);
//! ```

use std::ops::{Add, Div, Mul, Neg, Sub};

use crate::scalar::{Scalar, assign_operators};

/// A value and its derivatives with respect to `N` variables.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dual<const N: usize> {
    /// The number itself.
    pub value: f64,
    /// Its derivative with respect to each variable.
    pub gradient: [f64; N],
}

impl<const N: usize> Default for Dual<N> {
    fn default() -> Self {
        Self::from_value(0.0)
    }
}

impl<const N: usize> Dual<N> {
    /// A number that depends on no variable.
    #[inline(always)]
    pub const fn from_value(value: f64) -> Self {
        Self { value, gradient: [0.0; N] }
    }

    /// The variable with this index: its derivative with respect to itself is one.
    ///
    /// # Panics
    ///
    /// When `index` is not below `N`.
    #[inline]
    pub fn variable(value: f64, index: usize) -> Self {
        let mut gradient = [0.0; N];
        gradient[index] = 1.0;
        Self { value, gradient }
    }

    /// The chain rule: a function's value, and its slope times the gradient.
    #[inline(always)]
    fn chain(self, value: f64, slope: f64) -> Self {
        let mut gradient = self.gradient;
        for entry in &mut gradient {
            *entry *= slope;
        }
        Self { value, gradient }
    }

    /// The chain rule for two arguments.
    #[inline(always)]
    fn chain2(self, other: Self, value: f64, slope: f64, other_slope: f64) -> Self {
        let mut gradient = [0.0; N];
        for ((out, a), b) in gradient.iter_mut().zip(&self.gradient).zip(&other.gradient) {
            *out = slope * a + other_slope * b;
        }
        Self { value, gradient }
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn add(mut self, other: Self) -> Self {
        self.value += other.value;
        for (a, b) in self.gradient.iter_mut().zip(&other.gradient) {
            *a += b;
        }
        self
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn sub(mut self, other: Self) -> Self {
        self.value -= other.value;
        for (a, b) in self.gradient.iter_mut().zip(&other.gradient) {
            *a -= b;
        }
        self
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.chain2(other, self.value * other.value, other.value, self.value)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        let value = self.value / other.value;
        let slope = 1.0 / other.value;
        self.chain2(other, value, slope, -value * slope)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn neg(mut self) -> Self {
        self.value = -self.value;
        for entry in &mut self.gradient {
            *entry = -*entry;
        }
        self
    }
}

impl<const N: usize> Add<f64> for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn add(mut self, other: f64) -> Self {
        self.value += other;
        self
    }
}

impl<const N: usize> Sub<f64> for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn sub(mut self, other: f64) -> Self {
        self.value -= other;
        self
    }
}

impl<const N: usize> Mul<f64> for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: f64) -> Self {
        self.chain(self.value * other, other)
    }
}

impl<const N: usize> Div<f64> for Dual<N> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: f64) -> Self {
        self.chain(self.value / other, 1.0 / other)
    }
}

assign_operators!([const N: usize] Dual<N>);

impl<const N: usize> Scalar for Dual<N> {
    type Mask = bool;

    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self::from_value(value)
    }
    #[inline]
    fn sin(self) -> Self {
        let (sin, cos) = self.value.sin_cos();
        self.chain(sin, cos)
    }
    #[inline]
    fn cos(self) -> Self {
        let (sin, cos) = self.value.sin_cos();
        self.chain(cos, -sin)
    }
    #[inline]
    fn tan(self) -> Self {
        let tan = self.value.tan();
        self.chain(tan, 1.0 + tan * tan)
    }
    #[inline]
    fn asin(self) -> Self {
        self.chain(self.value.asin(), arc_slope(self.value))
    }
    #[inline]
    fn acos(self) -> Self {
        self.chain(self.value.acos(), -arc_slope(self.value))
    }
    #[inline]
    fn atan(self) -> Self {
        self.chain(self.value.atan(), 1.0 / (1.0 + self.value * self.value))
    }
    #[inline]
    fn atan2(self, x: Self) -> Self {
        let square = self.value * self.value + x.value * x.value;
        let inverse = if square == 0.0 { 0.0 } else { 1.0 / square };
        self.chain2(x, self.value.atan2(x.value), x.value * inverse, -self.value * inverse)
    }
    #[inline]
    fn exp(self) -> Self {
        let exp = self.value.exp();
        self.chain(exp, exp)
    }
    #[inline]
    fn ln(self) -> Self {
        self.chain(self.value.ln(), 1.0 / self.value)
    }
    #[inline]
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        self.chain(root, if root == 0.0 { 0.0 } else { 0.5 / root })
    }
    #[inline]
    fn tanh(self) -> Self {
        let tanh = self.value.tanh();
        self.chain(tanh, 1.0 - tanh * tanh)
    }
    #[inline]
    fn powf(self, exponent: Self) -> Self {
        let (x, y) = (self.value, exponent.value);
        let power = x.powf(y);
        let slope = match x == 0.0 {
            true if y == 1.0 => 1.0,
            true => 0.0,
            false => y * x.powf(y - 1.0),
        };
        let exponent_slope = if x > 0.0 { power * x.ln() } else { 0.0 };
        self.chain2(exponent, power, slope, exponent_slope)
    }
    #[inline]
    fn powi(self, exponent: i32) -> Self {
        let slope = if exponent == 0 {
            0.0
        } else {
            f64::from(exponent) * self.value.powi(exponent.saturating_sub(1))
        };
        self.chain(self.value.powi(exponent), slope)
    }
    #[inline]
    fn abs(self) -> Self {
        self.chain(self.value.abs(), Scalar::sign(self.value))
    }
    #[inline]
    fn sign(self) -> Self {
        Self::from_value(Scalar::sign(self.value))
    }
    #[inline]
    fn floor(self) -> Self {
        Self::from_value(self.value.floor())
    }
    #[inline(always)]
    fn lt(self, other: Self) -> bool {
        self.value < other.value
    }
    #[inline(always)]
    fn le(self, other: Self) -> bool {
        self.value <= other.value
    }
    #[inline(always)]
    fn eq(self, other: Self) -> bool {
        self.value == other.value
    }
    #[inline(always)]
    fn select(mask: bool, then: Self, otherwise: Self) -> Self {
        if mask { then } else { otherwise }
    }
    #[inline(always)]
    fn decided(mask: bool) -> Option<bool> {
        Some(mask)
    }
}

/// Slope of the arcsine, zero at ±1 where it is infinite.
#[inline]
fn arc_slope(value: f64) -> f64 {
    let square = 1.0 - value * value;
    if square == 0.0 { 0.0 } else { 1.0 / square.sqrt() }
}
