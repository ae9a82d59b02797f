//! The unscented transform on means and roots of covariances.

use super::triangle::{at, backward, disturb, downdate, forward, packed, triangularise};
use super::{FilterError, Process, Work};
use crate::program::Workspace;
use crate::scalar::{Inlined, Scalar};

/// How far the points of the unscented transform are from the mean, and how they weigh (R. van der Merwe, "Sigma-Point
/// Kalman Filters for Probabilistic Inference in Dynamic State-Space Models", 2004, section 3.2.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scaling {
    /// α: the spread around the mean, 1 for the plain transform.
    pub alpha: f64,
    /// β: what is known of the distribution beyond its covariance.
    pub beta: f64,
    /// κ; absent: 3 − n for up to three states, which matches the kurtosis of a normal distribution (S. Julier, J. Uhlmann,
    /// "A new extension of the Kalman filter to nonlinear systems", 1997), and 0 for more. No weight is negative then.
    pub kappa: Option<f64>,
}

impl Default for Scaling {
    /// α = 1, β = 0: no weight is negative, so that no covariance can lose its positivity, and nothing cancels.
    fn default() -> Self {
        Self { alpha: 1.0, beta: 0.0, kappa: None }
    }
}

/// Weights of the points.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Weights {
    /// How far the points are, in columns of the root.
    spread: f64,
    /// Of each point but the middle one.
    each: f64,
    /// Root of it.
    root: f64,
    /// Of the middle one in a covariance; that in a mean follows.
    middle: f64,
}

/// What a filter is given with every step.
#[derive(Debug, Clone, Copy)]
pub struct Constants<'a, T> {
    /// Parameters of the process, as [prepared](Process::prepare).
    pub params: &'a [T],
    /// Standard deviation of each reading's noise, above 0, in the reading's unit.
    pub noise: &'a [T],
    /// Density of the white noise that disturbs each of the disturbed states, in the state's unit over √s.
    pub disturbance: &'a [T],
}

/// What a reading was, compared with what was expected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation<T> {
    /// Normalised innovation squared, νᵀ S⁻¹ ν: χ² distributed with `count` degrees of freedom where the filter is right.
    pub nis: T,
    /// How many values there were.
    pub count: T,
    /// 1 where the covariance had to be repaired.
    pub repaired: T,
}

/// An unscented Kalman filter in square-root form, of any size.
///
/// A belief is one slice: the mean, then the lower triangle of the covariance's root, row by row. The covariance is never
/// formed: both steps triangularise a matrix of weighted points, as R. van der Merwe and E. Wan do ("The square-root unscented
/// Kalman filter for state and parameter-estimation", ICASSP 2001). Their measurement update takes the explained part off by
/// downdates, which rounding can make impossible; here the points less what the reading explains of them are triangularised
/// (I. Arasaratnam, S. Haykin, "Cubature Kalman filters", IEEE TAC 2009, section VI), which is the same covariance and cannot
/// fail. A downdate is left only where the middle point's weight is negative; where it is impossible, it is left out, and said
/// so.
#[derive(Debug, Clone)]
pub struct Unscented<P> {
    process: P,
    weights: Weights,
    disturbed: Vec<usize>,
    wraps: Vec<Option<f64>>,
}

/// Memory that a filter needs, lent by the caller; see [`Unscented::lend`].
#[derive(Debug)]
pub struct Room<'a, T: Scalar> {
    points: &'a mut [T],
    images: &'a mut [T],
    rows: &'a mut [T],
    readings: &'a mut [T],
    gain: &'a mut [T],
    innovation: &'a mut [T],
    differences: &'a mut [T],
    spare: &'a mut [T],
    work: Work<'a, T>,
}

/// The first `count` numbers of what is left.
pub(super) fn take<'a, T>(rest: &mut &'a mut [T], count: usize) -> &'a mut [T] {
    let (taken, left) = std::mem::take(rest).split_at_mut(count);
    *rest = left;
    taken
}

/// A prediction, compiled for its numbers.
struct Predict<'a, 'r, P, T: Scalar> {
    filter: &'a Unscented<P>,
    constants: &'a Constants<'a, T>,
    belief: &'a mut [T],
    inputs: &'a [T],
    times: [T; 2],
    room: &'a mut Room<'r, T>,
}

impl<P: Process, T: Scalar> Inlined for Predict<'_, '_, P, T> {
    type Output = T;
    #[inline(always)]
    fn run(self) -> T {
        self.filter.predicted(self.constants, self.belief, self.inputs, self.times, self.room)
    }
}

