//! Elementary functions without branches, on any register.
//!
//! Arguments are reduced as by Cody and Waite (*Software Manual for the Elementary Functions*, 1980), then a polynomial
//! follows. No multiplication is fused with an addition: results have the same bits on every machine.

use super::element::sealed::Constants;
use super::vector::Vector;

/// A number of the constants in every lane.
macro_rules! all {
    ($value:ident) => {
        V::splat(<V::Element as Constants>::$value)
    };
}

/// c₀ + c₁ x + c₂ x² + ..., in blocks of four, pairwise within (Estrin): less latency than Horner's chain.
#[inline(always)]
fn polynomial<V: Vector>(coefficients: &[V::Element], x: V) -> V {
    let square = x.mul(x);
    let fourth = square.mul(square);
    let mut sum = all!(ZERO);
    for (index, block) in coefficients.chunks(4).rev().enumerate() {
        let pair = |c, d| V::splat(d).mul(x).add(V::splat(c));
        let block = match *block {
            [c] => V::splat(c),
            [c, d] => pair(c, d),
            [c, d, e] => V::splat(e).mul(square).add(pair(c, d)),
            [c, d, e, f] => pair(e, f).mul(square).add(pair(c, d)),
            _ => all!(ZERO),
        };
        sum = if index == 0 { block } else { sum.mul(fourth).add(block) };
    }
    sum
}

/// Where [`sin`], [`cos`] and [`tan`] are exact enough; not where there is no number.
#[inline(always)]
pub(super) fn on_circle<V: Vector>(x: V) -> V::Mask {
    x.abs().le(all!(CIRCLE_LIMIT))
}

/// `x` minus `multiple` times a constant in two parts.
#[inline(always)]
fn reduce<V: Vector>(x: V, multiple: V, [high, low]: [V::Element; 2]) -> V {
    x.sub(multiple.mul(V::splat(high))).sub(multiple.mul(V::splat(low)))
}

/// Sine, |x| ≤ π/2.
#[inline(always)]
fn sin_reduced<V: Vector>(x: V) -> V {
    let square = x.mul(x);
    x.add(x.mul(square.mul(polynomial(V::Element::SINE, square))))
}

/// Sine of an angle [`on_circle`].
#[inline(always)]
pub(super) fn sin<V: Vector>(x: V) -> V {
    let rounded = x.mul(all!(FRAC_1_PI)).add(all!(ROUND));
    let turns = rounded.sub(all!(ROUND));
    sin_reduced(reduce(x, turns, V::Element::PI)).flip_if_odd(rounded)
}

/// Cosine of an angle [`on_circle`].
#[inline(always)]
pub(super) fn cos<V: Vector>(x: V) -> V {
    let rounded = x.mul(all!(FRAC_1_PI)).sub(all!(HALF)).add(all!(ROUND));
    let turns = rounded.sub(all!(ROUND));
    sin_reduced(reduce(x, turns.add(turns).add(all!(ONE)), V::Element::FRAC_PI_2).neg()).flip_if_odd(rounded)
}

/// Tangent of an angle [`on_circle`].
#[inline(always)]
pub(super) fn tan<V: Vector>(x: V) -> V {
    sin(x).div(cos(x))
}

/// `low` or `high` where `x` is beyond it; what is not a number stays so.
#[inline(always)]
fn clamp<V: Vector>(x: V, low: V, high: V) -> V {
    let x = V::select(x.lt(low), low, x);
    V::select(high.lt(x), high, x)
}

/// n and exp(r) − 1 for x = n ln 2 + r; n as [`Vector::two_to`] reads it.
#[inline(always)]
fn exp_reduced<V: Vector>(x: V) -> (V, V) {
    let rounded = x.mul(all!(LOG2_E)).add(all!(ROUND));
    let n = rounded.sub(all!(ROUND));
    let rest = reduce(x, n, V::Element::LN_2);
    (rounded, rest.add(rest.mul(rest).mul(polynomial(V::Element::EXP, rest))))
}

/// Natural exponential.
#[inline(always)]
pub(super) fn exp<V: Vector>(x: V) -> V {
    let [low, high] = V::Element::EXP_LIMITS.map(V::splat);
    let (rounded, rest) = exp_reduced(clamp(x, low, high));
    // In two factors: the power of two alone may be out of range where the result is not.
    let half = rounded.sub(all!(ROUND)).mul(all!(HALF)).add(all!(ROUND));
    let other = rounded.sub(half).add(all!(ROUND));
    rest.add(all!(ONE)).mul(V::two_to(half)).mul(V::two_to(other))
}

/// Natural logarithm.
#[inline(always)]
pub(super) fn ln<V: Vector>(x: V) -> V {
    let [scale, exponent] = V::Element::RESCALE.map(V::splat);
    let subnormal = x.lt(all!(MIN_POSITIVE));
    let (m, e) = V::select(subnormal, x.mul(scale), x).split();
    let e = V::select(subnormal, e.sub(exponent), e);
    // After fdlibm (Sun Microsystems, 1993), e_log.c.
    let f = m.sub(all!(ONE));
    let s = f.div(f.add(all!(TWO)));
    let square = s.mul(s);
    let rest = s.mul(f.sub(square.mul(polynomial(V::Element::LOG, square))));
    let [high, low] = V::Element::LN_2.map(V::splat);
    let result = e.mul(high).sub(rest.sub(e.mul(low)).sub(f));
    let result = V::select(x.eq(all!(ZERO)), all!(INFINITY).neg(), result);
    let result = V::select(x.eq(all!(INFINITY)), x, result);
    V::select(all!(ZERO).le(x), result, all!(NAN))
}

/// Hyperbolic tangent.
#[inline(always)]
pub(super) fn tanh<V: Vector>(x: V) -> V {
    // With e = exp(2|x|) − 1, which is exact also where it is small: tanh |x| = e / (e + 2).
    let size = x.abs();
    let size = V::select(all!(TANH_LIMIT).lt(size), all!(TANH_LIMIT), size);
    let (rounded, rest) = exp_reduced(size.add(size));
    let scale = V::two_to(rounded);
    let e = rest.mul(scale).add(scale.sub(all!(ONE)));
    e.div(e.add(all!(TWO))).copysign(x)
}

/// −1, 0 or 1; what is not a number stays so.
#[inline(always)]
pub(super) fn sign<V: Vector>(x: V) -> V {
    let size = V::select(all!(ZERO).lt(x.abs()), all!(ONE), x.abs());
    V::select(x.eq(all!(ZERO)), all!(ZERO), size.copysign(x))
}
