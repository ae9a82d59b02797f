//! The way from a node to the recorder: its steps with their messages, and its losses.

use super::desk::Errand;
use super::plan::{
    self, CHANGE, CHANGE_WORDS, CONSUMED, INITIAL, INPUT_HEAD, LOSS, LOSS_WORDS, REPLACED, RESET, STEP,
    STEP_HEAD,
};
use super::vitals::{Vital, Vitals};
use crate::channel::{ChannelError, Endpoint, Publisher, Topic};
use crate::recording::LossReason;
use crate::schedule::Inbox;
use crate::time::Nanos;

/// The way to the recorder.
pub(super) struct Records {
    pub(super) publisher: Publisher,
    pub(super) sent: u64,
}

/// What a step sent.
pub(super) struct Output<'a> {
    pub(super) leaves: &'a [f64],
    /// The words of its data, where its kind has some: the length, and as many as it takes.
    pub(super) data: &'a [u64],
    /// Whether it is the safe output, sent in place of what the step gave.
    pub(super) replaced: bool,
}

impl Records {
    /// The sending end of a node's records.
    pub(super) fn open(endpoint: &Endpoint, topic: &Topic) -> Result<Self, ChannelError> {
        Ok(Self { publisher: endpoint.open(topic)?.publisher()?, sent: 0 })
    }

    /// Sends that these messages of an input are lost.
    pub(super) fn loss(
        &mut self,
        input: usize,
        first: u64,
        count: u64,
        time: Nanos,
        reason: LossReason,
        vitals: &Vitals,
    ) -> Result<(), ChannelError> {
        let code = plan::reason_code(reason);
        let words = [LOSS, self.sent, input as u64, first, count, time as u64, code];
        self.send(LOSS_WORDS, vitals, |place| place.copy_from_slice(&words))
    }

    /// Sends what was set or reset before step `step`.
    pub(super) fn errand(
        &mut self,
        errand: &Errand,
        step: u64,
        time: Nanos,
        vitals: &Vitals,
    ) -> Result<(), ChannelError> {
        if errand.is_refused() {
            return Ok(());
        }
        let by = errand.by.word();
        let mut put = |parameter, old: f64, new: f64| {
            let words = [CHANGE, self.sent, step, parameter, old.to_bits(), time as u64, new.to_bits(), by];
            self.send(CHANGE_WORDS, vitals, |place| place.copy_from_slice(&words))
        };
        if errand.is_reset() {
            put(RESET, 0.0, 0.0)?;
        }
        errand.settings.iter().try_for_each(|setting| put(setting.parameter as u64, setting.old, setting.new))
    }

    /// Sends the record of a step: its number, when it was due, its start and its end.
    pub(super) fn step(
        &mut self,
        times: [u64; 4],
        inbox: &Inbox,
        output: &Output<'_>,
        vitals: &Vitals,
    ) -> Result<(), ChannelError> {
        let inputs = inbox.windows().iter().map(|window| INPUT_HEAD + CONSUMED * window.stamps().len());
        let length = STEP_HEAD + inputs.sum::<usize>() + output.leaves.len() + output.data.len();
        let number = self.sent;
        self.send(length, vitals, |words| put_step(words, number, times, inbox, output))
    }

    fn send(
        &mut self,
        length: usize,
        vitals: &Vitals,
        put: impl FnOnce(&mut [u64]),
    ) -> Result<(), ChannelError> {
        // A record that does not reach the recorder leaves a gap in this count, which the recorder reports.
        self.sent += 1;
        let mut record = self.publisher.loan(length)?;
        put(&mut record);
        record.send()?;
        vitals.set(Vital::Records, self.sent);
        Ok(())
    }
}

/// Writes the record of a step where the recorder reads it.
fn put_step(words: &mut [u64], number: u64, times: [u64; 4], inbox: &Inbox, output: &Output<'_>) {
    words[0] = if output.replaced { REPLACED } else { STEP };
    words[1] = number;
    words[2..STEP_HEAD].copy_from_slice(&times);
    let mut at = STEP_HEAD;
    for window in inbox.windows() {
        words[at] = window.superseded();
        words[at + 1] = window.stamps().len() as u64;
        at += INPUT_HEAD;
        for stamp in window.stamps() {
            let consumed = [stamp.seq.unwrap_or(INITIAL), stamp.sent as u64, stamp.received as u64];
            words[at..at + CONSUMED].copy_from_slice(&consumed);
            at += CONSUMED;
        }
    }
    for (word, value) in words[at..].iter_mut().zip(output.leaves) {
        *word = value.to_bits();
    }
    words[at + output.leaves.len()..].copy_from_slice(output.data);
}
