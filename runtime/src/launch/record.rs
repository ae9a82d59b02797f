//! What the recorder does: it takes the records of all nodes from shared memory and writes them to files.
//!
//! It takes a bounded number of records at a time, so that its memory does not grow however far it is behind; what waits
//! longer than the channels have room is counted as lost. When the disk takes no more, it goes on counting, and tries
//! again with a new file. About once a second it writes down in shared memory what has reached the disk, so that another
//! recorder can take over where it died.

use std::collections::BTreeMap;
use std::ops::{Range, RangeInclusive};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::Rotate;
use super::control::{Answer, Line, Order};
use super::error::RunError;
use super::ledger::Ledger;
use super::link::Placement;
use super::plan::{self, CHANGE, LOSS, REPLACED, STEP, Settings};
use super::priority::give_way;
use super::unpack::{NO_RECORD, Unpacker};
use super::watch::watched;
use crate::channel::{Endpoint, Space, Subscriber};
use crate::graph::{Graph, NodePlan};
use crate::recording::{
    Access, Clock, ClockReading, Description, Fault, Packing, RecordingError, RecordingWriter,
};
use crate::time::Nanos;

/// What the recorder is called among nodes, whose names are made of letters, digits and underscores.
pub(super) const NAME: &str = "@recorder";

/// Milliseconds between two visits to the channels: few while there is much to take, and more where visits find little. Each
/// visit takes a core from a node that polls, if all cores do: of few, fewer messages meet one.
const VISIT: RangeInclusive<i32> = 10..=100;
/// The share of a channel's room, or of a batch, that is much.
const MUCH: usize = 32;
/// Words taken from the channels before they are written: the recorder's memory.
const BATCH: usize = 1 << 20;
/// How often what was written is made sure of.
const CERTAIN: Duration = Duration::from_secs(1);
/// How often it is while somebody looks on.
const WATCHED: Duration = Duration::from_millis(100);
/// How long a disk that takes nothing is left alone, at first and at most.
const RETRY: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(30));
/// A launcher that is gone leaves nodes that stop by themselves; they are recorded until they are silent for so long.
const SILENCE: Duration = Duration::from_millis(300);
/// In place of the number of a node's next record: this machine does not know what came before.
const UNKNOWN: u64 = u64::MAX;
/// Makes a file that may not grow any further an error of this process, to be counted, and not a signal to die of.
pub(super) fn bear_full_files() {
    // SAFETY: ignoring a signal installs no code; the call takes integers only.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

/// Why a recorder ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    /// It was told to, or could not go on, and said so.
    Said,
    /// Its launcher is gone.
    LauncherGone,
}

