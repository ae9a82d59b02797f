//! Roots of covariances: lower triangles, packed row by row.

use crate::scalar::Scalar;

/// Loops of at most so many operations are written out in a trace.
const SHORT: usize = 64;

/// How many numbers a triangle of `n` rows has.
pub(super) const fn packed(n: usize) -> usize {
    n * (n + 1) / 2
}

/// Where row `i`, column `j` is.
#[inline(always)]
pub(super) const fn at(i: usize, j: usize) -> usize {
    packed(i) + j
}

/// The lower triangle L with L Lᵀ = A Aᵀ, of `rows`, an n × k matrix that is used up: Gram–Schmidt's orthogonalisation of the
/// rows, in its modified form, whose triangle is as exact as that of Householder's method (Å. Björck, "Numerical Methods for
/// Least Squares Problems", 2.4). A row without any length gives a column of zeros.
#[inline(always)]
pub(super) fn triangularise<T: Scalar>(rows: &mut [T], n: usize, root: &mut [T]) {
    let width = rows.len() / n;
    for i in 0..n {
        let (done, rest) = rows.split_at_mut((i + 1) * width);
        let row = &mut done[i * width..];
        let length = dot(row, row).sqrt();
        root[at(i, i)] = length;
        let zero = T::constant(0.0);
        let is = zero.lt(length);
        let inverse = T::select(is, T::constant(1.0) / T::select(is, length, T::constant(1.0)), zero);
        row.iter_mut().for_each(|value| *value *= inverse);
        let row = &*row;
        if T::STRUCTURED && rest.len() > SHORT {
            let others = rest.to_vec();
            let mut results = vec![zero; (n - 1 - i) * (width + 1)];
            T::map_values(n - 1 - i, &others, &mut results, |other, result| {
                result[1..].copy_from_slice(other);
                result[0] = project(row, &mut result[1..]);
            });
            for (k, result) in results.chunks_exact(width + 1).enumerate() {
                root[at(i + 1 + k, i)] = result[0];
                rest[k * width..(k + 1) * width].copy_from_slice(&result[1..]);
            }
        } else {
            for (k, other) in rest.chunks_exact_mut(width).enumerate() {
                root[at(i + 1 + k, i)] = project(row, other);
            }
        }
    }
}

/// The share of `row`, of length 1, in `other`, which is taken out of it.
#[inline(always)]
fn project<T: Scalar>(row: &[T], other: &mut [T]) -> T {
    let share = dot(row, other);
    other.iter_mut().zip(row).for_each(|(value, direction)| *value -= share * *direction);
    share
}

#[inline(always)]
fn dot<T: Scalar>(a: &[T], b: &[T]) -> T {
    let mut products = a.iter().zip(b).map(|(a, b)| *a * *b);
    let first = products.next().unwrap_or(T::constant(0.0));
    products.fold(first, |sum, product| sum + product)
}

/// Solves L x = b in place, for a triangle without zeros on its diagonal.
#[inline(always)]
pub(super) fn forward<T: Scalar>(root: &[T], b: &mut [T]) {
    for i in 0..b.len() {
        for j in 0..i {
            let known = b[j];
            b[i] -= root[at(i, j)] * known;
        }
        b[i] /= root[at(i, i)];
    }
}

/// Solves Lᵀ x = b in place, for a triangle without zeros on its diagonal.
#[inline(always)]
pub(super) fn backward<T: Scalar>(root: &[T], b: &mut [T]) {
    for i in (0..b.len()).rev() {
        for j in i + 1..b.len() {
            let known = b[j];
            b[i] -= root[at(j, i)] * known;
        }
        b[i] /= root[at(i, i)];
    }
}

/// The root of L Lᵀ + s² e eᵀ with the unit vector e of `place`: white noise of deviation `std` on one state. By rotations of
/// the columns from there on. `v` has room for a column, and is used up.
#[inline(always)]
pub(super) fn disturb<T: Scalar>(root: &mut [T], place: usize, std: T, v: &mut [T]) {
    let (zero, one) = (T::constant(0.0), T::constant(1.0));
    v.fill(zero);
    v[place] = std;
    for k in place..v.len() {
        let length = (root[at(k, k)] * root[at(k, k)] + v[k] * v[k]).sqrt();
        if k + 1 < v.len() {
            let is = zero.lt(length);
            let inverse = one / T::select(is, length, one);
            // Nothing is turned where both are zero.
            let (c, s) = (T::select(is, root[at(k, k)] * inverse, one), v[k] * inverse);
            for i in k + 1..v.len() {
                let (below, own) = (root[at(i, k)], v[i]);
                root[at(i, k)] = c * below + s * own;
                v[i] = c * own - s * below;
            }
        }
        root[at(k, k)] = length;
    }
}

