//! Holds a recorded schedule against the rules: what was recorded is fed through the gate that decides schedules.

use std::fmt;

use super::{Resumption, StepGate, Wait};
use crate::graph::Graph;
use crate::node::Consumed;
use crate::recording::{Clock, Fault, FaultKind, LossReason, NodeTrack, Recording, StepRecord};
use crate::time::Nanos;

/// Whether the recorded schedule of one node is one that its gate decides.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScheduleCheck {
    /// Steps that were checked and follow the rules.
    pub steps: u64,
    /// The first step that does not; those after it were not checked.
    pub deviation: Option<Deviation>,
    /// How long after the earliest possible moment steps started: the mean, ns. Under the simulated clock it is 0.
    pub mean_lateness: f64,
    /// The largest lateness, ns.
    pub largest_lateness: Nanos,
}

/// A recorded step that the rules do not allow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deviation {
    /// The node.
    pub node: String,
    /// Its step.
    pub seq: u64,
    /// How it deviates.
    pub kind: DeviationKind,
}

/// How a recorded step deviates from the rules.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviationKind {
    /// It was due at another time.
    Due {
        /// What was recorded.
        recorded: Nanos,
        /// What the rules say.
        expected: Nanos,
    },
    /// It started before it might.
    Early {
        /// When it started.
        start: Nanos,
        /// When it might start.
        earliest: Nanos,
    },
    /// It started late, although the clock was simulated.
    Late {
        /// When it started.
        start: Nanos,
        /// When it had to start.
        earliest: Nanos,
    },
    /// It started, although it had to wait.
    NotReady {
        /// For what.
        wait: Wait,
    },
    /// It saw other messages than it had to.
    Window {
        /// The input.
        port: String,
        /// What was recorded.
        recorded: Vec<Consumed>,
        /// What the rules say.
        expected: Vec<Consumed>,
    },
    /// It passed over another number of messages.
    Superseded {
        /// The input.
        port: String,
        /// What was recorded.
        recorded: u64,
        /// What the rules say.
        expected: u64,
    },
    /// A message that it saw was sent at another time than the sender recorded.
    Sent {
        /// The input.
        port: String,
        /// The message.
        seq: u64,
        /// When it was sent, says the receiver.
        recorded: Nanos,
        /// When it was sent, says the sender.
        expected: Nanos,
    },
    /// Messages of one connection arrived in an order, or the step ended at a time, that cannot be.
    Impossible {
        /// What the gate says.
        problem: String,
    },
}

impl fmt::Display for Deviation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "step {} of node `{}` ", self.seq, self.node)?;
        let seqs = |window: &[Consumed]| {
            let seqs = window.iter().map(|c| c.seq.map_or("initial".to_owned(), |seq| seq.to_string()));
            seqs.collect::<Vec<_>>().join(", ")
        };
        match &self.kind {
            DeviationKind::Due { recorded, expected } => {
                write!(f, "is recorded as due at {recorded} ns, but is due at {expected} ns")
            }
            DeviationKind::Early { start, earliest } => {
                write!(f, "started at {start} ns, before it might at {earliest} ns")
            }
            DeviationKind::Late { start, earliest } => {
                write!(f, "started at {start} ns, but had to at {earliest} ns")
            }
            DeviationKind::NotReady { wait } => write!(f, "started, but had to wait: {wait:?}"),
            DeviationKind::Window { port, recorded, expected } => write!(
                f,
                "saw messages [{}] at `{port}`, but the rules give [{}]",
                seqs(recorded),
                seqs(expected)
            ),
            DeviationKind::Superseded { port, recorded, expected } => {
                write!(f, "passed over {recorded} messages at `{port}`, but the rules give {expected}")
            }
            DeviationKind::Sent { port, seq, recorded, expected } => write!(
                f,
                "saw message {seq} at `{port}` as sent at {recorded} ns, but it was sent at {expected} ns"
            ),
            DeviationKind::Impossible { problem } => write!(f, "cannot be: {problem}"),
        }
    }
}