/// Records until it is told to finish, or until the launcher is gone and the nodes are silent.
pub(super) fn serve(graph: &Graph, settings: &Settings, space: &Space, stream: UnixStream) -> End {
    let mut line = Line::new(stream);
    give_way();
    let (streams, recording) = match (open(graph, settings, space), &settings.recorder) {
        (Ok(streams), Some(recording)) => (streams, recording),
        (Err(error), _) => return refuse(&mut line, error.to_string()),
        (_, None) => return refuse(&mut line, "the run is not recorded".into()),
    };
    let ledger = Ledger::read(space, graph.nodes().len());
    let mut scribe = Scribe {
        graph,
        hosts: hosts(graph, settings),
        space,
        path: &recording.path,
        access: recording.access,
        packing: recording.packing,
        rotate: recording.rotate,
        since: vec![0; ledger.next.len()],
        ledger,
        streams,
        target: Target::None,
        clock: None,
        wait: RETRY.0,
        certain: Instant::now(),
        last: 0,
        unpacker: Unpacker::new(graph, space),
        taken: Vec::new(),
        words: Vec::new(),
        rest: *VISIT.start(),
    };
    scribe.take_over();
    line.send(&Answer::Listening);
    let (mut finish, mut heard) = (None, Instant::now());
    loop {
        let gone = line.closed();
        if gone {
            std::thread::sleep(Duration::from_millis(*VISIT.start() as u64));
        }
        // Who is told to finish takes what is left at once.
        let rest = if finish.is_some() { *VISIT.start() } else { scribe.rest };
        for order in line.receive(rest).unwrap_or_else(|_| {
            // Somebody else speaks on the line: the launcher is none.
            line.hang_up();
            Vec::new()
        }) {
            match order {
                Order::Record { clock, again } => {
                    if again {
                        scribe.go_on();
                    }
                    scribe.begin(clock);
                }
                Order::Fault { fault } => scribe.fault(&fault),
                Order::Clocks { readings } => scribe.clocks(&readings),
                Order::Finish { duration } => finish = Some(duration),
                _ => {}
            }
        }
        let taken = match scribe.visit() {
            Ok(taken) => taken,
            Err(error) => return refuse(&mut line, error.to_string()),
        };
        if taken > 0 {
            heard = Instant::now();
        }
        if gone && finish.is_none() && heard.elapsed() > SILENCE {
            finish = Some(scribe.last);
        }
        // What is left is written before the end, however much it is.
        if let Some(duration) = finish.filter(|_| taken == 0) {
            scribe.finish(duration);
            line.send(&Answer::Recorded { ledger: Box::new(scribe.ledger) });
            while !line.closed() {
                let _ = line.receive::<Order>(1000);
            }
            return if gone { End::LauncherGone } else { End::Said };
        }
    }
}

/// The machine of each node, where there are several.
fn hosts(graph: &Graph, settings: &Settings) -> BTreeMap<String, String> {
    let names = |placement: &Placement| {
        let host = |(node, plan): (usize, &NodePlan)| (plan.name.clone(), placement.host_of(node).to_owned());
        graph.nodes().iter().enumerate().map(host).collect()
    };
    settings.placement.as_ref().map(names).unwrap_or_default()
}

fn refuse(line: &mut Line, reason: String) -> End {
    line.send(&Answer::Failed { reason });
    End::Said
}

/// One node's records.
struct Stream {
    node: usize,
    subscriber: Subscriber,
    /// So many at once are much.
    much: usize,
}

/// The records of all nodes, or, where this is a copy, of those of this machine.
fn open(graph: &Graph, settings: &Settings, space: &Space) -> Result<Vec<Stream>, RunError> {
    let endpoint = Endpoint::new(space)?;
    (0..graph.nodes().len())
        .filter(|&node| !settings.copies() || settings.is_here(node))
        .map(|node| {
            let topic = plan::records(graph, node);
            let subscriber = endpoint.open(&topic)?.subscriber()?;
            Ok(Stream { node, subscriber, much: topic.buffer / MUCH })
        })
        .collect()
}

/// A record taken from a channel.
struct Taken {
    time: Nanos,
    node: usize,
    /// Where its words lie among those that were taken.
    words: Range<usize>,
}

/// Where records go.
enum Target {
    /// Nowhere yet: the clock is not known.
    None,
    /// Into a file, open since then.
    File(Box<RecordingWriter>, Instant),
    /// Nowhere: the last file failed. A new one is tried at this time.
    Broken(Instant),
}

/// The recorder's files, and its books.
struct Scribe<'a> {
    graph: &'a Graph,
    /// The machine of each node, where there are several.
    hosts: BTreeMap<String, String>,
    space: &'a Space,
    path: &'a Path,
    access: Access,
    packing: Packing,
    rotate: Option<Rotate>,
    ledger: Ledger,
    streams: Vec<Stream>,
    target: Target,
    clock: Option<Clock>,
    /// How long a disk that takes nothing is left alone next.
    wait: Duration,
    /// When what was written was made sure of.
    certain: Instant,
    /// By node: records given to the file since then.
    since: Vec<u64>,
    /// The latest time of a record.
    last: Nanos,
    unpacker: Unpacker<'a>,
    /// What the last visit took, and its words.
    taken: Vec<Taken>,
    words: Vec<u64>,
    /// Milliseconds until the next visit.
    rest: i32,
}

