//! The state machine of one node's steps.

use super::input::{Account, Arrival, InputGate};
use crate::graph::{Graph, OnDeadSender, Scheduling};
use crate::node::Consumed;
use crate::time::{Nanos, Ticks};

/// What a node's next step waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// Nothing but time: it may start at this time or later. Under an exact clock it starts at it, or now where that is
    /// later.
    Until(Nanos),
    /// A message of a blocking input.
    Message {
        /// The input.
        input: usize,
        /// The last message it waits for; all before it come first.
        seq: u64,
    },
    /// Nothing any more: a message that it waits for will never come, and the node was told to stop then.
    Stop {
        /// The input whose sender is dead.
        input: usize,
    },
    /// The end of the step that runs now.
    End,
}

/// A gate was told something that cannot be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum GateError {
    /// A message came after a later one of the same connection.
    #[error(
        "message {seq} arrived after message {after} of the same connection; messages must not overtake each other"
    )]
    Overtaken {
        /// The message.
        seq: u64,
        /// The later one that came first.
        after: u64,
    },
    /// Time ran backwards.
    #[error("time runs backwards: {time} ns comes after {after} ns")]
    Backwards {
        /// The earlier time.
        time: Nanos,
        /// The later one that was told first.
        after: Nanos,
    },
    /// A step was begun before its time.
    #[error("step {seq} begins at {start} ns, but may not before {earliest} ns")]
    Early {
        /// The step.
        seq: u64,
        /// When it was begun.
        start: Nanos,
        /// When it may begin.
        earliest: Nanos,
    },
    /// A step was begun that has to wait for something other than time.
    #[error("step {seq} begins, but it has to wait: {wait:?}")]
    NotReady {
        /// The step.
        seq: u64,
        /// For what.
        wait: Wait,
    },
    /// A step was ended that had not begun.
    #[error("step {seq} ends, but it never began")]
    NotRunning {
        /// The step.
        seq: u64,
    },
}

/// Where a node takes up its work again.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Resumption {
    /// Its first step.
    pub step: u64,
    /// By how much its ticks are shifted.
    pub shift: Nanos,
    /// For each input, the first message that has not been accounted for; 0 where nothing is said.
    pub known: Vec<u64>,
}

/// Decides when a node's steps run and what they consume; see the [module](super) for the rules.
#[derive(Debug, Clone)]
pub struct StepGate {
    inputs: Box<[InputGate]>,
    scheduling: Scheduling,
    advance: bool,
    on_dead_sender: OnDeadSender,
    /// On the step that comes next, or runs now.
    tick: Ticks,
    shift: Nanos,
    running: Option<Nanos>,
    previous_end: Nanos,
}

impl StepGate {
    /// The gate of the node at `index` before its first step.
    pub fn new(graph: &Graph, index: usize) -> Self {
        Self::resumed(graph, index, &Resumption::default())
    }

    /// The gate of the node at `index` that takes up its work again, after an earlier one of the same node ended.
    ///
    /// What belongs to earlier steps is not waited for, and what arrived for them is not seen.
    pub fn resumed(graph: &Graph, index: usize, from: &Resumption) -> Self {
        let node = &graph.nodes()[index];
        let tick = node.grid.ticks_from(from.step);
        let inputs = node.inputs.iter().enumerate().map(|(input, &connection)| {
            let plan = &graph.connections()[connection];
            let sender = &graph.nodes()[plan.from].grid;
            let known = from.known.get(input).copied().unwrap_or(0);
            let mut gate = InputGate::new(plan, sender, known);
            if from.step > 0 {
                gate.resume(sender, tick.time());
            }
            gate
        });
        let mut gate = Self {
            inputs: inputs.collect(),
            scheduling: node.scheduling,
            advance: node.advance,
            on_dead_sender: node.on_dead_sender,
            tick,
            shift: from.shift,
            running: None,
            previous_end: 0,
        };
        gate.expect();
        gate
    }

    /// The number of the step that comes next, or runs now.
    #[inline]
    pub fn seq(&self) -> u64 {
        self.tick.tick()
    }

    /// When that step is due, without shift.
    #[inline]
    pub fn due(&self) -> Nanos {
        self.tick.time()
    }

    /// By how much earlier overruns have shifted the ticks.
    pub fn shift(&self) -> Nanos {
        self.shift
    }

