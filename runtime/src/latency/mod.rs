//! Measures this machine: how long a message takes from node to node, beside the raw floor under it.
//!
//! [`measure`] runs a real graph of two node processes, `ping` and `pong`, and beside it, in turns, what such a graph
//! could at best be made of: raw iceoryx2, a Unix socket, a channel inside one process, a word of shared memory. All of
//! them are paced alike, so that caches and sleeping cores are in the same state. [`aims`] compares.
//!
//! What is measured:
//!
//! - *one way*: from the sender's output (the last thing its step does) to the first thing that the receiver's next step
//!   does. For a floor: from before the send to after the receive.
//! - *round trip*: from the send to the arrival of the answer that the receiver sends back at once.
//! - *step*: what the runtime spends around a step: schedule, windows, stamps, sending, and the hand-over to the recorder.
//! - *lateness*: how long after its time a step of a sleeping 1 kHz node starts, beside a bare `clock_nanosleep` loop.

mod aims;
mod delays;
mod error;
mod floor;
mod graph;
mod link;
mod peer;
mod place;
mod turns;

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

pub use aims::{Aim, Verdict, aims};
pub use delays::{Delays, Percentile};
pub use error::LatencyError;
pub use graph::{NODE_COMMAND, node_main};
pub use peer::{PEER_COMMAND, peer_main};

use crate::time::Nanos;

/// How whoever waits for a message waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Wait {
    /// Polls all the time.
    Spin,
    /// Sleeps, and polls from shortly before a message is expected until shortly after.
    SpinThenBlock,
    /// Sleeps until it is woken.
    Block,
}

impl Wait {
    /// How long before and after the expected time is polled.
    pub(crate) fn spin(self) -> Nanos {
        match self {
            // Longer than any period measured here.
            Wait::Spin => 1_000_000_000,
            Wait::SpinThenBlock => 50_000,
            Wait::Block => 0,
        }
    }
}

impl std::fmt::Display for Wait {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Wait::Spin => "spin",
            Wait::SpinThenBlock => "spin-then-block",
            Wait::Block => "block",
        })
    }
}

/// What carries the messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Carrier {
    /// A graph of two node processes.
    Graph,
    /// The same, recorded.
    RecordedGraph,
    /// The runtime's channel by itself: a large message is written and read in place.
    Channel,
    /// iceoryx2 as it is, in place; woken by its own events.
    Iceoryx2,
    /// A Unix stream socket between two processes.
    UnixSocket,
    /// A crossbeam channel between two threads of one process.
    Crossbeam,
    /// A word of shared memory between two processes; woken by a futex.
    Futex,
}

impl Carrier {
    /// Whether it is a floor, and not Parallax.
    pub fn is_floor(self) -> bool {
        !matches!(self, Carrier::Graph | Carrier::RecordedGraph | Carrier::Channel)
    }
}

impl std::fmt::Display for Carrier {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Carrier::Graph => "graph",
            Carrier::RecordedGraph => "graph, recorded",
            Carrier::Channel => "channel, in place",
            Carrier::Iceoryx2 => "raw iceoryx2",
            Carrier::UnixSocket => "Unix socket",
            Carrier::Crossbeam => "crossbeam, threads",
            Carrier::Futex => "shared word, futex",
        })
    }
}

/// One thing to be measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Case {
    /// What carries the messages.
    pub carrier: Carrier,
    /// Bytes of a message.
    pub payload: usize,
    /// How both ends wait.
    pub wait: Wait,
    /// Whether both ends have a core each.
    pub pinned: bool,
    /// Whether both ends run under `SCHED_FIFO`.
    pub fifo: bool,
}

impl Case {
    /// Messages a second: as asked, or, where they are copied, as many of this size as can be copied several times.
    pub(crate) fn rate(&self, asked: f64) -> f64 {
        match self.carrier {
            Carrier::RecordedGraph | Carrier::UnixSocket => asked.min(200e6 / self.payload as f64),
            // At the same rate a large message finds caches and cores in the state in which a small one finds them.
            Carrier::Graph | Carrier::Channel | Carrier::Iceoryx2 | Carrier::Crossbeam | Carrier::Futex => {
                asked
            }
        }
    }
}

/// Bytes of a message from which on they are data, and not numbers.
const LARGE: usize = 4096;

/// Room for so many numbers, of which the pages are there: to touch one for the first time takes longer than a message.
fn room(numbers: usize) -> Vec<Nanos> {
    let mut room = vec![1; numbers];
    room.clear();
    room
}

/// How many of so many messages are not counted, from the first on: they fault pages in and warm caches.
fn warm_up(expected: usize) -> usize {
    (expected / 10).min(50)
}

/// What is to be measured, and how long.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The cases.
    pub cases: Vec<Case>,
    /// Messages a second.
    pub rate: f64,
    /// Time for each case, over all rounds.
    pub time: Duration,
    /// How many turns each case gets: what disturbs the machine for a while then disturbs all alike.
    pub rounds: usize,
    /// The cores of the two ends, for pinned cases.
    pub cores: [usize; 2],
}

