//! What comes in at a node's inputs: messages, and the news that a sender is gone.

use std::ops::Range;

use super::{StepError, Stepper};
use crate::channel::{ChannelError, Subscriber};
use crate::clock::WallClock;
use crate::data::Data;
use crate::graph::OnDeadSender;
use crate::launch::link::{ClockPage, next_that_crosses};
use crate::launch::orders::Orders;
use crate::launch::plan::{DATA_HEAD, MESSAGE_HEAD, data_words};
use crate::launch::vitals::{InputVital, Vitals};
use crate::recording::LossReason;
use crate::time::{Grid, Nanos, SECOND};

pub(super) struct Input {
    pub(super) sender: usize,
    pub(super) sender_name: String,
    pub(super) sender_grid: Grid,
    pub(super) sender_vitals: Vitals,
    /// How the clock of the sender's machine stands to this one's, where it is another.
    pub(super) clock: Option<ClockPage>,
    /// Of so many of its messages one comes: the others stay on the sender's machine.
    pub(super) every: u64,
    pub(super) subscriber: Subscriber,
    /// The leaves of the last message.
    pub(super) values: Box<[f64]>,
    /// The most bytes of data that a message has, and the data of the last one.
    pub(super) capacity: usize,
    pub(super) data: Data,
    /// What an earlier process of this node made of the messages.
    pub(super) consumed_before: u64,
    pub(super) superseded_before: u64,
    /// Nothing has arrived since an earlier process of this node ended.
    pub(super) resumed: bool,
    /// Messages below this number have their delay counted.
    pub(super) counted: u64,
    /// Whether nothing was left waiting when it was last looked at.
    pub(super) empty: bool,
    /// Whether something has arrived that is not [shown](Stepper::show) yet.
    pub(super) news: bool,
}

impl Input {
    /// Takes the next message apart, if there is one: gives when it was there, its head, and whether it is as long as it has to
    /// be.
    fn next(&mut self, clock: WallClock) -> Result<Option<(Nanos, [u64; MESSAGE_HEAD], bool)>, ChannelError> {
        let (mut head, mut fits) = ([0; MESSAGE_HEAD], false);
        let leaves = MESSAGE_HEAD + self.values.len();
        let expected = leaves + data_words(self.capacity);
        let values = &mut self.values;
        let mut read = |words: &[u64]| {
            fits = words.len() == expected;
            if fits {
                head.copy_from_slice(&words[..MESSAGE_HEAD]);
                for (value, word) in values.iter_mut().zip(&words[MESSAGE_HEAD..leaves]) {
                    *value = f64::from_bits(*word);
                }
            }
        };
        if self.capacity == 0 {
            let received = self.subscriber.receive_at(|| clock.now(), read)?;
            return Ok(received.map(|received| (received, head, fits)));
        }
        let Some(view) = self.subscriber.take()? else { return Ok(None) };
        let received = clock.now();
        read(&view);
        // A sender that says it wrote more than there is room for is not believed.
        let length = usize::try_from(view.get(leaves).copied().unwrap_or(u64::MAX)).unwrap_or(usize::MAX);
        self.data = match length {
            // Its place can be given back at once.
            0 => Data::default(),
            _ if fits && length <= self.capacity => {
                Data::in_place(view, leaves + DATA_HEAD, length).unwrap_or_default()
            }
            _ => {
                fits = false;
                Data::default()
            }
        };
        Ok(Some((received, head, fits)))
    }
}

/// What a look at the inputs gave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Taken {
    Nothing,
    Something,
    /// One or more messages, the last one at this time: the one that a step waited for.
    At(Nanos),
}

impl Stepper {
    /// Takes in which senders are gone: their safe outputs stand in for their messages.
    pub(super) fn learn(&mut self, orders: &Orders, now: Nanos) {
        for first in 0..self.inputs.len() {
            let sender = self.inputs[first].sender;
            if self.inputs[..first].iter().any(|input| input.sender == sender) {
                continue;
            }
            let Some(absence) = orders.absence(sender) else { continue };
            for index in (first..self.inputs.len()).filter(|index| self.inputs[*index].sender == sender) {
                // What it has sent since then shows that it is there.
                if self.inbox.gate().known(index) > absence.next {
                    continue;
                }
                // While it may come back, only those wait for it who would stop without it.
                if absence.for_good || self.on_dead_sender == OnDeadSender::Continue {
                    self.inbox.sender_dead(index);
                }
                if self.inbox.is_safe(index) {
                    self.inbox.substitute(index, now);
                    self.vitals.add_safe(index);
                }
            }
        }
    }

