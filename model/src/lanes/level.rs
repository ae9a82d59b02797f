//! One kernel, compiled for every instruction set of the architecture and chosen at run time.

use std::fmt::Debug;
use std::sync::atomic::{AtomicU8, Ordering};

use super::{F32x32, F64x16};
use crate::dual::Dual;
use crate::scalar::Scalar;

/// The registers of an instruction set, in which a [`Kernel`] computes. Only [`Level::run`] hands them out.
pub trait Simd: Copy + Debug + Send + Sync + 'static {
    /// [`F64x16`] in registers.
    type F64x16: Scalar<Mask: Send + Sync> + Send + Sync;
    /// [`F32x32`] in registers.
    type F32x32: Scalar<Mask: Send + Sync> + Send + Sync;
}

/// Lanes in memory, which a kernel reads as registers.
///
/// ```
/// use parallax_model::lanes::{F64x16, InMemory, Kernel, Level, Simd};
///
/// /// Adds one list to another; lanes of either precision.
/// struct Accumulate<'a, T>(&'a mut [T], &'a [T]);
///
/// impl<T: InMemory> Kernel for Accumulate<'_, T> {
///     type Output = ();
///     #[inline(always)]
///     fn run<S: Simd>(self) {
///         for (sum, x) in T::registers_mut::<S>(self.0).iter_mut().zip(T::registers::<S>(self.1)) {
///             *sum += *x;
///         }
///     }
/// }
///
/// let mut sums = [F64x16::splat(1.0)];
/// Level::widest().run(Accumulate(&mut sums, &[F64x16::splat(2.0)]));
/// assert_eq!(sums[0], F64x16::splat(3.0));
/// ```
pub trait InMemory: Scalar {
    /// The same lanes in registers.
    type On<S: Simd>: Scalar<Mask: Send + Sync> + Send + Sync;

    /// The same numbers, to be read as registers.
    fn registers<S: Simd>(lanes: &[Self]) -> &[Self::On<S>];

    /// The same numbers, to be read and written as registers.
    fn registers_mut<S: Simd>(lanes: &mut [Self]) -> &mut [Self::On<S>];

    /// One number for each lane, as registers.
    #[inline(always)]
    fn load<S: Simd>(lanes: &Self) -> Self::On<S> {
        Self::registers::<S>(std::slice::from_ref(lanes))[0]
    }

    /// Puts registers into memory.
    #[inline(always)]
    fn store<S: Simd>(lanes: &mut Self, value: Self::On<S>) {
        Self::registers_mut::<S>(std::slice::from_mut(lanes))[0] = value;
    }
}

macro_rules! in_memory {
    ($lanes:ident) => {
        impl InMemory for $lanes {
            type On<S: Simd> = S::$lanes;

            #[inline(always)]
            fn registers<S: Simd>(lanes: &[Self]) -> &[S::$lanes] {
                const { assert!(same_layout::<$lanes, S::$lanes>()) };
                // SAFETY: both are the same numbers one after the other, without padding, equally aligned; every
                // pattern of bits is a number.
                unsafe { std::slice::from_raw_parts(lanes.as_ptr().cast(), lanes.len()) }
            }
            #[inline(always)]
            fn registers_mut<S: Simd>(lanes: &mut [Self]) -> &mut [S::$lanes] {
                const { assert!(same_layout::<$lanes, S::$lanes>()) };
                // SAFETY: as above; the borrow is passed on.
                unsafe { std::slice::from_raw_parts_mut(lanes.as_mut_ptr().cast(), lanes.len()) }
            }
        }
    };
}

in_memory!(F64x16);
in_memory!(F32x32);

/// One number: its own register on every machine.
impl InMemory for f64 {
    type On<S: Simd> = f64;

    #[inline(always)]
    fn registers<S: Simd>(lanes: &[Self]) -> &[f64] {
        lanes
    }
    #[inline(always)]
    fn registers_mut<S: Simd>(lanes: &mut [Self]) -> &mut [f64] {
        lanes
    }
}

/// One number with its gradient, whose entries the compiler puts into registers.
impl<const N: usize> InMemory for Dual<N> {
    type On<S: Simd> = Dual<N>;

