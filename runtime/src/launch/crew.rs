//! The nodes of a run as the launcher sees them: brought up together, and watched.
//!
//! What happens to a single node while the run goes on is in [`supervise`](super::supervise), how they end together in
//! [`ending`](super::ending).

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::RunOptions;
use super::control::{Answer, Order, readable};
use super::door::{Door, Passed};
use super::error::RunError;
use super::event::{EventKind, Journal};
use super::link::{Begin, Bridge, Turn};
use super::plan::{self, Settings};
use super::recorder::Recorder;
use super::report::{End, Exit};
use super::settings::{NodeSettings, OnDeadline};
use super::signals::Signals;
use super::vitals::Vitals;
use super::worker::{LEAVING, Worker};
use crate::channel::{Endpoint, Space};
use crate::clock::WallClock;
use crate::graph::{Graph, OnDeadSender};
use crate::time::Nanos;
use parallax_model::system::Suggestion;

/// How often the launcher looks around when nothing happens.
pub(super) const TICK: Nanos = 50_000_000;
/// A look that comes so much later than the one before tells of the launcher's own absence: the machine slept or was frozen, and the nodes
/// with it.
const AWAY: Duration = Duration::from_millis(250);
/// How often at most.
const SHORTEST_TICK: Nanos = 2_000_000;

/// Starts a node: its place in the graph, and whether the process is to do nothing but to stop it.
pub(super) type Hire<'a> = dyn Fn(usize, bool) -> Result<Worker, RunError> + 'a;

/// One node of the run.
pub(super) struct Member {
    pub(super) worker: Worker,
    pub(super) settings: NodeSettings,
    pub(super) vitals: Vitals,
    pub(super) state: State,
    /// How it ended last; it may have been started again since then.
    pub(super) exit: Option<Exit>,
    pub(super) restarts: u64,
    /// Restarts since it last ran for a while.
    pub(super) in_a_row: u32,
    /// When it was last up.
    pub(super) up: Instant,
    /// Since when it gives no sign of life.
    pub(super) silent: Option<Nanos>,
    pub(super) hangs: u64,
    /// The launcher ended it because it hung for so long.
    pub(super) condemned: Option<Nanos>,
    /// It died without having stopped its hardware, and nobody has since.
    pub(super) unstopped: bool,
    /// What has been told of late steps and of outputs that are no numbers, and when.
    pub(super) told: Told,
}

/// What the journal has of a node's counts.
#[derive(Debug, Default)]
pub(super) struct Told {
    pub(super) late: u64,
    pub(super) late_at: Option<Instant>,
    pub(super) non_finite: u64,
    pub(super) non_finite_at: Option<Instant>,
    /// The step of which it was told that it is overdue, counted from 1.
    pub(super) overdue: u64,
}

/// Where a node is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum State {
    /// It runs.
    Up,
    /// It ended, and is started again at this time.
    Down(Instant),
    /// It is started again once the earlier one, whose line was closed at this time, is gone.
    Leaving(Instant),
    /// It was started again at this time, and is not up yet.
    Coming(Instant),
    /// It has ended, and is not started again.
    Over,
}

/// The nodes of a run, and the recorder.
pub(super) struct Crew<'a> {
    pub(super) site: Site<'a>,
    pub(super) members: Vec<Member>,
    pub(super) recorder: Option<Recorder<'a>>,
    /// The link to other machines.
    pub(super) bridge: Option<Bridge>,
    pub(super) journal: Journal,
    pub(super) door: Door,
    pub(super) patience: Duration,
    /// Processes that do nothing but stop the hardware of a node that died.
    pub(super) stopping: Vec<(usize, Worker)>,
    /// The launcher itself was away before this look: nobody's silence is held against them.
    pub(super) was_away: bool,
}

impl Drop for Crew<'_> {
    fn drop(&mut self) {
        // All are told before the first is waited for, and their time runs side by side. A node that only finds its line closed
        // takes its launcher for dead, and stays until it knows.
        for Member { worker, .. } in &mut self.members {
            worker.order(&Order::Stop);
            worker.hang_up();
        }
        let start = Instant::now();
        for Member { worker, .. } in &mut self.members {
            worker.end_within(LEAVING.saturating_sub(start.elapsed()));
        }
    }
}

/// What the crew of a run works with.
pub(super) struct Site<'a> {
    pub(super) graph: &'a Graph,
    pub(super) settings: &'a Settings,
    pub(super) space: &'a Space,
    pub(super) endpoint: &'a Endpoint,
    pub(super) hire: &'a Hire<'a>,
}