/// A message as the recording tells that it arrived.
#[derive(Debug, Clone, Copy)]
struct Arrived {
    seq: u64,
    sent: Nanos,
    received: Nanos,
    /// The first step that saw it, or that passed over it; `u64::MAX` when it was lost on arrival.
    step: u64,
    /// Whether its time of arrival is only a bound.
    bound: bool,
    /// Whether it is the safe output of a sender that was gone.
    safe: bool,
}

/// Feeds recorded steps of the node at `index`, from its first on, through its gate: the same arrivals at the same times
/// must lead to the same decisions. Real clocks may start a step late, but never early; a simulated clock is exact.
pub fn verify(recording: &Recording, graph: &Graph, index: usize, steps: &[StepRecord]) -> ScheduleCheck {
    let mut check = ScheduleCheck::default();
    let mut lateness = 0.0;
    let mut feed = Feed::new(recording, graph, index, steps);
    for step in steps {
        match feed.step(step) {
            Ok(late) => {
                check.steps += 1;
                check.largest_lateness = check.largest_lateness.max(late);
                lateness += late as f64;
            }
            Err(kind) => {
                let node = graph.nodes()[index].name.clone();
                check.deviation = Some(Deviation { node, seq: step.seq, kind });
                break;
            }
        }
    }
    check.mean_lateness = lateness / check.steps.max(1) as f64;
    check
}

struct Feed<'a> {
    recording: &'a Recording,
    graph: &'a Graph,
    index: usize,
    /// Per input, the track of the sender; `None` when the recording lacks it.
    senders: Vec<Option<&'a NodeTrack>>,
    gate: StepGate,
    /// Per input, what arrived and how much of it the gate was told.
    arrivals: Vec<(Vec<Arrived>, usize)>,
    /// Whether a step starts exactly when it may: under a simulated clock, unless something was lost or died.
    exact: bool,
}

impl<'a> Feed<'a> {
    fn new(recording: &'a Recording, graph: &'a Graph, index: usize, steps: &[StepRecord]) -> Self {
        let plan = &graph.nodes()[index];
        let sender =
            |&connection: &usize| recording.node(&graph.nodes()[graph.connections()[connection].from].name);
        let senders: Vec<Option<&NodeTrack>> = plan.inputs.iter().map(sender).collect();
        let inputs = 0..plan.inputs.len();
        let arrivals = inputs
            .map(|input| (arrivals(recording, graph, senders[input], index, input, steps), 0))
            .collect();
        let undisturbed =
            recording.faults.is_empty() && !recording.losses.iter().any(|loss| loss.to == plan.name);
        Self {
            recording,
            graph,
            index,
            senders,
            gate: StepGate::new(graph, index),
            arrivals,
            exact: matches!(recording.clock, Clock::Simulated { .. }) && undisturbed,
        }
    }

