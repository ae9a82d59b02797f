//! Between the thread that takes a node's orders and the one that makes its steps: wishes to set, read or reset something.
//!
//! A wish is a box that goes to the step's thread, is filled in between two steps, and comes back. The step's thread neither
//! allocates nor frees nor locks for it, and looks at one word where there is none.

use std::collections::VecDeque;

use crossbeam::queue::ArrayQueue;
use serde::{Deserialize, Serialize};

use super::control::Answer;
use crate::any_number;
use crate::node::ErasedNode;
use crate::recording::{Change, ChangeKind};
use crate::time::Nanos;
use crate::tuning::{Assignment, Parameter, Setting, Tuning, TuningError, resolve, set_all};

/// What somebody wants of a running node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Wish {
    /// To set these parameters, all before the same step.
    Set(Vec<Assignment>),
    /// To put its state back to what it was before the first step.
    Reset,
    /// To know its parameters and its state.
    Read,
}

/// Who wants it, as the system vouches for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct By {
    pub(super) user: u32,
    /// 0 for the launcher, which sets again what was set before a restart.
    pub(super) process: u32,
}

impl By {
    pub(super) fn word(self) -> u64 {
        u64::from(self.user) << 32 | u64::from(self.process)
    }

    pub(super) fn of_word(word: u64) -> Self {
        Self { user: (word >> 32) as u32, process: word as u32 }
    }

    /// In words, with the user's name where the system has one.
    pub(super) fn text(self) -> String {
        let Self { user, process } = self;
        let users = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
        let name = users.lines().find_map(|line| {
            let mut fields = line.split(':');
            let (name, number) = (fields.next()?, fields.nth(1)?);
            (number.parse() == Ok(user)).then(|| name.to_owned())
        });
        let name = name.unwrap_or_else(|| format!("user {user}"));
        match process {
            0 => format!("{name} (again, after a restart)"),
            process => format!("{name} (process {process})"),
        }
    }
}

/// What a node says to a wish.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Told {
    /// The step before which it was done: the first one that saw it.
    pub step: u64,
    /// When, since the common start.
    pub time: Nanos,
    /// What was changed.
    pub changes: Vec<Change>,
    /// The parameters that may be set, with their values.
    #[serde(with = "any_number::named")]
    pub parameters: Vec<(Parameter, f64)>,
    /// The state, by name.
    #[serde(with = "any_number::named")]
    pub state: Vec<(String, f64)>,
}

/// What of a node may be set and seen: found out once, when it was built.
#[derive(Debug, Clone, Default)]
pub(super) struct Face {
    pub(super) parameters: Vec<Parameter>,
    state: Vec<String>,
}

impl Face {
    pub(super) fn of(node: &mut dyn ErasedNode) -> Self {
        node.tuning().map_or_else(Self::default, |tuning| Self {
            parameters: tuning.parameters(),
            state: tuning.state(),
        })
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Work {
    Set,
    Reset,
    Read,
}

/// A wish on its way.
#[derive(Debug)]
pub(super) struct Errand {
    id: u64,
    pub(super) by: By,
    work: Work,
    pub(super) settings: Vec<Setting>,
    step: u64,
    time: Nanos,
    refused: Option<String>,
    values: Vec<f64>,
    state: Vec<f64>,
}

impl Errand {
    /// Does it, before step `step`.
    fn run(&mut self, tuning: &mut dyn Tuning, step: u64, time: Nanos) {
        (self.step, self.time) = (step, time);
        match self.work {
            Work::Set => self.refused = set_all(tuning, &mut self.settings).err(),
            Work::Reset => tuning.reset(),
            Work::Read => {
                self.values.iter_mut().enumerate().for_each(|(index, value)| *value = tuning.value(index));
                tuning.read_state(&mut self.state);
            }
        }
    }

    /// Whether it has put the state back.
    pub(super) fn is_reset(&self) -> bool {
        self.work == Work::Reset
    }

    /// Whether nothing was done.
    pub(super) fn is_refused(&self) -> bool {
        self.refused.is_some()
    }
}

/// Where the two threads meet.
#[derive(Debug)]
pub(super) struct Desk {
    asked: ArrayQueue<Box<Errand>>,
    done: ArrayQueue<Box<Errand>>,
}

impl Desk {
    pub(super) fn new() -> Self {
        Self { asked: ArrayQueue::new(1), done: ArrayQueue::new(1) }
    }

    /// Whether there is something to be done.
    #[inline]
    pub(super) fn any(&self) -> bool {
        !self.asked.is_empty()
    }

    /// Does what is there to be done; shows it to `record` before it goes back.
    pub(super) fn serve<E>(
        &self,
        node: &mut dyn ErasedNode,
        step: u64,
        time: Nanos,
        record: impl FnOnce(&Errand) -> Result<(), E>,
    ) -> Result<(), E> {
        let (Some(mut errand), Some(tuning)) = (self.asked.pop(), node.tuning()) else { return Ok(()) };
        errand.run(tuning, step, time);
        let recorded = record(&errand);
        // There is one errand under way at a time: it finds room.
        let _ = self.done.push(errand);
        recorded
    }
}

/// The side of the thread that takes orders.
pub(super) struct Front<'a> {
    node: &'a str,
    face: &'a Face,
    desk: &'a Desk,
    waiting: VecDeque<Box<Errand>>,
    /// One is on its way.
    out: bool,
}

impl<'a> Front<'a> {
    pub(super) fn new(node: &'a str, face: &'a Face, desk: &'a Desk) -> Self {
        Self { node, face, desk, waiting: VecDeque::new(), out: false }
    }

