//! One kernel, compiled for every instruction set of the machine and chosen at run time.

/// A piece of work that [`Level::run`] compiles once for every instruction set.
///
/// The trap: only what is inlined into `run` is compiled for the wider instructions. Mark `run` and the functions that
/// it calls in its hot loops `#[inline(always)]`; a call that stays a call runs on the baseline's instructions. That is
/// still correct, and the results have the same bits on every level.
///
/// ```
/// use parallax_model::lanes::{F64x16, Kernel, Level};
///
/// struct Sum<'a>(&'a [F64x16]);
///
/// impl Kernel for Sum<'_> {
///     type Output = F64x16;
///     #[inline(always)]
///     fn run(self) -> F64x16 {
///         self.0.iter().fold(F64x16::splat(0.0), |sum, x| sum + *x)
///     }
/// }
///
/// let sum = Level::widest().run(Sum(&[F64x16::splat(1.0), F64x16::splat(2.0)]));
/// assert_eq!(sum, F64x16::splat(3.0));
/// ```
pub trait Kernel {
    /// What the work gives.
    type Output;
    /// Does the work. Mark it `#[inline(always)]`.
    fn run(self) -> Self::Output;
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

    /// The widest level that this machine has. Asked once; afterwards one atomic load.
    #[inline]
    pub fn widest() -> Level {
        #[cfg(target_arch = "x86_64")]
        {
            if Level::Avx512.is_available() {
                return Level::Avx512;
            }
            if Level::Avx2.is_available() {
                return Level::Avx2;
            }
        }
        Level::Baseline
    }

    /// Whether this machine has the level's instructions.
    #[inline]
    pub fn is_available(self) -> bool {
        match self {
            Level::Baseline => true,
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => std::arch::is_x86_feature_detected!("avx2"),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => {
                std::arch::is_x86_feature_detected!("avx512f")
                    && std::arch::is_x86_feature_detected!("avx512bw")
                    && std::arch::is_x86_feature_detected!("avx512cd")
                    && std::arch::is_x86_feature_detected!("avx512dq")
                    && std::arch::is_x86_feature_detected!("avx512vl")
            }
            #[cfg(not(target_arch = "x86_64"))]
            Level::Avx2 | Level::Avx512 => false,
        }
    }

    /// Runs a kernel on this level's instructions, or on the baseline's where the machine lacks them.
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[cfg(target_arch = "x86_64")]
        {
            if self == Level::Avx512 && self.is_available() {
                // SAFETY: the machine has the instructions.
                return unsafe { run_avx512(kernel) };
            }
            if self == Level::Avx2 && self.is_available() {
                // SAFETY: the machine has the instructions.
                return unsafe { run_avx2(kernel) };
            }
        }
        kernel.run()
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
    kernel.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl")]
fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run()
}