impl<'a> Crew<'a> {
    /// Starts all nodes.
    pub(super) fn start(
        site: Site<'a>,
        vitals: Vec<Vitals>,
        recorder: Option<Recorder<'a>>,
        bridge: Option<Bridge>,
        options: &mut RunOptions,
    ) -> Result<Self, RunError> {
        let journal = Journal { tell: options.events.take(), ..Journal::default() };
        let (patience, stopping) = (options.patience, Vec::new());
        let door = Door::open(site.space, site.graph.nodes().len())?;
        let mut crew = Self {
            site,
            members: Vec::new(),
            recorder,
            bridge,
            journal,
            door,
            patience,
            stopping,
            was_away: false,
        };
        for (node, vitals) in vitals.into_iter().enumerate() {
            let worker = match &mut crew.bridge {
                Some(bridge) if !bridge.placement().is_here(node) => bridge.hire(crew.site.graph, node)?,
                _ => (crew.site.hire)(node, false)?,
            };
            crew.members.push(Member {
                worker,
                settings: crew.site.settings.nodes[node].clone(),
                vitals,
                state: State::Up,
                exit: None,
                restarts: 0,
                in_a_row: 0,
                up: Instant::now(),
                silent: None,
                hangs: 0,
                condemned: None,
                unstopped: false,
                told: Told::default(),
            });
        }
        Ok(crew)
    }

    /// Brings all nodes to the point where they wait for the common start, unless somebody has `stopped` that; gives what the
    /// system refused them.
    pub(super) fn handshake(&mut self, stopped: &mut dyn FnMut() -> bool) -> Result<Vec<String>, RunError> {
        let mut said = Vec::new();
        self.await_all("open its channels", stopped, |_, answer| {
            let Answer::Opened { refused } = answer else { return Ok(false) };
            said.extend_from_slice(refused);
            Ok(true)
        })?;
        self.order_all(&Order::Connect);
        let (graph, settings) = (self.site.graph, self.site.settings);
        self.await_all("connect to its receivers", stopped, |node, answer| {
            let Answer::Connected { receivers, recorders } = answer else { return Ok(false) };
            if !settings.is_here(node) {
                return Ok(true);
            }
            let here = plan::output_here(graph, settings, node).subscribers;
            let expected = here + usize::from(settings.recording) + usize::from(settings.copies());
            let got = receivers + recorders;
            if got != expected {
                return Err(RunError::Receivers { node: graph.nodes()[node].name.clone(), got, expected });
            }
            Ok(true)
        })?;
        Ok(said)
    }

    /// Begins the run; where it has begun without this machine, its nodes take up what they did before.
    pub(super) fn begin(&mut self, begin: Begin) {
        self.order_all(&Order::Start { epoch: begin.epoch, resume: begin.again });
        for (node, member) in self.members.iter_mut().enumerate().filter(|_| begin.again) {
            if self.site.settings.is_here(node) {
                member.state = State::Coming(Instant::now());
            }
        }
    }

    pub(super) fn order_all(&mut self, order: &Order) {
        self.members.iter_mut().for_each(|member| member.worker.order(order));
    }

    /// Waits until every node has given the answer that `accept` wants.
    fn await_all(
        &mut self,
        what: &'static str,
        stopped: &mut dyn FnMut() -> bool,
        mut accept: impl FnMut(usize, &Answer) -> Result<bool, RunError>,
    ) -> Result<(), RunError> {
        let start = Instant::now();
        let mut pending = vec![true; self.members.len()];
        loop {
            if let Some(bridge) = &mut self.bridge {
                bridge.look()?;
            }
            for (node, Member { worker, .. }) in self.members.iter_mut().enumerate() {
                for answer in worker.answers() {
                    if let Answer::Failed { reason } = answer {
                        return Err(RunError::Start {
                            node: worker.node.clone(),
                            exit: Exit::Failed { reason },
                        });
                    }
                    if accept(node, &answer)? {
                        pending[node] = false;
                    }
                }
                if worker.line.closed() {
                    worker.join(Duration::from_millis(100));
                }
                if let Some(exit) = worker.death() {
                    return Err(RunError::Start { node: worker.node.clone(), exit });
                }
            }
            let Some(late) = pending.iter().position(|pending| *pending) else { return Ok(()) };
            if stopped() {
                return Err(RunError::Interrupted);
            }
            if start.elapsed() > self.patience {
                let node = self.members[late].worker.node.clone();
                return Err(RunError::Silent { node, what, seconds: self.patience.as_secs_f64() });
            }
            self.pause(TICK);
        }
    }

    /// Waits until a node says something or dies, a signal comes, or the time is over.
    pub(super) fn pause(&self, time: Nanos) {
        // The line of one that is not heard has hung up, and would always have something to say.
        let heard = self.members.iter().filter(|member| matches!(member.state, State::Up | State::Coming(_)));
        let lines = heard.map(|member| &member.worker.line).filter(|line| !line.closed());
        let lines = lines.map(|line| line.fd()).chain(self.door.descriptors());
        let lines: Vec<_> = lines.chain(self.bridge.iter().filter_map(Bridge::fd)).collect();
        readable(&lines, ((time + 999_999) / 1_000_000).clamp(0, 1000) as i32);
    }

    /// How often to look around: often enough for what has to be noticed in time.
    fn tick(&self) -> Nanos {
        let wanted = self.members.iter().map(|Member { settings, .. }| {
            let deadline = match settings.on_deadline {
                OnDeadline::Safe | OnDeadline::Stop => settings.deadline.unwrap_or(Nanos::MAX),
                OnDeadline::Count | OnDeadline::Warn => Nanos::MAX,
            };
            deadline.min(settings.heartbeat / 4)
        });
        wanted.min().unwrap_or(TICK).clamp(SHORTEST_TICK, TICK)
    }

