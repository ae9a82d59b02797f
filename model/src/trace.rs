//! Tracing: a model's source, run once, written down as a [`Program`].
//!
//! [`Traced`] is a [`Scalar`]. A model evaluated on it computes nothing; every operation is appended to the program
//! under construction. Constants are computed at once, an operation that was already written down is used again, and
//! what no output needs is left out. Only identities that are exact in IEEE arithmetic are used (`x · 1`, `x − 0`,
//! `−(−x)`; not `x + 0`, which turns −0 to 0), so that a program gives the same bits as the model.
//!
//! Loops that should stay loops are written with [`control`](crate::control).
//!
//! ```
//! use parallax_model::trace::trace_fn;
//!
//! let program = trace_fn("energy", &["m", "v"], &["e"], |x| vec![x[0] * x[1] * x[1] * 0.5]);
//! assert_eq!(program.to_string(), "program energy(m, v) {\n  v2 = m * v\n  v3 = v2 * v\n  v5 = v3 * 0.5\n  return e = v5\n}");
//! ```

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

use crate::model::Model;
use crate::program::{Binary, Compare, Op, Program, Unary};
use crate::scalar::{Scalar, assign_operators};
use crate::trace_builder::{self as builder, Mask, Place};
use crate::tree::{Tree, leaf_names};

/// Something known while tracing, or a place in the program.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Known<C> {
    Constant(C),
    Place(Place),
}

/// A number of the program under construction.
///
/// It exists only inside [`trace_fn`] and its relatives, and only in the function (loop body) in which it came to be
/// and those inside; using it elsewhere panics.
#[derive(Clone, Copy, Debug)]
pub struct Traced(Known<f64>);

/// The result of a comparison in the program under construction.
#[derive(Clone, Copy, Debug)]
pub struct TracedMask(Mask);

impl Traced {
    pub(crate) const ZERO: Self = Self(Known::Constant(0.0));

    pub(crate) fn at(place: Place) -> Self {
        Self(Known::Place(place))
    }

    /// Where the number is in the program, or the constant that it is.
    pub(crate) fn place(self) -> Result<Place, f64> {
        match self.0 {
            Known::Place(place) => Ok(place),
            Known::Constant(value) => Err(value),
        }
    }

    fn is(self, constant: f64) -> bool {
        matches!(self.0, Known::Constant(value) if value.to_bits() == constant.to_bits())
    }

    fn unary(self, unary: Unary) -> Self {
        match self.0 {
            Known::Constant(value) => Self::constant(unary.apply(value)),
            Known::Place(_) => Self::at(builder::emit(&[self], |values| Op::Unary(unary, values[0]))),
        }
    }

    fn binary(self, binary: Binary, other: Self) -> Self {
        if let (Known::Constant(a), Known::Constant(b)) = (self.0, other.0) {
            return Self::constant(binary.apply(a, b));
        }
        Self::at(builder::emit(&[self, other], |values| Op::Binary(binary, values[0], values[1])))
    }

    fn compare(self, compare: Compare, other: Self) -> TracedMask {
        TracedMask(match (self.0, other.0) {
            (Known::Constant(a), Known::Constant(b)) => Known::Constant(compare.apply(a, b)),
            _ => Known::Place(builder::emit(&[self, other], |values| {
                Op::Compare(compare, values[0], values[1])
            })),
        })
    }
}

impl Add for Traced {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        match (self, other) {
            (x, zero) if zero.is(-0.0) => x,
            (zero, x) if zero.is(-0.0) => x,
            _ => self.binary(Binary::Add, other),
        }
    }
}

impl Sub for Traced {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        if other.is(0.0) { self } else { self.binary(Binary::Sub, other) }
    }
}

impl Mul for Traced {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        match (self, other) {
            (x, one) if one.is(1.0) => x,
            (one, x) if one.is(1.0) => x,
            (x, minus) if minus.is(-1.0) => -x,
            (minus, x) if minus.is(-1.0) => -x,
            _ => self.binary(Binary::Mul, other),
        }
    }
}

impl Div for Traced {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        match other {
            one if one.is(1.0) => self,
            minus if minus.is(-1.0) => -self,
            _ => self.binary(Binary::Div, other),
        }
    }
}

