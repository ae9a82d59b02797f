//! What a machine says to the others and hears from them beside messages: how far it is, what its nodes do, how the clocks stand.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use zenoh::Wait;
use zenoh::qos::Priority;

use super::News;
use super::carrier::Books;
use super::clock::Estimate;
use super::hosts::{OnGone, Placement};
use super::mirror::Mirror;
use super::page::{ClockPage, Standing};
use super::session::{Ear, lock, send_tick};
use super::wire::{Stage, State, Tick};
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::control::{Answer, Line};
use crate::launch::plan;
use crate::launch::report::Exit;
use crate::recording::ClockReading;
use crate::time::Nanos;

/// How often a machine says how far it is, and what its nodes do.
const STATE: Duration = Duration::from_millis(100);
/// How often it says all of that, and not what has changed.
const ALL: Duration = Duration::from_secs(2);
/// How often the clocks are compared: at first, and later.
const TICKS: (Duration, Duration) = (Duration::from_millis(10), Duration::from_millis(100));
/// Exchanges with each machine before the run begins.
const EXCHANGES: u64 = 30;
/// How often what the clocks say is passed on.
const CLOCKS: Duration = Duration::from_millis(500);

/// What this machine knows of another one's presence.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Peer {
    /// It has been heard at all.
    known: bool,
    silent: bool,
    gone: bool,
    over: bool,
    /// Which of its runs takes part.
    incarnation: Option<u64>,
    /// Which one was told to stay away.
    refused: Option<u64>,
    /// Faults of its nodes that the recording has.
    faults: usize,
}

/// When what is due next.
pub(super) struct Due {
    pub(super) discover: Instant,
    tick: Instant,
    pub(super) state: Instant,
    all: Instant,
    clocks: Instant,
    waiting: Instant,
}

impl Due {
    pub(super) fn new() -> Self {
        let now = Instant::now();
        let waiting = now + Duration::from_secs(2);
        Self { discover: now, tick: now, state: now, all: now, clocks: now, waiting }
    }
}

/// What this machine says to the others, and hears from them, beside messages.
pub(super) struct Post<'a> {
    pub(super) graph: &'a Graph,
    pub(super) placement: &'a Placement,
    pub(super) session: zenoh::Session,
    pub(super) ear: Ear,
    pub(super) mirror: Mirror,
    pub(super) clocks: Vec<ClockPage>,
    pub(super) state: State,
    pub(super) peers: Vec<Peer>,
    pub(super) told_ready: bool,
    pub(super) told_begin: bool,
    /// Which records had arrived here when that was told last.
    pub(super) receipt: Vec<u8>,
    pub(super) why: String,
    pub(super) due: Due,
}

