//! All counts of a run at one time.

use std::fs;

use super::LiveRun;
use crate::clock::monotonic;
use crate::launch::report::Histogram;
use crate::launch::vitals::{InputVital, Vital, VitalsView};
use crate::recording::LossReason;
use crate::time::Nanos;

/// All counts of a run at one time.
#[derive(Debug, Clone)]
pub struct Sample {
    /// When it was taken, on the monotonic clock.
    pub(super) time: Nanos,
    pub(super) nodes: Vec<NodeSample>,
}

/// One node's counts.
#[derive(Debug, Clone)]
pub(super) struct NodeSample {
    pub(super) beat: Nanos,
    pub(super) stepping: Nanos,
    pub(super) steps: u64,
    /// When the last step ended.
    pub(super) ended: Nanos,
    pub(super) sent: u64,
    pub(super) overruns: u64,
    pub(super) late: u64,
    pub(super) late_by: Nanos,
    pub(super) non_finite: u64,
    pub(super) replaced: u64,
    pub(super) undelivered: u64,
    pub(super) awaits: u64,
    pub(super) starts: u64,
    pub(super) lateness: Histogram,
    pub(super) computation: Histogram,
    pub(super) thread: Option<ThreadSample>,
    pub(super) inputs: Vec<InputSample>,
}

/// What the system says of a node's thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ThreadSample {
    pub(super) process: u32,
    pub(super) thread: u32,
    /// Time that it has run.
    pub(super) run: Nanos,
    /// The core that it was on last.
    pub(super) core: usize,
}

/// One input's counts.
#[derive(Debug, Clone)]
pub(super) struct InputSample {
    /// All messages below this number have arrived or are lost.
    pub(super) known: u64,
    pub(super) consumed: u64,
    pub(super) superseded: u64,
    pub(super) waiting: u64,
    pub(super) filled: u64,
    pub(super) safe: u64,
    pub(super) lost: Vec<(LossReason, u64)>,
    pub(super) delay: Histogram,
}

impl Sample {
    pub(super) fn take(run: &LiveRun) -> Self {
        let nodes = run.nodes.iter().zip(&run.about.nodes);
        let nodes = nodes.map(|(vitals, about)| NodeSample::take(vitals, about.inputs.len())).collect();
        Self { time: monotonic(), nodes }
    }

    /// When it was taken, on the machine's monotonic clock.
    pub fn time(&self) -> Nanos {
        self.time
    }
}

impl NodeSample {
    fn take(vitals: &VitalsView, inputs: usize) -> Self {
        let get = |vital| vitals.get(vital);
        let time = |vital| vitals.get(vital) as Nanos;
        // These two belong together. Where a step ended between the two reads, they are read again.
        let (mut ended, mut steps) = (time(Vital::Ended), get(Vital::Steps));
        for _ in 0..8 {
            let again = (time(Vital::Ended), get(Vital::Steps));
            if again == (ended, steps) {
                break;
            }
            (ended, steps) = again;
        }
        Self {
            beat: time(Vital::Beat),
            stepping: time(Vital::Stepping),
            steps,
            ended,
            sent: get(Vital::Sent),
            overruns: get(Vital::Overruns),
            late: get(Vital::Late),
            late_by: time(Vital::LateBy),
            non_finite: get(Vital::NonFinite),
            replaced: get(Vital::Replaced),
            undelivered: get(Vital::Undelivered),
            awaits: get(Vital::Awaits),
            starts: get(Vital::Starts),
            lateness: vitals.lateness(),
            computation: vitals.computation(),
            thread: ThreadSample::take(get(Vital::Process), get(Vital::Thread)),
            inputs: (0..inputs).map(|input| InputSample::take(vitals, input)).collect(),
        }
    }
}

impl InputSample {
    fn take(vitals: &VitalsView, input: usize) -> Self {
        let get = |vital| vitals.input(input, vital);
        let lost = LossReason::ALL.into_iter().map(|reason| (reason, vitals.lost(input, reason)));
        Self {
            known: get(InputVital::Known),
            consumed: get(InputVital::Consumed),
            superseded: get(InputVital::Superseded),
            waiting: get(InputVital::Waiting),
            filled: get(InputVital::Filled),
            safe: get(InputVital::Safe),
            lost: lost.collect(),
            delay: vitals.delay(input),
        }
    }
}

impl ThreadSample {
    /// What the system says of this thread; `None` when it is gone, or not there yet.
    fn take(process: u64, thread: u64) -> Option<Self> {
        let (process, thread) = (u32::try_from(process).ok()?, u32::try_from(thread).ok()?);
        if process == 0 {
            return None;
        }
        let stat = fs::read_to_string(format!("/proc/{process}/task/{thread}/stat")).ok()?;
        let (state, ticks, core) = parse(&stat)?;
        // SAFETY: sysconf takes an integer and touches no memory of ours.
        let per_second = unsafe { libc::sysconf(libc::_SC_CLK_TCK) }.max(1);
        let run = ticks.saturating_mul(1_000_000_000 / per_second);
        // One that has ended is in the list until somebody has asked how.
        (!matches!(state, 'Z' | 'X')).then_some(Self { process, thread, run, core })
    }
}

/// State, ticks of the processor, and the core, from the line of `/proc/PID/stat` (proc(5), fields 3, 14 + 15, 39). The name
/// in brackets may hold anything.
fn parse(stat: &str) -> Option<(char, Nanos, usize)> {
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let number = |field: usize| fields.get(field - 3)?.parse::<Nanos>().ok();
    Some((fields.first()?.chars().next()?, number(14)? + number(15)?, usize::try_from(number(39)?).ok()?))
}

/// Whether there is such a process.
pub(super) fn alive(process: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok();
    stat.and_then(|stat| parse(&stat)).is_some_and(|(state, ..)| !matches!(state, 'Z' | 'X'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_system_is_read_whatever_the_name() {
        let line = "77 (a) b (c)) S 1 77 77 0 -1 4194304 1 0 0 0 250 50 0 0 20 0 1 0 100 1 1 1 1 1 1 1 1 0 0 0 0 0 0 0 17 3 0 0 0 0";
        assert_eq!(parse(line), Some(('S', 300, 3)));
        assert_eq!(parse("77 (x"), None);
    }

    #[test]
    fn this_process_lives_and_has_a_core() {
        assert!(alive(std::process::id()));
        assert!(!alive(u32::MAX));
        let me = u64::from(std::process::id());
        let sample = ThreadSample::take(me, me).expect("the first thread has the number of the process");
        assert_eq!(sample.process, std::process::id());
        assert!(ThreadSample::take(0, 0).is_none());
    }
}
