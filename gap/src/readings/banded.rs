//! Linear algebra of symmetric matrices that are zero but near their diagonal: row k has the entries from the diagonal on.

/// ⟨a, b⟩ over the shorter one's length.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The Cholesky factor of a banded matrix, row by row from the diagonal on.
pub(super) struct Cholesky {
    rows: Vec<Vec<f64>>,
    pub(super) log_determinant: f64,
}

impl Cholesky {
    /// Of G + λ I. Nothing where that is not positive.
    pub(super) fn new(gram: &[Vec<f64>], diagonal: f64) -> Option<Self> {
        // Uᵀ U, by outer products: row k of U, then what it takes from the rows below.
        let mut rows: Vec<Vec<f64>> = gram.to_vec();
        let mut log_determinant = 0.0;
        for row in &mut rows {
            row[0] += diagonal;
        }
        for k in 0..rows.len() {
            let (head, tail) = rows.split_at_mut(k + 1);
            let own = &mut head[k];
            if own[0].is_nan() || own[0] <= 0.0 {
                return None;
            }
            log_determinant += own[0].ln();
            let root = own[0].sqrt();
            own.iter_mut().for_each(|v| *v /= root);
            for d in 1..own.len() {
                let below = &mut tail[d - 1];
                // Responses end at different times: what one fills in may lie beyond the next one's own band.
                if below.len() < own.len() - d {
                    below.resize(own.len() - d, 0.0);
                }
                for (v, later) in below.iter_mut().zip(&own[d..]) {
                    *v -= own[d] * later;
                }
            }
        }
        Some(Cholesky { rows, log_determinant })
    }

    /// (G + λ I)⁻¹ x.
    pub(super) fn solve(&self, x: &[f64]) -> Vec<f64> {
        let mut out = self.half(x);
        for (k, row) in self.rows.iter().enumerate().rev() {
            let later = dot(&row[1..], &out[k + 1..]);
            out[k] = (out[k] - later) / row[0];
        }
        out
    }

    /// U⁻ᵀ x: its square is xᵀ (G + λ I)⁻¹ x.
    pub(super) fn half(&self, x: &[f64]) -> Vec<f64> {
        let mut out = x.to_vec();
        for (k, row) in self.rows.iter().enumerate() {
            out[k] /= row[0];
            for (d, u) in row.iter().enumerate().skip(1) {
                out[k + d] -= u * out[k];
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_solves() {
        // Rows of different lengths, diagonally dominant.
        let gram: Vec<Vec<f64>> = (0..60_usize)
            .map(|k| {
                (0..(1 + k * 7 % 5).min(60 - k))
                    .map(|d| if d == 0 { 9.0 } else { 1.0 / (k + d) as f64 })
                    .collect()
            })
            .collect();
        let x: Vec<f64> = (0..60).map(|k| (f64::from(k) * 0.37).sin()).collect();
        let mut right: Vec<f64> = x.iter().map(|x| 0.5 * x).collect();
        for (k, row) in gram.iter().enumerate() {
            for (d, g) in row.iter().enumerate() {
                right[k] += g * x[k + d];
                if d > 0 {
                    right[k + d] += g * x[k];
                }
            }
        }
        let band = Cholesky::new(&gram, 0.5).unwrap();
        let half = band.half(&right);
        assert!((dot(&half, &half) - dot(&right, &x)).abs() < 1e-9);
        let solution = band.solve(&right);
        assert!(x.iter().zip(&solution).all(|(x, solved)| (x - solved).abs() < 1e-9));
    }
}
