//! Lanes as a [`Scalar`].

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use super::{Element, Lanes};
use crate::scalar::{Scalar, assign_operators};

/// One truth value for each lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mask<const N: usize>(pub [bool; N]);

impl<const N: usize> BitAnd for Mask<N> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane] & other.0[lane]))
    }
}

impl<const N: usize> BitOr for Mask<N> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane] | other.0[lane]))
    }
}

impl<const N: usize> Not for Mask<N> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(self.0.map(|lane| !lane))
    }
}

macro_rules! operator {
    ($operator:ident, $method:ident, $sign:tt) => {
        impl<F: Element, const N: usize> $operator for Lanes<F, N> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self::from_fn(|lane| self.0[lane] $sign other.0[lane])
            }
        }

        impl<F: Element, const N: usize> $operator<f64> for Lanes<F, N> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: f64) -> Self {
                let other = F::from_f64(other);
                Self::from_fn(|lane| self.0[lane] $sign other)
            }
        }
    };
}

operator!(Add, add, +);
operator!(Sub, sub, -);
operator!(Mul, mul, *);
operator!(Div, div, /);
assign_operators!([F: Element, const N: usize] Lanes<F, N>);

impl<F: Element, const N: usize> Neg for Lanes<F, N> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self::from_fn(|lane| -self.0[lane])
    }
}

impl<F: Element, const N: usize> Lanes<F, N> {
    /// A function of doubles, lane by lane.
    #[inline(always)]
    fn each(self, function: impl Fn(f64) -> f64) -> Self {
        Self::from_fn(|lane| F::from_f64(function(self.0[lane].to_f64())))
    }
}

impl<F: Element, const N: usize> Scalar for Lanes<F, N> {
    type Mask = Mask<N>;

    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self::splat(F::from_f64(value))
    }
    #[inline(always)]
    fn sin(self) -> Self {
        self.each(f64::sin)
    }
    #[inline(always)]
    fn cos(self) -> Self {
        self.each(f64::cos)
    }
    #[inline(always)]
    fn tan(self) -> Self {
        self.each(f64::tan)
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
        Self::from_fn(|lane| F::from_f64(self.0[lane].to_f64().atan2(x.0[lane].to_f64())))
    }
    #[inline(always)]
    fn exp(self) -> Self {
        self.each(f64::exp)
    }
    #[inline(always)]
    fn ln(self) -> Self {
        self.each(f64::ln)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self::from_fn(|lane| self.0[lane].sqrt())
    }
    #[inline(always)]
    fn tanh(self) -> Self {
        self.each(f64::tanh)
    }
    #[inline(always)]
    fn powf(self, exponent: Self) -> Self {
        Self::from_fn(|lane| F::from_f64(self.0[lane].to_f64().powf(exponent.0[lane].to_f64())))
    }
    #[inline(always)]
    fn powi(self, exponent: i32) -> Self {
        Self::from_fn(|lane| self.0[lane].powi(exponent))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::from_fn(|lane| self.0[lane].abs())
    }
    #[inline(always)]
    fn sign(self) -> Self {
        let (zero, one) = (F::from_f64(0.0), F::from_f64(1.0));
        // A number that is not one stays what it is, as with `f64::signum`.
        Self::from_fn(|lane| {
            let x = self.0[lane];
            let down = if x < zero { -one } else { x };
            let up = if x > zero { one } else { down };
            if x == zero { zero } else { up }
        })
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self::from_fn(|lane| self.0[lane].floor())
    }

    #[inline(always)]
    fn lt(self, other: Self) -> Mask<N> {
        Mask(std::array::from_fn(|lane| self.0[lane] < other.0[lane]))
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask<N> {
        Mask(std::array::from_fn(|lane| self.0[lane] <= other.0[lane]))
    }
    #[inline(always)]
    fn eq(self, other: Self) -> Mask<N> {
        Mask(std::array::from_fn(|lane| self.0[lane] == other.0[lane]))
    }
    #[inline(always)]
    fn select(mask: Mask<N>, then: Self, otherwise: Self) -> Self {
        Self::from_fn(|lane| if mask.0[lane] { then.0[lane] } else { otherwise.0[lane] })
    }
}
