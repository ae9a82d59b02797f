//! Lanes as a [`Scalar`].

use std::fmt;
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::vector::Vector;
use super::{Element, Lanes, functions};
use crate::scalar::{Inlined, Scalar, assign_operators};

/// One truth value for each lane.
#[derive(Clone, Copy)]
pub struct Mask<V: Vector, const K: usize>([V::Mask; K]);

impl<V: Vector, const K: usize> Mask<V, K> {
    /// The truth values, register by register.
    pub fn registers(&self) -> &[V::Mask; K] {
        &self.0
    }
}

impl<V: Vector, const K: usize> fmt::Debug for Mask<V, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Mask").field(&self.0).finish()
    }
}

impl<V: Vector, const K: usize> BitAnd for Mask<V, K> {
    type Output = Self;
    #[inline(always)]
    fn bitand(mut self, other: Self) -> Self {
        for k in 0..K {
            self.0[k] = V::and(self.0[k], other.0[k]);
        }
        self
    }
}

impl<V: Vector, const K: usize> BitOr for Mask<V, K> {
    type Output = Self;
    #[inline(always)]
    fn bitor(mut self, other: Self) -> Self {
        for k in 0..K {
            self.0[k] = V::or(self.0[k], other.0[k]);
        }
        self
    }
}

impl<V: Vector, const K: usize> Not for Mask<V, K> {
    type Output = Self;
    #[inline(always)]
    fn not(mut self) -> Self {
        for k in 0..K {
            self.0[k] = V::not(self.0[k]);
        }
        self
    }
}

/// The same function on every register. Macros, since a function that is passed on is compiled by itself, for the
/// baseline, and then called.
macro_rules! map {
    ($x:expr, $register:ident => $result:expr) => {{
        let mut lanes = $x;
        for k in 0..K {
            let $register = lanes.0[k];
            lanes.0[k] = $result;
        }
        lanes
    }};
}

/// The same function on every pair of registers.
macro_rules! zip {
    ($x:expr, $y:expr, ($a:ident, $b:ident) => $result:expr) => {{
        let (mut lanes, other) = ($x, $y);
        for k in 0..K {
            let ($a, $b) = (lanes.0[k], other.0[k]);
            lanes.0[k] = $result;
        }
        lanes
    }};
}

/// The same comparison of every pair of registers.
macro_rules! compare {
    ($x:expr, $y:expr, ($a:ident, $b:ident) => $result:expr) => {{
        let (lanes, other) = ($x, $y);
        let holds = |$a: V, $b: V| $result;
        let mut mask = [holds(lanes.0[0], other.0[0]); K];
        for k in 1..K {
            mask[k] = holds(lanes.0[k], other.0[k]);
        }
        Mask(mask)
    }};
}

/// A function of angles: the first on all lanes, or the second lane by lane if one angle is too large for it.
macro_rules! circular {
    ($x:expr, $near:ident, $exact:path) => {{
        let x = $x;
        let mut on_circle = functions::on_circle(x.0[0]);
        for k in 1..K {
            on_circle = V::and(on_circle, functions::on_circle(x.0[k]));
        }
        let near = map!(x, register => functions::$near(register));
        if V::all(on_circle) {
            near
        } else {
            zip!(x, near, (x, near) => large_angles(x, near, $exact))
        }
    }};
}

macro_rules! operator {
    ($operator:ident, $method:ident) => {
        impl<V: Vector, const K: usize> $operator for Lanes<V, K> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                zip!(self, other, (a, b) => a.$method(b))
            }
        }

        impl<V: Vector, const K: usize> $operator<f64> for Lanes<V, K> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: f64) -> Self {
                zip!(self, Self::constant(other), (a, b) => a.$method(b))
            }
        }
    };
}

operator!(Add, add);
operator!(Sub, sub);
operator!(Mul, mul);
operator!(Div, div);
assign_operators!([V: Vector, const K: usize] Lanes<V, K>);

impl<V: Vector, const K: usize> Neg for Lanes<V, K> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        map!(self, x => x.neg())
    }
}

impl<V: Vector, const K: usize> Lanes<V, K> {
    /// A function of doubles, lane by lane.
    #[inline(always)]
    fn each(self, function: fn(f64) -> f64) -> Self {
        map!(self, x => x.each(|x| V::Element::from_f64(function(x.to_f64()))))
    }
}

