//! The likelihood of a tape at another noise, without the model: exact first derivatives by the logarithms of variances, and Fisher's
//! information of the innovations (Gupta & Mehra 1974, "Computational aspects of maximum likelihood estimation and reduction in
//! sensitivity function calculations").

use parallax_model::Scalar;
use parallax_model::fit::Local;
use parallax_model::lanes::{F64x16, InMemory, Kernel, Simd};

use super::lanes::{Pattern, innovate, propagate, update};
use super::{NOTHING, Tape, Tick};
use crate::simulator::LANES;

/// −2 log likelihood of a tape at another noise, half its gradient and half of what its Hessian is expected to be.
pub(super) struct Likelihood<'a> {
    pub(super) tape: &'a Tape,
    pub(super) states: usize,
    pub(super) intensity: &'a [f64],
    pub(super) output: &'a [f64],
    /// Whose variances move: none for the process noise, or an output.
    pub(super) moving: &'a [Option<usize>],
}

/// Completes a symmetric matrix whose lower triangle is known.
#[inline(always)]
fn mirror<T: Scalar>(n: usize, matrix: &mut [T]) {
    for i in 0..n {
        for j in 0..i {
            matrix[j * n + i] = matrix[i * n + j];
        }
    }
}

/// v ← Φ v. No closure in the kernel: what the compiler does not inline there it compiles for the baseline.
#[inline(always)]
fn carry<T: Scalar>(pattern: &Pattern, phi: &[T], vector: &mut [T], moved: &mut [T]) {
    let n = vector.len();
    for (i, row) in pattern.0.iter().enumerate() {
        let mut sum = T::constant(0.0);
        for &k in row {
            sum += phi[i * n + k] * vector[k];
        }
        moved[i] = sum;
    }
    vector.copy_from_slice(moved);
}

