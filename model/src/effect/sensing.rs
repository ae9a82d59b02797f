//! Effects between an output's true value and its reading.

use crate::Scalar;

pub(super) fn bias<T: Scalar>(bias: T, value: T) -> T {
    value + bias
}
