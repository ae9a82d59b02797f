//! The link as the launcher sees it, and the nodes of other machines, for which it speaks.

use std::collections::BTreeMap;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use super::{NAME, News, OnGone, Placement, TIME_OVER, Word};
use crate::channel::Space;
use crate::graph::Graph;
use crate::launch::control::{Answer, Line, Order};
use crate::launch::error::RunError;
use crate::launch::report::{Exit, LinkReport};
use crate::launch::worker::{Program, Worker};
use crate::recording::{ClockReading, Fault};
use crate::time::{Nanos, to_seconds};

/// How long the link may take to open the network.
const OPENING: Duration = Duration::from_secs(10);
/// How long it may take to pass on what is left, once the others are over.
const CLOSING: Duration = Duration::from_secs(20);

/// The link of a run, and the ends of the lines of the nodes for which it speaks.
pub(in crate::launch) struct Bridge {
    worker: Worker,
    placement: Placement,
    proxies: Vec<Proxy>,
    all_ready: bool,
    begin: Option<Begin>,
    finished: bool,
    report: LinkReport,
    /// What has been said of the ends of this machine's nodes.
    told: BTreeMap<String, Exit>,
}

/// The start of a run on this machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::launch) struct Begin {
    /// When the clock of the run shows 0, on this machine's monotonic clock.
    pub(in crate::launch) epoch: Nanos,
    /// The run has begun without this machine: its nodes go on where others knew them last.
    pub(in crate::launch) again: bool,
}

/// A node of another machine.
struct Proxy {
    node: usize,
    name: String,
    line: Line,
    done: bool,
}

/// What the launcher has to do about what the link says.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::launch) enum Turn {
    /// Tell the user.
    Tell(String),
    /// End the run.
    End { host: String, why: String },
    /// End the run: its time is over.
    TimeOver,
    /// Give it to the recorder.
    Clocks(Vec<ClockReading>),
    /// Give them to the recorder.
    Faults(Vec<Fault>),
}

impl Bridge {
    /// Starts the link; it has joined the channels when this returns.
    pub(in crate::launch) fn start(
        space: &Space,
        placement: &Placement,
        command: &[String],
    ) -> Result<Self, RunError> {
        if cfg!(not(feature = "link")) {
            return Err(RunError::NoLink);
        }
        let worker = Worker::process(Program::own(command), space.path(), NAME, &BTreeMap::default(), false)
            .map_err(|source| RunError::Link { reason: source.to_string() })?;
        let mut bridge = Self {
            worker,
            placement: placement.clone(),
            proxies: Vec::new(),
            all_ready: false,
            begin: None,
            finished: false,
            report: LinkReport::default(),
            told: BTreeMap::new(),
        };
        let start = Instant::now();
        loop {
            for answer in bridge.worker.answers() {
                match answer {
                    Answer::Listening => return Ok(bridge),
                    Answer::Failed { reason } => return Err(RunError::Link { reason }),
                    _ => {}
                }
            }
            bridge.check()?;
            if start.elapsed() > OPENING {
                return Err(RunError::Link { reason: "it did not open the network in time".into() });
            }
            bridge.worker.wait(20);
        }
    }

    /// Whether the link is there.
    fn check(&mut self) -> Result<(), RunError> {
        if !self.worker.line.closed() {
            return Ok(());
        }
        self.worker.join(Duration::from_millis(200));
        let death = self.worker.death().map_or_else(|| "it hung up".into(), |exit| exit.to_string());
        Err(RunError::Link { reason: death })
    }

    pub(in crate::launch) fn placement(&self) -> &Placement {
        &self.placement
    }

    pub(in crate::launch) fn fd(&self) -> Option<std::os::fd::RawFd> {
        (!self.worker.line.closed()).then(|| self.worker.line.fd())
    }

    /// A node of another machine, as a member of the crew.
    pub(in crate::launch) fn hire(&mut self, graph: &Graph, node: usize) -> Result<Worker, RunError> {
        let name = graph.nodes()[node].name.clone();
        let spawn = |source| RunError::Spawn { node: name.clone(), source };
        let (here, there) = UnixStream::pair().map_err(spawn)?;
        let mut line = Line::new(there);
        line.send(&Answer::Opened { refused: Vec::new() });
        self.proxies.push(Proxy { node, name: name.clone(), line, done: false });
        Ok(Worker::elsewhere(&name, here))
    }

    /// Answers for the nodes of other machines, and takes in what the link says.
    pub(in crate::launch) fn look(&mut self) -> Result<Vec<Turn>, RunError> {
        let mut turns = Vec::new();
        for answer in self.worker.answers() {
            match answer {
                Answer::Link { news } => turns.extend(self.take(news)),
                Answer::Failed { reason } => return Err(RunError::Link { reason }),
                _ => {}
            }
        }
        let placement = &self.placement;
        for proxy in &mut self.proxies {
            for order in proxy.line.receive::<Order>(0).unwrap_or_default() {
                match order {
                    // How many it reaches is counted on its own machine.
                    Order::Connect => proxy.line.send(&Answer::Connected { receivers: 0, recorders: 0 }),
                    Order::Tune { id, .. } => {
                        let host = placement.host_of(proxy.node);
                        let told = Err(format!("node `{}` runs on machine {host}: ask there", proxy.name));
                        proxy.line.send(&Answer::Tuned { id, told });
                    }
                    Order::Stop => proxy.end(Exit::Clean),
                    _ => {}
                }
            }
        }
        if !self.finished {
            self.check()?;
        }
        Ok(turns)
    }

