//! A filter in step with a graph: late readings, commands in flight, and an estimate for the time at which it will matter.
//!
//! After J. van der Heijden et al., "REX", section 3.4 and appendix B (algorithm 1), without its simplifications: delays vary,
//! steps have any length, and readings may be missing or come out of order.

use super::commands::{Commands, Source};
use super::triangle::at;
use super::unscented::take;
use super::{Constants, FilterError, Process, Room, Scaling, Unscented};
use crate::control::when;
use crate::program::Workspace;
use crate::scalar::Scalar;

/// The time (s) of what has not happened.
pub const UNKNOWN: f64 = -1e9;
/// A step that is this much longer than wished for is better than a second one, as a share.
const SLACK: f64 = 1e-6;
/// The shortest step, s, where a trace computes what is not used.
const SHORTEST: f64 = 1e-9;

/// How a filter is used in a graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Compensation {
    /// The points of the unscented transform.
    pub scaling: Scaling,
    /// The states that noise drives.
    pub disturbed: Vec<usize>,
    /// For each reading, the period of an angle.
    pub wraps: Vec<Option<f64>>,
    /// For each state, the period after which the system is the same again: its mean is kept within half of it.
    pub circular: Vec<Option<f64>>,
    /// For each sensor, the readings that its messages hold, in order.
    pub sensors: Vec<Vec<usize>>,
    /// For each actuator, how many leaves its commands have.
    pub actuators: Vec<usize>,
    /// For each input of the process, what it is the mean of.
    pub inputs: Vec<Vec<Source>>,
    /// The integrator's step, s.
    pub step: f64,
    /// How many steps it may take from one reading to the next, and from the last one to the estimate's time; they become
    /// longer where so many do not suffice. What runs compiled takes so many always.
    pub steps: usize,
    /// How many readings that were taken later may arrive before one: so many are kept, and applied again behind it.
    pub reorder: usize,
    /// What is believed of the state before the first reading, and when it is taken: the mean,
    pub mean: Vec<f64>,
    /// and its standard deviations.
    pub std: Vec<f64>,
    /// Between which values an innovation's normalised square should lie, by how many values it has, from 1.
    pub bands: Vec<[f64; 2]>,
}

/// An [`Unscented`] filter in step with a graph.
///
/// It remembers the belief at the time of the oldest reading that it keeps, the later ones with the beliefs behind them, and
/// what it counts. A reading that was taken before the oldest belief comes too late: it is counted and left out. Several that
/// were taken at the same time are applied in the order of their sensors, so that the order of arrival does not matter.
#[derive(Debug, Clone)]
pub struct Compensator<P> {
    filter: Unscented<P>,
    how: Compensation,
    /// Leaves of a reading that is kept.
    widest: usize,
}

/// What a step is given.
#[derive(Debug, Clone, Copy)]
pub struct Given<'a, T> {
    /// Parameters and noise.
    pub constants: Constants<'a, T>,
    /// Readings, of [`Compensator::arrival`] numbers each: 1 for one that is new, when it was taken (s), the number of its
    /// sensor, and its values, as many as the widest sensor has. What is not a number is missing.
    pub arrivals: &'a [T],
    /// Commands.
    pub commands: Commands<'a, T>,
    /// The time that the estimate is for, s.
    pub until: T,
}

/// Memory for a step.
#[derive(Debug)]
pub struct CompensatorRoom<'a, T: Scalar> {
    filter: Room<'a, T>,
    inputs: &'a mut [T],
    readings: &'a mut [T],
    shares: &'a mut [T],
    /// What is kept, as it is walked through.
    sequence: &'a mut [T],
    entry: &'a mut [T],
    kept: &'a mut [T],
}

/// Places in what is remembered, behind the belief.
const UPDATES: usize = 1;
const NIS: usize = 2;
const VALUES: usize = 3;
const OUTSIDE: usize = 4;
const REPAIRED: usize = 0;
const CARRIED: usize = 5;

