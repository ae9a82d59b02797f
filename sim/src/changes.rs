//! Parameters that are set, and states that are reset, in the middle of a simulated run: as a file plans it, or as they were in
//! a recorded one.

use std::collections::BTreeMap;

use parallax_runtime::graph::Graph;
use parallax_runtime::recording::{Change, ChangeKind, Recording};
use parallax_runtime::time::{Nanos, from_seconds};
use serde::Deserialize;

/// What is set and reset in which node, before which step.
///
/// ```
/// let plan = parallax_sim::ChangePlan::from_toml("changes.toml", r#"
///     [[change]]
///     node = "motor"
///     time = 2.0                # before the first step that starts then or later, s
///     set = { rated = 2.0 }     # all before the same step
///
///     [[change]]
///     node = "pid"
///     step = 300                # before this step
///     reset = true              # its state
/// "#)?;
/// assert_eq!(plan.len(), 2);
/// # Ok::<(), parallax_sim::ChangesError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ChangePlan {
    /// In the order in which they are made, by node.
    planned: Vec<Planned>,
}

/// What is made before one step of one node.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Planned {
    pub(crate) node: String,
    at: At,
    pub(crate) changes: Vec<Change>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum At {
    Step(u64),
    Time(Nanos),
}

/// Why a plan cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ChangesError {
    /// It is no such text.
    #[error("{file}: {problem}")]
    Text {
        /// The file.
        file: String,
        /// What the parser says, with line and column.
        problem: String,
    },
    /// An entry that says too little or too much.
    #[error("{file}: [[change]] number {number} of node `{node}`: {problem}")]
    Entry {
        /// The file.
        file: String,
        /// Which entry, from 1.
        number: usize,
        /// Its node.
        node: String,
        /// What is wrong.
        problem: &'static str,
    },
    /// A node that the graph does not have.
    #[error("a change is planned for node `{node}`, which the graph does not have (it has: {known})")]
    Node {
        /// The node.
        node: String,
        /// All nodes.
        known: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    change: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    node: String,
    step: Option<u64>,
    time: Option<f64>,
    #[serde(default)]
    set: BTreeMap<String, f64>,
    #[serde(default)]
    reset: bool,
}

impl ChangePlan {
    /// Reads a plan; `file` is its name, for messages and for the recording.
    ///
    /// # Errors
    ///
    /// [`ChangesError::Text`], [`ChangesError::Entry`].
    pub fn from_toml(file: &str, text: &str) -> Result<Self, ChangesError> {
        let File { change } = toml::from_str(text)
            .map_err(|error| ChangesError::Text { file: file.into(), problem: error.to_string() })?;
        let plan = |(place, entry): (usize, Entry)| {
            let Entry { node, step, time, set, reset } = entry;
            let wrong = |problem| {
                Err(ChangesError::Entry { file: file.into(), number: place + 1, node: node.clone(), problem })
            };
            let at = match (step, time) {
                (Some(step), None) => At::Step(step),
                (None, Some(time)) if (0.0..9e9).contains(&time) => At::Time(from_seconds(time)),
                (None, Some(_)) => return wrong("`time` must be seconds, from 0 on"),
                _ => return wrong("it needs either `step` or `time`"),
            };
            if set.is_empty() && !reset {
                return wrong("it changes nothing: `set = { PARAMETER = VALUE }` or `reset = true`");
            }
            let change = |kind| Change { node: node.clone(), step: 0, time: 0, by: file.into(), kind };
            // What the node calls the unit and what it had before is found out when it is set.
            let sets = set.into_iter().map(|(parameter, new)| {
                change(ChangeKind::Set { parameter, unit: String::new(), old: 0.0, new })
            });
            let changes = reset.then(|| change(ChangeKind::Reset)).into_iter().chain(sets).collect();
            Ok(Planned { node: node.clone(), at, changes })
        };
        Ok(Self { planned: change.into_iter().enumerate().map(plan).collect::<Result<_, _>>()? })
    }

    /// What was changed in a recorded run, before the same steps.
    pub fn from_recording(recording: &Recording) -> Self {
        let mut planned: Vec<Planned> = Vec::new();
        for change in &recording.changes {
            match planned.iter_mut().rev().find(|planned| planned.node == change.node) {
                Some(last) if last.at == At::Step(change.step) => last.changes.push(change.clone()),
                _ => planned.push(Planned {
                    node: change.node.clone(),
                    at: At::Step(change.step),
                    changes: vec![change.clone()],
                }),
            }
        }
        Self { planned }
    }

    /// For how many steps something is planned.
    pub fn len(&self) -> usize {
        self.planned.len()
    }

    /// Whether nothing is planned.
    pub fn is_empty(&self) -> bool {
        self.planned.is_empty()
    }

    /// Checks that the graph has the nodes.
    pub(crate) fn check(&self, graph: &Graph) -> Result<(), ChangesError> {
        let unknown = self.planned.iter().find(|planned| graph.index(&planned.node).is_none());
        unknown.map_or(Ok(()), |planned| {
            let names: Vec<&str> = graph.nodes().iter().map(|node| node.name.as_str()).collect();
            Err(ChangesError::Node { node: planned.node.clone(), known: names.join(", ") })
        })
    }

    /// What is planned for one node.
    pub(crate) fn of(&self, node: &str) -> Vec<Planned> {
        self.planned.iter().filter(|planned| planned.node == node).cloned().collect()
    }
}

impl Planned {
    /// Whether it is made before this step, which starts at this time.
    pub(crate) fn is_due(&self, step: u64, start: Nanos) -> bool {
        match self.at {
            At::Step(at) => step >= at,
            At::Time(at) => start >= at,
        }
    }
}