    fn take(&mut self, news: News) -> Option<Turn> {
        let seconds = to_seconds;
        match news {
            News::Waits { waits_for } => Some(Turn::Tell(format!("waits for {}", waits_for.join("; ")))),
            News::AllReady => {
                self.all_ready = true;
                None
            }
            News::Begin { epoch, again } => {
                self.begin = Some(Begin { epoch, again });
                None
            }
            News::Silent { host, silent } => {
                self.report.silences += 1;
                Some(Turn::Tell(format!("machine {host} has been silent for {:.2} s", seconds(silent))))
            }
            News::Again { host } => {
                self.report.rejoined += 1;
                Some(Turn::Tell(format!("machine {host} was started again and takes part again")))
            }
            News::Faults { faults } => Some(Turn::Faults(faults)),
            News::Back { host } => Some(Turn::Tell(format!("machine {host} is heard again"))),
            News::Gone { host, silent } => {
                let why = format!("it has been silent for {:.1} s", seconds(silent));
                match self.placement.on_gone {
                    OnGone::Stop => Some(Turn::End { host, why }),
                    OnGone::Continue => Some(Turn::Tell(format!("machine {host} is gone: {why}"))),
                }
            }
            // So is this one's, in a moment.
            News::Over { why, .. } if why == TIME_OVER => Some(Turn::TimeOver),
            News::Over { host, why } => Some(Turn::End { host, why }),
            News::Exits { host, exits } => {
                for (name, exit) in exits {
                    if let Some(proxy) = self.proxies.iter_mut().find(|proxy| proxy.name == name) {
                        proxy.end(Exit::Failed { reason: format!("on machine {host} it {exit}") });
                    }
                }
                None
            }
            News::Clocks { readings } => {
                for reading in readings.iter().filter(|reading| reading.host == self.placement.my_name()) {
                    self.report.clocks.retain(|old| old.other != reading.other);
                    self.report.clocks.push(reading.clone());
                }
                Some(Turn::Clocks(readings))
            }
            News::Trouble { text } => Some(Turn::Tell(format!("the link: {text}"))),
            News::Finished { crossings, exits } => {
                self.finished = true;
                self.report.crossings = crossings;
                self.report.exits = exits;
                None
            }
        }
    }

    /// All nodes of this machine wait for the common start: gives its time, on this machine's monotonic clock, once all
    /// machines are there. The leading one begins at what `epoch` says then.
    pub(in crate::launch) fn begin(
        &mut self,
        epoch: impl Fn() -> Nanos,
        mut each: impl FnMut(&str) -> bool,
    ) -> Result<Begin, RunError> {
        let start = Instant::now();
        self.worker.order(&Order::Link { word: Word::Ready });
        let patience = Duration::from_nanos(self.placement.patience.unsigned_abs());
        let mut last = "the other machines".to_owned();
        let begin = loop {
            for turn in self.look()? {
                match turn {
                    Turn::Tell(text) => {
                        last.clone_from(&text);
                        if !each(&text) {
                            return Err(RunError::Interrupted);
                        }
                    }
                    Turn::End { host, why } => {
                        return Err(RunError::Link { reason: format!("machine {host} has stopped: {why}") });
                    }
                    Turn::Clocks(_) | Turn::Faults(_) | Turn::TimeOver => {}
                }
            }
            if let Some(begin) = self.begin {
                break begin;
            }
            if self.all_ready && self.placement.me == self.placement.lead {
                break Begin { epoch: epoch(), again: false };
            }
            if !each("") {
                return Err(RunError::Interrupted);
            }
            if start.elapsed() > patience {
                return Err(RunError::Link {
                    reason: format!(
                        "after {:.0} s it still {last}. Is `parallax run` started there, are the addresses right, and is \
                         the secret the same?",
                        patience.as_secs_f64()
                    ),
                });
            }
            self.worker.wait(20);
        };
        self.worker.order(&Order::Link { word: Word::Started { epoch: begin.epoch } });
        Ok(begin)
    }

    /// How the nodes of this machine ended, as far as they have.
    pub(in crate::launch) fn tell_exits(&mut self, exits: BTreeMap<String, Exit>) {
        if exits != self.told {
            self.worker.order(&Order::Link { word: Word::Exits { exits: exits.clone() } });
            self.told = exits;
        }
    }

    /// Something happened to a node of this machine: whoever records it is told.
    pub(in crate::launch) fn tell_fault(&mut self, fault: Fault) {
        self.worker.order(&Order::Link { word: Word::Fault { fault } });
    }

    /// The nodes of this machine have stopped: waits until everything has been passed on, and the other machines are over.
    pub(in crate::launch) fn finish(
        &mut self,
        why: String,
        exits: BTreeMap<String, Exit>,
        mut record: impl FnMut(Turn),
    ) {
        let start = Instant::now();
        self.worker.order(&Order::Link { word: Word::Over { why, exits } });
        while !self.finished {
            match self.look() {
                Ok(turns) => {
                    turns.into_iter().for_each(&mut record);
                }
                Err(error) => {
                    self.report.problem = Some(error.to_string());
                    break;
                }
            }
            if start.elapsed() > CLOSING {
                self.report.problem = Some("the link did not pass on in time what was left".into());
                break;
            }
            self.worker.wait(20);
        }
    }

    /// What became of everything; the link ends.
    pub(in crate::launch) fn dismiss(mut self) -> LinkReport {
        self.worker.hang_up();
        self.worker.join(Duration::from_secs(2));
        std::mem::take(&mut self.report)
    }

    /// What the link says of the ends of nodes on other machines.
    pub(in crate::launch) fn exits(&self) -> &BTreeMap<String, Exit> {
        &self.report.exits
    }
}

impl Proxy {
    /// The node has ended.
    fn end(&mut self, exit: Exit) {
        if !std::mem::replace(&mut self.done, true) {
            self.line.send(&Answer::Done { exit, problem: None, ends_run: false });
        }
    }
}
