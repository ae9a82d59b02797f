//! Which operations of a frame are the same: what is computed once is not computed again.

use crate::program::{Binary, Compare, Op, Unary, Value};

/// What makes two operations the same.
#[derive(PartialEq, Eq, Hash)]
pub(super) enum Key {
    Constant(u64),
    Unary(Unary, Value),
    Binary(Binary, Value, Value),
    Powi(Value, i32),
    Compare(Compare, Value, Value),
    And(Value, Value),
    Or(Value, Value),
    Not(Value),
    Select(Value, Value, Value),
    /// Kind, function, length, and the lengths of the lists in front of the lists.
    Structured(u8, u32, u32, Vec<Value>),
}

impl Key {
    pub(super) fn of(op: &Op) -> Self {
        let ordered = |a: Value, b: Value| if a <= b { (a, b) } else { (b, a) };
        match op {
            Op::Constant(value) => Key::Constant(value.to_bits()),
            Op::Unary(unary, a) => Key::Unary(*unary, *a),
            // These commute exactly.
            Op::Binary(binary @ (Binary::Add | Binary::Mul), a, b) => {
                let (a, b) = ordered(*a, *b);
                Key::Binary(*binary, a, b)
            }
            Op::Binary(binary, a, b) => Key::Binary(*binary, *a, *b),
            Op::Powi(a, exponent) => Key::Powi(*a, *exponent),
            Op::Compare(Compare::Eq, a, b) => {
                let (a, b) = ordered(*a, *b);
                Key::Compare(Compare::Eq, a, b)
            }
            Op::Compare(compare, a, b) => Key::Compare(*compare, *a, *b),
            Op::And(a, b) => {
                let (a, b) = ordered(*a, *b);
                Key::And(a, b)
            }
            Op::Or(a, b) => {
                let (a, b) = ordered(*a, *b);
                Key::Or(a, b)
            }
            Op::Not(a) => Key::Not(*a),
            Op::Select(mask, then, otherwise) => Key::Select(*mask, *then, *otherwise),
            Op::Call { function, inputs } => Key::Structured(0, *function, 1, inputs.clone()),
            Op::Scan { function, length, carry, xs, captures } => {
                let sizes = [carry.len() as u32, xs.len() as u32];
                Key::Structured(1, *function, *length, [&sizes[..], carry, xs, captures].concat())
            }
            Op::Map { function, length, xs, captures } => {
                let sizes = [xs.len() as u32];
                Key::Structured(2, *function, *length, [&sizes[..], xs, captures].concat())
            }
        }
    }
}
