//! Loops and calls that a trace keeps as such.
//!
//! On numbers and duals these are plain loops, without allocation. On [`Traced`](crate::trace::Traced) the body is run
//! once and written down as a function; a loop over a thousand steps stays as small as one step. A body may use values
//! from outside (parameters, other states); it hands values out only through its carry and its results. Since a trace
//! runs the body once, it must not count its own runs.

use crate::scalar::Scalar;
use crate::tree::Tree;

/// Runs `body` once for each of `xs`, handing a carry from step to step; gives the last carry and all results.
///
/// ```
/// use parallax_model::control::scan;
///
/// let (sum, squares) = scan(0.0, &[1.0, 2.0, 3.0], |sum, x| (sum + x, x * x));
/// assert_eq!((sum, squares), (6.0, [1.0, 4.0, 9.0]));
/// ```
#[inline(always)]
pub fn scan<T: Scalar, C: Tree<T>, X: Tree<T>, Y: Tree<T>, const N: usize>(
    carry: C,
    xs: &[X; N],
    mut body: impl FnMut(C, &X) -> (C, Y),
) -> (C, [Y; N]) {
    if T::STRUCTURED {
        let mut carried = carry.to_vec();
        let mut ys = vec![T::constant(0.0); N * Y::LEAVES];
        T::scan_values(N, &mut carried, &xs.to_vec(), &mut ys, |carry, x, y| {
            let (next, result) = body(C::read_from(carry), &X::read_from(x));
            next.write_to(carry);
            result.write_to(y);
        });
        return (C::read_from(&carried), Tree::read_from(&ys));
    }
    let mut carry = Some(carry);
    let ys = std::array::from_fn(|step| {
        let (next, y) = body(carry.take().expect("put back below"), &xs[step]);
        carry = Some(next);
        y
    });
    (carry.expect("put back after every step"), ys)
}

/// Applies `step` to `carry`, `times` times.
///
/// ```
/// use parallax_model::control::repeat;
///
/// assert_eq!(repeat(3, 1.0, |x| x * 2.0), 8.0);
/// ```
#[inline(always)]
pub fn repeat<T: Scalar, C: Tree<T>>(times: usize, carry: C, mut step: impl FnMut(C) -> C) -> C {
    if T::STRUCTURED {
        let mut carried = carry.to_vec();
        T::scan_values(times, &mut carried, &[], &mut [], |carry, _, _| {
            step(C::read_from(carry)).write_to(carry);
        });
        return C::read_from(&carried);
    }
    let mut carry = carry;
    for _ in 0..times {
        carry = step(carry);
    }
    carry
}

/// Runs `body` on `values` where the mask holds, and leaves them as they are where it does not. On numbers it is not run in
/// vain; a trace and lanes that differ run it and choose.
///
/// ```
/// use parallax_model::Scalar;
/// use parallax_model::control::when;
///
/// let mut values = [4.0];
/// when(values[0].lt(3.0), &mut values, |values| values[0] = 0.0);
/// assert_eq!(values, [4.0]);
/// ```
#[inline(always)]
pub fn when<T: Scalar>(mask: T::Mask, values: &mut [T], body: impl FnOnce(&mut [T])) {
    match T::decided(mask) {
        Some(true) => body(values),
        Some(false) => {}
        None => {
            let before = values.to_vec();
            body(values);
            for (value, before) in values.iter_mut().zip(before) {
                *value = T::select(mask, *value, before);
            }
        }
    }
}

/// The same computation on each element.
///
/// ```
/// use parallax_model::control::map;
///
/// assert_eq!(map(&[1.0, 2.0], |x| x * x), [1.0, 4.0]);
/// ```
#[inline(always)]
pub fn map<T: Scalar, X: Tree<T>, Y: Tree<T>, const N: usize>(
    xs: &[X; N],
    mut body: impl FnMut(&X) -> Y,
) -> [Y; N] {
    if T::STRUCTURED {
        let mut ys = vec![T::constant(0.0); N * Y::LEAVES];
        T::map_values(N, &xs.to_vec(), &mut ys, |x, y| body(&X::read_from(x)).write_to(y));
        return Tree::read_from(&ys);
    }
    std::array::from_fn(|element| body(&xs[element]))
}

/// A named function: a trace writes it down once, however often it is called with other numbers.
///
/// ```
/// use parallax_model::control::call;
///
/// assert_eq!(call("double", 2.0, |x: f64| x * 2.0), 4.0);
/// ```
#[inline(always)]
pub fn call<T: Scalar, X: Tree<T>, Y: Tree<T>>(name: &str, x: X, body: impl FnOnce(X) -> Y) -> Y {
    if T::STRUCTURED {
        let mut ys = vec![T::constant(0.0); Y::LEAVES];
        T::call_values(name, &x.to_vec(), &mut ys, |x, y| body(X::read_from(x)).write_to(y));
        return Y::read_from(&ys);
    }
    body(x)
}