impl<P: Process> Compensator<P> {
    /// A filter of this process, used like this.
    ///
    /// # Errors
    ///
    /// [`FilterError`] as [`Unscented::new`], and where a list does not fit the process.
    pub fn new(process: P, how: Compensation) -> Result<Self, FilterError> {
        let filter = Unscented::new(process, how.scaling, how.disturbed.clone(), how.wraps.clone())?;
        let (n, m) = (filter.process().states(), filter.process().outputs());
        for (list, what) in [(how.mean.len(), "the mean of state"), (how.std.len(), "the deviation of state")]
        {
            if list != n {
                return Err(FilterError::Index { what, index: list, count: n });
            }
        }
        if how.circular.len() != n {
            return Err(FilterError::Index {
                what: "the period of state",
                index: how.circular.len(),
                count: n,
            });
        }
        if let Some(&index) = how.sensors.iter().flatten().find(|reading| **reading >= m) {
            return Err(FilterError::Index { what: "reading", index, count: m });
        }
        let of =
            |source: &Source| how.actuators.get(source.actuator).is_some_and(|leaves| source.leaf < *leaves);
        if let Some(source) = how.inputs.iter().flatten().find(|source| !of(source)) {
            let (index, count) = (source.actuator, how.actuators.len());
            return Err(FilterError::Index { what: "actuator", index, count });
        }
        if how.bands.len() != m {
            return Err(FilterError::Index {
                what: "the band for so many values:",
                index: how.bands.len(),
                count: m,
            });
        }
        let positive = |what, value: f64| match value.is_finite() && value > 0.0 {
            true => Ok(()),
            false => Err(FilterError::Positive { what, value }),
        };
        positive("the integrator's step", how.step)?;
        positive("the number of steps", how.steps as f64)?;
        if let Some(value) = how.std.iter().find(|std| !(std.is_finite() && **std >= 0.0)) {
            return Err(FilterError::Positive {
                what: "a standard deviation of the first state",
                value: *value,
            });
        }
        let widest = how.sensors.iter().map(Vec::len).max().unwrap_or(0);
        Ok(Self { filter, how, widest })
    }

    /// The filter.
    pub fn filter(&self) -> &Unscented<P> {
        &self.filter
    }

    /// How it is used.
    pub fn how(&self) -> &Compensation {
        &self.how
    }

    /// How many numbers a reading has among [`Given::arrivals`].
    pub fn arrival(&self) -> usize {
        3 + self.widest
    }

    /// Numbers of a reading that is kept, with the belief behind it.
    fn slot(&self) -> usize {
        2 + self.widest + self.filter.belief()
    }

    /// Time, belief and what is counted.
    fn carried(&self) -> usize {
        1 + self.filter.belief() + CARRIED
    }