impl Neg for Traced {
    type Output = Self;
    fn neg(self) -> Self {
        match self.0 {
            Known::Place(place) => {
                builder::inverted(place, false).map_or_else(|| self.unary(Unary::Neg), Self::at)
            }
            Known::Constant(value) => Self::constant(-value),
        }
    }
}

impl Add<f64> for Traced {
    type Output = Self;
    fn add(self, other: f64) -> Self {
        self + Self::constant(other)
    }
}

impl Sub<f64> for Traced {
    type Output = Self;
    fn sub(self, other: f64) -> Self {
        self - Self::constant(other)
    }
}

impl Mul<f64> for Traced {
    type Output = Self;
    fn mul(self, other: f64) -> Self {
        self * Self::constant(other)
    }
}

impl Div<f64> for Traced {
    type Output = Self;
    fn div(self, other: f64) -> Self {
        self / Self::constant(other)
    }
}

assign_operators!([] Traced);

impl BitAnd for TracedMask {
    type Output = Self;
    fn bitand(self, other: Self) -> Self {
        match (self.0, other.0) {
            (Known::Constant(known), _) => {
                if known {
                    other
                } else {
                    self
                }
            }
            (_, Known::Constant(known)) => {
                if known {
                    self
                } else {
                    other
                }
            }
            (Known::Place(a), Known::Place(b)) if a == b => self,
            (Known::Place(a), Known::Place(b)) => {
                Self(Known::Place(builder::emit_masked(&[a, b], &[], |masks, _| Op::And(masks[0], masks[1]))))
            }
        }
    }
}

impl BitOr for TracedMask {
    type Output = Self;
    fn bitor(self, other: Self) -> Self {
        match (self.0, other.0) {
            (Known::Constant(known), _) => {
                if known {
                    self
                } else {
                    other
                }
            }
            (_, Known::Constant(known)) => {
                if known {
                    other
                } else {
                    self
                }
            }
            (Known::Place(a), Known::Place(b)) if a == b => self,
            (Known::Place(a), Known::Place(b)) => {
                Self(Known::Place(builder::emit_masked(&[a, b], &[], |masks, _| Op::Or(masks[0], masks[1]))))
            }
        }
    }
}

impl Not for TracedMask {
    type Output = Self;
    fn not(self) -> Self {
        Self(match self.0 {
            Known::Constant(known) => Known::Constant(!known),
            Known::Place(place) => Known::Place(
                builder::inverted(place, true)
                    .unwrap_or_else(|| builder::emit_masked(&[place], &[], |masks, _| Op::Not(masks[0]))),
            ),
        })
    }
}

impl Scalar for Traced {
    type Mask = TracedMask;

    const STRUCTURED: bool = true;

    fn constant(value: f64) -> Self {
        Self(Known::Constant(value))
    }
    fn sin(self) -> Self {
        self.unary(Unary::Sin)
    }
    fn cos(self) -> Self {
        self.unary(Unary::Cos)
    }
    fn tan(self) -> Self {
        self.unary(Unary::Tan)
    }
    fn asin(self) -> Self {
        self.unary(Unary::Asin)
    }
    fn acos(self) -> Self {
        self.unary(Unary::Acos)
    }
    fn atan(self) -> Self {
        self.unary(Unary::Atan)
    }
    fn atan2(self, x: Self) -> Self {
        self.binary(Binary::Atan2, x)
    }
    fn exp(self) -> Self {
        self.unary(Unary::Exp)
    }
    fn ln(self) -> Self {
        self.unary(Unary::Ln)
    }
    fn sqrt(self) -> Self {
        self.unary(Unary::Sqrt)
    }
    fn tanh(self) -> Self {
        self.unary(Unary::Tanh)
    }
    fn powf(self, exponent: Self) -> Self {
        self.binary(Binary::Powf, exponent)
    }
    fn powi(self, exponent: i32) -> Self {
        match (self.0, exponent) {
            (Known::Constant(value), _) => Self::constant(value.powi(exponent)),
            (_, 0) => Self::constant(1.0),
            (_, 1) => self,
            _ => Self::at(builder::emit(&[self], |values| Op::Powi(values[0], exponent))),
        }
    }
    fn abs(self) -> Self {
        self.unary(Unary::Abs)
    }
    fn sign(self) -> Self {
        self.unary(Unary::Sign)
    }
    fn floor(self) -> Self {
        self.unary(Unary::Floor)
    }
    fn lt(self, other: Self) -> TracedMask {
        self.compare(Compare::Lt, other)
    }
    fn le(self, other: Self) -> TracedMask {
        self.compare(Compare::Le, other)
    }
    fn eq(self, other: Self) -> TracedMask {
        self.compare(Compare::Eq, other)
    }
    fn select(mask: TracedMask, then: Self, otherwise: Self) -> Self {
        let same = match (then.0, otherwise.0) {
            (Known::Constant(a), Known::Constant(b)) => a.to_bits() == b.to_bits(),
            (Known::Place(a), Known::Place(b)) => a == b,
            _ => false,
        };
        match mask.0 {
            _ if same => then,
            Known::Constant(true) => then,
            Known::Constant(false) => otherwise,
            Known::Place(place) => {
                Self::at(builder::emit_masked(&[place], &[then, otherwise], |masks, values| {
                    Op::Select(masks[0], values[0], values[1])
                }))
            }
        }
    }

