//! What a machine computes with at once: a register of some lanes, or one number as a register of one lane.

use super::{Element, functions};
use crate::scalar::Inlined;

/// A register. The operations are those of [`Element`], on every lane.
///
/// Machines' registers are sealed in [`super::x86`]; `f64` and `f32` are registers of one lane, for every machine.
pub trait Vector: Copy + Send + Sync + 'static {
    /// What a lane holds.
    type Element: Element;
    /// A truth value for each lane.
    type Mask: Copy + std::fmt::Debug + Send + Sync;

    /// The same number in every lane.
    fn splat(value: Self::Element) -> Self;
    /// `self + other`
    fn add(self, other: Self) -> Self;
    /// `self - other`
    fn sub(self, other: Self) -> Self;
    /// `self * other`
    fn mul(self, other: Self) -> Self;
    /// `self / other`
    fn div(self, other: Self) -> Self;
    /// `-self`
    fn neg(self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Largest whole number not above.
    fn floor(self) -> Self;
    /// The magnitude of `self` with the sign of `sign`.
    fn copysign(self, sign: Self) -> Self;

    /// −1, 0 or 1; what is not a number stays so.
    fn sign(self) -> Self;

    /// `self < other`
    fn lt(self, other: Self) -> Self::Mask;
    /// `self <= other`
    fn le(self, other: Self) -> Self::Mask;
    /// `self == other`
    fn eq(self, other: Self) -> Self::Mask;
    /// Both.
    fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Either.
    fn or(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Neither is nor.
    fn not(a: Self::Mask) -> Self::Mask;
    /// Whether the mask holds in every lane.
    fn all(mask: Self::Mask) -> bool;
    /// `then` where the mask holds, else `otherwise`.
    fn select(mask: Self::Mask, then: Self, otherwise: Self) -> Self;

    /// A function of each number.
    fn each(self, function: impl FnMut(Self::Element) -> Self::Element) -> Self;
    /// A function of each pair of numbers.
    fn each_pair(self, other: Self, function: impl Fn(Self::Element, Self::Element) -> Self::Element)
    -> Self;

    /// Does `work` on the instructions that these registers need: what is inlined into it is compiled for them.
    fn compiled<W: Inlined>(work: W) -> W::Output;

    /// Changes the sign where the whole number in the lowest bits of `rounded` is odd.
    fn flip_if_odd(self, rounded: Self) -> Self;
    /// Two to the power of the whole number in the lowest bits of `rounded`: the exponent of a normal number.
    fn two_to(rounded: Self) -> Self;
    /// A positive normal number as m 2^e with m in [√½, √2): m and e.
    fn split(self) -> (Self, Self);
}

macro_rules! vector {
    ($float:ident, $bits:ty, mantissa $mantissa:literal, bias $bias:literal) => {
        impl Vector for $float {
            type Element = $float;
            type Mask = bool;

            #[inline(always)]
            fn splat(value: $float) -> Self {
                value
            }
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                self + other
            }
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                self - other
            }
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                self * other
            }
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                self / other
            }
            #[inline(always)]
            fn neg(self) -> Self {
                -self
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $float::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                $float::abs(self)
            }
            #[inline(always)]
            fn floor(self) -> Self {
                $float::floor(self)
            }
            #[inline(always)]
            fn copysign(self, sign: Self) -> Self {
                $float::copysign(self, sign)
            }
            #[inline(always)]
            fn sign(self) -> Self {
                functions::sign(self)
            }
            #[inline(always)]
            fn lt(self, other: Self) -> bool {
                self < other
            }
            #[inline(always)]
            fn le(self, other: Self) -> bool {
                self <= other
            }
            #[inline(always)]
            fn eq(self, other: Self) -> bool {
                self == other
            }
            #[inline(always)]
            fn and(a: bool, b: bool) -> bool {
                a & b
            }
            #[inline(always)]
            fn or(a: bool, b: bool) -> bool {
                a | b
            }
            #[inline(always)]
            fn not(a: bool) -> bool {
                !a
            }
            #[inline(always)]
            fn all(mask: bool) -> bool {
                mask
            }
            #[inline(always)]
            fn select(mask: bool, then: Self, otherwise: Self) -> Self {
                if mask { then } else { otherwise }
            }
            #[inline(always)]
            fn each(self, mut function: impl FnMut($float) -> $float) -> Self {
                function(self)
            }
            #[inline(always)]
            fn each_pair(self, other: Self, function: impl Fn($float, $float) -> $float) -> Self {
                function(self, other)
            }
            #[inline(always)]
            fn compiled<W: Inlined>(work: W) -> W::Output {
                work.run()
            }
            #[inline(always)]
            fn flip_if_odd(self, rounded: Self) -> Self {
                $float::from_bits(self.to_bits() ^ (rounded.to_bits() << (<$bits>::BITS - 1)))
            }
            #[inline(always)]
            fn two_to(rounded: Self) -> Self {
                $float::from_bits(rounded.to_bits().wrapping_add($bias) << $mantissa)
            }
            #[inline(always)]
            fn split(self) -> (Self, Self) {
                const LEAST: $bits = std::$float::consts::FRAC_1_SQRT_2.to_bits();
                const ONE: $bits = (1.0 as $float).to_bits();
                const HIGH: $float = ((1 as $bits) << $mantissa) as $float;
                let bits = self.to_bits();
                let exponent = bits.wrapping_add(ONE.wrapping_sub(LEAST)) >> $mantissa;
                let mantissa = bits.wrapping_sub(exponent << $mantissa).wrapping_add(ONE);
                let whole = $float::from_bits(exponent | HIGH.to_bits()) - (HIGH + $bias as $float);
                ($float::from_bits(mantissa), whole)
            }
        }
    };
}

vector!(f64, u64, mantissa 52, bias 1023);
vector!(f32, u32, mantissa 23, bias 127);
