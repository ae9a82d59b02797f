//! The operations of a program.

use serde::{Deserialize, Serialize};

use crate::scalar::Scalar;

/// A value of a function by its number: first the inputs, then the results of each operation in turn.
pub type Value = u32;

/// One operation of a [`Function`](super::Function), in single-assignment form.
///
/// Serialized, an operation is a map from its name to its operands, as in `{"binary": ["mul", 3, 4]}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Op {
    /// A fixed number.
    Constant(#[serde(with = "any_number")] f64),
    /// A function of one number.
    Unary(Unary, Value),
    /// A function of two numbers.
    Binary(Binary, Value, Value),
    /// A number to a whole power.
    Powi(Value, i32),
    /// A comparison of two numbers; its result is a mask.
    Compare(Compare, Value, Value),
    /// Both of two masks.
    And(Value, Value),
    /// Either of two masks.
    Or(Value, Value),
    /// A mask, inverted.
    Not(Value),
    /// `Select(mask, then, otherwise)`: one of two numbers.
    Select(Value, Value, Value),
    /// The results of an earlier function.
    Call {
        /// Which function.
        function: u32,
        /// Its inputs.
        inputs: Vec<Value>,
    },
    /// A loop that hands a carry from step to step.
    ///
    /// The function maps (carry, one step's `xs`, `captures`) to (carry, one step's ys). The results are the last
    /// carry and then the ys of all steps, step after step.
    Scan {
        /// The body.
        function: u32,
        /// How many steps.
        length: u32,
        /// The first carry.
        carry: Vec<Value>,
        /// Numbers for all steps, step after step.
        xs: Vec<Value>,
        /// Numbers that are the same in every step.
        captures: Vec<Value>,
    },
    /// The same function on every element.
    ///
    /// The function maps (one element's `xs`, `captures`) to one element's ys. The results are the ys of all elements,
    /// element after element.
    Map {
        /// The body.
        function: u32,
        /// How many elements.
        length: u32,
        /// Numbers for all elements, element after element.
        xs: Vec<Value>,
        /// Numbers that are the same for every element.
        captures: Vec<Value>,
    },
}

impl Op {
    /// Calls `see` with every operand, in order.
    pub fn for_each_operand(&self, mut see: impl FnMut(Value)) {
        match self {
            Op::Constant(_) => {}
            Op::Unary(_, a) | Op::Powi(a, _) | Op::Not(a) => see(*a),
            Op::Binary(_, a, b) | Op::Compare(_, a, b) | Op::And(a, b) | Op::Or(a, b) => {
                see(*a);
                see(*b);
            }
            Op::Select(mask, then, otherwise) => {
                see(*mask);
                see(*then);
                see(*otherwise);
            }
            Op::Call { inputs, .. } => inputs.iter().copied().for_each(see),
            Op::Scan { carry, xs, captures, .. } => {
                carry.iter().chain(xs).chain(captures).copied().for_each(see)
            }
            Op::Map { xs, captures, .. } => xs.iter().chain(captures).copied().for_each(see),
        }
    }

    /// Replaces every operand.
    pub(crate) fn map_operands(&mut self, mut replace: impl FnMut(Value) -> Value) {
        match self {
            Op::Constant(_) => {}
            Op::Unary(_, a) | Op::Powi(a, _) | Op::Not(a) => *a = replace(*a),
            Op::Binary(_, a, b) | Op::Compare(_, a, b) | Op::And(a, b) | Op::Or(a, b) => {
                *a = replace(*a);
                *b = replace(*b);
            }
            Op::Select(mask, then, otherwise) => {
                *mask = replace(*mask);
                *then = replace(*then);
                *otherwise = replace(*otherwise);
            }
            Op::Call { inputs, .. } => inputs.iter_mut().for_each(|value| *value = replace(*value)),
            Op::Scan { carry, xs, captures, .. } => {
                carry.iter_mut().chain(xs).chain(captures).for_each(|value| *value = replace(*value));
            }
            Op::Map { xs, captures, .. } => {
                xs.iter_mut().chain(captures).for_each(|value| *value = replace(*value))
            }
        }
    }

