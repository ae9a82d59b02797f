//! The normal equations of windows: a state of their own for each, eliminated, and what integrating it out costs.

use parallax_model::lanes::{F64x16, Level};

use super::sums::{Accumulate, AddScaled, Sums};
use super::triangular::{backward, factor, forward};
use super::{Placed, Residuals, Window};
use crate::fit::Local;
use crate::lockstep::{Lockstep, Stretch, Tick};
use crate::simulator::{Gradient, LANES, Motion, Run, Simulator, wrapped};

/// Scale of a reading from which it tells the states no less.
const LEAST_SCALE: f64 = 1e-6;

/// The normal equations of as many windows as there are lanes.
pub(super) struct Normal {
    pub(super) n: usize,
    columns: usize,
    pub(super) squares: F64x16,
    /// JᵀJ over `[state | θ]`, the lower triangle row by row.
    information: Vec<F64x16>,
    /// Jᵀe over the same.
    gradient: Vec<F64x16>,
    /// The same without weights, output by output.
    pub(super) sums: Vec<Sums>,
    /// By how much each output's reading is what its sensor would read, where one is not 1, and the states' JᵀJ as these sensors would
    /// tell them.
    scales: Vec<f64>,
    unscaled: Vec<F64x16>,
    motion: Motion,
    row: Gradient,
}

impl Normal {
    pub(super) fn new(n: usize, p: usize, outputs: usize) -> Self {
        let (columns, zero) = (n + p, F64x16::splat(0.0));
        Normal {
            n,
            columns,
            squares: zero,
            information: vec![zero; columns * (columns + 1) / 2],
            gradient: vec![zero; columns],
            sums: vec![Sums::new(columns); outputs],
            scales: Vec::new(),
            unscaled: Vec::new(),
            motion: Motion::new(n, n, p),
            row: Gradient::default(),
        }
    }

    /// States are told in the units of sensors: one that reads a tenth tells no less, and what integrating states out costs must not make
    /// it likelier.
    pub(super) fn with_scales(mut self, simulator: &dyn Simulator, theta: &[f64]) -> Self {
        let scales: Vec<f64> = (0..self.sums.len())
            .map(|output| simulator.scale(theta, output).abs().max(LEAST_SCALE))
            .collect();
        if scales.iter().any(|scale| *scale != 1.0) {
            self.unscaled = vec![F64x16::splat(0.0); self.n * (self.n + 1) / 2];
            self.scales = scales;
        }
        self
    }

    /// Walks the windows from the given initial states.
    pub(super) fn march(
        &mut self,
        run: &mut dyn Run,
        group: &[Placed<'_>],
        initial: &[Vec<f64>],
        variance: &[f64],
        mut residuals: Option<&mut Residuals>,
    ) {
        let zero = F64x16::splat(0.0);
        self.sums.iter_mut().for_each(Sums::clear);
        self.motion.x.fill(zero);
        for (lane, state) in initial.iter().enumerate() {
            for (lanes, value) in self.motion.x.iter_mut().zip(state) {
                lanes[lane] = *value;
            }
        }
        self.motion.seed();
        let mut lanes = Lockstep::new(group.iter().map(|(window, first, end)| Stretch {
            first: *first,
            end: *end,
            from: window.from,
            to: window.to,
        }));
        while let Some(tick) = lanes.next(run) {
            let reads = match tick {
                Tick::Advance(steps) => {
                    run.advance_lanes(&steps, &mut self.motion);
                    continue;
                }
                Tick::Read(reads) => reads,
            };
            let (mut error, mut active) = (zero, zero);
            let value = run.compare_lanes(&reads, &self.motion, &mut self.row);
            let mut output = 0;
            for lane in 0..LANES {
                let Some(reading) = reads[lane].and_then(|index| run.events()[index].reading) else {
                    continue;
                };
                let e = wrapped(reading.value - value[lane], run.wrap(reading.output));
                (error[lane], active[lane], output) = (e, 1.0, reading.output);
                if let Some(residuals) = residuals.as_deref_mut() {
                    residuals.squares[reading.output] += e * e;
                    residuals.counts[reading.output] += 1;
                }
            }
            // All lanes read the same output.
            let sums = &mut self.sums[output];
            Level::widest().run(Accumulate { row: &self.row, error: &error, active: &active, sums });
        }
        let sums = std::mem::take(&mut self.sums);
        self.weigh(&sums, variance);
        self.sums = sums;
    }

    /// Sums up the outputs, each weighed by its variance.
    pub(super) fn weigh(&mut self, sums: &[Sums], variance: &[f64]) {
        let zero = F64x16::splat(0.0);
        self.squares = zero;
        self.information.fill(zero);
        self.gradient.fill(zero);
        for (sums, variance) in sums.iter().zip(variance) {
            let weight = 1.0 / variance;
            let add =
                |to: &mut [F64x16], from: &[F64x16]| Level::widest().run(AddScaled { to, from, weight });
            add(std::slice::from_mut(&mut self.squares), std::slice::from_ref(&sums.squares));
            add(&mut self.information, &sums.information);
            add(&mut self.gradient, &sums.gradient);
        }
        self.unscaled.fill(zero);
        for ((sums, variance), scale) in sums.iter().zip(variance).zip(&self.scales) {
            let (to, from) = (&mut self.unscaled[..], &sums.information[..self.n * (self.n + 1) / 2]);
            Level::widest().run(AddScaled { to, from, weight: 1.0 / (variance * scale * scale) });
        }
    }

    /// Adds a window to the total, its state eliminated.
    pub(super) fn add(&self, lane: usize, window: &mut Window, total: &mut Local, residuals: &mut Residuals) {
        let (score, volume) = self.eliminate(lane, window, total);
        residuals.scores.push(score);
        residuals.volume += volume - 2.0 * window.flow;
    }

    /// Squared residuals and the weak prior of the initial state, which is `window.state`.
    pub(super) fn cost(&self, lane: usize, window: &Window) -> f64 {
        self.squares[lane] + window.prior()
    }

    fn information(&self, lane: usize, i: usize, j: usize) -> f64 {
        let (i, j) = (i.max(j), i.min(j));
        self.information[i * (i + 1) / 2 + j][lane]
    }

    /// The Cholesky factor of the initial state's curvature, and its gradient, the prior included.
    pub(super) fn state_system(&self, lane: usize, window: &Window) -> (Option<Vec<f64>>, Vec<f64>) {
        let n = self.n;
        let mut a = vec![0.0; n * n];
        let mut g = vec![0.0; n];
        for i in 0..n {
            for j in 0..=i {
                a[i * n + j] = self.information(lane, i, j);
            }
            let precision = window.std[i].powi(-2);
            a[i * n + i] += precision;
            g[i] = self.gradient[i][lane] + precision * (window.state[i] - window.guess[i]);
        }
        (factor(a, n), g)
    }

    /// ln det of the initial state's curvature, the prior included, in units of that.
    fn volume(&self, lane: usize, window: &Window, factored: &[f64]) -> f64 {
        let n = self.n;
        let of = |l: &[f64]| (0..n).map(|i| 2.0 * (l[i * n + i] * window.std[i]).ln()).sum();
        if self.unscaled.is_empty() {
            return of(factored);
        }
        let mut a = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..=i {
                a[i * n + j] = self.unscaled[i * (i + 1) / 2 + j][lane];
            }
            a[i * n + i] += window.std[i].powi(-2);
        }
        factor(a, n).map_or_else(|| of(factored), |l| of(&l))
    }

