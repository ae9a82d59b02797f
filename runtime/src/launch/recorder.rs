//! The recorder as the launcher sees it: a process, or a thread, that is started again when it dies.

use std::cell::RefCell;
use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::RunOptions;
use super::control::{Answer, Order};
use super::error::RunError;
use super::ledger::Ledger;
use super::plan::Settings;
use super::record;
use super::report::RecordingReport;
use super::settings::RunAs;
use super::worker::{Program, Worker};
use crate::channel::{Endpoint, Space};
use crate::graph::Graph;
use crate::recording::{Access, Clock, ClockReading, Fault, RecordingError, claim};
use crate::time::Nanos;

/// How long a recorder that died is left alone, at first; twice as long each time.
const REST: Duration = Duration::from_millis(50);
/// After so many deaths it is not started again: what kills it would go on to do so.
const DEATHS: u64 = 8;
/// How long the recorder may take to write what is left.
const CLOSING: Duration = Duration::from_secs(60);

/// Starts a recorder.
type Hire<'a> = Box<dyn Fn() -> io::Result<Worker> + 'a>;

/// The recorder of a run.
pub(super) struct Recorder<'a> {
    worker: Worker,
    hire: Hire<'a>,
    space: &'a Space,
    state: State,
    clock: Option<Clock>,
    /// The run has begun before, and this machine takes part again.
    again: bool,
    /// Faults that it has not been told of.
    unsaid: RefCell<Vec<Fault>>,
    deaths: u64,
    last_death: Option<String>,
    /// Its books, once it has closed its file.
    recorded: Option<Ledger>,
    /// The file, while it is empty because no run has begun.
    empty: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    /// It opens its channels.
    Opening(Instant),
    /// It listens to all nodes.
    Listening,
    /// It has died and is to be started at this time.
    Dead(Instant),
    /// It has died too often.
    GivenUp,
}

