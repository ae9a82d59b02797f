//! Small least squares on plain vectors.

/// Inner product.
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Takes the part along a unit vector out.
pub(crate) fn remove(r: &mut [f64], unit: &[f64]) {
    let part = dot(r, unit);
    r.iter_mut().zip(unit).for_each(|(r, u)| *r -= part * u);
}

/// Adds a column to an orthonormal basis, unless it lies in its span.
pub(crate) fn orthonormal(basis: &mut Vec<Vec<f64>>, mut column: Vec<f64>) {
    let before = dot(&column, &column).sqrt();
    for _ in 0..2 {
        basis.iter().for_each(|b| remove(&mut column, b));
    }
    let size = dot(&column, &column).sqrt();
    if size > 1e-6 * before && size > 0.0 {
        column.iter_mut().for_each(|x| *x /= size);
        basis.push(column);
    }
}

/// Solves a symmetric positive system by elimination with pivots on the diagonal. What the matrix does not see is zero.
pub(crate) fn solve(matrix: &[Vec<f64>], right: &[f64]) -> Vec<f64> {
    let n = right.len();
    let size = |i: usize| matrix[i][i].max(0.0).sqrt().max(1e-150);
    // Scaled to a unit diagonal, so that units of the unknowns do not matter.
    let mut a: Vec<Vec<f64>> =
        (0..n).map(|i| (0..n).map(|j| matrix[i][j] / (size(i) * size(j))).collect()).collect();
    let mut b: Vec<f64> = (0..n).map(|i| right[i] / size(i)).collect();
    let mut open: Vec<usize> = (0..n).collect();
    let mut order = Vec::new();
    while let Some((at, &k)) = open.iter().enumerate().max_by(|x, y| a[*x.1][*x.1].total_cmp(&a[*y.1][*y.1]))
    {
        if a[k][k] < 1e-12 {
            break;
        }
        open.swap_remove(at);
        for &i in &open {
            let factor = a[i][k] / a[k][k];
            for j in 0..n {
                a[i][j] -= factor * a[k][j];
            }
            b[i] -= factor * b[k];
        }
        order.push(k);
    }
    let mut x = vec![0.0; n];
    for &k in order.iter().rev() {
        let known: f64 = (0..n).filter(|j| *j != k).map(|j| a[k][j] * x[j]).sum();
        x[k] = (b[k] - known) / a[k][k];
    }
    (0..n).map(|i| x[i] / size(i)).collect()
}