/// An update, compiled for its numbers.
struct Update<'a, 'r, P, T: Scalar> {
    filter: &'a Unscented<P>,
    constants: &'a Constants<'a, T>,
    belief: &'a mut [T],
    readings: &'a [T],
    held: (&'a [T], T),
    room: &'a mut Room<'r, T>,
}

impl<P: Process, T: Scalar> Inlined for Update<'_, '_, P, T> {
    type Output = Innovation<T>;
    #[inline(always)]
    fn run(self) -> Innovation<T> {
        self.filter.updated(self.constants, self.belief, self.readings, self.held, self.room)
    }
}

impl<P: Process> Unscented<P> {
    /// A filter of this process. `disturbed` names the states that noise drives, `wraps` the period of each reading that is an
    /// angle, in its own unit.
    ///
    /// # Errors
    ///
    /// [`FilterError`] where there is nothing to estimate, or a number counts beyond what there is.
    pub fn new(
        process: P,
        scaling: Scaling,
        disturbed: Vec<usize>,
        wraps: Vec<Option<f64>>,
    ) -> Result<Self, FilterError> {
        let (states, outputs) = (process.states(), process.outputs());
        if states == 0 || outputs == 0 {
            return Err(FilterError::Empty { states, outputs });
        }
        if let Some(&index) = disturbed.iter().find(|index| **index >= states) {
            return Err(FilterError::Index { what: "state", index, count: states });
        }
        if wraps.len() != outputs {
            return Err(FilterError::Index { what: "reading", index: wraps.len(), count: outputs });
        }
        if let Some(&value) = wraps.iter().flatten().find(|period| !(period.is_finite() && **period > 0.0)) {
            return Err(FilterError::Positive { what: "the period of a reading", value });
        }
        let n = states as f64;
        let Scaling { alpha, beta, kappa } = scaling;
        let kappa = kappa.unwrap_or((3.0 - n).max(0.0));
        let scale = alpha * alpha * (n + kappa);
        if !(alpha > 0.0 && scale > 0.0 && scale.is_finite() && beta.is_finite()) {
            return Err(FilterError::Scaling { alpha, beta, kappa, states });
        }
        let middle = (scale - n) / scale + 1.0 - alpha * alpha + beta;
        let each = 0.5 / scale;
        let weights = Weights { spread: scale.sqrt(), each, root: each.sqrt(), middle };
        Ok(Self { process, weights, disturbed, wraps })
    }

    /// The process.
    pub fn process(&self) -> &P {
        &self.process
    }

    /// The states that noise drives.
    pub fn disturbed(&self) -> &[usize] {
        &self.disturbed
    }

    /// How many numbers a belief has.
    pub fn belief(&self) -> usize {
        self.process.states() + packed(self.process.states())
    }

    /// How many points there are.
    fn points(&self) -> usize {
        2 * self.process.states() + 1
    }

    /// Points that a matrix has a column for.
    fn columns(&self) -> usize {
        if self.weights.middle > 0.0 { self.points() } else { self.points() - 1 }
    }

    fn sizes(&self) -> [usize; 8] {
        let (n, m) = (self.process.states(), self.process.outputs());
        let (points, columns) = (self.points(), self.columns());
        [
            points * n,
            points * n.max(m),
            n * (columns + m),
            m * (columns + m),
            n * m,
            packed(m),
            m * points,
            packed(n.max(m)) + n.max(m),
        ]
    }

    /// How many numbers of memory it needs.
    pub fn room(&self) -> usize {
        self.process.room() + self.sizes().iter().sum::<usize>()
    }

    /// Memory for the filter's steps.
    ///
    /// # Panics
    ///
    /// When there are fewer numbers than [`room`](Self::room) says.
    pub fn lend<'a, T: Scalar>(&self, values: &'a mut [T], workspace: &'a mut Workspace<T>) -> Room<'a, T> {
        let mut rest = values;
        let work = Work { workspace, values: take(&mut rest, self.process.room()) };
        let [points, images, rows, readings, gain, innovation, differences, spare] =
            self.sizes().map(|count| take(&mut rest, count));
        Room { points, images, rows, readings, gain, innovation, differences, spare, work }
    }

    /// Points around a belief.
    #[inline(always)]
    fn draw<T: Scalar>(&self, belief: &[T], points: &mut [T]) {
        let n = self.process.states();
        let (mean, root) = belief.split_at(n);
        points[..n].copy_from_slice(mean);
        for j in 0..n {
            for i in 0..n {
                let shift = if j <= i { root[at(i, j)] * self.weights.spread } else { T::constant(0.0) };
                points[(1 + 2 * j) * n + i] = mean[i] + shift;
                points[(2 + 2 * j) * n + i] = mean[i] - shift;
            }
        }
    }

