//! What a step gives: where its data go, and whether its output may be sent.

use super::StepError;
use crate::channel::{ChannelError, Loan, Publisher};
use crate::data::{DataSpace, bytes_mut};
use crate::launch::plan::{DATA_HEAD, MESSAGE_HEAD};
use crate::launch::settings::{NodeSettings, OnDeadline, OnNonFinite};
use crate::launch::vitals::{Vital, Vitals};
use crate::node::{ErasedNode, NodeError, Step};
use crate::time::Nanos;

/// Where the data of a node's messages lie, if its kind declares some.
#[derive(Debug, Clone, Copy)]
pub(super) struct Room {
    /// The word that holds their length.
    at: usize,
    /// The most bytes that they have.
    capacity: usize,
}

impl Room {
    pub(super) fn new(leaves: usize, capacity: usize) -> Self {
        Self { at: MESSAGE_HEAD + leaves, capacity }
    }

    /// The message that the next step writes its data into, where it will be read; `None` for messages without data.
    pub(super) fn message<'a>(&self, output: &'a Publisher) -> Result<Option<Loan<'a>>, ChannelError> {
        match self.capacity {
            0 => Ok(None),
            _ => output.loan(output.topic().words).map(Some),
        }
    }

    /// Makes a step; its data go into the message.
    pub(super) fn step(
        &self,
        node: &mut dyn ErasedNode,
        step: &Step<'_>,
        values: &mut [f64],
        message: Option<&mut [u64]>,
    ) -> Result<(), NodeError> {
        let Some(words) = message else { return node.step_into(step, values) };
        let (length, room) = words[self.at..].split_at_mut(DATA_HEAD);
        let mut space = DataSpace::new(&mut bytes_mut(room)[..self.capacity]);
        node.step_with_data(step, values, &mut space)?;
        length[0] = space.used() as u64;
        Ok(())
    }

    /// Writes what stands before the data. A safe output has none.
    pub(super) fn head(
        &self,
        message: &mut [u64],
        head: [u64; MESSAGE_HEAD],
        values: &[f64],
        without_data: bool,
    ) {
        message[..MESSAGE_HEAD].copy_from_slice(&head);
        for (word, value) in message[MESSAGE_HEAD..self.at].iter_mut().zip(values) {
            *word = value.to_bits();
        }
        if without_data {
            message[self.at] = 0;
        }
    }

    /// The words of the data with their length, as far as they are used.
    pub(super) fn data<'a>(&self, message: &'a [u64]) -> &'a [u64] {
        let used = (message[self.at] as usize).div_ceil(8);
        &message[self.at..self.at + DATA_HEAD + used]
    }
}

impl NodeSettings {
    /// Judges a step's output by its deadline and its values; says whether the safe output takes its place.
    pub(super) fn judge(
        &self,
        vitals: &Vitals,
        leaves: &[String],
        values: &[f64],
        seq: u64,
        took: Nanos,
    ) -> Result<bool, StepError> {
        let mut replace = false;
        if let Some(deadline) = self.deadline.filter(|deadline| took > *deadline) {
            vitals.add(Vital::Late, 1);
            let by = (took - deadline) as u64;
            if by > vitals.get(Vital::LateBy) {
                vitals.set(Vital::LateBy, by);
            }
            match self.on_deadline {
                OnDeadline::Count | OnDeadline::Warn => {}
                OnDeadline::Safe => replace = true,
                OnDeadline::Stop => return Err(StepError::Deadline { seq, took, deadline }),
            }
        }
        // All at once: a search that may end at each value is not made of vector instructions.
        let finite = values.iter().fold(true, |finite, value| finite & value.is_finite());
        if !finite && let Some(leaf) = values.iter().position(|value| !value.is_finite()) {
            if vitals.get(Vital::NonFinite) == 0 {
                vitals.set(Vital::NonFiniteStep, seq);
                vitals.set(Vital::NonFiniteLeaf, leaf as u64);
            }
            vitals.add(Vital::NonFinite, 1);
            match self.on_non_finite {
                OnNonFinite::Warn => {}
                OnNonFinite::Safe => replace = true,
                OnNonFinite::Fail => {
                    let (leaf, value) = (leaves[leaf].clone(), values[leaf]);
                    return Err(StepError::NonFinite { seq, leaf, value });
                }
            }
        }
        Ok(replace)
    }
}