/// The root of L Lᵀ − v vᵀ, by hyperbolic rotations (R. van der Merwe, E. Wan, "The square-root unscented Kalman filter",
/// ICASSP 2001: `cholupdate` with a negative sign). `v` is used up. Where that is no covariance, the root stays as it is,
/// which believes too little rather than too much: the result is 1 then, else 0. `before` has room for the root.
#[inline(always)]
pub(super) fn downdate<T: Scalar>(root: &mut [T], v: &mut [T], before: &mut [T]) -> T {
    let (zero, one) = (T::constant(0.0), T::constant(1.0));
    before.copy_from_slice(root);
    let mut fails = zero.lt(zero);
    for i in 0..v.len() {
        let length = root[at(i, i)];
        let squared = length * length - v[i] * v[i];
        // A direction without variance, from which nothing is taken.
        let idle = v[i].eq(zero);
        let impossible = !(zero.lt(squared) | idle);
        fails = fails | impossible;
        let squared = T::select(idle | impossible, one, squared);
        let length = T::select(idle | impossible, one, length);
        let next = squared.sqrt();
        let (c, s) = (next / length, v[i] / length);
        root[at(i, i)] = T::select(idle, root[at(i, i)], next);
        for k in i + 1..v.len() {
            let below = (root[at(k, i)] - s * v[k]) / c;
            v[k] = c * v[k] - s * below;
            root[at(k, i)] = below;
        }
    }
    for (value, before) in root.iter_mut().zip(before) {
        *value = T::select(fails, *before, *value);
    }
    T::select(fails, one, zero)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(root: &[f64], n: usize) -> Vec<f64> {
        let entry = |i: usize, j: usize| if j <= i { root[at(i, j)] } else { 0.0 };
        let pairs = (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
        pairs.map(|(i, j)| (0..n).map(|k| entry(i, k) * entry(j, k)).sum()).collect()
    }

    #[test]
    fn a_triangle_squares_to_what_it_was_made_from() {
        let rows: [f64; 8] = [1.0, -2.0, 0.5, 3.0, 0.25, 1.5, -1.0, 2.0];
        let mut root = [0.0; 3];
        triangularise(&mut rows.clone(), 2, &mut root);
        let product = |i: usize, j: usize| (0..4).map(|k| rows[i * 4 + k] * rows[j * 4 + k]).sum::<f64>();
        let squared = square(&root, 2);
        for (i, j) in [(0, 0), (0, 1), (1, 1)] {
            assert!((squared[i * 2 + j] - product(i, j)).abs() < 1e-12);
        }
        let mut nothing = [0.0, 0.0, 1.0, 1.0];
        triangularise(&mut nothing, 2, &mut root);
        assert_eq!(root[..2], [0.0, 0.0], "what is known for sure stays so");
        assert!((root[2] - 2f64.sqrt()).abs() < 1e-15);
    }

    #[test]
    fn noise_on_one_state_adds_its_square_there() {
        for root in [[2.0, 0.5, 1.0, -0.3, 0.7, 0.4], [0.0, 0.5, 0.0, -0.3, 0.7, 0.0]] {
            for place in 0..3 {
                let mut more = root;
                disturb(&mut more, place, 0.6, &mut [0.0; 3]);
                let (before, after) = (square(&root, 3), square(&more, 3));
                for k in 0..9 {
                    let added = if k == 4 * place { 0.36 } else { 0.0 };
                    assert!((after[k] - before[k] - added).abs() < 1e-14, "{place} {k}");
                }
            }
        }
    }

    #[test]
    fn a_downdate_takes_a_square_off_or_says_that_it_cannot() {
        let root = [2.0, 0.5, 1.0];
        let mut less = root;
        assert_eq!(downdate(&mut less, &mut [0.7, 0.3], &mut [0.0; 3]), 0.0);
        let (full, rest) = (square(&root, 2), square(&less, 2));
        for (k, taken) in [0.49, 0.21, 0.21, 0.09].into_iter().enumerate() {
            assert!((full[k] - taken - rest[k]).abs() < 1e-14);
        }
        let mut kept = root;
        assert_eq!(downdate(&mut kept, &mut [0.1, 5.0], &mut [0.0; 3]), 1.0);
        assert_eq!(kept, root);
    }
}