    /// Adds half a step's disturbance to a root.
    #[inline(always)]
    fn spread<T: Scalar>(&self, root: &mut [T], disturbance: &[T], scale: T, column: &mut [T]) {
        for (state, density) in self.disturbed.iter().zip(disturbance) {
            disturb(root, *state, *density * scale, &mut column[..self.process.states()]);
        }
    }

    /// Moves a belief from `time` on by `dt`, both in seconds, under constant inputs.
    ///
    /// The noise of the disturbed states is white in time: half of what a step brings enters before it and half after it
    /// (Strang's splitting), so that it spreads to the other states within the step already. Gives 1 where the covariance had
    /// to be repaired, else 0.
    ///
    /// # Panics
    ///
    /// When a list has another length than the process says.
    pub fn predict<T: Scalar>(
        &self,
        constants: &Constants<'_, T>,
        belief: &mut [T],
        inputs: &[T],
        times: [T; 2],
        room: &mut Room<'_, T>,
    ) -> T {
        T::compiled(Predict { filter: self, constants, belief, inputs, times, room })
    }

    /// Moves a belief on, wherever it is inlined.
    #[inline(always)]
    fn predicted<T: Scalar>(
        &self,
        constants: &Constants<'_, T>,
        belief: &mut [T],
        inputs: &[T],
        [time, dt]: [T; 2],
        room: &mut Room<'_, T>,
    ) -> T {
        let n = self.process.states();
        let Weights { each, root: weight, middle, .. } = self.weights;
        let half = (dt * 0.5).sqrt();
        self.spread(&mut belief[n..], constants.disturbance, half, room.spare);
        self.draw(belief, room.points);
        let images = &mut room.images[..self.points() * n];
        let work = &mut room.work;
        T::map_values(self.points(), room.points, images, |state, next| {
            self.process.advance(constants.params, state, inputs, [time, dt], work, next);
        });

        let (mean, root) = belief.split_at_mut(n);
        for i in 0..n {
            let first = images[i];
            let mut sum = T::constant(0.0);
            for point in images[n..].chunks_exact(n) {
                sum += point[i] - first;
            }
            mean[i] = first + sum * each;
        }
        let columns = self.columns();
        let rows = &mut room.rows[..n * columns];
        for (i, row) in rows.chunks_exact_mut(columns).enumerate() {
            for (value, point) in row.iter_mut().zip(images[n..].chunks_exact(n)) {
                *value = (point[i] - mean[i]) * weight;
            }
            if middle > 0.0 {
                row[columns - 1] = (images[i] - mean[i]) * middle.sqrt();
            }
        }
        triangularise(rows, n, root);
        let mut repaired = T::constant(0.0);
        if middle < 0.0 {
            let (off, before) = room.spare.split_at_mut(n);
            for i in 0..n {
                off[i] = (images[i] - mean[i]) * (-middle).sqrt();
            }
            repaired = downdate(root, off, &mut before[..packed(n)]);
        }
        self.spread(root, constants.disturbance, half, room.spare);
        repaired
    }

    /// Corrects a belief by readings that were taken at its time, under these inputs and at this time (s). Values that are not
    /// numbers are missing, and correct nothing. Differences of readings that wrap are taken the short way round.
    ///
    /// # Panics
    ///
    /// When a list has another length than the process says.
    pub fn update<T: Scalar>(
        &self,
        constants: &Constants<'_, T>,
        belief: &mut [T],
        readings: &[T],
        held: (&[T], T),
        room: &mut Room<'_, T>,
    ) -> Innovation<T> {
        T::compiled(Update { filter: self, constants, belief, readings, held, room })
    }

