//! Sums over readings on lanes: the normal equations of windows, output by output.

use parallax_model::Scalar;
use parallax_model::lanes::{F64x16, InMemory, Kernel, Simd};

use crate::simulator::Gradient;

/// Unweighted normal equations of one output's readings.
#[derive(Clone, Debug)]
pub(super) struct Sums {
    pub(super) squares: F64x16,
    pub(super) information: Vec<F64x16>,
    pub(super) gradient: Vec<F64x16>,
}

impl Sums {
    pub(super) fn new(columns: usize) -> Self {
        let zero = F64x16::splat(0.0);
        let entries = columns * (columns + 1) / 2;
        Sums { squares: zero, information: vec![zero; entries], gradient: vec![zero; columns] }
    }

    pub(super) fn clear(&mut self) {
        let zero = F64x16::splat(0.0);
        self.squares = zero;
        self.information.fill(zero);
        self.gradient.fill(zero);
    }
}

/// Adds a reading of each lane to the normal equations; lanes that rest add nothing, whatever they hold.
pub(super) struct Accumulate<'a> {
    /// Derivatives of the prediction.
    pub(super) row: &'a Gradient,
    pub(super) error: &'a F64x16,
    /// 1 in the lanes that read.
    pub(super) active: &'a F64x16,
    pub(super) sums: &'a mut Sums,
}

impl Kernel for Accumulate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let row = F64x16::registers::<S>(&self.row.by);
        let information = F64x16::registers_mut::<S>(&mut self.sums.information);
        let gradient = F64x16::registers_mut::<S>(&mut self.sums.gradient);
        let error = <F64x16 as InMemory>::load::<S>(self.error);
        let zero = <F64x16 as InMemory>::load::<S>(&F64x16::splat(0.0));
        let rests = <F64x16 as InMemory>::load::<S>(self.active).eq(zero);
        let squares = <F64x16 as InMemory>::load::<S>(&self.sums.squares);
        <F64x16 as InMemory>::store::<S>(&mut self.sums.squares, squares + error * error);
        for i in self.row.live.iter() {
            let by = Scalar::select(rests, zero, row[i]);
            // The residual is the reading less the prediction.
            gradient[i] -= by * error;
            let first = i * (i + 1) / 2;
            for j in self.row.live.iter().take_while(|j| *j <= i) {
                // What a resting lane holds may be no number.
                information[first + j] += by * Scalar::select(rests, zero, row[j]);
            }
        }
    }
}

/// Adds numbers times a weight.
pub(super) struct AddScaled<'a> {
    pub(super) to: &'a mut [F64x16],
    pub(super) from: &'a [F64x16],
    pub(super) weight: f64,
}

impl Kernel for AddScaled<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let from = F64x16::registers::<S>(self.from);
        for (to, from) in F64x16::registers_mut::<S>(self.to).iter_mut().zip(from) {
            *to += *from * self.weight;
        }
    }
}
