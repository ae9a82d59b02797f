//! The loop of one node on the wall clock: wait, take what arrived, step, send, record.
//!
//! It drives the same [`Inbox`] as the simulated clock does. After it was made it allocates nothing and takes
//! no lock.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Duration;

mod intake;
mod output;

use intake::{Input, Taken};
use output::Room;

use super::link::{self, ClockPage};
use super::orders::Orders;
use super::plan::{self, MESSAGE_HEAD, Settings};
use super::records::{Output, Records};
use super::settings::NodeSettings;
use super::vitals::{InputVital, Vital, Vitals};
use crate::channel::{ChannelError, Endpoint, Listener, Publisher, Waker};
use crate::clock::{WallClock, monotonic};
use crate::data::Data;
use crate::graph::{Graph, OnDeadSender, SafeOutput, Scheduling};
use crate::node::{ErasedNode, NodeError, Step, Stopping};
use crate::recording::LossReason;
use crate::schedule::{GateError, Inbox, Resumption, Wait};
use crate::time::{Grid, Nanos};

/// A wait is never longer than this, so that an order to stop is seen soon and signs of life are given.
const PATIENCE: Nanos = 20_000_000;
/// How often a message is polled for before anything else is looked at again: some microseconds.
const POLLS: u32 = 64;
/// So long after a step its receivers have taken what it gave, if they poll.
const SETTLED: Nanos = 10_000;
/// Between the order to take up the work of an earlier process and its first step.
const LEAD: Nanos = 5_000_000;

/// Why a node cannot go on.
#[derive(Debug, thiserror::Error)]
pub(super) enum StepError {
    #[error(transparent)]
    Channel(#[from] ChannelError),
    #[error(transparent)]
    Gate(#[from] GateError),
    #[error("step {seq}: {source}")]
    Node { seq: u64, source: NodeError },
    #[error("{sender} is gone, and it was told to stop then")]
    DeadSender { sender: String },
    #[error(
        "step {seq} took {:.3} ms from when it could begin, and its deadline is {:.3} ms",
        *took as f64 / 1e6, *deadline as f64 / 1e6
    )]
    Deadline { seq: u64, took: Nanos, deadline: Nanos },
    #[error("step {seq} gave {value} at leaf {leaf}")]
    NonFinite { seq: u64, leaf: String, value: f64 },
}

/// A node with everything it needs to run.
pub(super) struct Stepper {
    node: Box<dyn ErasedNode>,
    inbox: Inbox,
    inputs: Box<[Input]>,
    listener: Listener,
    output: Publisher,
    wakers: Vec<Waker>,
    records: Option<Records>,
    /// Where the data of a message lie.
    room: Room,
    /// The output of the last step.
    values: Box<[f64]>,
    leaves: Vec<String>,
    /// What was sent last, and what is sent in place of an output.
    sent: Box<[f64]>,
    safe: Option<SafeOutput>,
    on_dead_sender: OnDeadSender,
    scheduling: Scheduling,
    grid: Grid,
    /// No step starts at or after this time.
    end: Nanos,
    /// When the last step ended.
    last_end: Nanos,
    settings: NodeSettings,
    vitals: Vitals,
}

impl Stepper {
    /// Opens the receiving ends of a node's channels and its own, which the launcher has created.
    pub(super) fn open(
        graph: &Graph,
        index: usize,
        node: Box<dyn ErasedNode>,
        settings: &Settings,
        endpoint: &Endpoint,
        run: &Path,
    ) -> Result<Self, ChannelError> {
        let plan = &graph.nodes()[index];
        let mut inputs = Vec::with_capacity(plan.inputs.len());
        for &connection in &plan.inputs {
            let connection = &graph.connections()[connection];
            let sender = &graph.nodes()[connection.from];
            inputs.push(Input {
                sender: connection.from,
                sender_name: sender.name.clone(),
                sender_grid: sender.grid,
                sender_vitals: Vitals::open(run, &sender.name, sender.inputs.len())?,
                clock: match &settings.placement {
                    Some(placement) if !placement.is_here(connection.from) => {
                        Some(ClockPage::open(run, placement.host_of(connection.from))?)
                    }
                    _ => None,
                },
                every: settings.every(index, connection.from),
                subscriber: endpoint.open(&plan::output(graph, connection.from))?.subscriber()?,
                values: vec![0.0; connection.leaves].into(),
                capacity: connection.data,
                data: Data::default(),
                consumed_before: 0,
                superseded_before: 0,
                resumed: false,
                counted: 0,
                empty: false,
                news: false,
            });
        }
        let records = match settings.recording {
            false => None,
            true => Some(Records::open(endpoint, &plan::records(graph, index))?),
        };
        let vitals = Vitals::open(run, &plan.name, plan.inputs.len())?;
        // Whoever looks on finds the thread by these.
        vitals.set(Vital::Process, std::process::id().into());
        // SAFETY: gettid takes no arguments, cannot fail and touches no memory of ours.
        vitals.set(Vital::Thread, unsafe { libc::gettid() } as u64);
        Ok(Self {
            node,
            inbox: Inbox::new(graph, index),
            inputs: inputs.into(),
            listener: endpoint.listener(&plan::wake(graph, index))?,
            output: endpoint.open(&plan::output_here(graph, settings, index))?.publisher()?,
            wakers: Vec::new(),
            records,
            room: Room::new(plan.kind.output().leaves.len(), plan.kind.data_capacity()),
            values: vec![0.0; plan.kind.output().leaves.len()].into(),
            leaves: plan.kind.output().leaves.clone(),
            sent: plan.kind.initial_message().into(),
            safe: plan.safe.clone(),
            on_dead_sender: plan.on_dead_sender,
            scheduling: plan.scheduling,
            grid: plan.grid,
            end: settings.duration.unwrap_or(Nanos::MAX),
            last_end: 0,
            settings: settings.nodes.get(index).cloned().unwrap_or_default(),
            vitals,
        })
    }

