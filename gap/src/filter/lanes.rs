//! The covariance recursion of the filter on lanes.

use parallax_model::Scalar;
use parallax_model::lanes::{F64x16, InMemory, Kernel, Simd};

use crate::machine::columns::Columns;
use crate::simulator::{Gradient, Motion};

/// The entries of a matrix that can differ from zero, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Pattern(pub(super) Vec<Vec<usize>>);

impl Pattern {
    /// Of the transition of `live.len()` states.
    pub(super) fn new(live: &[Columns]) -> Self {
        let n = live.len();
        Pattern(live.iter().map(|row| row.iter().take_while(|k| *k < n).collect()).collect())
    }

    /// Whether it is that of these transitions.
    pub(super) fn fits(&self, live: &[Columns]) -> bool {
        let n = live.len();
        self.0.len() == n
            && self
                .0
                .iter()
                .zip(live)
                .all(|(own, row)| row.iter().take_while(|k| *k < n).eq(own.iter().copied()))
    }
}

/// P ← Φ P Φᵀ + dt (Φ_½ B Φ_½ᵀ), with Φ_½ = (I + Φ)/2: the noise enters, on average, in the middle of the step.
#[inline(always)]
pub(super) fn propagate<T: Scalar>(
    pattern: &Pattern,
    phi: &[T],
    dt: T,
    intensity: &[f64],
    p: &mut [T],
    scratch: &mut [T],
) {
    let zero = T::constant(0.0);
    let n = intensity.len();
    let (moved, half) = scratch.split_at_mut(n * n);
    half.fill(zero);
    for (i, row) in pattern.0.iter().enumerate() {
        for j in 0..n {
            let mut sum = zero;
            for k in row {
                sum += phi[i * n + k] * p[k * n + j];
            }
            moved[i * n + j] = sum;
        }
        for k in row {
            half[i * n + k] = (phi[i * n + k] + f64::from(u8::from(i == *k))) * 0.5;
        }
    }
    for i in 0..n {
        for j in 0..=i {
            let (mut value, mut added) = (zero, zero);
            for &k in &pattern.0[j] {
                value += moved[i * n + k] * phi[j * n + k];
                if intensity[k] > 0.0 {
                    added += half[i * n + k] * half[j * n + k] * intensity[k];
                }
            }
            value += dt * added;
            p[i * n + j] = value;
            p[j * n + i] = value;
        }
    }
}

/// Variance of the innovation of a reading with gradient `h`, which is zero but for the states `seen`; the gain of lanes that read, zero in the others.
#[inline(always)]
pub(super) fn innovate<T: Scalar>(
    seen: &[usize],
    h: &[T],
    noise: T,
    rests: T::Mask,
    p: &[T],
    gain: &mut [T],
) -> T {
    let zero = T::constant(0.0);
    let n = gain.len();
    let mut variance = noise;
    for i in 0..n {
        let mut sum = zero;
        for &j in seen {
            sum += p[i * n + j] * h[j];
        }
        gain[i] = sum;
    }
    for &i in seen {
        variance += h[i] * gain[i];
    }
    for g in gain.iter_mut() {
        *g = T::select(rests, zero, *g / variance);
    }
    variance
}

/// P ← P − K s Kᵀ in the lanes that read.
#[inline(always)]
pub(super) fn update<T: Scalar>(n: usize, gain: &[T], variance: T, rests: T::Mask, p: &mut [T]) {
    let zero = T::constant(0.0);
    for i in 0..n {
        let scaled = T::select(rests, zero, gain[i] * variance);
        for j in 0..n {
            p[i * n + j] -= scaled * gain[j];
        }
        // Rounding must not make a variance negative where the reading pins the state down.
        p[i * n + i] = p[i * n + i].max(zero);
    }
}

/// A step of the covariance.
pub(super) struct Covariance<'a> {
    pub(super) pattern: &'a Pattern,
    pub(super) by_state: &'a [F64x16],
    pub(super) dt: &'a F64x16,
    pub(super) intensity: &'a [f64],
    pub(super) covariance: &'a mut [F64x16],
    pub(super) scratch: &'a mut [F64x16],
}

impl Kernel for Covariance<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        propagate(
            self.pattern,
            F64x16::registers::<S>(self.by_state),
            <F64x16 as InMemory>::load::<S>(self.dt),
            self.intensity,
            F64x16::registers_mut::<S>(self.covariance),
            F64x16::registers_mut::<S>(self.scratch),
        );
    }
}

/// A reading corrects the states and their sensitivities; gives the innovation's variance.
pub(super) struct Read<'a> {
    /// Derivatives of the prediction by the states, then by θ.
    pub(super) row: &'a Gradient,
    /// The states that the reading depends on.
    pub(super) seen: &'a [usize],
    pub(super) innovation: &'a F64x16,
    pub(super) noise: &'a F64x16,
    /// 1 in the lanes that read.
    pub(super) active: &'a F64x16,
    pub(super) motion: &'a mut Motion,
    pub(super) covariance: &'a mut [F64x16],
    pub(super) gain: &'a mut [F64x16],
}

impl Kernel for Read<'_> {
    type Output = F64x16;

    #[inline(always)]
    fn run<S: Simd>(self) -> F64x16 {
        let n = self.gain.len();
        let columns = self.motion.columns;
        let row = F64x16::registers::<S>(&self.row.by);
        let gain = F64x16::registers_mut::<S>(self.gain);
        let p = F64x16::registers_mut::<S>(self.covariance);
        let x = F64x16::registers_mut::<S>(&mut self.motion.x);
        let by = F64x16::registers_mut::<S>(&mut self.motion.by);
        let innovation = <F64x16 as InMemory>::load::<S>(self.innovation);
        let rests = <F64x16 as InMemory>::load::<S>(self.active)
            .eq(<F64x16 as InMemory>::load::<S>(&F64x16::splat(0.0)));
        let noise = <F64x16 as InMemory>::load::<S>(self.noise);
        let variance = innovate(self.seen, &row[..n], noise, rests, p, gain);
        for i in 0..n {
            x[i] += gain[i] * innovation;
            for column in self.row.live.iter().skip_while(|column| *column < n) {
                // The innovation is the reading less the prediction.
                by[i * columns + column] -= gain[i] * row[column];
                self.motion.live[i].insert(column);
            }
        }
        update(n, gain, variance, rests, p);
        let mut out = F64x16::splat(0.0);
        <F64x16 as InMemory>::store::<S>(&mut out, variance);
        out
    }
}
