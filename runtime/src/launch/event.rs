//! What happens to the nodes while a run goes on.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Warner;
use super::report::Exit;
use crate::time::{Nanos, to_seconds};

/// Events that a report lists at most.
const LISTED: usize = 1000;

/// Takes events as they happen.
pub type Watcher = Box<dyn FnMut(&Event)>;

/// Something that happened to a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// When the launcher noticed, since the common start.
    pub time: Nanos,
    /// The node.
    pub node: String,
    /// What happened.
    pub kind: EventKind,
}

/// What can happen to a node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// It ended before the run did.
    Ended {
        /// How.
        exit: Exit,
    },
    /// It will be started again.
    Restarting {
        /// How often it will have been restarted then.
        attempt: u64,
        /// In how long.
        delay: Nanos,
    },
    /// It runs again, with a fresh state.
    Restarted {
        /// Its first step.
        step: u64,
    },
    /// It has been started again as often as it may.
    GivenUp {
        /// How often.
        restarts: u64,
    },
    /// It gives no sign of life.
    Hangs {
        /// For how long now.
        silent: Nanos,
        /// The step that it is in, if it is in one.
        step: Option<u64>,
    },
    /// It gives signs of life again.
    Returns {
        /// After so long.
        silent: Nanos,
    },
    /// A step has run beyond its deadline and goes on.
    Overdue {
        /// The step.
        step: u64,
    },
    /// Steps ended after their deadline.
    Late {
        /// How many since the last event of this kind.
        count: u64,
        /// The largest time by which one did in this run.
        late_by: Nanos,
    },
    /// Outputs held a NaN or an infinity.
    NonFinite {
        /// How many since the last event of this kind.
        count: u64,
        /// The step of the first in this run.
        step: u64,
        /// Its leaf.
        leaf: String,
    },
    /// A fresh process stopped its hardware after it had died.
    StoppedAfterCrash,
    /// What it does at its end failed.
    StopFailed {
        /// What it said.
        problem: String,
    },
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} s: node {} ", to_seconds(self.time), self.node)?;
        let ms = |time: &Nanos| *time as f64 / 1e6;
        match &self.kind {
            EventKind::Ended { exit } => write!(f, "{exit}"),
            EventKind::Restarting { attempt, delay } => {
                write!(f, "is started again in {:.0} ms (restart {attempt})", ms(delay))
            }
            EventKind::Restarted { step } => write!(f, "runs again, from step {step}"),
            EventKind::GivenUp { restarts } => write!(f, "was restarted {restarts} times and is given up"),
            EventKind::Hangs { silent, step: Some(step) } => {
                write!(f, "gives no sign of life for {:.0} ms, in step {step}", ms(silent))
            }
            EventKind::Hangs { silent, step: None } => {
                write!(f, "gives no sign of life for {:.0} ms, between two steps", ms(silent))
            }
            EventKind::Returns { silent } => write!(f, "is back after {:.0} ms", ms(silent)),
            EventKind::Overdue { step } => {
                write!(f, "is beyond the deadline of step {step}, and still in it")
            }
            EventKind::Late { count, late_by } => {
                write!(f, "ended {count} steps after their deadline, the worst by {:.3} ms", ms(late_by))
            }
            EventKind::NonFinite { count, step, leaf } => {
                write!(f, "sent {count} outputs that are no numbers, the first in step {step} at leaf {leaf}")
            }
            EventKind::StoppedAfterCrash => write!(f, "was stopped by a fresh process after its crash"),
            EventKind::StopFailed { problem } => write!(f, "could not stop in order: {problem}"),
        }
    }
}

/// The events of a run, told as they happen and kept for the report.
#[derive(Default)]
pub(super) struct Journal {
    pub(super) tell: Option<Watcher>,
    /// Tells what concerns no single node.
    pub(super) warn: Option<Warner>,
    /// What was told of that kind.
    pub(super) said: Vec<String>,
    pub(super) events: Vec<Event>,
    pub(super) omitted: u64,
}

impl Journal {
    /// Something that concerns no single node.
    pub(super) fn say(&mut self, text: &str) {
        if let Some(warn) = &mut self.warn {
            warn(text);
        }
        if self.said.len() < LISTED {
            self.said.push(text.into());
        }
    }

    pub(super) fn note(&mut self, time: Nanos, node: &str, kind: EventKind) {
        let event = Event { time, node: node.into(), kind };
        if let Some(tell) = &mut self.tell {
            tell(&event);
        }
        if self.events.len() < LISTED {
            self.events.push(event);
        } else {
            self.omitted += 1;
        }
    }
}