    /// Corrects a belief, wherever it is inlined.
    #[inline(always)]
    fn updated<T: Scalar>(
        &self,
        constants: &Constants<'_, T>,
        belief: &mut [T],
        readings: &[T],
        (inputs, time): (&[T], T),
        room: &mut Room<'_, T>,
    ) -> Innovation<T> {
        let (n, m) = (self.process.states(), self.process.outputs());
        let Weights { each, root: weight, middle, .. } = self.weights;
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let (points, columns) = (self.points(), self.columns());
        self.draw(belief, room.points);
        let images = &mut room.images[..points * m];
        let work = &mut room.work;
        T::map_values(points, room.points, images, |state, seen| {
            self.process.observe(constants.params, state, inputs, time, work, seen);
        });

        // Deviations of the points' readings from their mean; none where the reading is missing.
        let differences = &mut *room.differences;
        let (off, before) = room.spare.split_at_mut(n.max(m));
        let (mut count, mut repaired) = (zero, zero);
        for k in 0..m {
            let is = readings[k].eq(readings[k]);
            count += T::select(is, one, zero);
            let first = images[k];
            let mut sum = zero;
            for (point, difference) in
                images.chunks_exact(m).zip(differences[k * points..(k + 1) * points].iter_mut())
            {
                *difference = self.wrapped(k, point[k] - first);
                sum += *difference;
            }
            let mean = sum * each;
            for difference in &mut differences[k * points..(k + 1) * points] {
                *difference = T::select(is, *difference - mean, zero);
            }
            // The innovation, until it is normalised.
            off[k] = T::select(is, self.wrapped(k, readings[k] - first - mean), zero);
        }

        // The innovation's root from the same points, and the noise.
        let width = columns + m;
        for k in 0..m {
            let row = &mut room.readings[k * width..(k + 1) * width];
            row.fill(zero);
            self.weigh(&differences[k * points..(k + 1) * points], weight, &mut row[..columns]);
            row[columns + k] = constants.noise[k];
        }
        let innovation = &mut *room.innovation;
        triangularise(room.readings, m, innovation);
        if middle < 0.0 {
            let lost = &mut room.readings[..m];
            for (k, lost) in lost.iter_mut().enumerate() {
                *lost = differences[k * points] * (-middle).sqrt();
            }
            repaired += downdate(innovation, lost, &mut before[..packed(m)]);
        }

        // The gain, state by state: C S⁻¹ with C from points that lie symmetrically.
        let (mean, root) = belief.split_at_mut(n);
        for i in 0..n {
            let row = &mut room.gain[i * m..(i + 1) * m];
            for (k, value) in row.iter_mut().enumerate() {
                let seen = &differences[k * points + 1..(k + 1) * points];
                let mut sum = zero;
                for (point, difference) in room.points[n..].chunks_exact(n).zip(seen) {
                    sum += (point[i] - mean[i]) * *difference;
                }
                *value = sum * each;
            }
            forward(innovation, row);
            backward(innovation, row);
        }

        let width = columns + m;
        let rows = &mut room.rows[..n * width];
        for i in 0..n {
            let row = &mut rows[i * width..(i + 1) * width];
            let gain = &room.gain[i * m..(i + 1) * m];
            let explained = |point: usize| {
                let seen = gain.iter().enumerate().map(|(k, gain)| *gain * differences[k * points + point]);
                seen.fold(zero, |sum, value| sum + value)
            };
            for point in 1..points {
                let left = room.points[point * n + i] - mean[i] - explained(point);
                row[point - 1] = left * weight;
            }
            if middle > 0.0 {
                row[columns - 1] = -explained(0) * middle.sqrt();
            }
            for (k, gain) in gain.iter().enumerate() {
                row[columns + k] = *gain * constants.noise[k];
            }
        }
        triangularise(rows, n, root);
        if middle < 0.0 {
            let lost = &mut room.images[..n];
            for (lost, gain) in lost.iter_mut().zip(room.gain.chunks_exact(m)) {
                let explained = gain.iter().enumerate().map(|(k, gain)| *gain * differences[k * points]);
                *lost = explained.fold(zero, |sum, value| sum + value) * (-middle).sqrt();
            }
            repaired += downdate(root, lost, &mut before[..packed(n)]);
        }

        let off = &mut off[..m];
        for (mean, gain) in mean.iter_mut().zip(room.gain.chunks_exact(m)) {
            *mean += gain.iter().zip(&*off).fold(zero, |sum, (gain, off)| sum + *gain * *off);
        }
        forward(innovation, off);
        let nis = off.iter().fold(zero, |sum, value| sum + *value * *value);
        Innovation { nis, count, repaired }
    }

    /// The deviations of one reading, weighted, in the order of a matrix's columns: the middle point last.
    #[inline(always)]
    fn weigh<T: Scalar>(&self, differences: &[T], weight: f64, row: &mut [T]) {
        for (value, difference) in row.iter_mut().zip(&differences[1..]) {
            *value = *difference * weight;
        }
        if self.weights.middle > 0.0 {
            row[differences.len() - 1] = differences[0] * self.weights.middle.sqrt();
        }
    }

    /// The same difference, within half a period of zero.
    #[inline(always)]
    fn wrapped<T: Scalar>(&self, reading: usize, difference: T) -> T {
        match self.wraps[reading] {
            Some(period) => difference - (difference * (1.0 / period) + 0.5).floor() * period,
            None => difference,
        }
    }
}