impl Scribe<'_> {
    /// The file in which a recording goes on: the first one has the name that was asked for, later ones a number.
    fn part(&self, number: usize) -> PathBuf {
        if number == 0 || !self.path.metadata().map_or(true, |file| file.is_file()) {
            // What is no file, such as a device, has no others beside it.
            return self.path.to_path_buf();
        }
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy();
        let extension =
            self.path.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
        self.path.with_file_name(format!("{stem}.{number}{extension}"))
    }

    /// Says in the ledger that an earlier recorder died: its last file has no end.
    fn take_over(&mut self) {
        if !self.ledger.files.is_empty() {
            self.ledger.problem.get_or_insert_with(|| "the recorder died and was started again".into());
        }
    }

    /// The run has begun before this machine was started again: its files are kept, and what nodes elsewhere recorded meanwhile
    /// came to nobody.
    fn go_on(&mut self) {
        // A recorder that was started again after that has it in its ledger.
        while self.ledger.files.len() < 1 << 16 {
            let file = self.part(self.ledger.files.len());
            // What the launcher has made is empty: no run has written into it.
            if !file.is_file() || file.metadata().is_ok_and(|file| file.len() == 0) {
                break;
            }
            self.ledger.files.push(file);
        }
        self.ledger.next.iter_mut().filter(|next| **next == 0).for_each(|next| *next = UNKNOWN);
    }

    fn begin(&mut self, clock: Clock) {
        self.clock = Some(clock);
        self.open_next();
    }

    fn open_next(&mut self) {
        let Some(clock) = self.clock.clone() else { return };
        let path = self.part(self.ledger.files.len());
        let description = Description { hosts: self.hosts.clone(), ..Description::new(self.graph, clock) };
        match RecordingWriter::create_for(&path, &description, self.access, self.packing) {
            Ok(writer) => {
                self.target = Target::File(Box::new(writer), Instant::now());
                if self.ledger.files.last() != Some(&path) {
                    self.ledger.files.push(path);
                }
                self.certain = Instant::now();
                self.ledger.write(self.space);
            }
            Err(error) => self.fail(&error),
        }
    }

    /// The file takes no more: what it was given since the last time that was made sure of counts as not written.
    fn fail(&mut self, error: &RecordingError) {
        self.ledger.problem = Some(error.to_string());
        for (unwritten, since) in self.ledger.unwritten.iter_mut().zip(&mut self.since) {
            *unwritten += std::mem::take(since);
        }
        self.target = Target::Broken(Instant::now() + self.wait);
        self.wait = (self.wait * 2).min(RETRY.1);
        self.ledger.write(self.space);
    }

    fn fault(&mut self, fault: &Fault) {
        if let Target::File(file, _) = &mut self.target
            && let Err(error) = file.fault(fault)
        {
            self.fail(&error);
        }
    }

    fn clocks(&mut self, readings: &[ClockReading]) {
        if let Target::File(file, _) = &mut self.target
            && let Err(error) = readings.iter().try_for_each(|reading| file.clock(reading))
        {
            self.fail(&error);
        }
    }

    /// Takes and writes what is there, up to a batch; gives how many records there were.
    fn visit(&mut self) -> Result<usize, RunError> {
        if matches!(self.target, Target::None) {
            return Ok(0);
        }
        if matches!(&self.target, Target::Broken(until) if Instant::now() >= *until) {
            self.open_next();
        }
        self.take()?;
        // The order of the file is that of time, as far as one visit sees it.
        let mut taken = std::mem::take(&mut self.taken);
        taken.sort_by_key(|record| record.time);
        let count = taken.len();
        for record in taken.drain(..) {
            self.last = self.last.max(record.time);
            let Target::File(file, _) = &mut self.target else {
                self.ledger.unwritten[record.node] += 1;
                continue;
            };
            self.since[record.node] += 1;
            match self.unpacker.write(file, record.node, &self.words[record.words]) {
                Ok(()) => {}
                // What no file can hold is the fault of the node that sent it.
                Err(error @ RecordingError::Unwritable { .. }) => {
                    self.since[record.node] -= 1;
                    self.ledger.unwritten[record.node] += 1;
                    self.ledger.problem = Some(error.to_string());
                }
                Err(error) => self.fail(&error),
            }
        }
        self.taken = taken;
        self.turn_over();
        Ok(count)
    }

    /// Makes sure of what was written, and goes on in a new file when this one is long enough.
    fn turn_over(&mut self) {
        let Target::File(file, opened) = &mut self.target else { return };
        let full = match self.rotate {
            None => false,
            Some(Rotate::Bytes(most)) => file.bytes() >= most,
            Some(Rotate::Time(most)) => opened.elapsed().as_nanos() >= most.unsigned_abs().into(),
        };
        if full {
            let last = self.last;
            if self.close(last) {
                self.open_next();
            }
        } else if self.certain.elapsed() >= CERTAIN
            || (self.certain.elapsed() >= WATCHED && watched(self.space.path()))
        {
            match file.flush() {
                Ok(()) => self.make_certain(),
                Err(error) => self.fail(&error),
            }
        }
    }

    fn make_certain(&mut self) {
        self.certain = Instant::now();
        self.since.fill(0);
        self.wait = RETRY.0;
        self.ledger.write(self.space);
    }

    /// Ends the file; says whether that went well.
    fn close(&mut self, duration: Nanos) -> bool {
        match std::mem::replace(&mut self.target, Target::None) {
            Target::File(file, _) => match file.finish(duration) {
                Ok(()) => {
                    self.make_certain();
                    true
                }
                Err(error) => {
                    self.fail(&error);
                    false
                }
            },
            other => {
                self.target = other;
                false
            }
        }
    }

    fn finish(&mut self, duration: Nanos) {
        self.close(duration);
        self.ledger.write(self.space);
    }

    fn take(&mut self) -> Result<(), RunError> {
        let mut room = BATCH;
        let mut much = false;
        self.words.clear();
        let streams = self.streams.len();
        for (visited, &Stream { node, ref subscriber, much: many }) in self.streams.iter().enumerate() {
            let before = self.taken.len();
            let Ledger { next, lost, unwritten, problem, .. } = &mut self.ledger;
            // Each node has its share of the room, whatever the others send.
            let mut share = room.div_ceil(streams - visited);
            while share > 0 {
                let got = subscriber.receive(|words| {
                    let (number, time) = match *words {
                        [LOSS | STEP | CHANGE | REPLACED, number, _, _, _, time, ..] => {
                            (number, time as Nanos)
                        }
                        // Only our own nodes write here, so it stands in the place of one of theirs.
                        _ => {
                            next[node] = next[node].saturating_add(1);
                            unwritten[node] = unwritten[node].saturating_add(1);
                            *problem = Some(NO_RECORD.into());
                            share = share.saturating_sub(words.len().max(1));
                            return;
                        }
                    };
                    if next[node] != UNKNOWN {
                        lost[node] = lost[node].saturating_add(number.saturating_sub(next[node]));
                    }
                    next[node] = number.saturating_add(1);
                    share = share.saturating_sub(words.len());
                    room = room.saturating_sub(words.len());
                    let at = self.words.len();
                    self.words.extend_from_slice(words);
                    self.taken.push(Taken { time, node, words: at..self.words.len() });
                })?;
                if !got {
                    break;
                }
            }
            much |= self.taken.len() - before > many;
        }
        much |= BATCH - room > BATCH / MUCH;
        self.rest = if much { *VISIT.start() } else { (2 * self.rest).min(*VISIT.end()) };
        Ok(())
    }
}
