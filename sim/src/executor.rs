//! Runs a graph under a simulated clock.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use parallax_runtime::data::{Data, DataSpace};
use parallax_runtime::delay::{Delay, DelaySampler};
use parallax_runtime::graph::Graph;
use parallax_runtime::node::{ErasedNode, NodeError, Step};
use parallax_runtime::random::{Purpose, stream};
use parallax_runtime::recording::{
    Change, Clock, Fault, FaultKind, Loss, LossReason, MemorySink, Recording, RecordingSink, StepView,
};
use parallax_runtime::schedule::{GateError, Inbox, Wait};
use parallax_runtime::time::Nanos;
use parallax_runtime::tuning::apply;
use rand_chacha::ChaCha8Rng;

use crate::changes::{ChangePlan, Planned};
use crate::event::{Class, Event, Queue};
use crate::outcome::{ConnectionAccount, Outcome, SimError};

/// Runs a graph under a simulated clock: computation and communication delays are drawn from the graph's distributions,
/// one random stream per node and per connection. One seed gives one run, bit for bit.
#[derive(Debug, Clone)]
pub struct Executor {
    graph: Graph,
    seed: u64,
    real_time_factor: Option<f64>,
    /// Whether nodes are left out: steps run when they would and send their initial messages.
    timing_only: bool,
    changes: ChangePlan,
}

impl Executor {
    /// Runs `graph` with all randomness from `seed`, as fast as it can.
    pub fn new(graph: Graph, seed: u64) -> Self {
        Self { graph, seed, real_time_factor: None, timing_only: false, changes: ChangePlan::default() }
    }

    /// Runs the schedule alone, without the nodes. A computation delay that follows from a step's output is then what
    /// the graph expects of it.
    #[must_use]
    pub(crate) fn timing_only(mut self) -> Self {
        self.timing_only = true;
        self
    }

    /// Holds the run back so that it takes `factor` simulated seconds a second: 1 is real time.
    #[must_use]
    pub fn real_time_factor(mut self, factor: f64) -> Self {
        self.real_time_factor = Some(factor);
        self
    }

    /// Sets and resets in the nodes what is planned, before the steps for which it is planned, and records that.
    #[must_use]
    pub fn changes(mut self, plan: ChangePlan) -> Self {
        self.changes = plan;
        self
    }

    /// The graph that it runs.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// The clock as recordings name it.
    pub fn clock(&self) -> Clock {
        Clock::Simulated { seed: self.seed }
    }

    /// Runs for `duration` and keeps the recording in memory.
    ///
    /// # Errors
    ///
    /// As [`run`](Self::run).
    pub fn record(&self, duration: Nanos) -> Result<Recording, SimError> {
        let mut sink = MemorySink::new(&self.graph, self.clock());
        self.run(duration, &mut sink)?;
        Ok(sink.finish(duration))
    }

    /// Runs for `duration`: no step starts at or after it, and those that run then are ended. A node that gives up is a
    /// fault of the [`Outcome`], not an error: its receivers react as to a dead sender.
    ///
    /// # Errors
    ///
    /// When a node cannot be built, the sink cannot keep what happens, or `duration` or the real-time factor is not
    /// positive.
    pub fn run(&self, duration: Nanos, sink: &mut impl RecordingSink) -> Result<Outcome, SimError> {
        if duration <= 0 {
            return Err(SimError::Duration { duration });
        }
        let pace = match self.real_time_factor {
            Some(factor) if !(factor.is_finite() && factor > 0.0) => {
                return Err(SimError::RealTimeFactor { factor });
            }
            factor => factor.map(|factor| (Instant::now(), factor)),
        };
        self.changes.check(&self.graph)?;
        let mut run = Run::new(&self.graph, self.seed, duration, sink, self.timing_only)?;
        if !self.timing_only {
            for (state, plan) in run.nodes.iter_mut().zip(self.graph.nodes()) {
                state.planned = self.changes.of(&plan.name).into();
            }
        }
        for &node in self.graph.order() {
            run.wake(node, 0)?;
        }
        while let Some(event) = run.queue.pop() {
            if let Some((began, factor)) = pace {
                let target = Duration::from_secs_f64(event.time.max(0) as f64 * 1e-9 / factor);
                std::thread::sleep(target.saturating_sub(began.elapsed()));
            }
            // As at the end of the time: nothing starts or arrives any more, and what runs is ended.
            if run.over.is_none() || event.class == Class::End {
                run.happen(event)?;
            }
        }
        Ok(run.outcome())
    }
}

