//! One input of a gate: which messages are there, and which of them a step sees.

use std::ops::Range;

use super::GateError;
use crate::graph::{ConnectionPlan, JitterPolicy};
use crate::node::Consumed;
use crate::time::{Grid, Nanos, Ticks};

/// What became of a message that arrived.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Arrival {
    /// The place where the payload belongs; `None` when there was no room for the message and it is lost
    /// ([`LossReason::Overflow`](crate::recording::LossReason)).
    pub slot: Option<usize>,
    /// The messages before it that never came ([`LossReason::Transport`](crate::recording::LossReason)).
    pub missing: Range<u64>,
}

/// Where the messages of one connection are.
///
/// Every message that was sent is in exactly one place:
/// `sent = consumed + superseded + in flight + lost_transport + lost_overflow`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Account {
    /// Messages that reached the receiver, whatever became of them then.
    pub arrived: u64,
    /// Messages that at least one step saw.
    pub consumed: u64,
    /// Messages that newer ones pushed out before any step saw them.
    pub superseded: u64,
    /// Messages that have arrived and that a step may still see.
    pub waiting: u64,
    /// Messages that never arrived although later ones did.
    pub lost_transport: u64,
    /// Messages for which the receiver had no room.
    pub lost_overflow: u64,
}

impl Account {
    /// How many of `sent` messages are still in flight: under way, or arrived and not yet seen.
    pub fn in_flight(&self, sent: u64) -> u64 {
        sent.saturating_sub(self.arrived + self.lost_transport) + self.waiting
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Entry {
    seq: u64,
    sent: Nanos,
    received: Nanos,
    /// From when on a step may use it; never decreases from one entry to the next.
    usable: Nanos,
    /// It is no message that was sent, but the safe output of a sender that is gone.
    safe: bool,
}

/// One input. Its entries form a ring: first the window of the last step, then what came since.
#[derive(Debug, Clone)]
pub(super) struct InputGate {
    blocking: bool,
    skip: bool,
    window: usize,
    entries: Box<[Entry]>,
    head: usize,
    len: usize,
    /// How many entries, from the oldest, the last step saw.
    seen: usize,
    /// What left unseen since the last step, and in the interval before it.
    leaving: u64,
    superseded: u64,
    /// Every message below this number has arrived or is lost.
    known: u64,
    /// Ideal send times; the tick of the cursor is the number of messages that the next step waits for.
    ideal: Ticks,
    /// Expected arrivals, for `JitterPolicy::Buffer`; the cursor follows the last arrival.
    expected: Option<Ticks>,
    dead: bool,
    /// Safe outputs among the entries that no step has seen.
    safes: usize,
    last_received: Nanos,
    last_usable: Nanos,
    account: Account,
}

impl InputGate {
    /// The input before the first step, when every message below `known` has been accounted for already.
    pub(super) fn new(plan: &ConnectionPlan, sender: &Grid, known: u64) -> Self {
        let buffer = plan.jitter == JitterPolicy::Buffer;
        let arrivals = sender.with_phase(sender.phase().saturating_add(plan.expected));
        Self {
            blocking: plan.blocking,
            skip: plan.skip,
            window: plan.window,
            entries: vec![Entry::default(); plan.capacity.max(plan.window + 1)].into_boxed_slice(),
            head: 0,
            len: 0,
            seen: 0,
            leaving: 0,
            superseded: 0,
            known,
            ideal: sender.ticks(),
            expected: buffer.then(|| arrivals.ticks_from(known)),
            dead: false,
            safes: 0,
            last_received: Nanos::MIN,
            last_usable: Nanos::MIN,
            account: Account::default(),
        }
    }

    pub(super) fn capacity(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn is_dead(&self) -> bool {
        self.dead
    }

    pub(super) fn die(&mut self) {
        self.dead = true;
    }

    pub(super) fn account(&self) -> Account {
        Account { waiting: (self.len - self.seen - self.safes) as u64, ..self.account }
    }

    /// How many of these entries, which no step has seen, are safe outputs.
    #[inline]
    fn safes_among(&self, entries: Range<usize>) -> usize {
        if self.safes == 0 { 0 } else { entries.filter(|&index| self.entry(index).safe).count() }
    }

    /// The number of the message that comes next.
    #[inline]
    pub(super) fn known(&self) -> u64 {
        self.known
    }

    /// The node's first step, due at `due`, is not step 0: what belongs to earlier ones is not waited for. Only before the
    /// first step.
    pub(super) fn resume(&mut self, sender: &Grid, due: Nanos) {
        self.ideal = sender.ticks_from(sender.count_until(due));
        if self.skip && self.ideal.tick() > 0 && sender.time(self.ideal.tick() - 1) == due {
            self.ideal = sender.ticks_from(self.ideal.tick() - 1);
        }
    }

    /// The sender is gone: a step that starts from now on sees its safe output as the newest message. The result is the
    /// place where the payload belongs; `None` when there is no room before the next step.
    pub(super) fn substitute(&mut self, time: Nanos) -> Option<usize> {
        let time = time.max(self.last_usable);
        if self.len == self.entries.len() {
            let newer = self.entry(self.window);
            if !self.belongs(&newer, time) {
                return None;
            }
            self.drop_oldest(1);
        }
        self.last_usable = time;
        let slot = self.slot(self.len);
        // It belongs to whichever step comes next, and has no number of its own.
        let seq = self.known.saturating_sub(1);
        self.entries[slot] = Entry { seq, sent: time, received: time, usable: time, safe: true };
        self.len += 1;
        self.safes += 1;
        Some(slot)
    }

    /// The message that the next step waits for, if it is not there yet.
    #[inline]
    pub(super) fn awaited(&self) -> Option<u64> {
        (self.blocking && self.known < self.ideal.tick()).then(|| self.ideal.tick() - 1)
    }

    /// How many of the messages for which the next step waits are missing; below 0 when later ones are there, too.
    #[inline]
    pub(super) fn missing(&self) -> Option<i64> {
        self.blocking.then(|| self.ideal.tick() as i64 - self.known as i64)
    }

    /// The next step is due at `due`: counts the messages that belong to it.
    #[inline]
    pub(super) fn expect_until(&mut self, due: Nanos) {
        if self.blocking {
            while self.ideal.time() < due || (self.ideal.time() == due && !self.skip) {
                self.ideal.advance();
            }
        }
    }

    /// From when on everything that the next step waits for may be used.
    #[inline]
    pub(super) fn usable_from(&self) -> Option<Nanos> {
        if !self.blocking {
            return None;
        }
        let belonging = (self.seen..self.len).map(|index| self.entry(index));
        belonging.take_while(|entry| entry.seq < self.ideal.tick()).last().map(|entry| entry.usable)
    }

    pub(super) fn arrive(&mut self, seq: u64, sent: Nanos, received: Nanos) -> Result<Arrival, GateError> {
        if seq < self.known {
            return Err(GateError::Overtaken { seq, after: self.known - 1 });
        }
        if received < self.last_received {
            return Err(GateError::Backwards { time: received, after: self.last_received });
        }
        let missing = self.known..seq;
        self.known = seq + 1;
        // Who sends is not dead, or not any more.
        self.dead = false;
        self.account.lost_transport += missing.end - missing.start;
        self.account.arrived += 1;
        self.last_received = received;
        if let Some(expected) = &mut self.expected {
            while expected.tick() < seq {
                expected.advance();
            }
            self.last_usable = self.last_usable.max(expected.time());
        }
        self.last_usable = self.last_usable.max(received);

        if self.len == self.entries.len() {
            // Room is made only if the next step's window cannot reach back to the oldest entry, however soon it starts.
            let newer = self.entry(self.window);
            if !self.belongs(&newer, received) {
                self.account.lost_overflow += 1;
                return Ok(Arrival { slot: None, missing });
            }
            self.drop_oldest(1);
        }
        let slot = self.slot(self.len);
        self.entries[slot] = Entry { seq, sent, received, usable: self.last_usable, safe: false };
        self.len += 1;
        Ok(Arrival { slot: Some(slot), missing })
    }

    /// A step starts: what may be seen is seen, what is pushed out is counted.
    #[inline]
    pub(super) fn begin(&mut self, start: Nanos) {
        let mut visible = self.seen;
        while visible < self.len && self.belongs(&self.entry(visible), start) {
            visible += 1;
        }
        let oldest = visible.saturating_sub(self.window);
        self.drop_oldest(oldest);
        let seen = visible - oldest;
        let safes = self.safes_among(self.seen..seen);
        self.safes -= safes;
        self.account.consumed += (seen - self.seen - safes) as u64;
        self.seen = seen;
        self.superseded = self.leaving;
        self.leaving = 0;
    }

    /// How many messages left unseen in the interval before the current step.
    pub(super) fn superseded(&self) -> u64 {
        self.superseded
    }

    /// The places in the window that only the initial message can fill.
    #[inline]
    pub(super) fn initial(&self) -> usize {
        self.window - self.seen
    }

    /// The messages of the current step with their places, oldest first. Valid until the next arrival.
    #[inline]
    pub(super) fn visible(&self) -> impl Iterator<Item = (usize, Consumed)> + '_ {
        (0..self.seen).map(|index| {
            let Entry { seq, sent, received, safe, .. } = self.entry(index);
            (self.slot(index), Consumed { seq: (!safe).then_some(seq), sent, received })
        })
    }

    /// The places that hold nothing now.
    pub(super) fn free(&self) -> impl Iterator<Item = usize> + '_ {
        (self.len..self.entries.len()).map(|index| self.slot(index))
    }

    #[inline]
    fn belongs(&self, entry: &Entry, start: Nanos) -> bool {
        if self.blocking {
            entry.seq < self.ideal.tick()
        } else if self.skip {
            entry.usable < start
        } else {
            entry.usable <= start
        }
    }

    #[inline]
    fn drop_oldest(&mut self, count: usize) {
        let safes = self.safes_among(self.seen..count);
        self.safes -= safes;
        let unseen = count.saturating_sub(self.seen) - safes;
        self.leaving += unseen as u64;
        self.account.superseded += unseen as u64;
        self.seen = self.seen.saturating_sub(count);
        self.head = self.slot(count);
        self.len -= count;
    }

    #[inline]
    fn entry(&self, index: usize) -> Entry {
        self.entries[self.slot(index)]
    }

    #[inline]
    fn slot(&self, index: usize) -> usize {
        let slot = self.head + index;
        if slot < self.entries.len() { slot } else { slot - self.entries.len() }
    }
}
