//! What the machines of a run say to each other beside messages: who they are, how far they are, and what their nodes do.
//!
//! Each says its whole state again and again; nothing hangs on a single word that may be lost.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::clock::Exchange;
use super::hosts::Placement;
use crate::graph::Graph;
use crate::launch::plan::{self, Settings};
use crate::launch::report::Exit;
use crate::random::fnv1a;
use crate::recording::{ClockReading, Fault};
use crate::time::Nanos;

/// The state of one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::launch) struct State {
    /// What it must share with the others.
    pub(in crate::launch) terms: Terms,
    /// Which of its runs this is: a process that was started again has another number.
    pub(in crate::launch) incarnation: u64,
    pub(in crate::launch) stage: Stage,
    /// How its nodes ended, as far as they have.
    pub(in crate::launch) exits: BTreeMap<String, Exit>,
    /// What it knows of the others' clocks.
    pub(in crate::launch) clocks: Vec<ClockReading>,
    /// What happened to its nodes, for the recording: all of it, again and again, and how many are too old to be told.
    pub(in crate::launch) faults: Vec<Fault>,
    pub(in crate::launch) forgotten: usize,
}

/// So many faults of a machine are told again and again.
const FAULTS: usize = 256;

impl State {
    /// Something happened to a node of this machine.
    pub(super) fn add_fault(&mut self, fault: Fault) {
        if self.faults.len() == FAULTS {
            self.faults.remove(0);
            self.forgotten += 1;
        }
        self.faults.push(fault);
    }

    /// The faults after the first `known` of them, and how many there are in all.
    pub(super) fn faults_after(&self, known: usize) -> (Vec<Fault>, usize) {
        let all = self.forgotten.saturating_add(self.faults.len());
        let new = all.saturating_sub(known).min(self.faults.len());
        (self.faults[self.faults.len() - new..].to_vec(), all)
    }
}

/// How far a machine is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::launch) enum Stage {
    /// Its nodes come up.
    Opening,
    /// All its nodes wait for the common start.
    Ready,
    /// The run goes on; its clock began when this machine's monotonic clock showed `epoch`.
    Running { epoch: Nanos },
    /// Its nodes have stopped, for this reason, at this end of the monotonic clock of the run; all it sent is on the way.
    Over { why: String },
}

/// What all machines of a run have to agree about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::launch) struct Terms {
    version: String,
    /// Hash of the graph.
    graph: u64,
    seed: u64,
    duration: Option<Nanos>,
    /// Which node is where, and which machine leads and records.
    placement: String,
    /// Hashes of the layouts of all messages, by node.
    layouts: BTreeMap<String, u64>,
}

impl Terms {
    pub(in crate::launch) fn of(graph: &Graph, settings: &Settings, placement: &Placement) -> Self {
        let text = serde_json::to_string(graph.spec()).unwrap_or_default();
        let nodes = graph.nodes().iter().enumerate();
        let ways = nodes.clone().filter_map(|(node, plan)| {
            let way = placement.ways[node].describe(placement.silence)?;
            Some(format!("; {}: {way}", plan.name))
        });
        let role = |host: Option<usize>| host.map_or("none", |host| placement.hosts[host].name.as_str());
        Self {
            version: env!("CARGO_PKG_VERSION").into(),
            graph: fnv1a(text.as_bytes()),
            seed: settings.seed,
            duration: settings.duration,
            placement: format!(
                "{}; lead {}, recorder {}{}",
                nodes
                    .clone()
                    .map(|(node, plan)| format!("{} on {}", plan.name, placement.host_of(node)))
                    .collect::<Vec<_>>()
                    .join(", "),
                role(Some(placement.lead)),
                role(placement.recorder),
                ways.collect::<String>()
            ),
            layouts: nodes
                .map(|(node, plan)| (plan.name.clone(), plan::output(graph, node).layout))
                .collect(),
        }
    }

    /// What the two do not agree about, in words.
    pub(in crate::launch) fn disagreement(&self, other: &Self) -> Option<String> {
        let time =
            |duration: Option<Nanos>| duration.map_or("no end".into(), |d| format!("{} s", d as f64 / 1e9));
        if self.version != other.version {
            return Some(format!("runs version {} and this one {}", other.version, self.version));
        }
        if let Some((node, _)) =
            self.layouts.iter().find(|(node, layout)| other.layouts.get(*node).is_some_and(|l| l != *layout))
        {
            return Some(format!(
                "gives messages of node {node} another layout: both must be built from the same message types"
            ));
        }
        if self.graph != other.graph {
            return Some("runs another graph (a node, a connection or a parameter differs)".into());
        }
        if self.placement != other.placement {
            return Some(format!(
                "has other launch settings: there {}; here {}",
                other.placement, self.placement
            ));
        }
        if self.seed != other.seed {
            return Some(format!(
                "was started with --seed {} and this one with --seed {}",
                other.seed, self.seed
            ));
        }
        if self.duration != other.duration {
            return Some(format!(
                "was started for {} and this one for {}",
                time(other.duration),
                time(self.duration)
            ));
        }
        None
    }
}