impl<'a> Recorder<'a> {
    /// Starts the recorder; it listens to all nodes when this returns.
    pub(super) fn start(
        graph: &'a Graph,
        settings: &'a Settings,
        space: &'a Space,
        path: &Path,
        command: &[String],
        options: &RunOptions,
    ) -> Result<Self, RunError> {
        // Found out now, and not when the run is over. An older recording stays until the new one begins.
        let existed = path.exists();
        let create = |source| RecordingError::Io { path: path.into(), what: "create the file", source };
        let open = OpenOptions::new().write(true).create(true).truncate(false).mode(Access::NEW).open(path);
        let access = settings.recorder.as_ref().map_or(Access::Owner, |recording| recording.access);
        let given = open.map_err(create).and_then(|file| {
            claim(&file, path)?;
            let what = "set who may read";
            access.give(&file).map_err(|source| RecordingError::Io { path: path.into(), what, source })
        });
        if given.is_err() && !existed {
            // It is empty, and nobody is to take it for a recording.
            let _ = std::fs::remove_file(path);
        }
        given?;
        // Where no node is a process, this program need not know how to be one.
        let processes = settings.nodes.iter().any(|node| node.run_as == RunAs::Process);
        let command = command.to_vec();
        let hire: Hire<'a> = Box::new(move || match processes {
            true => Worker::process(
                Program::own(&command),
                space.path(),
                record::NAME,
                &Default::default(),
                false,
            ),
            false => {
                let (graph, settings, run) = (graph.clone(), settings.clone(), space.path().to_path_buf());
                Worker::thread("recorder", move |stream| {
                    if let Ok(space) = Space::attach(&run) {
                        record::serve(&graph, &settings, &space, stream);
                    }
                })
            }
        });
        let worker = hire().map_err(RunError::Thread)?;
        let mut recorder = Self {
            worker,
            hire,
            space,
            state: State::Opening(Instant::now()),
            clock: None,
            again: false,
            unsaid: RefCell::default(),
            deaths: 0,
            last_death: None,
            recorded: None,
            empty: (!existed).then(|| path.to_path_buf()),
        };
        let start = Instant::now();
        while recorder.state != State::Listening {
            recorder.hear()?;
            if let State::Dead(_) = recorder.state {
                return Err(RunError::Recorder { reason: recorder.last_death.take().unwrap_or_default() });
            }
            if start.elapsed() > options.patience {
                return Err(RunError::Recorder { reason: "it did not open its channels in time".into() });
            }
            recorder.worker.wait(20);
        }
        Ok(recorder)
    }

    /// The run's clock is known: writing can begin, beside what was written before when the run has begun without this machine.
    pub(super) fn begin(&mut self, clock: Clock, again: bool) {
        self.empty = None;
        self.worker.order(&Order::Record { clock: clock.clone(), again });
        (self.clock, self.again) = (Some(clock), again);
    }

    /// Something happened to a node. The recorder is told when it is next looked after.
    pub(super) fn fault(&self, fault: Fault) {
        self.unsaid.borrow_mut().push(fault);
    }

    /// How the clocks of two machines stand to each other: is written, unless the recorder is away in this moment.
    pub(super) fn clocks(&mut self, readings: Vec<ClockReading>) {
        if self.state == State::Listening {
            self.worker.order(&Order::Clocks { readings });
        }
    }

    /// Looks after it: passes on what it has to know, and starts it again when it has died.
    pub(super) fn look(&mut self, endpoint: &Endpoint) {
        if let Err(error) = self.hear() {
            self.die(error.to_string());
        }
        match self.state {
            State::Listening => {
                for fault in self.unsaid.borrow_mut().drain(..) {
                    self.worker.order(&Order::Fault { fault });
                }
            }
            State::Dead(until) if Instant::now() >= until => {
                // Its place on the channels is free only when what it left there is removed.
                endpoint.remove_dead();
                match (self.hire)() {
                    Ok(worker) => {
                        self.worker = worker;
                        self.state = State::Opening(Instant::now());
                    }
                    Err(error) => self.die(error.to_string()),
                }
            }
            State::Opening(since) if since.elapsed() > Duration::from_secs(10) => {
                self.die("it did not open its channels in time".into());
            }
            _ => {}
        }
    }

    /// Takes in what it says, and whether it has died.
    fn hear(&mut self) -> Result<(), RunError> {
        for answer in self.worker.answers() {
            match answer {
                Answer::Listening => {
                    self.state = State::Listening;
                    // One that comes later than the run's start has to know what the first one was told.
                    if let Some(clock) = self.clock.clone() {
                        self.worker.order(&Order::Record { clock, again: self.again });
                    }
                }
                Answer::Recorded { ledger } => self.recorded = Some(*ledger),
                Answer::Failed { reason } => return Err(RunError::Recorder { reason }),
                _ => {}
            }
        }
        if matches!(self.state, State::Listening | State::Opening(_)) && self.worker.line.closed() {
            self.worker.join(Duration::from_millis(200));
            let death = self.worker.death().map_or_else(|| "it hung up".into(), |exit| exit.to_string());
            self.die(death);
        }
        Ok(())
    }

    fn die(&mut self, how: String) {
        self.deaths += 1;
        self.last_death = Some(how);
        self.state = if self.deaths >= DEATHS {
            State::GivenUp
        } else {
            State::Dead(Instant::now() + REST * 2_u32.saturating_pow(self.deaths as u32 - 1))
        };
    }

    /// Takes what is left and closes the file; gives what became of everything.
    pub(super) fn finish(mut self, graph: &Graph, duration: Nanos, endpoint: &Endpoint) -> RecordingReport {
        let start = Instant::now();
        let mut asked = 0;
        let ledger = loop {
            // Whoever died meanwhile is started once more: what waits in the channels is taken yet.
            self.look(endpoint);
            if let Some(ledger) = self.recorded.take() {
                break Some(ledger);
            }
            match self.state {
                State::Listening if asked <= self.deaths => {
                    self.worker.order(&Order::Finish { duration });
                    asked = self.deaths + 1;
                }
                State::GivenUp => break None,
                _ => {}
            }
            if start.elapsed() > CLOSING {
                self.last_death = Some(format!("it did not close the file within {} s", CLOSING.as_secs()));
                break None;
            }
            self.worker.wait(20);
        };
        let closed = ledger.is_some();
        // What a recorder that is no more had put on paper last.
        let ledger = ledger.unwrap_or_else(|| Ledger::read(self.space, graph.nodes().len()));
        let by_node = |counts: &[u64]| {
            let counts = graph.nodes().iter().zip(counts).filter(|(_, count)| **count > 0);
            counts.map(|(node, count)| (node.name.clone(), *count)).collect()
        };
        let bytes =
            ledger.files.iter().filter_map(|file| std::fs::metadata(file).ok()).map(|file| file.len()).sum();
        let problem = match (&ledger.problem, closed) {
            (None, false) => self.last_death.take(),
            (problem, _) => problem.clone(),
        };
        RecordingReport {
            bytes,
            lost: by_node(&ledger.lost),
            unwritten: by_node(&ledger.unwritten),
            restarts: self.deaths,
            problem,
            files: ledger.files,
        }
    }
}

impl Drop for Recorder<'_> {
    fn drop(&mut self) {
        // After a run that was not made, the recorder must be gone before the run's shared memory is. One that only finds its
        // line closed takes its launcher for dead, and waits for what dying nodes may still send.
        self.worker.order(&Order::Finish { duration: 0 });
        self.worker.hang_up();
        self.worker.join(Duration::from_secs(2));
        if let Some(path) = self.empty.take() {
            // A file that cannot be removed is empty, and the reader says so.
            let _ = std::fs::remove_file(path);
        }
    }
}