/// Stands for every node where only the timing counts: its output stays the initial message.
struct Nothing;

impl ErasedNode for Nothing {
    fn step_into(&mut self, _: &Step<'_>, _: &mut [f64]) -> Result<(), NodeError> {
        Ok(())
    }
}

struct NodeState {
    inbox: Inbox,
    node: Box<dyn ErasedNode>,
    output: Box<[f64]>,
    /// Room for the data of a message, and those of the last one.
    room: Box<[u8]>,
    data: Data,
    computation: DelaySampler,
    random: ChaCha8Rng,
    alive: bool,
    /// A start is in the queue.
    scheduled: bool,
    start: Nanos,
    sent: u64,
    /// What is to be changed in it, in order.
    planned: VecDeque<Planned>,
}

/// Messages under way on one connection, oldest first.
struct Flight {
    delay: DelaySampler,
    random: ChaCha8Rng,
    stamps: VecDeque<(u64, Nanos)>,
    values: VecDeque<f64>,
    /// As many as there are stamps, for messages with data.
    data: VecDeque<Data>,
    payload: Box<[f64]>,
    last_arrival: Nanos,
}

struct Run<'a, S> {
    graph: &'a Graph,
    duration: Nanos,
    sink: &'a mut S,
    nodes: Vec<NodeState>,
    flights: Vec<Flight>,
    queue: Queue,
    steps: u64,
    faults: Vec<Fault>,
    /// When a node said that the run is over.
    over: Option<Nanos>,
}

impl<'a, S: RecordingSink> Run<'a, S> {
    fn new(
        graph: &'a Graph,
        seed: u64,
        duration: Nanos,
        sink: &'a mut S,
        timing_only: bool,
    ) -> Result<Self, SimError> {
        let mut nodes = Vec::with_capacity(graph.nodes().len());
        for (index, plan) in graph.nodes().iter().enumerate() {
            let (node, computation) = if timing_only {
                let delay = match plan.computation.leaf() {
                    Some(_) => Delay::constant(plan.computation.expected()).sampler(&[]),
                    None => plan.computation.sampler(&[]),
                };
                (Box::new(Nothing) as Box<dyn ErasedNode>, delay)
            } else {
                let build = graph.build(index, seed);
                let node = build.map_err(|source| SimError::Build { node: plan.name.clone(), source })?;
                (node, plan.computation.sampler(&plan.kind.output().leaves))
            };
            nodes.push(NodeState {
                inbox: Inbox::new(graph, index),
                node,
                output: plan.kind.initial_message().into(),
                room: vec![0; if timing_only { 0 } else { plan.kind.data_capacity() }].into(),
                data: Data::default(),
                computation,
                random: stream(seed, Purpose::Computation, &plan.name),
                alive: true,
                scheduled: false,
                start: 0,
                sent: 0,
                planned: VecDeque::new(),
            });
        }
        let flights = graph.connections().iter().enumerate().map(|(index, plan)| Flight {
            delay: plan.delay.sampler(&[]),
            random: stream(seed, Purpose::Communication, &graph.connection_name(index)),
            stamps: VecDeque::with_capacity(plan.capacity),
            values: VecDeque::with_capacity(plan.capacity * plan.leaves),
            data: VecDeque::new(),
            payload: vec![0.0; plan.leaves].into(),
            last_arrival: 0,
        });
        Ok(Self {
            graph,
            duration,
            sink,
            nodes,
            flights: flights.collect(),
            queue: Queue::default(),
            steps: 0,
            faults: Vec::new(),
            over: None,
        })
    }