    /// Whether something is to come back.
    pub(super) fn busy(&self) -> bool {
        self.out || !self.waiting.is_empty()
    }

    /// Sends a wish on its way; gives the answer where it is clear without the node.
    pub(super) fn take(&mut self, id: u64, by: By, wish: &Wish) -> Option<Answer> {
        match self.errand(id, by, wish) {
            Ok(errand) => {
                self.waiting.push_back(Box::new(errand));
                self.turn()
            }
            Err(error) => Some(Answer::Tuned { id, told: Err(error.to_string()) }),
        }
    }

    fn errand(&self, id: u64, by: By, wish: &Wish) -> Result<Errand, TuningError> {
        let Face { parameters, state } = self.face;
        let node = || self.node.to_owned();
        let mut settings = Vec::new();
        let work = match wish {
            Wish::Set(assignments) => {
                settings = resolve(self.node, parameters, assignments)?;
                Work::Set
            }
            Wish::Reset if state.is_empty() => return Err(TuningError::Stateless { node: node() }),
            Wish::Reset => Work::Reset,
            Wish::Read if state.is_empty() && parameters.is_empty() => {
                return Err(TuningError::Closed { node: node() });
            }
            Wish::Read => Work::Read,
        };
        let room = |count: usize| if work == Work::Read { vec![0.0; count] } else { Vec::new() };
        let (values, state) = (room(parameters.len()), room(state.len()));
        Ok(Errand { id, by, work, settings, step: 0, time: 0, refused: None, values, state })
    }

    /// Takes what has come back, and sends the next one.
    pub(super) fn turn(&mut self) -> Option<Answer> {
        let done = self.desk.done.pop();
        if done.is_some() {
            self.out = false;
        }
        if !self.out
            && let Some(next) = self.waiting.pop_front()
        {
            self.out = self.desk.asked.push(next).is_ok();
        }
        done.map(|errand| self.answer(*errand))
    }

    fn answer(&self, errand: Errand) -> Answer {
        let Errand { id, by, step, time, refused, settings, values, state, work } = errand;
        if let Some(reason) = refused {
            let error = TuningError::Refused { node: self.node.into(), reason };
            return Answer::Tuned { id, told: Err(error.to_string()) };
        }
        let change = |kind| Change { node: self.node.into(), step, time, by: by.text(), kind };
        let changes = match work {
            Work::Set => {
                settings.iter().map(|setting| change(describe(&self.face.parameters, setting))).collect()
            }
            Work::Reset => vec![change(ChangeKind::Reset)],
            Work::Read => Vec::new(),
        };
        let parameters = self.face.parameters.iter().cloned().zip(values).collect();
        let state = self.face.state.iter().cloned().zip(state).collect();
        Answer::Tuned { id, told: Ok(Told { step, time, changes, parameters, state }) }
    }
}

/// A setting as it is recorded.
pub(super) fn describe(parameters: &[Parameter], setting: &Setting) -> ChangeKind {
    let Setting { parameter, old, new } = *setting;
    // A number beyond the list comes from another version of the node; it is kept as a number.
    let known = parameters.get(parameter);
    ChangeKind::Set {
        parameter: known.map_or_else(|| format!("parameter {parameter}"), |known| known.name.clone()),
        unit: known.map_or_else(String::new, |known| known.unit.clone()),
        old,
        new,
    }
}