    /// Takes over one lane of another walk.
    pub(super) fn take(&mut self, other: &Normal, lane: usize) {
        self.squares[lane] = other.squares[lane];
        for (to, from) in self.information.iter_mut().zip(&other.information) {
            to[lane] = from[lane];
        }
        for (to, from) in self.gradient.iter_mut().zip(&other.gradient) {
            to[lane] = from[lane];
        }
    }

    /// Adds a window to the total, its state projected out (Schur complement). Gives its share of the gradient, and
    /// ln det of its state's curvature in units of the prior.
    fn eliminate(&self, lane: usize, window: &mut Window, total: &mut Local) -> (Vec<f64>, f64) {
        let n = self.n;
        let p = self.columns - n;
        total.cost += self.cost(lane, window);
        let (factor, g) = self.state_system(lane, window);
        window.newton.clear();
        window.response.clear();
        window.newton.resize(n, 0.0);
        window.response.resize(n * p, 0.0);
        let mut score: Vec<f64> = (0..p).map(|j| self.gradient[n + j][lane]).collect();
        // With A = L Lᵀ: Y = L⁻¹ B and z = L⁻¹ g, so that Bᵀ A⁻¹ B = Yᵀ Y.
        let mut y = vec![0.0; n * p];
        let mut volume = 0.0;
        if let Some(l) = &factor {
            volume = self.volume(lane, window, l);
            let mut z = g;
            forward(l, n, &mut z);
            for j in 0..p {
                let mut column: Vec<f64> = (0..n).map(|i| self.information(lane, n + j, i)).collect();
                forward(l, n, &mut column);
                score[j] -= column.iter().zip(&z).map(|(a, b)| a * b).sum::<f64>();
                for (i, entry) in column.iter().enumerate() {
                    y[i * p + j] = *entry;
                }
                backward(l, n, &mut column);
                for (i, moved) in column.iter().enumerate() {
                    window.response[i * p + j] = -moved;
                }
            }
            backward(l, n, &mut z);
            for (newton, z) in window.newton.iter_mut().zip(&z) {
                *newton = -z;
            }
        }
        for i in 0..p {
            total.gradient[i] += score[i];
            for j in 0..=i {
                let through: f64 = (0..n).map(|k| y[k * p + i] * y[k * p + j]).sum();
                let value = self.information(lane, n + i, n + j) - through;
                total.information[i * p + j] += value;
                if i != j {
                    total.information[j * p + i] += value;
                }
            }
        }
        (score, volume)
    }
}