/// What was measured of one case.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// The case.
    #[serde(flatten)]
    pub case: Case,
    /// From the send to the receiver.
    pub one_way: Delays,
    /// From the send to the arrival of the answer.
    pub round_trip: Delays,
}

/// Everything that was measured.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// The cases, in the order asked for.
    pub rows: Vec<Row>,
    /// What the runtime spends around a step, recorded; the node's own work is not in it.
    pub step: Delays,
    /// The same without a recorder.
    pub step_unrecorded: Delays,
    /// How late steps of a sleeping 1 kHz node start.
    pub lateness: Delays,
    /// How late a bare `clock_nanosleep` loop of 1 kHz wakes.
    pub bare_lateness: Delays,
    /// What the system refused, once each.
    pub warnings: Vec<String>,
}

/// Measures all cases in turns. `progress` is called with the share that is done; `false` ends the measurement.
///
/// The program must call [`node_main`] under [`NODE_COMMAND`] and [`peer_main`] under [`PEER_COMMAND`].
///
/// # Errors
///
/// [`LatencyError`] when a graph or a floor could not be run, or `progress` said to stop.
pub fn measure(options: &Options, mut progress: impl FnMut(f64) -> bool) -> Result<Report, LatencyError> {
    let rounds = options.rounds.max(1);
    let slice = options.time.div_f64(rounds as f64).max(Duration::from_millis(50));
    let empty = |case: &Case| Row { case: *case, one_way: Delays::new(), round_trip: Delays::new() };
    let mut report = Report {
        rows: options.cases.iter().map(empty).collect(),
        step: Delays::new(),
        step_unrecorded: Delays::new(),
        lateness: Delays::new(),
        bare_lateness: Delays::new(),
        warnings: Vec::new(),
    };
    let (turns, mut turn) = (rounds * (options.cases.len() + 2), 0);
    let mut done = || {
        turn += 1;
        if progress(turn as f64 / turns as f64) { Ok(()) } else { Err(LatencyError::Interrupted) }
    };
    for round in 0..rounds {
        for at in 0..options.cases.len() {
            // Every other round goes backwards, so that nobody always follows the same neighbour.
            let at = if round % 2 == 0 { at } else { options.cases.len() - 1 - at };
            let row = &mut report.rows[at];
            let mut turn = empty(&row.case);
            let warnings = match row.case.carrier {
                Carrier::Graph | Carrier::RecordedGraph => graph::exchange(&mut turn, options, slice)?,
                _ => floor::exchange(&mut turn, options, slice)?,
            };
            row.one_way.add_turn(&turn.one_way);
            row.round_trip.add_turn(&turn.round_trip);
            warn(&mut report.warnings, warnings);
            done()?;
        }
        for (all, recorded) in [(&mut report.step, true), (&mut report.step_unrecorded, false)] {
            let mut turn = Delays::new();
            graph::overhead(&mut turn, options, recorded)?;
            all.add_turn(&turn);
        }
        done()?;
        let (mut turn, mut bare) = (Delays::new(), Delays::new());
        let warnings = graph::lateness(&mut turn, options, slice)?;
        warn(&mut report.warnings, warnings);
        place::bare_lateness(&mut bare, options.cores[0], true, slice);
        report.lateness.add_turn(&turn);
        report.bare_lateness.add_turn(&bare);
        done()?;
    }
    Ok(report)
}

/// How late this thread wakes at 1 kHz over such a time, under `SCHED_FIFO` where it is allowed, and whether it was.
pub(crate) fn sleeper(time: Duration) -> (Vec<Nanos>, bool) {
    let fifo = place::settle(None, true).is_empty();
    (place::wake_ups(1_000_000, time), fifo)
}

/// The cores that this program may run on.
pub fn cores() -> Vec<usize> {
    core_affinity::get_core_ids().unwrap_or_default().iter().map(|core| core.id).collect()
}

fn warn(known: &mut Vec<String>, new: Vec<String>) {
    for warning in new {
        if !known.contains(&warning) {
            known.push(warning);
        }
    }
}

/// A clock for pacing: the given number of times a second, polling or sleeping in between.
struct Pace {
    next: Nanos,
    period: Nanos,
    sleeps: bool,
    end: Instant,
}

impl Pace {
    fn new(rate: f64, wait: Wait, time: Duration) -> Self {
        let period = (1e9 / rate) as Nanos;
        let (next, sleeps) = (crate::clock::monotonic() + period, wait != Wait::Spin);
        Self { next, period, sleeps, end: Instant::now() + time }
    }

    /// Waits for the next time; `false` when the measurement is over.
    fn wait(&mut self) -> bool {
        if self.sleeps {
            place::sleep_until(self.next);
        }
        while crate::clock::monotonic() < self.next {
            std::hint::spin_loop();
        }
        // After a long interruption the missed times are left out, not made up for at once.
        self.next = (self.next + self.period).max(crate::clock::monotonic());
        Instant::now() < self.end
    }
}