    /// Takes what has arrived, each message stamped with the time it was taken. What comes after the message that a step
    /// waited for is taken after that step, unless `all` is asked for.
    pub(super) fn receive(&mut self, clock: WallClock, end: Nanos, all: bool) -> Result<Taken, StepError> {
        let mut taken = Taken::Nothing;
        for index in 0..self.inputs.len() {
            let before = self.inputs[index].empty;
            loop {
                let next = self.inputs[index].next(clock)?;
                self.inputs[index].empty = next.is_none();
                let Some((received, head, fits)) = next else { break };
                // What arrives after the end belongs to no step.
                if received >= end {
                    taken = Taken::Something;
                    continue;
                }
                self.inputs[index].news = true;
                let [seq, sent] = head;
                let sent = match &self.inputs[index].clock {
                    None => sent,
                    Some(clock) => clock.here(sent as Nanos, received) as u64,
                };
                if !fits || !self.plausible(index, seq, received) {
                    // Garbage of one node must not end another.
                    let first = seq.min(u64::MAX - 1);
                    self.lose(index, first..first + 1, received, LossReason::Malformed)?;
                    taken = Taken::Something;
                    continue;
                }
                let Input { values, capacity, data, .. } = &mut self.inputs[index];
                let arrival = match *capacity {
                    0 => self.inbox.arrive(index, seq, sent as Nanos, received, values)?,
                    _ => {
                        let data = std::mem::take(data);
                        self.inbox.arrive_with_data(index, seq, sent as Nanos, received, values, data)?
                    }
                };
                self.miss(index, arrival.missing, received)?;
                self.inputs[index].resumed = false;
                if arrival.slot.is_none() {
                    self.lose(index, seq..seq + 1, received, LossReason::Overflow)?;
                }
                // A step that begins at the very time of an arrival is taken to have seen it.
                let awaited = self.inbox.gate().missing(index);
                taken = if awaited == Some(0) { Taken::At(received) } else { Taken::Something };
                if before && !all && awaited.is_some_and(|missing| missing <= 0) {
                    break;
                }
            }
        }
        Ok(taken)
    }

    /// Whether a sender can have sent a message of this number by now: it is new, and no sender runs that much ahead.
    fn plausible(&self, input: usize, seq: u64, received: Nanos) -> bool {
        let known = self.inbox.gate().known(input);
        seq == known
            || (seq > known && {
                let due = self.inputs[input].sender_grid.count_until(received.saturating_add(SECOND));
                seq <= due.saturating_mul(2).max(known + 1)
            })
    }

    /// Accounts for messages that did not come although a later one did.
    fn miss(&mut self, input: usize, missing: Range<u64>, time: Nanos) -> Result<(), ChannelError> {
        let reason = match self.inputs[input].resumed {
            true => LossReason::ReceiverDown,
            false => LossReason::Transport,
        };
        let Range { mut start, end } = missing;
        while start < end {
            let gap = self.inputs[input].sender_vitals.skipped(start..end).unwrap_or(end..end);
            self.miss_sent(input, start..gap.start, time, reason)?;
            self.lose(input, gap.clone(), time, LossReason::NotSent)?;
            start = gap.end;
        }
        Ok(())
    }

    /// Accounts for such messages that were sent: those that do not cross were held back.
    fn miss_sent(
        &mut self,
        input: usize,
        missing: Range<u64>,
        time: Nanos,
        reason: LossReason,
    ) -> Result<(), ChannelError> {
        let every = self.inputs[input].every;
        if every == 1 {
            return self.lose(input, missing, time, reason);
        }
        let Range { mut start, end } = missing;
        while start < end {
            let crosses = next_that_crosses(start, every).min(end);
            self.lose(input, start..crosses, time, LossReason::HeldBack)?;
            start = crosses.saturating_add(1).min(end);
            self.lose(input, crosses..start, time, reason)?;
        }
        Ok(())
    }

    pub(super) fn lose(
        &mut self,
        input: usize,
        seqs: Range<u64>,
        time: Nanos,
        reason: LossReason,
    ) -> Result<(), ChannelError> {
        let count = seqs.end.saturating_sub(seqs.start);
        if count == 0 {
            return Ok(());
        }
        self.vitals.add_lost(input, reason, count);
        match &mut self.records {
            Some(records) => records.loss(input, seqs.start, count, time, reason, &self.vitals),
            None => Ok(()),
        }
    }

    /// Shows where the messages are that have arrived since that was last shown. The step that they lead to shows it, too, when
    /// its own message is under way: nothing of this comes between a message and the step that waits for it.
    pub(super) fn show_news(&mut self) {
        for input in 0..self.inputs.len() {
            if std::mem::take(&mut self.inputs[input].news) {
                self.show(input);
            }
        }
    }

    /// Shows where the messages of an input are.
    pub(super) fn show(&self, input: usize) {
        let (account, state) = (self.inbox.gate().account(input), &self.inputs[input]);
        self.vitals.set_input(input, InputVital::Known, self.inbox.gate().known(input));
        self.vitals.set_input(input, InputVital::Consumed, state.consumed_before + account.consumed);
        self.vitals.set_input(input, InputVital::Superseded, state.superseded_before + account.superseded);
        self.vitals.set_input(input, InputVital::Waiting, account.waiting);
    }
}