impl Post<'_> {
    /// The other machines.
    pub(super) fn others(&self) -> impl Iterator<Item = usize> + use<> {
        let me = self.placement.me;
        (0..self.placement.hosts.len()).filter(move |&host| host != me)
    }

    fn name(&self, host: usize) -> String {
        self.placement.hosts[host].name.clone()
    }

    fn epoch(&self) -> Option<Nanos> {
        match self.state.stage {
            Stage::Running { epoch } => Some(epoch),
            _ => None,
        }
    }

    /// Says what is due, and takes in what has come.
    pub(super) fn turn(&mut self, line: &mut Line, books: &Books) -> Result<(), String> {
        let now = Instant::now();
        if self.due.tick <= now {
            self.due.tick = now + if self.told_ready { TICKS.1 } else { TICKS.0 };
            for host in self.others() {
                let tick = Tick::Question { asked: monotonic() };
                send_tick(&self.session, &self.name(host), self.placement.my_name(), tick);
            }
        }
        if self.due.clocks <= now {
            self.due.clocks = now + CLOCKS;
            self.tell_clocks(line);
        }
        if self.due.state <= now {
            self.due.state = now + STATE;
            let all = self.due.all <= now;
            if all {
                self.due.all = now + ALL;
            }
            self.say(all);
            self.hear_pages();
            self.watch(line, books)?;
        }
        Ok(())
    }

    /// Says how far this machine is, and what its nodes do.
    fn say(&mut self, all: bool) {
        let Ok(state) = serde_json::to_vec(&self.state) else { return };
        // What does not arrive is said again. Not in the queue of messages, of which each urgent word would take a place.
        let put = self.session.put(format!("state/{}", self.placement.my_name()), state);
        let _ = put.express(true).priority(Priority::InteractiveHigh).wait();
        for telegram in self.mirror.news(all) {
            let put = self.session.put(format!("pages/{}", self.placement.my_name()), telegram);
            // Before pictures and records: who is not heard counts as silent.
            let _ = put.priority(Priority::DataHigh).wait();
        }
    }

    /// The nodes have stopped, and what they sent is on the way: says so, with their last signs of life.
    pub(super) fn last_words(&mut self) {
        self.state.stage = Stage::Over { why: std::mem::take(&mut self.why) };
        self.say(true);
    }

    /// Tells the others which records have arrived here, when that has changed; gives up what the recording machine, which is
    /// heard, has not received for long.
    pub(super) fn receipts(&mut self, books: &Books) {
        if self.placement.records_here() {
            let receipt = books.receipt();
            if receipt != self.receipt {
                let put = self.session.put(format!("receipt/{}", self.placement.my_name()), receipt.clone());
                let _ = put.express(true).priority(Priority::InteractiveHigh).wait();
                self.receipt = receipt;
            }
        } else if let Some(host) = self.placement.recorder {
            let (now, at) = (monotonic(), lock(&self.ear[host]).at);
            books.forget(now, now.saturating_sub(at) < self.placement.silence);
        }
    }

    /// Tells a machine that was started again what is known of its nodes.
    fn remind(&self, host: usize, books: &Books) {
        let next = |node: usize| {
            let name = |topic: crate::channel::Topic| books.next(&topic.name);
            (name(plan::output(self.graph, node)), name(plan::records(self.graph, node)))
        };
        let memory = self.mirror.memory(self.placement, host, next);
        let put =
            self.session.put(format!("memory/{}/{}", self.name(host), self.placement.my_name()), memory);
        // It is sent again until that machine takes part.
        let _ = put.wait();
    }

    /// Whether another machine's clock says when the run begins here: the leading one's, and where that is this one or is not
    /// there, any that has begun.
    fn gives_the_start(&self, host: usize) -> bool {
        let lead = self.placement.lead;
        host == lead || lead == self.placement.me || lock(&self.ear[lead]).state.is_none()
    }

    pub(super) fn all_over(&self) -> bool {
        self.others().all(|host| self.peers[host].over || self.peers[host].gone || !self.peers[host].known)
    }

    fn estimate(&self, host: usize) -> Option<Estimate> {
        lock(&self.ear[host]).offsets.estimate(monotonic())
    }

    /// Takes over the signs of life of nodes on other machines.
    pub(super) fn hear_pages(&self) {
        for host in self.others() {
            let telegrams = std::mem::take(&mut lock(&self.ear[host]).telegrams);
            let Some(estimate) = self.estimate(host) else { continue };
            for telegram in telegrams {
                self.mirror.hear(self.placement, host, estimate.offset, &telegram);
            }
        }
    }

    /// Tells the nodes, the others and the recording how the clocks stand to each other.
    fn tell_clocks(&mut self, line: &mut Line) {
        let Some(epoch) = self.epoch() else { return };
        let mut readings = Vec::new();
        for host in self.others() {
            let Some(estimate) = self.estimate(host) else { continue };
            let theirs = match lock(&self.ear[host]).state.as_ref().map(|state| &state.stage) {
                Some(Stage::Running { epoch }) => *epoch,
                _ => continue,
            };
            // Of the same moment: here `at - epoch`, there `at + offset - theirs`.
            let ahead = estimate.offset.saturating_sub(theirs.saturating_sub(epoch));
            let at = estimate.at - epoch;
            self.clocks[host].write(&Standing { shift: -ahead, at, skew: estimate.skew });
            readings.push(ClockReading {
                host: self.placement.my_name().into(),
                other: self.name(host),
                time: at,
                ahead,
                bound: estimate.bound,
                skew: estimate.skew,
                skew_bound: estimate.skew_bound,
                round_trip: estimate.round_trip,
                offset: estimate.offset,
                exchanges: estimate.exchanges,
            });
        }
        self.state.clocks.clone_from(&readings);
        if self.placement.records_here() {
            // Those that the others have of each other are in their state.
            for host in self.others() {
                let theirs = lock(&self.ear[host]).state.as_ref().map(|state| state.clocks.clone());
                readings.extend(theirs.unwrap_or_default());
            }
        }
        if !readings.is_empty() {
            line.send(&Answer::Link { news: News::Clocks { readings } });
        }
    }

    /// What the others' states mean for this machine.
    fn watch(&mut self, line: &mut Line, books: &Books) -> Result<(), String> {
        let mut say = |news: News| line.send(&Answer::Link { news });
        let mut waits_for = Vec::new();
        for host in self.others() {
            let (state, at, exchanges) = {
                let heard = lock(&self.ear[host]);
                (heard.state.clone(), heard.at, heard.offsets.exchanges())
            };
            let name = self.name(host);
            let Some(state) = state else {
                waits_for.push(format!("{name}, which has not answered"));
                continue;
            };
            let running = matches!(self.state.stage, Stage::Running { .. });
            if let Some(problem) = self.state.terms.disagreement(&state.terms) {
                if !running {
                    return Err(format!("machine {name} {problem}"));
                }
                // Whoever comes later, and does not fit, ends nobody's run: it finds out by itself.
                if self.peers[host].refused.replace(state.incarnation) != Some(state.incarnation) {
                    say(News::Trouble { text: format!("machine {name} stays outside: it {problem}") });
                }
                continue;
            }
            let silent_for = monotonic().saturating_sub(at);
            let peer = &mut self.peers[host];
            peer.known = true;
            if silent_for > self.placement.silence && !peer.silent {
                peer.silent = true;
                say(News::Silent { host: name.clone(), silent: silent_for });
            } else if silent_for <= self.placement.silence && peer.silent {
                (peer.silent, peer.gone) = (false, false);
                say(News::Back { host: name.clone() });
            }
            if silent_for > self.placement.gone && !peer.gone {
                peer.gone = true;
                say(News::Gone { host: name.clone(), silent: silent_for });
            }
            let first = *peer.incarnation.get_or_insert(state.incarnation);
            if first != state.incarnation && !running {
                peer.incarnation = Some(state.incarnation);
            } else if first != state.incarnation && self.placement.on_gone == OnGone::Continue {
                // It knows nothing of what was before, and is reminded.
                peer.incarnation = Some(state.incarnation);
                (peer.over, peer.faults) = (false, 0);
                say(News::Again { host: name.clone() });
            } else if first != state.incarnation {
                if !std::mem::replace(&mut peer.over, true) {
                    say(News::Over { host: name, why: "it was started again while the run went on".into() });
                }
                continue;
            }
            if running && matches!(state.stage, Stage::Opening | Stage::Ready) {
                self.remind(host, books);
            }
            let (faults, known) = state.faults_after(self.peers[host].faults);
            if self.placement.records_here() && !faults.is_empty() {
                self.peers[host].faults = known;
                say(News::Faults { faults });
            }
            match &state.stage {
                Stage::Opening => waits_for.push(format!("{name}, whose nodes come up")),
                _ if exchanges < EXCHANGES => waits_for.push(format!("the clock of {name}")),
                Stage::Ready => {}
                Stage::Running { epoch } => {
                    if !self.told_begin
                        && self.state.stage == Stage::Ready
                        && self.gives_the_start(host)
                        && let Some(estimate) = self.estimate(host)
                    {
                        let epoch = epoch.saturating_sub(estimate.offset);
                        // One that is still to come is common to all. Otherwise the run has begun without this machine.
                        let again = monotonic() > epoch;
                        let memory = lock(&self.ear[host]).memory.take();
                        if let Some(memory) = memory.as_ref().filter(|_| again) {
                            self.mirror.remember(self.placement, memory);
                            books.begin_anywhere();
                        }
                        if !again || memory.is_some() {
                            (self.told_begin, self.told_ready) = (true, true);
                            say(News::Begin { epoch, again });
                        } else {
                            waits_for.push(format!("{name}, which knows what the nodes here did before"));
                        }
                    }
                }
                Stage::Over { why } if !self.peers[host].over => {
                    self.peers[host].over = true;
                    say(News::Over { host: name.clone(), why: why.clone() });
                }
                Stage::Over { .. } => {}
            }
            let exits: BTreeMap<String, Exit> =
                state.exits.into_iter().filter(|(_, exit)| *exit != Exit::Clean).collect();
            let of_host =
                |node: &str| self.graph.index(node).is_some_and(|node| self.placement.of[node] == host);
            let exits: BTreeMap<_, _> = exits.into_iter().filter(|(node, _)| of_host(node)).collect();
            if !exits.is_empty() {
                say(News::Exits { host: name, exits });
            }
        }
        if self.state.stage == Stage::Ready && waits_for.is_empty() && !self.told_ready {
            self.told_ready = true;
            say(News::AllReady);
        }
        if !self.told_ready && !waits_for.is_empty() && self.due.waiting <= Instant::now() {
            self.due.waiting = Instant::now() + Duration::from_secs(5);
            say(News::Waits { waits_for });
        }
        Ok(())
    }
}