    #[inline]
    fn happen(&mut self, event: Event) -> Result<(), SimError> {
        let target = event.target as usize;
        match event.class {
            Class::End => self.end(target, event.time),
            Class::Arrival => self.arrive(target, event.time),
            Class::Death => {
                let plan = &self.graph.connections()[target];
                let inbox = &mut self.nodes[plan.to].inbox;
                inbox.sender_dead(plan.input);
                inbox.substitute(plan.input, event.time);
                self.wake(plan.to, event.time)
            }
            Class::Start => {
                self.nodes[target].scheduled = false;
                // A death may have changed what the step waits for since the start was scheduled.
                match self.nodes[target].inbox.gate().ready() {
                    Wait::Until(start) if start <= event.time => self.start(target, event.time),
                    _ => self.wake(target, event.time),
                }
            }
        }
    }

    /// Looks at what `node` waits for, and schedules its next step if that is nothing but time.
    #[inline]
    fn wake(&mut self, node: usize, now: Nanos) -> Result<(), SimError> {
        let state = &mut self.nodes[node];
        if !state.alive || state.scheduled {
            return Ok(());
        }
        let gate = state.inbox.gate();
        match gate.ready() {
            Wait::Until(start) => {
                let start = start.max(now);
                // Nothing starts once the time is up; what runs then is ended.
                if start < self.duration {
                    state.scheduled = true;
                    let rank = self.graph.nodes()[node].rank as u32;
                    let event = Event {
                        time: start,
                        class: Class::Start,
                        rank,
                        seq: gate.seq(),
                        target: node as u32,
                    };
                    self.queue.push(event);
                }
                Ok(())
            }
            Wait::Stop { input } => {
                let connection = self.graph.nodes()[node].inputs[input];
                let sender = self.graph.nodes()[self.graph.connections()[connection].from].name.clone();
                self.die(node, now, FaultKind::DeadSender { sender })
            }
            Wait::Message { .. } | Wait::End => Ok(()),
        }
    }

    #[inline]
    fn start(&mut self, node: usize, now: Nanos) -> Result<(), SimError> {
        if !self.nodes[node].planned.is_empty() {
            self.change(node, now)?;
        }
        let state = &mut self.nodes[node];
        let step = state.inbox.begin(now).map_err(|source| gate_error(self.graph, node, now, source))?;
        let seq = step.seq;
        let mut space = DataSpace::new(&mut state.room);
        let made = state.node.step_with_data(&step, &mut state.output, &mut space);
        if made == Err(NodeError::Over) {
            (self.over, self.duration) = (Some(now), now);
            return Ok(());
        }
        if let Err(error) = made {
            return self.die(node, now, FaultKind::Failed { message: error.to_string() });
        }
        let used = space.used();
        if used > 0 || !state.data.is_empty() {
            state.data = Data::from(&state.room[..used]);
        }
        state.start = now;
        let end = now.saturating_add(state.computation.sample(&mut state.random, &state.output));
        let rank = self.graph.nodes()[node].rank as u32;
        self.queue.push(Event { time: end, class: Class::End, rank, seq, target: node as u32 });
        Ok(())
    }

    /// Makes the changes that are planned before the next step of a node, which starts now.
    fn change(&mut self, node: usize, now: Nanos) -> Result<(), SimError> {
        let state = &mut self.nodes[node];
        let step = state.inbox.gate().seq();
        while state.planned.front().is_some_and(|planned| planned.is_due(step, now)) {
            let Some(planned) = state.planned.pop_front() else { break };
            let made = apply(state.node.tuning(), &planned.node, &planned.changes);
            for change in made.map_err(|source| SimError::Change { step, source })? {
                self.sink.change(&Change { step, time: now, ..change })?;
            }
        }
        Ok(())
    }

