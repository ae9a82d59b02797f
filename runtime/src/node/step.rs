//! What a step sees: its inputs, each a window of messages with the times at which they travelled.

use std::marker::PhantomData;

use serde::{Deserialize, Serialize};

use super::{Message, Port};
use crate::time::Nanos;
use crate::window::InputWindow;

/// Which message a step saw, and when it travelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Consumed {
    /// The sender's step that made it; `None` for the initial message, which fills a window before enough have come, and
    /// for the [safe output](crate::graph::SafeOutput) of a sender that is gone.
    pub seq: Option<u64>,
    /// When the sender sent it; 0 for the initial message.
    pub sent: Nanos,
    /// When it arrived at the receiver; 0 for the initial message. A safe output has here and in `sent` the time from which
    /// on it stood in for messages.
    pub received: Nanos,
}

impl Consumed {
    /// The stamps of an initial message.
    pub const INITIAL: Self = Self { seq: None, sent: 0, received: 0 };

    /// Whether it is the safe output of a sender that is gone.
    pub fn is_safe_output(&self) -> bool {
        self.seq.is_none() && *self != Self::INITIAL
    }
}

/// A message in a step's window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Received<M> {
    /// The sender's step that made it; `None` for the initial message.
    pub seq: Option<u64>,
    /// When it was sent; 0 for the initial message.
    pub sent: Nanos,
    /// When it arrived; 0 for the initial message.
    pub received: Nanos,
    /// The payload.
    pub message: M,
}

/// One step, as a node sees it.
#[derive(Debug, Clone, Copy)]
pub struct Step<'a> {
    /// The step's number, from 0.
    pub seq: u64,
    /// When it was due: `phase + seq / rate`.
    pub due: Nanos,
    /// When it started.
    pub start: Nanos,
    inputs: &'a [InputWindow],
}

impl<'a> Step<'a> {
    /// A step with these inputs.
    pub fn new(seq: u64, due: Nanos, start: Nanos, inputs: &'a [InputWindow]) -> Self {
        Self { seq, due, start, inputs }
    }

    /// All inputs, in the order in which the kind of node declares them.
    pub fn inputs(&self) -> &'a [InputWindow] {
        self.inputs
    }

    /// The messages at `port`, oldest first: as many as the connection's window, the missing ones being initial.
    ///
    /// # Panics
    ///
    /// When the kind of node does not declare this port with this message: a mistake in the node itself.
    #[inline]
    pub fn window<M: Message>(&self, port: Port<M>) -> Window<'a, M> {
        let input = self.input(port);
        Window { next: 0, end: input.stamps().len(), input, message: PhantomData }
    }

    /// The input at `port`, with the data of its messages.
    ///
    /// # Panics
    ///
    /// When the kind of node does not declare this port: a mistake in the node itself.
    #[inline]
    pub fn input<M: Message>(&self, port: Port<M>) -> &'a InputWindow {
        let Some(input) = self.inputs.iter().find(|input| input.port() == port.name()) else {
            panic!(
                "the kind of node does not declare the port `{}`; add it with `NodeKind::input`",
                port.name()
            )
        };
        input
    }

    /// The [data](crate::data) of the newest message at `port`; empty where it has none.
    ///
    /// # Panics
    ///
    /// When the kind of node does not declare this port: a mistake in the node itself.
    pub fn latest_data<M: Message>(&self, port: Port<M>) -> &'a [u8] {
        let input = self.input(port);
        input.stamps().len().checked_sub(1).map_or(&[], |newest| input.data(newest))
    }

    /// The newest message at `port`.
    ///
    /// # Panics
    ///
    /// When the kind of node does not declare this port with this message: a mistake in the node itself.
    #[inline]
    pub fn latest<M: Message>(&self, port: Port<M>) -> Received<M> {
        match self.window(port).next_back() {
            Some(received) => received,
            // Executors never hand out an empty window; one made by hand reads as the initial message.
            None => Received { seq: None, sent: 0, received: 0, message: M::default() },
        }
    }
}

/// The messages of one input in one step, oldest first.
#[derive(Debug, Clone)]
pub struct Window<'a, M> {
    input: &'a InputWindow,
    next: usize,
    end: usize,
    message: PhantomData<fn() -> M>,
}

impl<M: Message> Window<'_, M> {
    #[inline]
    fn get(&self, index: usize) -> Received<M> {
        let Consumed { seq, sent, received } = self.input.stamps()[index];
        Received { seq, sent, received, message: M::read_from(self.input.payload(index)) }
    }
}

impl<M: Message> Iterator for Window<'_, M> {
    type Item = Received<M>;

    #[inline]
    fn next(&mut self) -> Option<Received<M>> {
        if self.next == self.end {
            return None;
        }
        self.next += 1;
        Some(self.get(self.next - 1))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (self.end - self.next, Some(self.end - self.next))
    }
}

impl<M: Message> DoubleEndedIterator for Window<'_, M> {
    #[inline]
    fn next_back(&mut self) -> Option<Received<M>> {
        if self.next == self.end {
            return None;
        }
        self.end -= 1;
        Some(self.get(self.end))
    }
}

impl<M: Message> ExactSizeIterator for Window<'_, M> {}