    /// Connects all ends, now that every other one exists; gives the number of receivers and recorders.
    pub(super) fn connect(
        &mut self,
        graph: &Graph,
        index: usize,
        settings: &Settings,
        endpoint: &Endpoint,
    ) -> Result<(usize, usize), ChannelError> {
        for receiver in plan::receivers(graph, index) {
            if settings.is_here(receiver) {
                self.wakers.push(endpoint.waker(&plan::wake(graph, receiver))?);
            }
        }
        if settings.placement.as_ref().is_some_and(|placement| placement.crosses(graph, index)) {
            self.wakers.push(endpoint.waker(link::WAKE)?);
        }
        self.inputs.iter().try_for_each(|input| input.subscriber.connect())?;
        let recorders = self.records.as_ref().map_or(Ok(0), |records| records.publisher.connect())?;
        Ok((self.output.connect()?, recorders))
    }

    /// Takes up the work of an earlier process of this node, whose counts go on; gives the first step and the shift of the
    /// ticks.
    ///
    /// The numbers of its steps go on, too. Where the grid is kept, the steps that were due meanwhile are never made, and
    /// receivers count their messages as not sent; where the frequency is kept, all later ticks are shifted.
    pub(super) fn resume(
        &mut self,
        graph: &Graph,
        index: usize,
        clock: WallClock,
    ) -> Result<(u64, Nanos), ChannelError> {
        let next = self.vitals.get(Vital::Next);
        let now = clock.now();
        let soon = now + LEAD;
        let (step, shift) = match self.scheduling {
            Scheduling::Phase => (next.max(self.grid.count_until(soon)), 0),
            Scheduling::Frequency => (next, soon.saturating_sub(self.grid.time(next)).max(0)),
        };
        self.vitals.skip(next..step);
        self.vitals.set(Vital::Next, step);
        self.vitals.set(Vital::Stepping, 0);
        // That of the earlier process is as old as its death.
        self.vitals.set(Vital::Beat, monotonic() as u64);
        self.vitals.add(Vital::Starts, 1);
        if let Some(records) = &mut self.records {
            records.sent = self.vitals.get(Vital::Records);
        }
        let mut known = Vec::new();
        for index in 0..self.inputs.len() {
            let (next, waiting) =
                (self.vitals.input(index, InputVital::Known), self.vitals.input(index, InputVital::Waiting));
            known.push(next);
            let input = &mut self.inputs[index];
            input.consumed_before = self.vitals.input(index, InputVital::Consumed);
            input.superseded_before = self.vitals.input(index, InputVital::Superseded);
            input.resumed = true;
            // What had arrived, and what the unfinished step saw, died with the earlier process.
            self.lose(index, next.saturating_sub(waiting)..next, now, LossReason::ReceiverDown)?;
            self.vitals.set_input(index, InputVital::Waiting, 0);
        }
        self.inbox = Inbox::resumed(graph, index, &Resumption { step, shift, known });
        Ok((step, shift))
    }