    /// Checks one step, and says how long after the earliest possible moment it started.
    fn step(&mut self, step: &StepRecord) -> Result<Nanos, DeviationKind> {
        let impossible = |error: &dyn fmt::Display| DeviationKind::Impossible { problem: error.to_string() };
        if let Some(shift) = restart(self.recording, self.graph, self.index, step.seq) {
            let mut known: Vec<u64> = Vec::new();
            for (input, (arrivals, told)) in self.arrivals.iter_mut().enumerate() {
                // What came before the restart was for the node that ended.
                while arrivals.get(*told).is_some_and(|next| next.step < step.seq) {
                    *told += 1;
                }
                known.push(arrivals.get(*told).map_or(self.gate.known(input), |next| next.seq));
            }
            self.gate =
                StepGate::resumed(self.graph, self.index, &Resumption { step: step.seq, shift, known });
        }
        if step.due != self.gate.due() {
            return Err(DeviationKind::Due { recorded: step.due, expected: self.gate.due() });
        }
        for (input, (arrivals, told)) in self.arrivals.iter_mut().enumerate() {
            while let Some(next) = arrivals.get(*told) {
                // At equal times the recorded order decides: what the step saw was there, the rest came after.
                if next.received > step.start || (next.received == step.start && next.step > step.seq) {
                    break;
                }
                if next.safe {
                    // Without room for it there is no place in the window either, which the comparison below shows.
                    let _ = self.gate.substitute(input, next.received);
                } else {
                    self.gate
                        .arrive(input, next.seq, next.sent, next.received)
                        .map_err(|e| impossible(&e))?;
                }
                *told += 1;
            }
        }
        let earliest = self.earliest(step.start)?;
        if step.start < earliest {
            return Err(DeviationKind::Early { start: step.start, earliest });
        }
        if self.exact && step.start > earliest {
            return Err(DeviationKind::Late { start: step.start, earliest });
        }
        self.gate.begin(step.start).map_err(|e| impossible(&e))?;
        for (input, recorded) in step.inputs.iter().enumerate() {
            let port = || recorded.port.clone();
            let initial = std::iter::repeat_n(Consumed::INITIAL, self.gate.initial(input));
            let expected: Vec<Consumed> =
                initial.chain(self.gate.visible(input).map(|(_, stamp)| stamp)).collect();
            if recorded.consumed != expected {
                let recorded = recorded.consumed.clone();
                return Err(DeviationKind::Window { port: port(), recorded, expected });
            }
            let expected = self.gate.superseded(input);
            if recorded.superseded != expected {
                return Err(DeviationKind::Superseded {
                    port: port(),
                    recorded: recorded.superseded,
                    expected,
                });
            }
            for consumed in &recorded.consumed {
                if let (Some(sender), Some(seq)) = (self.senders[input], consumed.seq)
                    && let Some(message) = sender.message(seq)
                    // On another machine's clock it was another time.
                    && !self.crosses(input)
                    && message.sent != consumed.sent
                {
                    return Err(DeviationKind::Sent {
                        port: port(),
                        seq: message.seq,
                        recorded: consumed.sent,
                        expected: message.sent,
                    });
                }
            }
        }
        self.gate.end(step.end).map_err(|e| impossible(&e))?;
        Ok(step.start - earliest)
    }

    /// Whether the messages of an input came from another machine.
    fn crosses(&self, input: usize) -> bool {
        let nodes = self.graph.nodes();
        let from = self.graph.connections()[nodes[self.index].inputs[input]].from;
        self.recording.crosses(&nodes[from].name, &nodes[self.index].name)
    }

    /// When the next step may start. A sender that ended during the run is taken for dead when the step did not wait for
    /// it: on a real clock, the receiver may notice that before whoever writes it down.
    fn earliest(&mut self, start: Nanos) -> Result<Nanos, DeviationKind> {
        loop {
            match self.gate.ready() {
                Wait::Until(earliest) => return Ok(earliest),
                Wait::Message { input, seq } => {
                    // It never came, and a later one showed that, which was passed over: when that arrived is not recorded,
                    // and by now it may have.
                    let (arrivals, told) = &mut self.arrivals[input];
                    if let Some(next) = arrivals.get(*told)
                        && next.bound
                        && next.sent <= start
                        && next.seq > seq
                    {
                        *told += 1;
                        let told = self.gate.arrive(input, next.seq, next.sent, start);
                        told.map_err(|error| DeviationKind::Impossible { problem: error.to_string() })?;
                        continue;
                    }
                    let connection = self.graph.nodes()[self.index].inputs[input];
                    let sender = &self.graph.nodes()[self.graph.connections()[connection].from].name;
                    let simulated = matches!(self.recording.clock, Clock::Simulated { .. });
                    let died = |fault: &Fault| {
                        fault.node == *sender
                            && !matches!(fault.kind, FaultKind::Replaced { .. })
                            && (fault.time <= start || !simulated)
                    };
                    if !self.recording.faults.iter().any(died) {
                        return Err(DeviationKind::NotReady { wait: Wait::Message { input, seq } });
                    }
                    self.gate.sender_dead(input);
                }
                wait => return Err(DeviationKind::NotReady { wait }),
            }
        }
    }
}

