//! What a running node shows of itself, in pages of shared memory.
//!
//! A node writes with plain stores and no system call; whoever may read the run's directory can watch. What is written
//! there outlives the node: the launcher reads from it how a node fared that was killed, and a node that is started again
//! takes up the counts of the one before. There is one writer at a time.

use std::io;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

use super::report::{Histogram, Percentiles};
use crate::channel::ChannelError;
use crate::channel::futex::SharedPage;
use crate::recording::LossReason;
use crate::time::Nanos;

/// One number of a node: its place in the first page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub(super) enum Vital {
    /// When the loop last came round, on the monotonic clock.
    Beat,
    /// When the running step could have begun, on the monotonic clock; 0 between steps.
    Stepping,
    /// The step that comes next, or runs now; its message has that number, too.
    Next,
    /// Steps made.
    Steps,
    /// Messages sent.
    Sent,
    /// Steps that took longer than a period from when they could begin.
    Overruns,
    /// Steps that ended after their deadline.
    Late,
    /// The largest time by which one did.
    LateBy,
    /// Outputs with a NaN or an infinity.
    NonFinite,
    /// The step of the first.
    NonFiniteStep,
    /// Its leaf.
    NonFiniteLeaf,
    /// Safe outputs sent in place of outputs.
    Replaced,
    /// Messages that did not reach a receiver, counted per receiver.
    Undelivered,
    /// Records sent to the recorder.
    Records,
    /// The input that the next step waits for, counted from 1; 0 when it waits for time.
    Awaits,
    /// How often the node was started again.
    Starts,
    /// Safe outputs applied when it ended, and when: 0 when none were.
    Stopped,
    /// Its process and its thread, as the system numbers them.
    Process,
    Thread,
    /// When the last step ended, on the monotonic clock.
    Ended,
}

/// One number of an input: its place among those of the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(usize)]
pub(super) enum InputVital {
    /// The message that comes next: all before it have arrived or are lost.
    Known,
    /// Messages that at least one step saw.
    Consumed,
    /// Messages that newer ones pushed out before any step saw them.
    Superseded,
    /// Messages that have arrived and that a step may still see.
    Waiting,
    /// Safe outputs that stood in for messages.
    Safe,
    /// Messages that the last step saw.
    Filled,
    /// The first of as many numbers as there are reasons for a loss.
    Lost,
}

/// Where the numbers of steps that were never made begin: pairs of the first and the one after the last.
const GAPS: usize = 32;
/// How many of them are remembered.
const REMEMBERED: u64 = 8;
/// Cells of one input.
const INPUT: usize = 16;
/// Inputs in a page.
const INPUTS: usize = 512 / INPUT;

/// The pages of one node.
#[derive(Debug)]
pub(super) struct Vitals {
    page: SharedPage,
    inputs: Vec<SharedPage>,
    pub(super) lateness: Durations,
    pub(super) computation: Durations,
    /// By input: how long the messages that a step saw were under way, from the end of the step that made them.
    pub(super) delays: Vec<Durations>,
}

impl Vitals {
    /// The pages of the node in this run; they are made where there are none, and kept otherwise.
    pub(super) fn open(run: &Path, node: &str, inputs: usize) -> Result<Self, ChannelError> {
        Self::with(run, node, inputs, "cannot make the signs of life", SharedPage::create)
    }

    fn with(
        run: &Path,
        node: &str,
        inputs: usize,
        what: &'static str,
        open: impl Fn(&Path) -> io::Result<SharedPage>,
    ) -> Result<Self, ChannelError> {
        let page = |name: &str| {
            let path = run.join(format!("{node}.{name}"));
            open(&path).map_err(|source| ChannelError::Io { what, path, source })
        };
        let durations = |name: &str| page(name).map(|page| Durations { page });
        Ok(Self {
            page: page("vitals")?,
            inputs: (0..inputs.div_ceil(INPUTS))
                .map(|number| page(&format!("inputs{number}")))
                .collect::<Result<_, _>>()?,
            lateness: durations("lateness")?,
            computation: durations("computation")?,
            delays: (0..inputs).map(|input| durations(&format!("delay{input}"))).collect::<Result<_, _>>()?,
        })
    }

    /// All pages of the node, the one with its [vitals](Vital) first.
    #[cfg(feature = "link")]
    pub(super) fn pages(&self) -> impl Iterator<Item = &[AtomicU64]> {
        let durations = [&self.lateness, &self.computation].into_iter().chain(&self.delays);
        let pages = [&self.page].into_iter().chain(&self.inputs).chain(durations.map(|counts| &counts.page));
        pages.map(SharedPage::cells)
    }

    pub(super) fn get(&self, vital: Vital) -> u64 {
        self.page.cell(vital as usize).load(Acquire)
    }

    #[inline]
    pub(super) fn set(&self, vital: Vital, value: u64) {
        self.page.cell(vital as usize).store(value, Release);
    }

    #[inline]
    pub(super) fn add(&self, vital: Vital, count: u64) {
        add(self.page.cell(vital as usize), count);
    }

    fn input_cell(&self, input: usize, place: usize) -> &AtomicU64 {
        self.inputs[input / INPUTS].cell(input % INPUTS * INPUT + place)
    }

    pub(super) fn input(&self, input: usize, vital: InputVital) -> u64 {
        self.input_cell(input, vital as usize).load(Acquire)
    }