    /// Runs the node until its time is over, somebody stops it, or it cannot go on.
    pub(super) fn run(&mut self, clock: WallClock, orders: &Orders) -> Result<(), StepError> {
        let end = self.end;
        let mut polls = 0;
        while !orders.stop.load(Ordering::Relaxed) {
            // What a node sent before its death is taken before the death is believed.
            let news = orders.any();
            let taken = self.receive(clock, end, news)?;
            if polls > 0 && taken == Taken::Nothing && !news {
                polls -= 1;
                std::hint::spin_loop();
                continue;
            }
            polls = 0;
            let now = if let Taken::At(time) = taken { time } else { clock.now() };
            self.vitals.set(Vital::Beat, (clock.epoch() + now) as u64);
            if news {
                self.learn(orders, now);
            }
            let wait = self.inbox.gate().ready();
            let awaits = if let Wait::Message { input, .. } = wait { input as u64 + 1 } else { 0 };
            self.vitals.set(Vital::Awaits, awaits);
            if !matches!(wait, Wait::Until(time) if now >= time) {
                self.show_news();
            }
            match wait {
                Wait::Until(time) if time.max(now) >= end => {
                    // A step that comes after the end would be the next; nothing is left to do but to wait
                    // for the end, so that this node does not report before the others can have finished.
                    if now >= end {
                        return Ok(());
                    }
                    self.pause(end.saturating_sub(now));
                }
                Wait::Until(time) if now >= time => {
                    if orders.desk.any() {
                        self.attend(orders, now)?;
                    }
                    match self.step(clock, now, time) {
                        // It is not gone for its receivers: the run is about to end for all.
                        Err(StepError::Node { source: NodeError::Over, .. }) => {
                            while !orders.stop.load(Ordering::Relaxed) && clock.now() < end {
                                self.pause(PATIENCE);
                            }
                            return Ok(());
                        }
                        made => made?,
                    }
                }
                Wait::Until(time) => {
                    let left = time - now - self.settings.spin;
                    match left {
                        1.. => self.pause(left),
                        _ => self.prepare(now),
                    }
                }
                Wait::Message { .. } if now >= end => return Ok(()),
                Wait::Message { .. } => {
                    // The message is expected about when the step is due.
                    let gate = self.inbox.gate();
                    let left = gate.due().saturating_add(gate.shift()) - self.settings.spin - now;
                    match left {
                        _ if self.settings.spin == 0 => self.pause(PATIENCE.min(end.saturating_sub(now))),
                        1.. => self.pause(left),
                        _ if left > -2 * self.settings.spin => {
                            self.prepare(now);
                            polls = POLLS;
                        }
                        _ => self.pause(PATIENCE),
                    }
                }
                Wait::Stop { input } => {
                    return Err(StepError::DeadSender { sender: self.inputs[input].sender_name.clone() });
                }
                // A step ends before this loop goes on.
                Wait::End => {}
            }
        }
        Ok(())
    }

    /// While a polling node has nothing else to do: readies the next message, once the receivers of the last one are done
    /// with it.
    fn prepare(&mut self, now: Nanos) {
        if now.saturating_sub(self.last_end) > SETTLED {
            self.output.prepare();
        }
        std::hint::spin_loop();
    }

    /// Sleeps until a message comes, at most this long.
    fn pause(&self, time: Nanos) {
        self.listener.wait(Duration::from_nanos(time.clamp(0, PATIENCE) as u64));
    }

    /// Does what somebody wished to be set, read or reset before the next step.
    fn attend(&mut self, orders: &Orders, now: Nanos) -> Result<(), StepError> {
        let Self { node, inbox, records, vitals, .. } = self;
        let step = inbox.gate().seq();
        orders.desk.serve(&mut **node, step, now, |errand| match records {
            Some(records) => Ok(records.errand(errand, step, now, vitals)?),
            None => Ok(()),
        })
    }