impl Kernel for Likelihood<'_> {
    type Output = Local;

    #[inline(always)]
    fn run<S: Simd>(self) -> Local {
        let (n, m) = (self.states, self.moving.len());
        let numbers = F64x16::registers::<S>(&self.tape.numbers);
        let zero = <F64x16 as InMemory>::load::<S>(&F64x16::splat(0.0));
        let mut p = vec![zero; n * n];
        for (i, variance) in F64x16::registers::<S>(&self.tape.start_variance).iter().enumerate() {
            p[i * n + i] = *variance;
        }
        let quiet = vec![0.0; n];
        let mut scratch = vec![zero; 2 * n * n];
        // The deviation is from the stored walk, which follows the stored gains.
        let (mut deviation, mut gain, mut moved) = (vec![zero; n], vec![zero; n], vec![zero; n]);
        // Derivatives of the covariance, of the deviation, of P h, of the innovation and of its variance.
        let (mut by_p, mut by_deviation) = (vec![zero; m * n * n], vec![zero; m * n]);
        let (mut by_gain, mut by_innovation, mut by_variance) = (vec![zero; n], vec![zero; m], vec![zero; m]);
        let (mut cost, mut gradient, mut information) = (zero, vec![zero; m], vec![zero; m * m]);
        for tick in &self.tape.ticks {
            match tick {
                Tick::Advance { dt, by_state, pattern } => {
                    let phi = &numbers[*by_state..*by_state + n * n];
                    let dt = <F64x16 as InMemory>::load::<S>(dt);
                    let pattern = &self.tape.patterns[*pattern];
                    carry(pattern, phi, &mut deviation, &mut moved);
                    for by_deviation in by_deviation.chunks_mut(n.max(1)) {
                        carry(pattern, phi, by_deviation, &mut moved);
                    }
                    propagate(pattern, phi, dt, self.intensity, &mut p, &mut scratch);
                    for (of, by_p) in self.moving.iter().zip(by_p.chunks_mut((n * n).max(1))) {
                        let own = if of.is_none() { self.intensity } else { &quiet };
                        mirror(n, by_p);
                        propagate(pattern, phi, dt, own, by_p, &mut scratch);
                    }
                }
                Tick::Read { by_state, seen, gain: stored, innovation, output, weighs, own } => {
                    let (mut noise, mut read) = (F64x16::splat(1.0), F64x16::splat(-1.0));
                    let own = own.as_deref().copied().unwrap_or(F64x16::splat(0.0));
                    for lane in (0..LANES).filter(|lane| output[*lane] != NOTHING) {
                        noise[lane] = if own[lane] > 0.0 { 0.0 } else { self.output[output[lane] as usize] };
                        read[lane] = f64::from(output[lane]);
                    }
                    let own = <F64x16 as InMemory>::load::<S>(&own);
                    let noise = <F64x16 as InMemory>::load::<S>(&noise);
                    let read = <F64x16 as InMemory>::load::<S>(&read);
                    let rests = read.eq(zero - 1.0);
                    let recorded = <F64x16 as InMemory>::load::<S>(innovation);
                    let h = &numbers[*by_state..*by_state + n];
                    let seen = &self.tape.seen[seen.clone()];
                    let variance = innovate(seen, h, noise + own, rests, &p, &mut gain);
                    let inverse = (zero + 1.0) / variance;
                    let mut innovation = recorded;
                    for &i in seen {
                        innovation -= h[i] * deviation[i];
                    }
                    for (k, of) in self.moving.iter().enumerate() {
                        let by_p = &mut by_p[k * n * n..(k + 1) * n * n];
                        let by_deviation = &mut by_deviation[k * n..(k + 1) * n];
                        let mut of_variance = match of {
                            Some(own) => Scalar::select(read.eq(zero + *own as f64), noise, zero),
                            None => zero,
                        };
                        for (i, by_gain) in by_gain.iter_mut().enumerate() {
                            let mut sum = zero;
                            for &j in seen {
                                sum += by_p[i.max(j) * n + i.min(j)] * h[j];
                            }
                            *by_gain = sum;
                        }
                        let mut of_innovation = zero;
                        for &i in seen {
                            of_variance += h[i] * by_gain[i];
                            of_innovation -= h[i] * by_deviation[i];
                        }
                        for i in 0..n {
                            let of_gain =
                                Scalar::select(rests, zero, (by_gain[i] - gain[i] * of_variance) * inverse);
                            by_deviation[i] += of_gain * innovation + gain[i] * of_innovation;
                            let scaled = by_gain[i] - gain[i] * of_variance;
                            for j in 0..=i {
                                by_p[i * n + j] -= scaled * gain[j] + gain[i] * by_gain[j];
                            }
                        }
                        by_variance[k] = of_variance;
                        by_innovation[k] = of_innovation;
                    }
                    for i in 0..n {
                        let change = gain[i] * innovation - numbers[stored + i] * recorded;
                        deviation[i] += Scalar::select(rests, zero, change);
                    }
                    update(n, &gain, variance, rests, &mut p);
                    let ignored = <F64x16 as InMemory>::load::<S>(weighs).eq(zero);
                    let square = innovation * innovation * inverse;
                    cost += Scalar::select(ignored, zero, square + variance.ln());
                    // A lane without a stretch may hold anything, even what is no number and no weight of zero takes away.
                    for k in 0..m {
                        let half = by_variance[k] * (zero + 1.0 - square) * 0.5;
                        let slope = (innovation * by_innovation[k] + half) * inverse;
                        gradient[k] += Scalar::select(ignored, zero, slope);
                        let (of_innovation, of_variance) =
                            (by_innovation[k] * inverse, by_variance[k] * inverse * inverse * 0.5);
                        for j in 0..=k {
                            let product = of_innovation * by_innovation[j] + of_variance * by_variance[j];
                            information[k * m + j] += Scalar::select(ignored, zero, product);
                        }
                    }
                }
            }
        }
        let sum = |of| {
            let mut out = F64x16::splat(0.0);
            <F64x16 as InMemory>::store::<S>(&mut out, of);
            out.to_array().iter().sum::<f64>()
        };
        for k in 0..m {
            for j in 0..k {
                information[j * m + k] = information[k * m + j];
            }
        }
        Local {
            cost: sum(cost),
            gradient: gradient.into_iter().map(sum).collect(),
            information: information.into_iter().map(sum).collect(),
        }
    }
}
