//! A gate with the payloads beside it.

use super::{Arrival, GateError, Resumption, StepGate};
use crate::data::Data;
use crate::graph::{Graph, SafeOutput};
use crate::node::{Consumed, InputWindow, Step};
use crate::time::Nanos;

/// A node's gate, the payloads that have arrived for it, and the windows of its current step.
///
/// All memory is taken when it is made: its rings hold as many messages as the graph's plan says.
#[derive(Debug, Clone)]
pub struct Inbox {
    gate: StepGate,
    rings: Box<[Ring]>,
    windows: Box<[InputWindow]>,
}

#[derive(Debug, Clone)]
struct Ring {
    leaves: usize,
    /// Whether messages have data, which lie in the window at the same places.
    data: bool,
    values: Box<[f64]>,
    initial: Box<[f64]>,
    /// The newest message that arrived, and then the safe output of its sender over it.
    newest: Box<[f64]>,
    safe: Option<SafeOutput>,
    /// It waits for room.
    safe_pending: bool,
}

impl Inbox {
    /// The inbox of the node at `index` of the graph.
    pub fn new(graph: &Graph, index: usize) -> Self {
        Self::resumed(graph, index, &Resumption::default())
    }

    /// The inbox of a node that takes up its work again; see [`StepGate::resumed`].
    pub fn resumed(graph: &Graph, index: usize, from: &Resumption) -> Self {
        let gate = StepGate::resumed(graph, index, from);
        let plans = || graph.nodes()[index].inputs.iter().map(|&connection| &graph.connections()[connection]);
        let rings = plans().enumerate().map(|(input, plan)| Ring {
            leaves: plan.leaves,
            data: plan.data > 0,
            // Written to, and not only asked for: zeros would come page by page, each with a fault, in the middle of a step.
            values: vec![f64::NAN; plan.leaves * gate.capacity(input)].into_boxed_slice(),
            initial: graph.nodes()[plan.from].kind.initial_message().into(),
            newest: graph.nodes()[plan.from].kind.initial_message().into(),
            safe: graph.nodes()[plan.from].safe.clone(),
            safe_pending: false,
        });
        let windows = plans().enumerate().map(|(input, plan)| {
            let places = if plan.data > 0 { gate.capacity(input) } else { 0 };
            InputWindow::new(plan.port.clone(), plan.leaves, plan.window).with_places(places)
        });
        Self { rings: rings.collect(), windows: windows.collect(), gate }
    }

    /// The gate: what the next step waits for, and where messages are.
    #[inline]
    pub fn gate(&self) -> &StepGate {
        &self.gate
    }

    /// What the running step sees, or the last one saw: one window per input.
    #[inline]
    pub fn windows(&self) -> &[InputWindow] {
        &self.windows
    }

    /// A message arrived; see [`StepGate::arrive`].
    ///
    /// # Errors
    ///
    /// As [`StepGate::arrive`].
    ///
    /// # Panics
    ///
    /// When the node has no such input, or its messages have another number of leaves.
    #[inline]
    pub fn arrive(
        &mut self,
        input: usize,
        seq: u64,
        sent: Nanos,
        received: Nanos,
        payload: &[f64],
    ) -> Result<Arrival, GateError> {
        let arrival = self.gate.arrive(input, seq, sent, received)?;
        let ring = &mut self.rings[input];
        if ring.safe.is_some() {
            ring.safe_pending = false;
            ring.newest.copy_from_slice(payload);
        }
        if let Some(slot) = arrival.slot {
            ring.values[slot * ring.leaves..(slot + 1) * ring.leaves].copy_from_slice(payload);
        }
        Ok(arrival)
    }