    #[inline]
    fn end(&mut self, node: usize, now: Nanos) -> Result<(), SimError> {
        let plan = &self.graph.nodes()[node];
        let state = &mut self.nodes[node];
        let gate = state.inbox.gate();
        let (seq, due) = (gate.seq(), gate.due());
        let step = StepView { seq, due, start: state.start, end: now, inputs: state.inbox.windows() };
        self.sink.step(node, &step)?;
        self.sink.message(node, seq, now, &state.output, &state.data)?;
        state.inbox.end(now).map_err(|source| gate_error(self.graph, node, now, source))?;
        state.sent += 1;
        self.steps += 1;
        for &connection in &plan.outputs {
            let flight = &mut self.flights[connection];
            // Messages of one connection never overtake each other.
            let delay = flight.delay.sample(&mut flight.random, &[]);
            let arrival = now.saturating_add(delay).max(flight.last_arrival);
            flight.last_arrival = arrival;
            if arrival < self.duration {
                flight.stamps.push_back((seq, now));
                flight.values.extend(state.output.iter());
                if self.graph.connections()[connection].data > 0 {
                    flight.data.push_back(state.data.clone());
                }
                self.queue.push(Event {
                    time: arrival,
                    class: Class::Arrival,
                    rank: plan.rank as u32,
                    seq,
                    target: connection as u32,
                });
            }
        }
        self.wake(node, now)
    }

    #[inline]
    fn arrive(&mut self, connection: usize, now: Nanos) -> Result<(), SimError> {
        let plan = &self.graph.connections()[connection];
        let flight = &mut self.flights[connection];
        let Some((seq, sent)) = flight.stamps.pop_front() else { return Ok(()) };
        for (place, value) in flight.payload.iter_mut().zip(flight.values.drain(..plan.leaves)) {
            *place = value;
        }
        let state = &mut self.nodes[plan.to];
        let arrival = match flight.data.pop_front() {
            None => state.inbox.arrive(plan.input, seq, sent, now, &flight.payload),
            Some(data) => state.inbox.arrive_with_data(plan.input, seq, sent, now, &flight.payload, data),
        };
        let arrival = arrival.map_err(|source| gate_error(self.graph, plan.to, now, source))?;
        if arrival.slot.is_none() {
            self.sink.loss(&Loss {
                from: self.graph.nodes()[plan.from].name.clone(),
                to: self.graph.nodes()[plan.to].name.clone(),
                port: plan.port.clone(),
                seq,
                time: now,
                reason: LossReason::Overflow,
            })?;
        }
        // A message can only end a blocking wait.
        if plan.blocking { self.wake(plan.to, now) } else { Ok(()) }
    }

    fn die(&mut self, node: usize, now: Nanos, kind: FaultKind) -> Result<(), SimError> {
        self.nodes[node].alive = false;
        let plan = &self.graph.nodes()[node];
        let fault = Fault { node: plan.name.clone(), time: now, kind };
        self.sink.fault(&fault)?;
        self.faults.push(fault);
        for &connection in &plan.outputs {
            // What is under way still arrives: the death is noticed after it.
            let time = now.max(self.flights[connection].last_arrival);
            let event = Event {
                time,
                class: Class::Death,
                rank: plan.rank as u32,
                seq: 0,
                target: connection as u32,
            };
            if time < self.duration {
                self.queue.push(event);
            }
        }
        Ok(())
    }

    fn outcome(self) -> Outcome {
        let connections = self.graph.connections().iter().enumerate().map(|(index, plan)| {
            let sent = self.nodes[plan.from].sent;
            let account = self.nodes[plan.to].inbox.gate().account(plan.input);
            ConnectionAccount {
                connection: self.graph.connection_name(index),
                sent,
                in_flight: account.in_flight(sent),
                account,
            }
        });
        let changes_left = self.nodes.iter().map(|node| node.planned.len()).sum();
        let connections = connections.collect();
        Outcome { steps: self.steps, connections, faults: self.faults, changes_left, over: self.over }
    }
}

fn gate_error(graph: &Graph, node: usize, time: Nanos, source: GateError) -> SimError {
    SimError::Gate { node: graph.nodes()[node].name.clone(), time, source }
}