/// A question for the other clock, or the answer to one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Tick {
    Question { asked: Nanos },
    Answer { asked: Nanos, heard: Nanos, answered: Nanos },
}

impl Tick {
    pub(super) fn bytes(self) -> Vec<u8> {
        let words: &[Nanos] = match &self {
            Self::Question { asked } => &[*asked],
            Self::Answer { asked, heard, answered } => &[*asked, *heard, *answered],
        };
        words.iter().flat_map(|word| word.to_le_bytes()).collect()
    }

    /// What these bytes say; `None` when they are neither.
    pub(super) fn read(bytes: &[u8]) -> Option<Self> {
        let words = bytes.as_chunks::<8>();
        let word = |index: usize| words.0.get(index).map(|bytes| Nanos::from_le_bytes(*bytes));
        match bytes.len() {
            8 => Some(Self::Question { asked: word(0)? }),
            24 => Some(Self::Answer { asked: word(0)?, heard: word(1)?, answered: word(2)? }),
            _ => None,
        }
    }

    /// The exchange that ends with this answer.
    pub(super) fn exchange(self, back: Nanos) -> Option<Exchange> {
        match self {
            Self::Question { .. } => None,
            Self::Answer { asked, heard, answered } => Some(Exchange { asked, heard, answered, back }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::FaultKind;

    #[test]
    fn what_is_no_tick_is_none() {
        for tick in [Tick::Question { asked: -7 }, Tick::Answer { asked: 1, heard: i64::MIN, answered: 3 }] {
            assert_eq!(Tick::read(&tick.bytes()), Some(tick));
        }
        for wrong in [&[][..], &[1; 7], &[1; 9], &[0; 16], &[0; 32]] {
            assert_eq!(Tick::read(wrong), None);
        }
    }

    fn terms() -> Terms {
        Terms {
            version: "1".into(),
            graph: 1,
            seed: 0,
            duration: Some(10_000_000_000),
            placement: "a on x".into(),
            layouts: [("arm".to_owned(), 5)].into(),
        }
    }

    #[test]
    fn each_fault_is_heard_once() {
        let mut state = State {
            terms: terms(),
            incarnation: 1,
            stage: Stage::Opening,
            exits: BTreeMap::new(),
            clocks: Vec::new(),
            faults: Vec::new(),
            forgotten: 0,
        };
        let fault =
            |time| Fault { node: "arm".into(), time, kind: FaultKind::Restarted { step: 1, shift: 0 } };
        state.add_fault(fault(0));
        let (new, known) = state.faults_after(0);
        assert_eq!((new, known), (vec![fault(0)], 1));
        assert_eq!(state.faults_after(known), (Vec::new(), 1));
        (1..=FAULTS as Nanos).for_each(|time| state.add_fault(fault(time)));
        let (new, known) = state.faults_after(known);
        assert_eq!((new.len(), known), (FAULTS, FAULTS + 1));
        // One that was not listened to for long has missed some.
        assert_eq!(state.faults_after(0).0[0], fault(1));
        assert_eq!(state.faults_after(usize::MAX).0, []);
    }

    #[test]
    fn a_disagreement_is_named() {
        let terms = terms();
        assert_eq!(terms.disagreement(&terms.clone()), None);
        let cases: [(Terms, &str); 5] = [
            (Terms { version: "2".into(), ..terms.clone() }, "version 2"),
            (Terms { graph: 2, layouts: [("arm".to_owned(), 6)].into(), ..terms.clone() }, "node arm"),
            (Terms { graph: 2, ..terms.clone() }, "another graph"),
            (Terms { duration: None, ..terms.clone() }, "started for no end and this one for 10 s"),
            (Terms { seed: 3, ..terms.clone() }, "--seed 3"),
        ];
        for (other, word) in cases {
            let said = terms.disagreement(&other).unwrap();
            assert!(said.contains(word), "{said}");
        }
    }
}