    #[inline]
    pub(super) fn set_input(&self, input: usize, vital: InputVital, value: u64) {
        self.input_cell(input, vital as usize).store(value, Release);
    }

    pub(super) fn lost(&self, input: usize, reason: LossReason) -> u64 {
        self.input_cell(input, InputVital::Lost as usize + reason as usize).load(Acquire)
    }

    pub(super) fn add_lost(&self, input: usize, reason: LossReason, count: u64) {
        add(self.input_cell(input, InputVital::Lost as usize + reason as usize), count);
    }

    pub(super) fn add_safe(&self, input: usize) {
        add(self.input_cell(input, InputVital::Safe as usize), 1);
    }

    /// These steps will never be made.
    pub(super) fn skip(&self, steps: Range<u64>) {
        let Range { start: first, end: next } = steps;
        if first < next {
            let count = self.page.cell(GAPS);
            let place = GAPS + 1 + 2 * (count.load(Relaxed) % REMEMBERED) as usize;
            self.page.cell(place).store(first, Relaxed);
            self.page.cell(place + 1).store(next, Relaxed);
            add(count, 1);
        }
    }

    /// The first steps among these that were never made, as far as is remembered.
    pub(super) fn skipped(&self, steps: Range<u64>) -> Option<Range<u64>> {
        let remembered = self.page.cell(GAPS).load(Acquire).min(REMEMBERED);
        let gap = |place: u64| {
            let place = GAPS + 1 + 2 * place as usize;
            let (from, to) = (self.page.cell(place).load(Relaxed), self.page.cell(place + 1).load(Relaxed));
            from.max(steps.start)..to.min(steps.end)
        };
        (0..remembered).map(gap).filter(|gap| gap.start < gap.end).min_by_key(|gap| gap.start)
    }
}

#[inline]
fn add(cell: &AtomicU64, count: u64) {
    // One writer: no other addition can come between.
    cell.store(cell.load(Relaxed).wrapping_add(count), Release);
}

/// Durations, counted in a page.
#[derive(Debug)]
pub(super) struct Durations {
    page: SharedPage,
}

impl Durations {
    /// Where the largest one stands, after the counts.
    const MAX: usize = Histogram::BINS;

    /// Counts one duration; negative ones count as 0.
    #[inline]
    pub(super) fn add(&self, duration: Nanos) {
        let duration = duration.max(0);
        add(self.page.cell(Histogram::bin(duration)), 1);
        let max = self.page.cell(Self::MAX);
        if max.load(Relaxed) < duration as u64 {
            max.store(duration as u64, Relaxed);
        }
    }

    pub(super) fn percentiles(&self) -> Percentiles {
        self.counts().percentiles()
    }

    /// What has been counted so far.
    pub(super) fn counts(&self) -> Histogram {
        let cell = |index| self.page.cell(index).load(Relaxed);
        Histogram::new((0..Histogram::BINS).map(cell), cell(Self::MAX) as Nanos)
    }
}

/// The pages of one node as somebody sees them who only looks: they cannot be written to through this mapping.
#[derive(Debug)]
pub(super) struct VitalsView(Vitals);

impl VitalsView {
    /// The pages that a node of this run has made.
    pub(super) fn open(run: &Path, node: &str, inputs: usize) -> Result<Self, ChannelError> {
        let what = "cannot look at the signs of life";
        Vitals::with(run, node, inputs, what, SharedPage::look_at).map(Self)
    }

    pub(super) fn get(&self, vital: Vital) -> u64 {
        self.0.get(vital)
    }

    pub(super) fn input(&self, input: usize, vital: InputVital) -> u64 {
        self.0.input(input, vital)
    }

    pub(super) fn lost(&self, input: usize, reason: LossReason) -> u64 {
        self.0.lost(input, reason)
    }

    pub(super) fn lateness(&self) -> Histogram {
        self.0.lateness.counts()
    }

    pub(super) fn computation(&self) -> Histogram {
        self.0.computation.counts()
    }

    pub(super) fn delay(&self, input: usize) -> Histogram {
        self.0.delays[input].counts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_outlive_their_writer_and_gaps_are_remembered() {
        let run = tempfile::tempdir().unwrap();
        let open = || Vitals::open(run.path(), "arm", 40).unwrap();
        {
            let vitals = open();
            vitals.add(Vital::Steps, 3);
            vitals.add_lost(39, LossReason::Malformed, 2);
            vitals.set_input(39, InputVital::Known, 7);
            [5, 10, 15].iter().for_each(|time| vitals.lateness.add(*time));
            vitals.skip(10..20);
            vitals.skip(25..25);
            vitals.skip(30..35);
        }
        let vitals = open();
        assert_eq!((vitals.get(Vital::Steps), vitals.get(Vital::Beat)), (3, 0));
        assert_eq!((vitals.lost(39, LossReason::Malformed), vitals.lost(38, LossReason::Malformed)), (2, 0));
        assert_eq!(vitals.input(39, InputVital::Known), 7);
        assert_eq!(vitals.lateness.percentiles(), Percentiles { p50: 10, p99: 15, max: 15 });
        assert_eq!(vitals.skipped(0..100), Some(10..20));
        assert_eq!((vitals.skipped(15..31), vitals.skipped(20..31)), (Some(15..20), Some(30..31)));
        assert_eq!(vitals.skipped(20..30), None);
    }
}