    /// The names of what it remembers, in order: `time` (s) of the oldest belief, its `mean` and `root`, then counts: covariances
    /// `repaired`, `updates`, the last `nis` and how many `values` it was of, updates `outside` of the band, readings that came
    /// too `late`, steps that looked back on commands that are not known (`blind`); then the readings that are kept.
    pub fn memory(&self, states: &[String]) -> Vec<String> {
        let n = states.len();
        let belief = |prefix: &str| -> Vec<String> {
            let means = states.iter().map(|state| format!("{prefix}mean.{state}"));
            let roots = (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)));
            means.chain(roots.map(|(i, j)| format!("{prefix}root_{i}_{j}"))).collect()
        };
        let mut names = vec!["time".to_owned()];
        names.extend(belief(""));
        names.extend(["repaired", "updates", "nis", "values", "outside", "late", "blind"].map(str::to_owned));
        for slot in 0..self.how.reorder {
            names.extend([format!("kept_{slot}.time"), format!("kept_{slot}.sensor")]);
            names.extend((0..self.widest).map(|k| format!("kept_{slot}.value_{k}")));
            names.extend(belief(&format!("kept_{slot}.")));
        }
        names
    }

    /// What it remembers before the first reading.
    pub fn start(&self) -> Vec<f64> {
        let n = self.how.mean.len();
        let mut root = vec![0.0; self.filter.belief() - n];
        for (i, std) in self.how.std.iter().enumerate() {
            root[at(i, i)] = *std;
        }
        let mut start = vec![UNKNOWN];
        start.extend(&self.how.mean);
        start.extend(root);
        start.resize(self.carried() + 2, 0.0);
        for _ in 0..self.how.reorder {
            let end = start.len() + self.slot();
            start.push(UNKNOWN);
            start.resize(end, 0.0);
        }
        start
    }

    /// How many numbers of memory a step needs.
    pub fn room(&self) -> usize {
        self.filter.room() + self.sizes().iter().sum::<usize>()
    }

    fn sizes(&self) -> [usize; 6] {
        let (slot, kept) = (self.slot(), self.how.reorder + 1);
        [
            self.how.inputs.len(),
            self.filter.process().outputs(),
            self.how.steps,
            kept * (1 + 2 * slot),
            slot,
            kept * (slot + 1),
        ]
    }

    /// Memory for a step.
    ///
    /// # Panics
    ///
    /// When there are fewer numbers than [`room`](Self::room) says.
    pub fn lend<'a, T: Scalar>(
        &self,
        values: &'a mut [T],
        workspace: &'a mut Workspace<T>,
    ) -> CompensatorRoom<'a, T> {
        let mut rest = values;
        let filter = self.filter.lend(take(&mut rest, self.filter.room()), workspace);
        let [inputs, readings, shares, sequence, entry, kept] =
            self.sizes().map(|size| take(&mut rest, size));
        CompensatorRoom { filter, inputs, readings, shares, sequence, entry, kept }
    }

    /// One step: takes what has arrived into account, and writes the belief for [`Given::until`] to `estimate`. Gives the time
    /// that it is for: that of the newest reading where that is later; [`UNKNOWN`] before the first reading where `until` is.
    ///
    /// # Panics
    ///
    /// When a list has another length than this says.
    pub fn step<T: Scalar>(
        &self,
        given: &Given<'_, T>,
        memory: &mut [T],
        estimate: &mut [T],
        room: &mut CompensatorRoom<'_, T>,
    ) -> T {
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        for (k, share) in room.shares.iter_mut().enumerate() {
            *share = T::constant(1.0 / (self.how.steps - k) as f64);
        }
        // Looking back further than the commands that are known.
        let (time, blind) = (memory[0], self.carried() + 1);
        let looks = T::constant(UNKNOWN).lt(time) & time.lt(given.commands.known_from());
        memory[blind] += T::select(looks, one, zero);

        let count = given.arrivals.len() / self.arrival();
        T::scan_values(count, memory, given.arrivals, &mut [], |memory, arrival, _| {
            when(zero.lt(arrival[0]), memory, |memory| self.arrive(given, memory, &arrival[1..], room));
        });

        let belief = self.filter.belief();
        let size = 2 + belief;
        let newest = match self.how.reorder {
            0 => [0, 1],
            reorder => {
                let last = self.carried() + 2 + (reorder - 1) * self.slot();
                [last, last + 2 + self.widest]
            }
        };
        let carry = &mut room.entry[..size];
        carry[0] = memory[newest[0]];
        carry[1..=belief].copy_from_slice(&memory[newest[1]..newest[1] + belief]);
        carry[belief + 1] = zero;
        // Before the first reading, nothing moves.
        let unknown = carry[0].le(T::constant(UNKNOWN));
        carry[0] = T::select(unknown, given.until, carry[0]);
        for (k, value) in carry[1..=belief].iter_mut().enumerate() {
            *value = T::select(unknown, memory[1 + k], *value);
        }
        self.walk(given, carry, given.until, &mut room.filter, room.inputs, room.shares);
        memory[1 + belief + REPAIRED] += carry[belief + 1];
        estimate.copy_from_slice(&carry[1..=belief]);
        self.turn(estimate);
        carry[0]
    }

    /// Takes one reading into account: `arrival` is its time, its sensor and its values.
    fn arrive<T: Scalar>(
        &self,
        given: &Given<'_, T>,
        memory: &mut [T],
        arrival: &[T],
        room: &mut CompensatorRoom<'_, T>,
    ) {
        let late = arrival[0].lt(memory[0]);
        let counted = self.carried();
        memory[counted] += T::select(late, T::constant(1.0), T::constant(0.0));
        when(!late, memory, |memory| self.insert(given, memory, arrival, room));
    }

    /// Puts a reading among those that are kept, and applies it and those after it to the belief before it. The oldest one
    /// is then no longer kept.
    fn insert<T: Scalar>(
        &self,
        given: &Given<'_, T>,
        memory: &mut [T],
        arrival: &[T],
        room: &mut CompensatorRoom<'_, T>,
    ) {
        let (slot, reorder, belief) = (self.slot(), self.how.reorder, self.filter.belief());
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let (carry, rest) = memory.split_at_mut(self.carried());
        let slots = &mut rest[2..];

        // The readings that come before it.
        let (time, sensor) = (arrival[0], arrival[1]);
        let mut place = zero;
        for kept in slots.chunks_exact(slot) {
            let before = kept[0].lt(time) | (kept[0].eq(time) & kept[1].le(sensor));
            place += T::select(before, one, zero);
        }

        // For every place, its number, the reading that was before it and the one that was there.
        let width = 1 + 2 * slot;
        for (j, row) in room.sequence.chunks_exact_mut(width).enumerate() {
            row.fill(T::constant(UNKNOWN));
            row[0] = T::constant(j as f64);
            let (before, here) = row[1..].split_at_mut(slot);
            if j > 0 {
                before.copy_from_slice(&slots[(j - 1) * slot..j * slot]);
            }
            if j < reorder {
                here.copy_from_slice(&slots[j * slot..(j + 1) * slot]);
            }
        }
        let CompensatorRoom { filter, inputs, readings, shares, sequence, entry, kept } = room;
        T::scan_values(reorder + 1, carry, sequence, kept, |carry, row, kept| {
            let (number, before, here) = (row[0], &row[1..=slot], &row[1 + slot..]);
            let (known, is) = (number.lt(place), number.eq(place));
            for (k, value) in entry[..2 + self.widest].iter_mut().enumerate() {
                *value = T::select(known, here[k], T::select(is, arrival[k], before[k]));
            }
            // What is known behind earlier readings stays; places that were never used are before all.
            let used = T::constant(UNKNOWN).lt(entry[0]);
            let (stays, applies) = (known & used, !known & used);
            carry[0] = T::select(stays, here[0], carry[0]);
            for (value, cached) in carry[1..=belief].iter_mut().zip(&here[2 + self.widest..]) {
                *value = T::select(stays, *cached, *value);
            }
            let taken = &entry[..2 + self.widest];
            when(applies, carry, |carry| {
                self.apply(given, carry, taken, is, (&mut *filter, &mut *inputs, &mut *readings, shares));
            });
            kept[..taken.len()].copy_from_slice(taken);
            kept[taken.len()..slot].copy_from_slice(&carry[1..=belief]);
            kept[slot] = carry[0];
        });
        // The first is now what all others build on.
        let (first, others) = kept.split_at(slot + 1);
        carry[0] = first[slot];
        carry[1..=belief].copy_from_slice(&first[2 + self.widest..slot]);
        for (to, from) in slots.chunks_exact_mut(slot).zip(others.chunks_exact(slot + 1)) {
            to.copy_from_slice(&from[..slot]);
        }
    }

    /// Moves a belief to the time of a reading and corrects it there. `counts`: whether it is the first time.
    fn apply<T: Scalar>(
        &self,
        given: &Given<'_, T>,
        carry: &mut [T],
        taken: &[T],
        counts: T::Mask,
        (filter, inputs, readings, shares): (&mut Room<'_, T>, &mut [T], &mut [T], &[T]),
    ) {
        let belief = self.filter.belief();
        let (zero, one) = (T::constant(0.0), T::constant(1.0));
        let (time, sensor) = (taken[0], taken[1]);
        // What is believed beforehand is believed of the first reading's time.
        carry[0] = T::select(carry[0].le(T::constant(UNKNOWN)), time, carry[0]);
        self.walk(given, &mut carry[..2 + belief], time, filter, inputs, shares);
        carry[0] = time;

        readings.fill(T::constant(f64::NAN));
        for (index, own) in self.how.sensors.iter().enumerate() {
            let is = sensor.eq(T::constant(index as f64));
            for (reading, value) in own.iter().zip(&taken[2..]) {
                readings[*reading] = T::select(is, *value, readings[*reading]);
            }
        }
        given.commands.at(time, inputs);
        let believed = &mut carry[1..=belief];
        let innovation = self.filter.update(&given.constants, believed, readings, (inputs, time), filter);
        self.turn(believed);

        let counts = counts & zero.lt(innovation.count);
        let mut outside = zero;
        for (values, [low, high]) in (1..).zip(&self.how.bands) {
            let is = innovation.count.eq(T::constant(f64::from(values)));
            let beyond = innovation.nis.lt(T::constant(*low)) | T::constant(*high).lt(innovation.nis);
            outside += T::select(is & beyond, one, zero);
        }
        let tail = &mut carry[1 + belief..];
        tail[REPAIRED] += innovation.repaired;
        tail[UPDATES] += T::select(counts, one, zero);
        tail[NIS] = T::select(counts, innovation.nis, tail[NIS]);
        tail[VALUES] = T::select(counts, innovation.count, tail[VALUES]);
        tail[OUTSIDE] += T::select(counts, outside, zero);
    }

    /// Moves time, belief and the count of repairs to the time `until` (s), under the commands that act on the way. A time that
    /// is already past changes nothing.
    fn walk<T: Scalar>(
        &self,
        given: &Given<'_, T>,
        carry: &mut [T],
        until: T,
        filter: &mut Room<'_, T>,
        inputs: &mut [T],
        shares: &[T],
    ) {
        let belief = self.filter.belief();
        let step = T::constant(self.how.step);
        T::scan_values(self.how.steps, carry, shares, &mut [], |carry, share, _| {
            let time = carry[0];
            when(time.lt(until), carry, |carry| {
                given.commands.at(time, inputs);
                let limit = given.commands.next(time).min(until);
                let near = (limit - time).le(step * (1.0 + SLACK));
                let wished = T::select(near, limit, time + step);
                // As long as it takes for those that are left to arrive; the last one arrives.
                let least = time + (until - time) * share[0];
                let end = T::select(share[0].lt(T::constant(1.0)), wished.max(least), until);
                let dt = (end - time).max(T::constant(SHORTEST));
                let believed = &mut carry[1..=belief];
                let repaired = self.filter.predict(&given.constants, believed, inputs, [time, dt], filter);
                carry[0] = end;
                carry[1 + belief + REPAIRED] += repaired;
            });
        });
    }

    /// Brings circular states back within half a period of zero.
    fn turn<T: Scalar>(&self, belief: &mut [T]) {
        for (mean, period) in belief.iter_mut().zip(&self.how.circular) {
            if let Some(period) = period {
                *mean -= (*mean * (1.0 / period) + 0.5).floor() * *period;
            }
        }
    }
}