/// The shift of the ticks, if this step is the first after the node was started again.
fn restart(recording: &Recording, graph: &Graph, index: usize, seq: u64) -> Option<Nanos> {
    recording.faults.iter().find_map(|fault| match &fault.kind {
        FaultKind::Restarted { step, shift } if *step == seq && fault.node == graph.nodes()[index].name => {
            Some(*shift)
        }
        _ => None,
    })
}

/// What arrived at an input, in order. Messages that were passed over are not recorded one by one: they did not
/// overtake, so they arrived no later than the next one that was seen, and count as arriving with it.
fn arrivals(
    recording: &Recording,
    graph: &Graph,
    sender: Option<&NodeTrack>,
    index: usize,
    input: usize,
    steps: &[StepRecord],
) -> Vec<Arrived> {
    let plan = &graph.connections()[graph.nodes()[index].inputs[input]];
    let (from, to) = (&graph.nodes()[plan.from].name, &graph.nodes()[plan.to].name);
    let sent = |seq: u64| sender.and_then(|track| track.message(seq)).map_or(0, |message| message.sent);
    let mut lost: Vec<_> = recording
        .losses
        .iter()
        .filter(|loss| loss.from == *from && loss.to == *to && loss.port == plan.port)
        .collect();
    lost.sort_by_key(|loss| loss.seq);
    let mut lost = lost.into_iter().peekable();

    let mut arrivals: Vec<Arrived> = Vec::new();
    let mut known = 0;
    for step in steps {
        let Some(record) = step.inputs.get(input) else { continue };
        let mut passed = record.superseded;
        for consumed in &record.consumed {
            if consumed.is_safe_output()
                && !arrivals.iter().any(|a| a.safe && a.received == consumed.received)
            {
                // What it pushed out came before it.
                for earlier in known..known + passed {
                    arrivals.push(Arrived {
                        seq: earlier,
                        sent: sent(earlier),
                        received: consumed.received,
                        step: step.seq,
                        bound: true,
                        safe: false,
                    });
                }
                known += std::mem::take(&mut passed);
                arrivals.push(Arrived {
                    seq: 0,
                    sent: consumed.sent,
                    received: consumed.received,
                    step: step.seq,
                    bound: false,
                    safe: true,
                });
            }
            let Some(seq) = consumed.seq.filter(|&seq| seq >= known) else { continue };
            passed = passed.saturating_sub(seq - known);
            for earlier in known..seq {
                let received = consumed.received;
                match lost.next_if(|loss| loss.seq == earlier) {
                    None => arrivals.push(Arrived {
                        seq: earlier,
                        sent: sent(earlier),
                        received,
                        step: step.seq,
                        bound: true,
                        safe: false,
                    }),
                    Some(loss) if loss.reason == LossReason::Overflow => arrivals.push(Arrived {
                        seq: earlier,
                        sent: sent(earlier),
                        received: loss.time,
                        step: u64::MAX,
                        bound: false,
                        safe: false,
                    }),
                    // The gate takes the hole in the numbers for what it is.
                    Some(_) => {}
                }
            }
            arrivals.push(Arrived {
                seq,
                sent: consumed.sent,
                received: consumed.received,
                step: step.seq,
                bound: false,
                safe: false,
            });
            known = seq + 1;
        }
    }
    for index in (1..arrivals.len()).rev() {
        if arrivals[index - 1].bound {
            arrivals[index - 1].received = arrivals[index - 1].received.min(arrivals[index].received);
        }
    }
    arrivals
}
