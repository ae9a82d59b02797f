//! What happens next under the simulated clock.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use parallax_runtime::time::Nanos;

/// What happens. At equal times steps end first, then messages arrive, then deaths are noticed, then steps start: a step
/// sees everything that has arrived by its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Class {
    /// A node's step ends.
    End,
    /// A connection delivers its oldest message.
    Arrival,
    /// A connection's receiver notices that the sender is dead.
    Death,
    /// A node's step may start.
    Start,
}

/// One event. The order of the fields is the order of events: equal times by class, then by node (senders before
/// receivers), then by sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Event {
    pub(crate) time: Nanos,
    pub(crate) class: Class,
    /// The rank of the node that steps, or of the sender.
    pub(crate) rank: u32,
    pub(crate) seq: u64,
    /// The node that steps, or the connection.
    pub(crate) target: u32,
}

/// The events to come, the next one first.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    events: BinaryHeap<Reverse<Event>>,
}

impl Queue {
    #[inline]
    pub(crate) fn push(&mut self, event: Event) {
        self.events.push(Reverse(event));
    }

    #[inline]
    pub(crate) fn pop(&mut self) -> Option<Event> {
        self.events.pop().map(|Reverse(event)| event)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_times_are_ordered_by_class_node_and_number() {
        let event = |time, class, rank, seq| Event { time, class, rank, seq, target: 0 };
        let expected = [
            event(1, Class::Start, 0, 0),
            event(2, Class::End, 1, 5),
            event(2, Class::Arrival, 0, 7),
            event(2, Class::Arrival, 1, 6),
            event(2, Class::Arrival, 1, 7),
            event(2, Class::Death, 0, 0),
            event(2, Class::Start, 0, 9),
        ];
        let mut queue = Queue::default();
        for event in expected.iter().rev() {
            queue.push(*event);
        }
        let order: Vec<Event> = std::iter::from_fn(|| queue.pop()).collect();
        assert_eq!(order, expected);
    }
}
