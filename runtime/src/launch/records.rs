//! The way from a node to the recorder: its steps with their messages, and its losses.

use super::desk::Errand;
use super::plan::{
    self, CHANGE, CHANGE_WORDS, CONSUMED, INITIAL, INPUT_HEAD, LOSS, LOSS_WORDS, RESET, STEP, STEP_HEAD,
};
use super::vitals::{Vital, Vitals};
use crate::channel::{ChannelError, Endpoint, Publisher, Topic};
use crate::recording::LossReason;
use crate::schedule::Inbox;
use crate::time::Nanos;

/// The way to the recorder.
pub(super) struct Records {
    pub(super) publisher: Publisher,
    words: Box<[u64]>,
    pub(super) sent: u64,
}

impl Records {
    /// The sending end of a node's records.
    pub(super) fn open(endpoint: &Endpoint, topic: &Topic) -> Result<Self, ChannelError> {
        let publisher = endpoint.open(topic)?.publisher()?;
        let words = vec![0; publisher.topic().words].into();
        Ok(Self { publisher, words, sent: 0 })
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
        self.words[..LOSS_WORDS].copy_from_slice(&[
            LOSS,
            self.sent,
            input as u64,
            first,
            count,
            time as u64,
            code,
        ]);
        self.send(LOSS_WORDS, vitals)
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
            self.words[..CHANGE_WORDS].copy_from_slice(&words);
            self.send(CHANGE_WORDS, vitals)
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
        values: &[f64],
        vitals: &Vitals,
    ) -> Result<(), ChannelError> {
        let length = self.put_step(times, inbox, values);
        self.send(length, vitals)
    }

    /// Puts the record of a step together; gives its length in words.
    fn put_step(&mut self, times: [u64; 4], inbox: &Inbox, values: &[f64]) -> usize {
        self.words[0] = STEP;
        self.words[1] = self.sent;
        self.words[2..STEP_HEAD].copy_from_slice(&times);
        let mut at = STEP_HEAD;
        for window in inbox.windows() {
            self.words[at] = window.superseded();
            self.words[at + 1] = window.stamps().len() as u64;
            at += INPUT_HEAD;
            for stamp in window.stamps() {
                let words = [stamp.seq.unwrap_or(INITIAL), stamp.sent as u64, stamp.received as u64];
                self.words[at..at + CONSUMED].copy_from_slice(&words);
                at += CONSUMED;
            }
        }
        for (word, value) in self.words[at..].iter_mut().zip(values) {
            *word = value.to_bits();
        }
        at + values.len()
    }

    fn send(&mut self, length: usize, vitals: &Vitals) -> Result<(), ChannelError> {
        // A record that does not reach the recorder leaves a gap in this count, which the recorder reports.
        self.sent += 1;
        self.publisher.send(length, |word| self.words[word])?;
        vitals.set(Vital::Records, self.sent);
        Ok(())
    }
}