/// `exact` in the lanes whose angles are too large; `near` in the others, so that lanes do not mix. Register by register:
/// lanes as a whole would be passed in memory, also where the angles are not too large.
#[cold]
#[inline(never)]
fn large_angles<V: Vector>(x: V, near: V, exact: fn(f64) -> f64) -> V {
    x.each_pair(
        near,
        |x, near| {
            if functions::on_circle(x) { near } else { V::Element::from_f64(exact(x.to_f64())) }
        },
    )
}

impl<V: Vector, const K: usize> Scalar for Lanes<V, K> {
    type Mask = Mask<V, K>;
    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self([V::splat(V::Element::from_f64(value)); K])
    }
    #[inline(always)]
    #[allow(clippy::manual_memcpy, reason = "a copy as memory is what this is to avoid")]
    fn loaded(&self) -> Self {
        let mut registers = [self.0[0]; K];
        for k in 1..K {
            registers[k] = self.0[k];
        }
        Self(registers)
    }
    #[inline(always)]
    fn sin(self) -> Self {
        circular!(self, sin, f64::sin)
    }
    #[inline(always)]
    fn cos(self) -> Self {
        circular!(self, cos, f64::cos)
    }
    #[inline(always)]
    fn tan(self) -> Self {
        circular!(self, tan, f64::tan)
    }
    #[inline(always)]
    fn asin(self) -> Self {
        self.each(f64::asin)
    }
    #[inline(always)]
    fn acos(self) -> Self {
        self.each(f64::acos)
    }
    #[inline(always)]
    fn atan(self) -> Self {
        self.each(f64::atan)
    }
    #[inline(always)]
    fn atan2(self, x: Self) -> Self {
        zip!(self, x, (y, x) => y.each_pair(x, |y, x| V::Element::from_f64(y.to_f64().atan2(x.to_f64()))))
    }
    #[inline(always)]
    fn exp(self) -> Self {
        map!(self, x => functions::exp(x))
    }
    #[inline(always)]
    fn ln(self) -> Self {
        map!(self, x => functions::ln(x))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        map!(self, x => x.sqrt())
    }
    #[inline(always)]
    fn tanh(self) -> Self {
        map!(self, x => functions::tanh(x))
    }
    #[inline(always)]
    fn powf(self, exponent: Self) -> Self {
        zip!(self, exponent, (x, exponent) => x.each_pair(exponent, |x, exponent| V::Element::from_f64(x.to_f64().powf(exponent.to_f64()))))
    }
    #[inline(always)]
    fn powi(self, exponent: i32) -> Self {
        // By squaring: the compiler's own `powi` leaves the order of the products open.
        let mut rest = exponent.unsigned_abs();
        let mut square = self;
        let mut product = Self::constant(1.0);
        while rest != 0 {
            if rest & 1 == 1 {
                product *= square;
            }
            rest >>= 1;
            if rest != 0 {
                square *= square;
            }
        }
        if exponent < 0 { Self::constant(1.0) / product } else { product }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        map!(self, x => x.abs())
    }
    #[inline(always)]
    fn sign(self) -> Self {
        map!(self, x => x.sign())
    }
    #[inline(always)]
    fn floor(self) -> Self {
        map!(self, x => x.floor())
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask<V, K> {
        compare!(self, other, (a, b) => a.lt(b))
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask<V, K> {
        compare!(self, other, (a, b) => a.le(b))
    }
    #[inline(always)]
    fn eq(self, other: Self) -> Mask<V, K> {
        compare!(self, other, (a, b) => a.eq(b))
    }
    #[inline(always)]
    fn gt(self, other: Self) -> Mask<V, K> {
        compare!(self, other, (a, b) => b.lt(a))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> Mask<V, K> {
        compare!(self, other, (a, b) => b.le(a))
    }
    #[inline(always)]
    fn select(mask: Mask<V, K>, then: Self, otherwise: Self) -> Self {
        let mut result = otherwise;
        for k in 0..K {
            result.0[k] = V::select(mask.0[k], then.0[k], otherwise.0[k]);
        }
        result
    }
    #[inline(always)]
    fn decided(mask: Mask<V, K>) -> Option<bool> {
        let all = |mask: Mask<V, K>| mask.0.iter().all(|mask| V::all(*mask));
        if all(mask) {
            return Some(true);
        }
        all(!mask).then_some(false)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        zip!(self, other, (a, b) => V::select(a.lt(b), a, b))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        zip!(self, other, (a, b) => V::select(b.lt(a), a, b))
    }
    #[inline(always)]
    fn clamp(self, low: Self, high: Self) -> Self {
        self.max(low).min(high)
    }

    #[inline(always)]
    fn compiled<W: Inlined>(work: W) -> W::Output {
        V::compiled(work)
    }
}
