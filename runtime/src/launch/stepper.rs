//! The loop of one node on the wall clock: wait, take what arrived, step, send, record.
//!
//! It drives the same [`Inbox`] as the simulated clock does. After it was made it allocates nothing and takes
//! no lock.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::plan::{
    self, CONSUMED, INITIAL, INPUT_HEAD, LOSS, LOSS_WORDS, MESSAGE_HEAD, STEP, STEP_HEAD, Settings,
};
use super::report::{Exit, Histogram, NodeReport};
use super::settings::NodeSettings;
use crate::channel::{ChannelError, Endpoint, Listener, Publisher, Subscriber, Waker};
use crate::clock::WallClock;
use crate::graph::Graph;
use crate::node::{ErasedNode, NodeError, Step};
use crate::recording::LossReason;
use crate::schedule::{GateError, Inbox, Wait};
use crate::time::Nanos;

/// A wait is never longer than this, so that an order to stop is seen soon.
const PATIENCE: Nanos = 20_000_000;

/// What others tell a running node.
#[derive(Debug)]
pub(super) struct Orders {
    pub(super) stop: AtomicBool,
    /// Nodes that are gone, and whether there is news about that.
    pub(super) dead: Box<[AtomicBool]>,
    pub(super) dead_news: AtomicBool,
}

impl Orders {
    pub(super) fn new(nodes: usize) -> Self {
        let dead = (0..nodes).map(|_| AtomicBool::new(false)).collect();
        Self { stop: AtomicBool::new(false), dead, dead_news: AtomicBool::new(false) }
    }
}

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
    #[error("a message of {sender} has {got} words instead of {expected}")]
    Length { sender: String, got: usize, expected: usize },
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
    values: Box<[f64]>,
    /// No step starts at or after this time.
    end: Nanos,
    settings: NodeSettings,
    name: String,
    steps: u64,
    overruns: u64,
    undelivered: u64,
    lateness: Histogram,
    computation: Histogram,
}

struct Input {
    sender: usize,
    sender_name: String,
    subscriber: Subscriber,
    values: Box<[f64]>,
    lost: u64,
}

/// The way to the recorder.
struct Records {
    publisher: Publisher,
    words: Box<[u64]>,
    sent: u64,
}

impl Stepper {
    /// Opens the receiving ends of a node's channels and its own, which the launcher has created.
    pub(super) fn open(
        graph: &Graph,
        index: usize,
        node: Box<dyn ErasedNode>,
        settings: &Settings,
        endpoint: &Endpoint,
    ) -> Result<Self, ChannelError> {
        let plan = &graph.nodes()[index];
        let mut inputs = Vec::with_capacity(plan.inputs.len());
        for &connection in &plan.inputs {
            let connection = &graph.connections()[connection];
            inputs.push(Input {
                sender: connection.from,
                sender_name: graph.nodes()[connection.from].name.clone(),
                subscriber: endpoint.open(&plan::output(graph, connection.from))?.subscriber()?,
                values: vec![0.0; connection.leaves].into(),
                lost: 0,
            });
        }
        let records = match settings.recording {
            false => None,
            true => {
                let publisher = endpoint.open(&plan::records(graph, index))?.publisher()?;
                let words = vec![0; publisher.topic().words].into();
                Some(Records { publisher, words, sent: 0 })
            }
        };
        Ok(Self {
            node,
            inbox: Inbox::new(graph, index),
            inputs: inputs.into(),
            listener: endpoint.listener(&plan::wake(graph, index))?,
            output: endpoint.open(&plan::output(graph, index))?.publisher()?,
            wakers: Vec::new(),
            records,
            values: vec![0.0; plan.kind.output().leaves.len()].into(),
            end: settings.duration.unwrap_or(Nanos::MAX),
            settings: settings.nodes.get(index).cloned().unwrap_or_default(),
            name: plan.name.clone(),
            steps: 0,
            overruns: 0,
            undelivered: 0,
            lateness: Histogram::new(),
            computation: Histogram::new(),
        })
    }

    /// Connects the sending ends, now that every receiver exists; gives the number of receivers and recorders.
    pub(super) fn connect(
        &mut self,
        graph: &Graph,
        index: usize,
        endpoint: &Endpoint,
    ) -> Result<(usize, usize), ChannelError> {
        for receiver in plan::receivers(graph, index) {
            self.wakers.push(endpoint.waker(&plan::wake(graph, receiver))?);
        }
        let recorders = self.records.as_ref().map_or(Ok(0), |records| records.publisher.connect())?;
        Ok((self.output.connect()?, recorders))
    }

