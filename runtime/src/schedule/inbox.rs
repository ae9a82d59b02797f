//! A gate with the payloads beside it.

use super::{Arrival, GateError, StepGate};
use crate::graph::Graph;
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
    values: Box<[f64]>,
    initial: Box<[f64]>,
}

impl Inbox {
    /// The inbox of the node at `index` of the graph.
    pub fn new(graph: &Graph, index: usize) -> Self {
        let gate = StepGate::new(graph, index);
        let plans = || graph.nodes()[index].inputs.iter().map(|&connection| &graph.connections()[connection]);
        let rings = plans().enumerate().map(|(input, plan)| Ring {
            leaves: plan.leaves,
            values: vec![0.0; plan.leaves * gate.capacity(input)].into_boxed_slice(),
            initial: graph.nodes()[plan.from].kind.initial_message().into(),
        });
        let windows = plans().map(|plan| InputWindow::new(plan.port.clone(), plan.leaves, plan.window));
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
        if let Some(slot) = arrival.slot {
            let ring = &mut self.rings[input];
            ring.values[slot * ring.leaves..(slot + 1) * ring.leaves].copy_from_slice(payload);
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
                window.push(stamp, &ring.values[slot * ring.leaves..(slot + 1) * ring.leaves]);
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
        self.gate.end(end)
    }
}
