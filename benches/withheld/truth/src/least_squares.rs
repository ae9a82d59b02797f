//! Small least squares.

use nalgebra::{DMatrix, DVector};

/// Takes the part along a unit vector out.
pub(crate) fn remove(r: &mut DVector<f64>, unit: &DVector<f64>) {
    r.axpy(-r.dot(unit), unit, 1.0);
}

/// Adds a column to an orthonormal basis, unless it lies in its span.
pub(crate) fn orthonormal(basis: &mut Vec<DVector<f64>>, mut column: DVector<f64>) {
    let before = column.norm();
    // Twice is enough: the second pass removes what rounding left of the first.
    for _ in 0..2 {
        basis.iter().for_each(|b| remove(&mut column, b));
    }
    let size = column.norm();
    if size > 1e-6 * before && size > 0.0 {
        basis.push(column / size);
    }
}

/// The inverse of a symmetric positive matrix; where the matrix does not see an unknown or a combination of them, zero.
pub(crate) fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    if matrix.is_empty() {
        return matrix.clone();
    }
    // Scaled to a unit diagonal, so that units of the unknowns do not matter.
    let scale = DMatrix::from_diagonal(&matrix.diagonal().map(|d| d.max(1e-300).sqrt().recip()));
    let eigen = (&scale * matrix * &scale).symmetric_eigen();
    let seen = DMatrix::from_diagonal(&eigen.eigenvalues.map(|v| if v > 1e-12 { v.recip() } else { 0.0 }));
    let vectors = eigen.eigenvectors;
    &scale * &vectors * seen * vectors.transpose() * &scale
}