    /// Watches the running nodes until the run is to end.
    pub(super) fn watch(
        &mut self,
        clock: WallClock,
        options: &mut RunOptions,
        signals: Option<&Signals>,
    ) -> End {
        let tick = self.tick();
        let mut looked = Instant::now();
        loop {
            // Once at a time: a launcher that is always late has to judge as well.
            self.was_away = looked.elapsed() > AWAY && !self.was_away;
            looked = Instant::now();
            let now = clock.now();
            let left = options.duration.map_or(Nanos::MAX, |duration| duration - now);
            if let Some(progress) = &mut options.progress
                && !progress(super::Progress { elapsed: now, duration: options.duration })
            {
                return End::Signal;
            }
            if signals.is_some_and(Signals::raised) {
                return End::Signal;
            }
            if left <= 0 {
                return End::Duration;
            }
            for node in 0..self.members.len() {
                if let Some(end) = self.look(node, clock) {
                    return end;
                }
            }
            if let Some(end) = self.cross() {
                return end;
            }
            self.open_door();
            if let Some(recorder) = &mut self.recorder {
                recorder.look(self.site.endpoint);
            }
            if self.members.iter().all(|member| member.state == State::Over) {
                return End::Duration;
            }
            let next = self.members.iter().filter_map(|member| match member.state {
                State::Down(at) => Some(at.saturating_duration_since(Instant::now()).as_nanos() as Nanos),
                // About to be gone.
                State::Leaving(_) => Some(SHORTEST_TICK),
                State::Up | State::Coming(_) => member.worker.line.closed().then_some(SHORTEST_TICK),
                State::Over => None,
            });
            self.pause(tick.min(left).min(next.min().unwrap_or(tick)).max(1));
        }
    }

    /// Takes in what the link to other machines says, and tells it of ends; gives the end of the run.
    fn cross(&mut self) -> Option<End> {
        let exits = self.exits();
        let bridge = self.bridge.as_mut()?;
        bridge.tell_exits(exits);
        let turns = match bridge.look() {
            Ok(turns) => turns,
            Err(RunError::Link { reason }) => {
                let problem = format!("the link to the other machines ended: {reason}");
                return Some(End::Link { problem });
            }
            Err(error) => return Some(End::Link { problem: error.to_string() }),
        };
        let mut end = None;
        for turn in turns {
            match turn {
                Turn::Tell(text) => self.journal.say(&text),
                Turn::Clocks(readings) => {
                    if let Some(recorder) = &mut self.recorder {
                        recorder.clocks(readings);
                    }
                }
                Turn::Faults(faults) => {
                    faults
                        .into_iter()
                        .for_each(|fault| self.recorder.iter().for_each(|r| r.fault(fault.clone())));
                }
                Turn::TimeOver => end = end.or(Some(End::Duration)),
                Turn::End { host, why } => end = end.or(Some(End::Host { host, why })),
            }
        }
        end
    }

    /// How nodes of this machine ended, as far as they have.
    pub(super) fn exits(&self) -> BTreeMap<String, Exit> {
        let here = |node: &usize| self.site.settings.is_here(*node);
        let over =
            (0..self.members.len()).filter(here).filter(|&node| self.members[node].state == State::Over);
        let exit = |node: usize| {
            Some((self.site.graph.nodes()[node].name.clone(), self.members[node].exit.clone()?))
        };
        over.filter_map(exit).collect()
    }

    /// Passes on what somebody at the door wishes of a node.
    fn open_door(&mut self) {
        let Self { door, members, site, .. } = self;
        let passed = door.hear(|name| {
            let names = || site.graph.nodes().iter().map(|node| node.name.as_str());
            let node = site.graph.index(name).ok_or_else(|| {
                let suggestion = Suggestion::nearest(name, names());
                let known = names().collect::<Vec<_>>().join(", ");
                format!("the graph has no node `{name}`{suggestion} (it has: {known})")
            })?;
            match members[node].state {
                State::Up => Ok(node),
                State::Down(_) | State::Leaving(_) | State::Coming(_) => {
                    Err(format!("node `{name}` is being started again; ask again in a moment"))
                }
                State::Over => Err(format!("node `{name}` has ended")),
            }
        });
        for Passed { node, id, by, wish } in passed {
            members[node].worker.order(&Order::Tune { id, by, wish });
        }
    }

    /// Whether the run cannot go on without a node: it is the supervisor, nobody listens to it, or somebody
    /// who does wants to stop then.
    pub(super) fn needed(&self, node: usize) -> bool {
        let receivers = plan::receivers(self.site.graph, node);
        node == self.site.graph.supervisor()
            || receivers.is_empty()
            || receivers
                .iter()
                .any(|receiver| self.site.graph.nodes()[*receiver].on_dead_sender == OnDeadSender::Stop)
    }

    pub(super) fn note(&mut self, clock: WallClock, node: usize, kind: EventKind) {
        let name = &self.site.graph.nodes()[node].name;
        self.journal.note(clock.now(), name, kind);
    }
}