    /// Runs the node until its time is over, somebody stops it, or it cannot go on.
    pub(super) fn run(&mut self, clock: WallClock, orders: &Orders) -> Result<(), StepError> {
        let end = self.end;
        while !orders.stop.load(Ordering::Relaxed) {
            // What a node sent before its death is taken before the death is believed.
            let news = orders.dead_news.swap(false, Ordering::Acquire);
            self.receive(clock, end)?;
            if news {
                for (input, state) in self.inputs.iter().enumerate() {
                    if orders.dead[state.sender].load(Ordering::Relaxed) {
                        self.inbox.sender_dead(input);
                    }
                }
            }
            let now = clock.now();
            match self.inbox.gate().ready() {
                Wait::Until(time) if time.max(now) >= end => {
                    // A step that comes after the end would be the next; nothing is left to do but to wait
                    // for the end, so that this node does not report before the others can have finished.
                    if now >= end {
                        return Ok(());
                    }
                    self.pause(end - now);
                }
                Wait::Until(time) if now >= time => self.step(clock, now, time)?,
                Wait::Until(time) => {
                    let left = time - now - self.settings.spin;
                    if left > 0 { self.pause(left) } else { std::hint::spin_loop() }
                }
                Wait::Message { .. } if now >= end => return Ok(()),
                Wait::Message { .. } => {
                    // The message is expected about when the step is due.
                    let gate = self.inbox.gate();
                    let left = gate.due().saturating_add(gate.shift()) - self.settings.spin - now;
                    match left {
                        1.. => self.pause(left),
                        _ if left > -2 * self.settings.spin => std::hint::spin_loop(),
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

    /// Sleeps until a message comes, at most this long.
    fn pause(&self, time: Nanos) {
        self.listener.wait(Duration::from_nanos(time.clamp(0, PATIENCE) as u64));
    }

    /// Takes everything that has arrived, each message stamped with the time it was taken.
    fn receive(&mut self, clock: WallClock, end: Nanos) -> Result<(), StepError> {
        for index in 0..self.inputs.len() {
            loop {
                let Input { subscriber, values, sender_name, .. } = &mut self.inputs[index];
                let mut head = [0; MESSAGE_HEAD];
                let mut length = 0;
                let expected = MESSAGE_HEAD + values.len();
                let got = subscriber.receive(|words| {
                    length = words.len();
                    if length == expected {
                        head.copy_from_slice(&words[..MESSAGE_HEAD]);
                        for (value, word) in values.iter_mut().zip(&words[MESSAGE_HEAD..]) {
                            *value = f64::from_bits(*word);
                        }
                    }
                })?;
                if !got {
                    break;
                }
                if length != expected {
                    return Err(StepError::Length { sender: sender_name.clone(), got: length, expected });
                }
                let [seq, sent] = head;
                // What arrives after the end belongs to no step.
                let received = clock.now();
                if received >= end {
                    continue;
                }
                let arrival =
                    self.inbox.arrive(index, seq, sent as Nanos, received, &self.inputs[index].values)?;
                let missing = arrival.missing.end - arrival.missing.start;
                if missing > 0 {
                    self.lose(index, arrival.missing.start, missing, received, LossReason::Transport)?;
                }
                if arrival.slot.is_none() {
                    self.lose(index, seq, 1, received, LossReason::Overflow)?;
                }
            }
        }
        Ok(())
    }

    fn lose(
        &mut self,
        input: usize,
        first: u64,
        count: u64,
        time: Nanos,
        reason: LossReason,
    ) -> Result<(), ChannelError> {
        self.inputs[input].lost += count;
        let Some(records) = &mut self.records else { return Ok(()) };
        let reason = match reason {
            LossReason::Transport => 0,
            LossReason::Overflow => 1,
        };
        records.words[..LOSS_WORDS].copy_from_slice(&[
            LOSS,
            records.sent,
            input as u64,
            first,
            count,
            time as u64,
            reason,
        ]);
        records.send(LOSS_WORDS)
    }

    /// Makes the next step, which begins now, at `start`, and could have begun at `earliest`.
    fn step(&mut self, clock: WallClock, start: Nanos, earliest: Nanos) -> Result<(), StepError> {
        let step: Step<'_> = self.inbox.begin(start)?;
        let (seq, due) = (step.seq, step.due);
        self.node.step_into(&step, &mut self.values).map_err(|source| StepError::Node { seq, source })?;
        let end = clock.now();
        let values = &self.values;
        let delivered = self.output.send(MESSAGE_HEAD + values.len(), |word| match word {
            0 => seq,
            1 => end as u64,
            leaf => values[leaf - MESSAGE_HEAD].to_bits(),
        })?;
        self.undelivered += self.output.topic().subscribers.saturating_sub(delivered) as u64;
        for waker in &self.wakers {
            waker.wake();
        }
        if let Some(records) = &mut self.records {
            let length = records.step([seq, due as u64, start as u64, end as u64], &self.inbox, values);
            records.send(length)?;
        }
        let shift = self.inbox.gate().shift();
        self.inbox.end(end)?;
        self.steps += 1;
        self.overruns += u64::from(end > self.inbox.gate().due().saturating_add(shift));
        self.lateness.add(start - earliest);
        self.computation.add(end - start);
        Ok(())
    }

    /// How the node fared so far.
    pub(super) fn report(&self) -> NodeReport {
        let lost = self.inputs.iter().filter(|input| input.lost > 0);
        NodeReport {
            node: self.name.clone(),
            core: self.settings.core,
            steps: self.steps,
            overruns: self.overruns,
            lateness: self.lateness.percentiles(),
            computation: self.computation.percentiles(),
            undelivered: self.undelivered,
            lost: lost.map(|input| (input.sender_name.clone(), input.lost)).collect(),
            exit: Exit::Clean,
        }
    }
}

impl Records {
    /// Puts the record of a step together; gives its length in words.
    fn step(&mut self, times: [u64; 4], inbox: &Inbox, values: &[f64]) -> usize {
        self.words[0] = STEP;
        self.words[1] = self.sent;
        self.words[2..STEP_HEAD].copy_from_slice(&times);
        let mut at = STEP_HEAD;
        for window in inbox.windows() {
            self.words[at] = window.superseded();
            self.words[at + 1] = window.stamps().len() as u64;
            at += INPUT_HEAD;
            for stamp in window.stamps() {
                let words = [stamp.seq.unwrap_or(INITIAL), stamp.sent as u64, stamp.received as u64];
                self.words[at..at + CONSUMED].copy_from_slice(&words);
                at += CONSUMED;
            }
        }
        for (word, value) in self.words[at..].iter_mut().zip(values) {
            *word = value.to_bits();
        }
        at + values.len()
    }

    fn send(&mut self, length: usize) -> Result<(), ChannelError> {
        // A record that does not reach the recorder leaves a gap in this count, which the recorder reports.
        self.sent += 1;
        self.publisher.send(length, |word| self.words[word]).map(drop)
    }
}