    /// A message with data arrived; otherwise as [`arrive`](Self::arrive).
    ///
    /// # Errors
    ///
    /// As [`StepGate::arrive`].
    ///
    /// # Panics
    ///
    /// As [`arrive`](Self::arrive).
    pub fn arrive_with_data(
        &mut self,
        input: usize,
        seq: u64,
        sent: Nanos,
        received: Nanos,
        payload: &[f64],
        data: Data,
    ) -> Result<Arrival, GateError> {
        let arrival = self.arrive(input, seq, sent, received, payload)?;
        if let Some(slot) = arrival.slot {
            self.windows[input].keep(slot, data);
        }
        Ok(arrival)
    }

    /// The sender of an input is dead; see [`StepGate::sender_dead`].
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    pub fn sender_dead(&mut self, input: usize) {
        self.gate.sender_dead(input);
    }

    /// The sender of an input is gone, for now or for good. If it has a safe output, that is the newest message from `time`
    /// on, or from when there is room for it, unless a message comes before that.
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    pub fn substitute(&mut self, input: usize, time: Nanos) {
        let ring = &mut self.rings[input];
        let Some(safe) = &ring.safe else { return };
        // At time 0 it would pass for the initial message.
        let slot = self.gate.substitute(input, time.max(1));
        ring.safe_pending = slot.is_none();
        if let Some(slot) = slot {
            safe.write_over(&mut ring.newest);
            ring.values[slot * ring.leaves..(slot + 1) * ring.leaves].copy_from_slice(&ring.newest);
            self.windows[input].keep(slot, Data::default());
        }
    }

    /// Whether the sender of an input has a safe output.
    ///
    /// # Panics
    ///
    /// When the node has no such input.
    pub fn is_safe(&self, input: usize) -> bool {
        self.rings[input].safe.is_some()
    }

    /// Whether the sender of some input has a safe output.
    pub fn has_safe(&self) -> bool {
        self.rings.iter().any(|ring| ring.safe.is_some())
    }

    /// One more step after the last, at `now`, which no schedule asks for: where a sender has a safe output, the window
    /// holds nothing else; the other inputs are as the last step saw them.
    pub fn last(&mut self, now: Nanos) -> Step<'_> {
        for (ring, window) in self.rings.iter_mut().zip(&mut self.windows) {
            if let Some(safe) = &ring.safe {
                safe.write_over(&mut ring.newest);
                let places = window.capacity();
                window.clear(0);
                for _ in 0..places {
                    window.push(Consumed { seq: None, sent: now, received: now }, &ring.newest);
                }
            } else if window.stamps().is_empty() {
                for _ in 0..window.capacity() {
                    window.push(Consumed::INITIAL, &ring.initial);
                }
            }
        }
        Step::new(self.gate.seq(), self.gate.due(), now, &self.windows)
    }

    /// The next step starts; it is returned as the node is to see it.
    ///
    /// # Errors
    ///
    /// As [`StepGate::begin`].
    #[inline]
    pub fn begin(&mut self, start: Nanos) -> Result<Step<'_>, GateError> {
        let (seq, due) = (self.gate.seq(), self.gate.due());
        self.gate.begin(start)?;
        for (input, (ring, window)) in self.rings.iter().zip(&mut self.windows).enumerate() {
            window.clear(self.gate.superseded(input));
            for _ in 0..self.gate.initial(input) {
                window.push(Consumed::INITIAL, &ring.initial);
            }
            for (slot, stamp) in self.gate.visible(input) {
                window.show(stamp, &ring.values[slot * ring.leaves..(slot + 1) * ring.leaves], slot);
            }
            if ring.data {
                // What no window will show again is let go of.
                self.gate.free(input).for_each(|place| window.keep(place, Data::default()));
            }
        }
        Ok(Step::new(seq, due, start, &self.windows))
    }

    /// The running step ended; see [`StepGate::end`].
    ///
    /// # Errors
    ///
    /// As [`StepGate::end`].
    #[inline]
    pub fn end(&mut self, end: Nanos) -> Result<(), GateError> {
        self.gate.end(end)?;
        for input in 0..self.rings.len() {
            if self.rings[input].safe_pending {
                self.substitute(input, end);
            }
        }
        Ok(())
    }
}