    fn decided(mask: TracedMask) -> Option<bool> {
        match mask.0 {
            Known::Constant(known) => Some(known),
            Known::Place(_) => None,
        }
    }

    fn scan_values(
        length: usize,
        carry: &mut [Self],
        xs: &[Self],
        ys: &mut [Self],
        body: impl FnMut(&mut [Self], &[Self], &mut [Self]),
    ) {
        builder::scan(length, carry, xs, ys, body);
    }
    fn map_values(length: usize, xs: &[Self], ys: &mut [Self], body: impl FnMut(&[Self], &mut [Self])) {
        builder::map(length, xs, ys, body);
    }
    fn call_values(name: &str, xs: &[Self], ys: &mut [Self], body: impl FnOnce(&[Self], &mut [Self])) {
        builder::call(name, xs, ys, body);
    }
}

/// The program of a function of flat lists.
///
/// # Panics
///
/// When names are not distinct, or `f` gives another number of values than `outputs` names.
pub fn trace_fn<I: AsRef<str>, O: AsRef<str>>(
    name: &str,
    inputs: &[I],
    outputs: &[O],
    f: impl FnOnce(&[Traced]) -> Vec<Traced>,
) -> Program {
    let inputs = inputs.iter().map(|name| name.as_ref().to_owned()).collect();
    let outputs = outputs.iter().map(|name| name.as_ref().to_owned()).collect();
    builder::program(name, inputs, outputs, f).unwrap_or_else(|error| panic!("tracing `{name}`: {error}"))
}

/// The program of a function of trees; inputs and outputs have the leaves' names.
pub fn trace_tree<I: Tree<Traced>, O: Tree<Traced>>(name: &str, f: impl FnOnce(I) -> O) -> Program {
    trace_fn(name, &leaf_names::<Traced, I>(), &leaf_names::<Traced, O>(), |values| {
        f(I::read_from(values)).to_vec()
    })
}

/// The program of a model's step.
///
/// Inputs are the leaves of `params`, `state` and `input`, each below that name, and `dt`; outputs are the leaves of the
/// next `state` and of `output`. A tree that is a single scalar has the name alone.
pub fn trace_model<M: Model>() -> Program {
    let mut inputs = Vec::new();
    M::Params::<Traced>::names("params", &mut inputs);
    M::State::<Traced>::names("state", &mut inputs);
    M::Input::<Traced>::names("input", &mut inputs);
    inputs.push("dt".to_owned());
    let mut outputs = Vec::new();
    M::State::<Traced>::names("state", &mut outputs);
    M::Output::<Traced>::names("output", &mut outputs);
    trace_fn(M::NAME, &inputs, &outputs, |values| {
        let mut values = values.iter().copied();
        let params = M::Params::<Traced>::read(&mut values);
        let state = M::State::<Traced>::read(&mut values);
        let input = M::Input::<Traced>::read(&mut values);
        let dt = Traced::read(&mut values);
        let (state, output) = M::step(&params, state, input, dt);
        let mut out = state.to_vec();
        output.write(&mut out);
        out
    })
}
