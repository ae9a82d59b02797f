//! Delays that the sender's own output decides while the tables run.
//!
//! A step's start does not depend on how long steps take, as long as every step ends before the next of its node is due
//! and nobody waits for its message. Under these conditions ([`check`]) only one thing remains to be decided at run
//! time: which of the messages that could be there are there. Messages then cannot overtake each other either: the
//! node's steps end in their order, and the way takes all of them equally long.

use parallax_runtime::delay::{Delay, DelayOfOutput};
use parallax_runtime::graph::{Graph, JitterPolicy};
use parallax_runtime::time::{Nanos, from_seconds, to_seconds};

use super::candidates::Reach;
use super::{CompileError, CompileOptions, InputRows};
use crate::episode::Episode;

/// When messages were sent whose sender's computation delay follows from its output
/// ([`Delay::Output`](parallax_runtime::delay::Delay::Output)).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum OutputDelays {
    /// When the episode says: as recorded, or, where the episode was generated, as the graph expects.
    #[default]
    AsScheduled,
    /// When the output says that is computed at run time ([`OutputDelay`]), whatever the episode was drawn or recorded
    /// with. Every step has to end, under the longest delay, by the time when the next of its node is due; its
    /// receivers must not wait for its messages, have no jitter buffer, and be reached after a constant delay. Where the
    /// shortest delay is the longest, nothing is left to be decided, and the times are the episode's.
    AtRunTime,
}

/// Messages that arrive at `start + computation(output) + travel`, where `start` is that of the sender's step.
///
/// The step at `t` sees the `window` newest candidates that have arrived at `t` (with `skip`: before); initial messages
/// count as always there. In whole nanoseconds this is what the executor does, bit for bit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputDelay {
    /// How long the sender's step takes.
    pub computation: DelayOfOutput,
    /// How long the message travels, ns.
    pub travel: Nanos,
    /// Whether a message that arrives exactly at the start is left for the next step.
    pub skip: bool,
}

impl OutputDelay {
    pub(super) fn reach(&self) -> Reach {
        let (min, max) = self.computation.bounds();
        let arrival = |computation: Nanos| computation.saturating_add(self.travel);
        Reach { min: arrival(min), max: arrival(max), skip: self.skip, behind: 0, before: 0 }
    }

    /// When a message was sent, ns: the sender's step started at `start`, and its output's leaf is `leaf`.
    #[inline]
    pub fn sent(&self, start: Nanos, leaf: f64) -> Nanos {
        start.saturating_add(self.computation.nanos(leaf))
    }

    /// When a message arrives that was sent at `sent`, ns.
    #[inline]
    pub fn received(&self, sent: Nanos) -> Nanos {
        sent.saturating_add(self.travel)
    }

    /// Whether what arrived at `received` is there for a step at `start`.
    #[inline]
    pub fn is_there(&self, received: Nanos, start: Nanos) -> bool {
        if self.skip { received < start } else { received <= start }
    }

    /// The place of the newest candidate of a row that is there for a step at `start`, or that no step can miss: at least
    /// `window − 1`. `leaf` tells a candidate's leaf.
    #[inline]
    pub fn newest(&self, input: &InputRows, row: usize, start: Nanos, leaf: impl Fn(usize) -> f64) -> usize {
        let first = row * input.candidates;
        let mut newest = input.window - 1;
        // A whole window is there under the longest delay.
        while newest + 1 < input.candidates {
            let next = newest + 1;
            let arrives = || self.received(self.sent(input.sent[first + next], leaf(next)));
            if input.seq[first + next] >= 0 && !self.is_there(arrives(), start) {
                break;
            }
            newest = next;
        }
        newest
    }
}

/// The delay of a connection where its sender's output decides it, at run time.
pub(super) fn of_connection(
    graph: &Graph,
    options: &CompileOptions,
    connection: usize,
) -> Option<OutputDelay> {
    let plan = &graph.connections()[connection];
    if !is_open(graph, options, plan.from) {
        return None;
    }
    let Delay::Constant { .. } = plan.delay else { return None };
    let sender = &graph.nodes()[plan.from];
    let computation = sender.computation.of_output(&sender.kind.output().leaves)?;
    Some(OutputDelay { computation, travel: plan.delay.expected_nanos(), skip: plan.skip })
}

/// Whether a node's steps take a time that is decided at run time. One whose bounds are equal takes what the episode
/// says.
fn is_open(graph: &Graph, options: &CompileOptions, node: usize) -> bool {
    let delay = &graph.nodes()[node].computation;
    options.output_delays == OutputDelays::AtRunTime
        && matches!(delay, Delay::Output { min, max, .. } if from_seconds(*min) < from_seconds(*max))
}

/// Whether the starts in the episodes are those under any output.
pub(super) fn check(
    graph: &Graph,
    episodes: &[Episode],
    options: &CompileOptions,
) -> Result<(), CompileError> {
    for (index, node) in graph.nodes().iter().enumerate() {
        if !is_open(graph, options, index) {
            continue;
        }
        let wrong = |problem: String| Err(CompileError::OutputDelay { node: node.name.clone(), problem });
        if node.advance {
            return wrong("it has `advance`, so its next step starts when the one before ends".into());
        }
        for &connection in &node.outputs {
            let plan = &graph.connections()[connection];
            let name = graph.connection_name(connection);
            if plan.blocking {
                return wrong(format!(
                    "the receiver of `{name}` waits for its messages; make it non-blocking"
                ));
            }
            if plan.jitter == JitterPolicy::Buffer {
                return wrong(format!("`{name}` has a jitter buffer; use the policy `latest`"));
            }
            if !matches!(plan.delay, Delay::Constant { .. }) {
                return wrong(format!("the delay of `{name}` is not constant"));
            }
            if options.trainable.iter().any(|trainable| trainable.connection == connection) {
                return wrong(format!("the delay of `{name}` is trainable"));
            }
        }
        let (_, max) = node.computation.bounds();
        let period = graph.spec().nodes[index].rate.recip();
        // A grid of whole nanoseconds has periods of up to one more.
        if from_seconds(max) > from_seconds(period) + 1 {
            return wrong(format!(
                "a step may take {max} s, which is more than the node's period of {period} s"
            ));
        }
        for (number, episode) in episodes.iter().enumerate() {
            let steps = &episode.nodes[index];
            let late = steps.start.iter().zip(steps.due.iter().skip(1));
            let late = late.map(|(&start, &due)| start.saturating_add(from_seconds(max)) - due);
            if let Some((step, late)) = late.enumerate().find(|(_, late)| *late > 0) {
                let late = to_seconds(late);
                return wrong(format!(
                    "step {step} of episode {number} starts so late that it may end {late} s after the next one is due"
                ));
            }
        }
    }
    Ok(())
}