    /// Makes the next step, which begins now, at `start`, and could have begun at `earliest`.
    fn step(&mut self, clock: WallClock, start: Nanos, earliest: Nanos) -> Result<(), StepError> {
        let step: Step<'_> = self.inbox.begin(start)?;
        let (seq, due) = (step.seq, step.due);
        self.vitals.set(Vital::Stepping, (clock.epoch() + earliest) as u64);
        let mut large = self.room.message(&self.output)?;
        let failed = |source| StepError::Node { seq, source };
        self.room.step(&mut *self.node, &step, &mut self.values, large.as_deref_mut()).map_err(failed)?;
        let end = clock.now();
        let replace = self.settings.judge(&self.vitals, &self.leaves, &self.values, seq, end - earliest)?;
        let replaced = replace && self.safe.is_some();
        match &self.safe {
            Some(safe) if replace => {
                safe.write_over(&mut self.sent);
                self.vitals.add(Vital::Replaced, 1);
            }
            _ => self.sent.copy_from_slice(&self.values),
        }
        // Before it is sent: whoever takes up this node's work must not use the number again.
        self.vitals.set(Vital::Next, seq + 1);
        let (values, wakers, records) = (&self.sent, &self.wakers, &mut self.records);
        let times = [seq, due as u64, start as u64, end as u64];
        let delivered = match large {
            None => {
                let delivered = self.output.send_filled(MESSAGE_HEAD + values.len(), |words| {
                    let (head, leaves) = words.split_at_mut(MESSAGE_HEAD);
                    head.copy_from_slice(&[seq, end as u64]);
                    leaves.iter_mut().zip(values).for_each(|(leaf, value)| *leaf = value.to_bits());
                })?;
                wakers.iter().for_each(|waker| _ = waker.wake());
                if let Some(records) = records {
                    let output = Output { leaves: values, data: &[], replaced };
                    records.step(times, &self.inbox, &output, &self.vitals)?;
                }
                delivered
            }
            Some(mut message) => {
                self.room.head(&mut message, [seq, end as u64], values, replaced);
                let mut recorded = Ok(());
                // SAFETY: nothing in there begins or sends a message of the node's output.
                let delivered = unsafe {
                    message.send_then(|words| {
                        wakers.iter().for_each(|waker| _ = waker.wake());
                        if let Some(records) = records {
                            let output = Output { leaves: values, data: self.room.data(words), replaced };
                            recorded = records.step(times, &self.inbox, &output, &self.vitals);
                        }
                    })
                }?;
                recorded?;
                delivered
            }
        };
        self.vitals.add(Vital::Sent, 1);
        let undelivered = self.output.topic().subscribers.saturating_sub(delivered);
        if undelivered > 0 {
            self.vitals.add(Vital::Undelivered, undelivered as u64);
        }
        self.inbox.end(end)?;
        self.last_end = end;
        self.vitals.set(Vital::Stepping, 0);
        self.vitals.add(Vital::Steps, 1);
        // A step that waited for a message, or for the one before, is not to blame for that.
        let period = self.inbox.gate().due().saturating_sub(due);
        if end.saturating_sub(earliest) > period {
            self.vitals.add(Vital::Overruns, 1);
        }
        self.vitals.lateness.add(start - earliest);
        self.vitals.computation.add(end - start);
        self.vitals.set(Vital::Ended, (clock.epoch() + end) as u64);
        for (input, window) in self.inbox.windows().iter().enumerate() {
            self.show(input);
            self.inputs[input].news = false;
            let stamps = || window.stamps().iter().filter(|stamp| stamp.seq.is_some());
            self.vitals.set_input(input, InputVital::Filled, stamps().count() as u64);
            // Counted here and not on arrival: nothing comes between a message and the step that waits for it.
            let counted = &mut self.inputs[input].counted;
            for stamp in stamps().filter(|stamp| stamp.seq >= Some(*counted)) {
                self.vitals.delays[input].add(stamp.received.saturating_sub(stamp.sent));
            }
            *counted = stamps().next_back().map_or(*counted, |stamp| stamp.seq.map_or(0, |seq| seq + 1));
        }
        Ok(())
    }

    /// The end of the node: one more step on the safe outputs of its senders, if they have any, and the node's own stop.
    /// Gives what went wrong with that.
    ///
    /// What the last step returns is not sent: the receivers make a last step of their own.
    pub(super) fn finish(&mut self, clock: WallClock, why: Stopping) -> Option<String> {
        let mut problem = None;
        // Whatever it does from here on is no step.
        self.vitals.set(Vital::Stepping, 0);
        // What arrived for a step that did not end, or for none.
        self.show_news();
        if why != Stopping::Failed && self.inbox.has_safe() {
            let now = clock.now();
            let Self { node, inbox, values, room, output, .. } = self;
            let last = catch_unwind(AssertUnwindSafe(|| {
                let mut large = room.message(output).map_err(|e| NodeError::failed(e.to_string()))?;
                room.step(&mut **node, &inbox.last(now), values, large.as_deref_mut())
            }));
            problem = match last {
                Ok(Ok(())) => None,
                Ok(Err(error)) => Some(format!("its last step: {error}")),
                Err(panic) => Some(format!("its last step {}", panicked(&*panic))),
            };
            if problem.is_none() {
                self.vitals.set(Vital::Stopped, now.max(1) as u64);
            }
        }
        let stopped = catch_unwind(AssertUnwindSafe(|| self.node.stop(why)));
        problem.or_else(|| Some(panicked(&*stopped.err()?)))
    }

    /// The step that was running, if one was.
    pub(super) fn running(&self) -> u64 {
        self.inbox.gate().seq()
    }
}

/// What a panic says, in words.
pub(super) fn panicked(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    format!("panicked: {}", text.unwrap_or("without a message"))
}