    /// The function that a structured operation runs.
    pub fn function(&self) -> Option<u32> {
        match self {
            Op::Call { function, .. } | Op::Scan { function, .. } | Op::Map { function, .. } => {
                Some(*function)
            }
            _ => None,
        }
    }
}

/// Functions of one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs, reason = "the names say it, and Scalar documents each")]
pub enum Unary {
    Neg,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Exp,
    Ln,
    Sqrt,
    Tanh,
    Abs,
    Sign,
    Floor,
}

impl Unary {
    /// The function's value.
    #[inline(always)]
    pub fn apply<T: Scalar>(self, a: T) -> T {
        match self {
            Unary::Neg => -a,
            Unary::Sin => a.sin(),
            Unary::Cos => a.cos(),
            Unary::Tan => a.tan(),
            Unary::Asin => a.asin(),
            Unary::Acos => a.acos(),
            Unary::Atan => a.atan(),
            Unary::Exp => a.exp(),
            Unary::Ln => a.ln(),
            Unary::Sqrt => a.sqrt(),
            Unary::Tanh => a.tanh(),
            Unary::Abs => a.abs(),
            Unary::Sign => a.sign(),
            Unary::Floor => a.floor(),
        }
    }

    /// As it is written in a printed program.
    pub fn name(self) -> &'static str {
        match self {
            Unary::Neg => "neg",
            Unary::Sin => "sin",
            Unary::Cos => "cos",
            Unary::Tan => "tan",
            Unary::Asin => "asin",
            Unary::Acos => "acos",
            Unary::Atan => "atan",
            Unary::Exp => "exp",
            Unary::Ln => "ln",
            Unary::Sqrt => "sqrt",
            Unary::Tanh => "tanh",
            Unary::Abs => "abs",
            Unary::Sign => "sign",
            Unary::Floor => "floor",
        }
    }
}

/// Functions of two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs, reason = "the names say it, and Scalar documents each")]
pub enum Binary {
    Add,
    Sub,
    Mul,
    Div,
    Atan2,
    Powf,
}

impl Binary {
    /// The function's value.
    #[inline(always)]
    pub fn apply<T: Scalar>(self, a: T, b: T) -> T {
        match self {
            Binary::Add => a + b,
            Binary::Sub => a - b,
            Binary::Mul => a * b,
            Binary::Div => a / b,
            Binary::Atan2 => a.atan2(b),
            Binary::Powf => a.powf(b),
        }
    }

    /// As it is written in a printed program.
    pub fn name(self) -> &'static str {
        match self {
            Binary::Add => "+",
            Binary::Sub => "-",
            Binary::Mul => "*",
            Binary::Div => "/",
            Binary::Atan2 => "atan2",
            Binary::Powf => "powf",
        }
    }

    /// Whether it is written between its operands.
    pub fn is_infix(self) -> bool {
        !matches!(self, Binary::Atan2 | Binary::Powf)
    }
}

/// Comparisons of two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs, reason = "the names say it, and Scalar documents each")]
pub enum Compare {
    Lt,
    Le,
    Eq,
}

impl Compare {
    /// The comparison's mask.
    #[inline(always)]
    pub fn apply<T: Scalar>(self, a: T, b: T) -> T::Mask {
        match self {
            Compare::Lt => a.lt(b),
            Compare::Le => a.le(b),
            Compare::Eq => a.eq(b),
        }
    }

    /// As it is written in a printed program.
    pub fn name(self) -> &'static str {
        match self {
            Compare::Lt => "<",
            Compare::Le => "<=",
            Compare::Eq => "==",
        }
    }
}

/// Numbers in formats that know no infinities (JSON writes them as null): those are written as text.
mod any_number {
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum Number {
        Finite(f64),
        Text(String),
    }

    pub(super) fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        let number = if value.is_finite() { Number::Finite(*value) } else { Number::Text(value.to_string()) };
        number.serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        match Number::deserialize(deserializer)? {
            Number::Finite(value) => Ok(value),
            Number::Text(text) => {
                text.parse().map_err(|_| serde::de::Error::custom(format!("`{text}` is not a number")))
            }
        }
    }
}
