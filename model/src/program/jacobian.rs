//! Derivatives of a program.

use nalgebra::DMatrix;

use super::{Program, Workspace};
use crate::dual::Dual;
use crate::scalar::Scalar;

/// How many derivatives one evaluation carries: eight `f64` fill one AVX-512 register.
const CHUNK: usize = 8;

impl Program {
    /// The derivative of every output (row) with respect to each input in `wrt` (column), exact up to rounding.
    ///
    /// # Panics
    ///
    /// When `inputs` has another length than the program, or `wrt` names an input that is not there.
    pub fn jacobian(&self, inputs: &[f64], wrt: &[usize]) -> DMatrix<f64> {
        let mut jacobian = DMatrix::zeros(self.outputs().len(), wrt.len());
        let mut workspace = Workspace::new();
        let mut outputs = vec![Dual::<CHUNK>::default(); self.outputs().len()];
        let mut duals: Vec<Dual<CHUNK>> = inputs.iter().map(|value| Dual::constant(*value)).collect();
        for (chunk, columns) in wrt.chunks(CHUNK).enumerate() {
            for (direction, column) in columns.iter().enumerate() {
                duals[*column].gradient[direction] = 1.0;
            }
            self.evaluate(&duals, &mut workspace, &mut outputs);
            for (row, output) in outputs.iter().enumerate() {
                for direction in 0..columns.len() {
                    jacobian[(row, chunk * CHUNK + direction)] = output.gradient[direction];
                }
            }
            for column in columns {
                duals[*column].gradient = [0.0; CHUNK];
            }
        }
        jacobian
    }
}
