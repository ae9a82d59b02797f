//! The tables of one episode in the order in which a batch reads them: one stream instead of many columns, and nothing
//! of what does not run.

use parallax_runtime::time::to_seconds;

use crate::compiled::{CompiledGraph, Slot};

/// What runs in an episode, one entry after the other.
#[derive(Debug)]
pub(super) struct Schedule {
    entries: Vec<Entry>,
    /// Per pass, where its entries end.
    ends: Vec<usize>,
    /// Per pass, the latest start of a step up to its end, s.
    latest: Vec<f64>,
    /// The places that the entries read, port after port: in histories, or in the window of what is selected.
    read: Vec<u32>,
}

/// One step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) slot: u32,
    pub(super) seq: i32,
    pub(super) write: u32,
    /// When it was due, s.
    pub(super) due: f64,
    /// When it starts, s.
    pub(super) start: f64,
    read: (u32, u32),
}

impl Schedule {
    pub(super) fn new(compiled: &CompiledGraph, episode: usize) -> Self {
        let passes = compiled.warm_up + compiled.lengths[episode] as usize;
        let mut schedule = Self {
            entries: Vec::new(),
            ends: Vec::with_capacity(passes),
            latest: Vec::with_capacity(passes),
            read: Vec::new(),
        };
        let mut latest = f64::NEG_INFINITY;
        for pass in 0..passes {
            let row = compiled.row(episode, pass);
            for (index, slot) in compiled.slots.iter().enumerate() {
                let rows = &slot.rows;
                if rows.run[row] == 0 {
                    continue;
                }
                let first = schedule.read.len() as u32;
                for input in &rows.inputs {
                    if input.is_open() {
                        schedule.read.extend(0..input.window as u32);
                    } else {
                        schedule.read.extend(&input.read[row * input.candidates..][..input.window]);
                    }
                }
                latest = latest.max(to_seconds(rows.start[row]));
                schedule.entries.push(Entry {
                    slot: index as u32,
                    seq: rows.seq[row],
                    write: rows.write[row],
                    due: to_seconds(rows.due[row]),
                    start: to_seconds(rows.start[row]),
                    read: (first, schedule.read.len() as u32),
                });
            }
            schedule.ends.push(schedule.entries.len());
            schedule.latest.push(latest);
        }
        schedule
    }

    pub(super) fn passes(&self) -> usize {
        self.ends.len()
    }

    /// The first pass in which a step starts at `time` (s) or later.
    pub(super) fn pass_at(&self, time: f64) -> usize {
        self.latest.partition_point(|latest| *latest < time)
    }

    #[inline(always)]
    pub(super) fn pass(&self, pass: usize) -> &[Entry] {
        let first = pass.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.entries[first..self.ends[pass]]
    }

    #[inline(always)]
    pub(super) fn read(&self, entry: &Entry) -> &[u32] {
        &self.read[entry.read.0 as usize..entry.read.1 as usize]
    }
}

/// Where each port's places begin among those that a step in this slot reads.
pub(super) fn offsets(slot: &Slot) -> Vec<usize> {
    let mut next = 0;
    let inputs = slot.rows.inputs.iter().map(|input| {
        next += input.window;
        next - input.window
    });
    inputs.collect()
}