    /// What the next step waits for.
    #[inline]
    pub fn ready(&self) -> Wait {
        if self.running.is_some() {
            return Wait::End;
        }
        let held_by_inputs = self.advance && !self.inputs.iter().any(InputGate::is_dead);
        let mut start = self.previous_end;
        if !held_by_inputs {
            start = start.max(self.due().saturating_add(self.shift));
        }
        for (index, input) in self.inputs.iter().enumerate() {
            if let Some(seq) = input.awaited() {
                match self.on_dead_sender {
                    _ if !input.is_dead() => return Wait::Message { input: index, seq },
                    OnDeadSender::Stop => return Wait::Stop { input: index },
                    OnDeadSender::Continue => {}
                }
            }
            if let Some(usable) = input.usable_from() {
                start = start.max(usable);
            }
        }
        Wait::Until(start)
    }

    /// A message arrived at an input. Arrivals of one input come in order of `seq` and of `received`; a number that is
    /// left out is a message lost on the way.
    ///
    /// # Errors
    ///
    /// [`GateError::Overtaken`], [`GateError::Backwards`].
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    #[inline]
    pub fn arrive(
        &mut self,
        input: usize,
        seq: u64,
        sent: Nanos,
        received: Nanos,
    ) -> Result<Arrival, GateError> {
        self.inputs[input].arrive(seq, sent, received)
    }

    /// The sender of an input is dead: no message that has not arrived will come. One that arrives all the same shows that
    /// the sender is back.
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    pub fn sender_dead(&mut self, input: usize) {
        self.inputs[input].die();
    }

    /// The sender of an input is gone, for now or for good: a step that starts at `time` or later sees its safe output as
    /// the newest message. The result is the place where the payload belongs; `None` when there is no room before the next
    /// step.
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    pub fn substitute(&mut self, input: usize, time: Nanos) -> Option<usize> {
        self.inputs[input].substitute(time)
    }

    /// The number of the message that comes next at an input: all before it have arrived or are lost.
    #[inline]
    pub fn known(&self, input: usize) -> u64 {
        self.inputs[input].known()
    }

    /// How many of the messages for which the next step waits at this input are missing; below 0 when messages for later
    /// steps are there, too. `None` where it waits for none.
    #[inline]
    pub fn missing(&self, input: usize) -> Option<i64> {
        self.inputs[input].missing()
    }

    /// The next step starts. What it sees is then in [`visible`](Self::visible).
    ///
    /// # Errors
    ///
    /// [`GateError::NotReady`] and [`GateError::Early`] when it may not start yet; nothing has changed then.
    #[inline]
    pub fn begin(&mut self, start: Nanos) -> Result<(), GateError> {
        match self.ready() {
            Wait::Until(earliest) if start >= earliest => {}
            Wait::Until(earliest) => return Err(GateError::Early { seq: self.seq(), start, earliest }),
            wait => return Err(GateError::NotReady { seq: self.seq(), wait }),
        }
        self.running = Some(start);
        for input in &mut self.inputs {
            input.begin(start);
        }
        Ok(())
    }

    /// The running step ended, and its message was sent.
    ///
    /// # Errors
    ///
    /// [`GateError::NotRunning`], and [`GateError::Backwards`] when it ends before it began.
    #[inline]
    pub fn end(&mut self, end: Nanos) -> Result<(), GateError> {
        let start = self.running.ok_or(GateError::NotRunning { seq: self.seq() })?;
        if end < start {
            return Err(GateError::Backwards { time: end, after: start });
        }
        self.running = None;
        self.previous_end = end;
        self.tick.advance();
        if self.scheduling == Scheduling::Frequency {
            self.shift = self.shift.max(end.saturating_sub(self.due()));
        }
        self.expect();
        Ok(())
    }

    fn expect(&mut self) {
        let due = self.due();
        for input in &mut self.inputs {
            input.expect_until(due);
        }
    }

    /// How many inputs the node has.
    pub fn inputs(&self) -> usize {
        self.inputs.len()
    }

    /// The window of the running step: how many places only the initial message can fill.
    #[inline]
    pub fn initial(&self, input: usize) -> usize {
        self.inputs[input].initial()
    }

    /// The window of the running step: the messages after the initial ones, oldest first, each with the place of its
    /// payload. To be read before the next arrival.
    #[inline]
    pub fn visible(&self, input: usize) -> impl Iterator<Item = (usize, Consumed)> + '_ {
        self.inputs[input].visible()
    }

    /// The places of an input that hold no payload now.
    pub fn free(&self, input: usize) -> impl Iterator<Item = usize> + '_ {
        self.inputs[input].free()
    }

    /// How many messages left the input unseen between the last step and the running one.
    #[inline]
    pub fn superseded(&self, input: usize) -> u64 {
        self.inputs[input].superseded()
    }

    /// Where the input's messages are.
    pub fn account(&self, input: usize) -> Account {
        self.inputs[input].account()
    }

    /// How many payloads the input needs room for; places are below this number.
    pub fn capacity(&self, input: usize) -> usize {
        self.inputs[input].capacity()
    }
}
