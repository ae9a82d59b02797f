//! Arrays of numbers as one scalar: many parameter sets or environments at once.
//!
//! [`Lanes`] implements [`Scalar`](crate::Scalar), so that any [`Model`](crate::Model) and any
//! [`Program`](crate::Program) runs on it. Lanes do not mix: lane 3 of a result depends on lane 3 of the operands only.
//!
//! [`F64x16`] and [`F32x32`] are lanes in memory. They can be computed with anywhere, as arrays. A [`Kernel`] computes
//! with the same lanes in registers: it is compiled for several instruction sets ([`Simd`]), and [`Level::widest`] finds
//! the one to run. The bits of the results are the same on each, and agree with plain `f64` to 1e-12.
//!
//! ```
//! use parallax_model::Scalar;
//! use parallax_model::lanes::F64x16;
//!
//! let x = F64x16::from_fn(|lane| lane as f64);
//! let y = F64x16::select(x.lt(F64x16::constant(3.0)), x * 2.0, x.sin());
//! assert_eq!(y[2], 4.0);
//! assert!((y[7] - 7f64.sin()).abs() < 1e-12);
//! ```

mod element;
mod functions;
mod level;
mod scalar;
mod vector;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::fmt;
use std::ops::{Index, IndexMut};

pub use element::Element;
pub use level::{InMemory, Kernel, Level, Simd};
pub use scalar::Mask;
use vector::Vector;

/// Numbers that are computed with at once: `K` registers `V`. Outside kernels a register is one number, and `K` counts
/// the lanes.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub struct Lanes<V, const K: usize>([V; K]);

/// Sixteen lanes of double precision.
pub type F64x16 = Lanes<f64, 16>;

/// Thirty-two lanes of single precision.
pub type F32x32 = Lanes<f32, 32>;

impl<F: Element, const N: usize> Lanes<F, N> {
    /// How many lanes there are.
    pub const LANES: usize = N;

    /// The same number in every lane.
    #[inline(always)]
    pub fn splat(value: F) -> Self {
        Self([value; N])
    }

    /// Each lane from its index.
    #[inline(always)]
    pub fn from_fn(lane: impl FnMut(usize) -> F) -> Self {
        Self(std::array::from_fn(lane))
    }

    /// The lanes as an array.
    #[inline(always)]
    pub fn to_array(self) -> [F; N] {
        self.0
    }

    /// The first `N` numbers of a slice.
    ///
    /// # Panics
    ///
    /// When there are fewer.
    #[inline(always)]
    pub fn load(from: &[F]) -> Self {
        let from = &from[..N];
        Self::from_fn(|lane| from[lane])
    }

    /// Writes the lanes to the first `N` places of a slice.
    ///
    /// # Panics
    ///
    /// When there are fewer.
    #[inline(always)]
    pub fn store(self, to: &mut [F]) {
        to[..N].copy_from_slice(&self.0);
    }
}

impl<F: Element, const N: usize> Index<usize> for Lanes<F, N> {
    type Output = F;
    #[inline(always)]
    fn index(&self, lane: usize) -> &F {
        &self.0[lane]
    }
}

impl<F: Element, const N: usize> IndexMut<usize> for Lanes<F, N> {
    #[inline(always)]
    fn index_mut(&mut self, lane: usize) -> &mut F {
        &mut self.0[lane]
    }
}

impl<F: Element, const N: usize> PartialEq for Lanes<F, N> {
    fn eq(&self, other: &Self) -> bool {
        self.0 == other.0
    }
}

impl<V: Vector, const K: usize> fmt::Debug for Lanes<V, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut list = f.debug_list();
        for register in self.0 {
            register.each(|number| {
                list.entry(&number);
                number
            });
        }
        list.finish()
    }
}