    #[inline(always)]
    fn registers<S: Simd>(lanes: &[Self]) -> &[Dual<N>] {
        lanes
    }
    #[inline(always)]
    fn registers_mut<S: Simd>(lanes: &mut [Self]) -> &mut [Dual<N>] {
        lanes
    }
}

const fn same_layout<A, B>() -> bool {
    size_of::<A>() == size_of::<B>() && align_of::<A>() == align_of::<B>()
}

/// A piece of work that [`Level::run`] compiles once for every instruction set. See [`InMemory`] for an example.
///
/// The trap: only what is inlined into `run` is compiled for the wide instructions. Mark `run` and the functions that
/// it calls in its hot loops `#[inline(always)]`. In a function that stays a call, every operation on registers is a
/// call as well: the results have the same bits, but it is several times slower. A function that cannot be inlined, such
/// as a recursive one, wraps its body in [`Scalar::compiled`]. So does a closure that is handed to a function, such as `for_each`. This counts
/// such calls by the function that they stand in:
///
/// ```sh
/// objdump -dC target/release/parallax |
///     awk '/^[0-9a-f]+ </ { at = $0 } /call.*core_arch/ { calls[at]++ } END { for (at in calls) print calls[at], at }' | sort -rn
/// ```
pub trait Kernel {
    /// What the work gives.
    type Output;
    /// Does the work. Mark it `#[inline(always)]`.
    fn run<S: Simd>(self) -> Self::Output;
}

/// A set of vector instructions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// What every machine of this architecture has.
    Baseline,
    /// AVX2: 256 bits. Without FMA, which rounds differently.
    Avx2,
    /// AVX-512 (F, BW, CD, DQ, VL): 512 bits.
    Avx512,
}

impl Level {
    /// Every level, from the narrowest.
    pub const ALL: [Level; 3] = [Level::Baseline, Level::Avx2, Level::Avx512];

    /// The widest level that this machine has. Asked once; afterwards an atomic load.
    #[inline]
    pub fn widest() -> Level {
        match WIDEST.load(Ordering::Relaxed) {
            1 => Level::Baseline,
            2 => Level::Avx2,
            3 => Level::Avx512,
            _ => Self::detect(),
        }
    }

    #[cold]
    fn detect() -> Level {
        let widest = detected();
        WIDEST.store(widest as u8 + 1, Ordering::Relaxed);
        widest
    }

    /// Whether this machine has the level's instructions.
    #[inline]
    pub fn is_available(self) -> bool {
        self <= Self::widest()
    }

    /// Runs a kernel on this level's instructions, or on the baseline's where the machine lacks them. The results have
    /// the same bits on every level.
    #[cfg(target_arch = "x86_64")]
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        use super::x86::{Sse2, run_avx2, run_avx512};
        match self {
            // SAFETY: the machine has the instructions.
            Level::Avx512 if self.is_available() => unsafe { run_avx512(kernel) },
            // SAFETY: the machine has the instructions.
            Level::Avx2 if self.is_available() => unsafe { run_avx2(kernel) },
            _ => kernel.run::<Sse2>(),
        }
    }

    /// Runs a kernel on this level's instructions, or on the baseline's where the machine lacks them. The results have
    /// the same bits on every level.
    #[cfg(not(target_arch = "x86_64"))]
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run::<Portable>()
    }
}

/// The widest level plus one; 0 as long as nobody has asked.
static WIDEST: AtomicU8 = AtomicU8::new(0);

#[cfg(target_arch = "x86_64")]
fn detected() -> Level {
    use std::arch::is_x86_feature_detected;
    if !is_x86_feature_detected!("avx2") {
        Level::Baseline
    } else if is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512cd")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
    {
        Level::Avx512
    } else {
        Level::Avx2
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn detected() -> Level {
    Level::Baseline
}

/// Arrays, left to the compiler.
#[cfg(not(target_arch = "x86_64"))]
#[derive(Clone, Copy, Debug)]
struct Portable;

#[cfg(not(target_arch = "x86_64"))]
impl Simd for Portable {
    type F64x16 = F64x16;
    type F32x32 = F32x32;
}
