//! Playback: a node that commands what a file says, in place of the node that would decide it.
//!
//! For every kind of node there is a kind `playback/KIND` with the same inputs and the same messages, so that it can take
//! that node's place in a graph ([`put`], or a node's `kind` in a `graph.toml`). It ignores its inputs. At each step it
//! sends what the command file holds at the step's due time; the last value holds after the end. A leaf `stamp` gets the due time,
//! leaves that the file does not name keep their initial values.
//!
//! In a graph, `file` names a [`CommandFile`], relative to where the program runs; its columns are called
//! `NODE.LEAF` or just `LEAF`. [`put`] writes `times` and `leaves` instead, so that a recording of the run holds
//! all that a replay needs.
//!
//! ```
//! use parallax_nodes::command_file::CommandFile;
//! use parallax_nodes::{pendulum, playback, registry};
//!
//! let file = CommandFile::parse("time,motor.voltage\n0,0\n0.5,2.5\n", "step.csv")?;
//! let mut graph = pendulum::graph();
//! playback::put(&mut graph, "motor", &file, &registry())?;
//! assert!(graph.validate(&registry()).is_ok());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::collections::BTreeMap;
use std::path::PathBuf;

use parallax_model::system::Suggestion;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::node::{ErasedNode, Layout, NodeContext, NodeError, Step};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::to_seconds;
use serde::Deserialize;

use crate::command_file::{CommandFile, CommandFileError, index_at};

/// What stands before the name of the kind whose place is taken.
pub const PREFIX: &str = "playback/";

/// The leaf that gets the time of the step.
const STAMP: &str = "stamp";

/// The registry with a kind that plays for each of its kinds.
#[must_use]
pub fn with_playback(registry: Registry) -> Registry {
    let names: Vec<String> = registry.names().filter(|n| !n.starts_with(PREFIX)).map(Into::into).collect();
    names.into_iter().fold(registry, |registry, name| match registry.get(&name) {
        // What these send is known in a graph only.
        Some(kind) if !kind.is_by_graph() => {
            let kind = kind_like(kind);
            registry.with(format!("{PREFIX}{name}"), kind)
        }
        _ => registry,
    })
}

/// A kind that plays, with the inputs and messages of `other`.
#[must_use]
pub fn kind_like(other: &NodeKind) -> NodeKind {
    let (layout, initial) = (other.output().clone(), other.initial_message().to_vec());
    let start = initial.clone();
    let has_data = other.data_capacity() > 0;
    let kind = NodeKind::erased(layout.clone(), initial, move |context| {
        if has_data {
            let problem = "the kind in whose place it stands sends data, such as images, and a command file holds numbers only";
            return Err(NodeError::failed(format!("node `{}` cannot be played: {problem}", context.name)));
        }
        Ok(Box::new(Playback::new(context, &layout, &start)?))
    });
    let inputs = other.inputs().iter().cloned();
    inputs.fold(kind, |kind, input| kind.input_with_layout(input.name, input.layout))
}

/// Why a command file cannot be played by a node.
#[derive(Debug, thiserror::Error)]
pub enum PlaybackError {
    /// The graph has no such node.
    #[error("the graph has no node `{node}`{suggestion} (it has: {known})")]
    Node {
        /// What was asked for.
        node: String,
        /// What may have been meant.
        suggestion: Suggestion,
        /// All nodes.
        known: String,
    },
    /// The node's kind is unknown or has no kind that plays.
    #[error(
        "node `{node}` is of the kind `{kind}`, for which the program knows no `{PREFIX}{kind}`; add it with playback::with_playback"
    )]
    Kind {
        /// The node.
        node: String,
        /// Its kind.
        kind: String,
    },
    /// The node sends data, such as images, and a command file holds numbers only.
    #[error(
        "node `{node}` sends data beside numbers (`{kind}`), such as images, and a command file holds numbers only; play a node \
         that sends none"
    )]
    Data {
        /// The node.
        node: String,
        /// Its kind.
        kind: String,
    },
    /// A column names no leaf of the node's messages.
    #[error(
        "the command file's column `{column}` is no leaf of what node `{node}` sends (it sends: {known}); name it {node}.LEAF"
    )]
    Column {
        /// The node.
        node: String,
        /// The column.
        column: String,
        /// The leaves that can be played.
        known: String,
    },
    /// No column is for this node.
    #[error("the command file has no column for node `{node}` (it has: {known}); name one {node}.LEAF")]
    Nothing {
        /// The node.
        node: String,
        /// The columns.
        known: String,
    },
}

/// Lets a node of the graph play the columns of a command file that are called `NODE.LEAF` or `LEAF`.
///
/// # Errors
///
/// [`PlaybackError`] when node, kind or columns do not fit.
pub fn put(
    graph: &mut GraphSpec,
    node: &str,
    file: &CommandFile,
    registry: &Registry,
) -> Result<(), PlaybackError> {
    let names: Vec<String> = graph.nodes.iter().map(|node| node.name.clone()).collect();
    let Some(spec) = graph.node_mut(node) else {
        let suggestion = Suggestion::nearest(node, names.iter().map(String::as_str));
        return Err(PlaybackError::Node { node: node.into(), suggestion, known: names.join(", ") });
    };
    let kind = match spec.kind.strip_prefix(PREFIX) {
        Some(_) => spec.kind.clone(),
        None => format!("{PREFIX}{}", spec.kind),
    };
    let Some(known) = registry.get(&kind) else {
        return Err(PlaybackError::Kind { node: node.into(), kind: spec.kind.clone() });
    };
    if registry.get(kind.trim_start_matches(PREFIX)).is_some_and(|kind| kind.data_capacity() > 0) {
        return Err(PlaybackError::Data { node: node.into(), kind: spec.kind.clone() });
    }
    let leaves = leaves(file, node, known.output())?;
    spec.kind = kind;
    spec.parameters.clear();
    spec.parameters.insert("times".into(), file.times.clone().into());
    let leaves =
        leaves.into_iter().map(|(leaf, values)| (known.output().leaves[leaf].clone(), values.into()));
    spec.parameters.insert("leaves".into(), serde_json::Value::Object(leaves.collect()));
    Ok(())
}

/// The columns for a node, by leaf.
fn leaves(file: &CommandFile, node: &str, layout: &Layout) -> Result<Vec<(usize, Vec<f64>)>, PlaybackError> {
    let mut out = Vec::new();
    for (column, values) in &file.signals {
        let name = match column.split_once('.') {
            Some((owner, leaf)) if owner == node => leaf,
            // Another node's.
            Some((owner, _)) if layout.leaf(column).is_none() && !owner.is_empty() => continue,
            _ => column,
        };
        match layout.leaf(name).filter(|_| name != STAMP) {
            Some(leaf) => out.push((leaf, values.clone())),
            None => {
                let known: Vec<&str> =
                    layout.leaves.iter().map(String::as_str).filter(|leaf| *leaf != STAMP).collect();
                return Err(PlaybackError::Column {
                    node: node.into(),
                    column: column.clone(),
                    known: known.join(", "),
                });
            }
        }
    }
    if out.is_empty() {
        let known: Vec<&str> = file.signals.iter().map(|(name, _)| name.as_str()).collect();
        return Err(PlaybackError::Nothing { node: node.into(), known: known.join(", ") });
    }
    Ok(out)
}

/// What may stand in a graph.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Parameters {
    file: Option<PathBuf>,
    times: Vec<f64>,
    leaves: BTreeMap<String, Vec<f64>>,
}

/// The node.
#[derive(Clone, Debug)]
pub struct Playback {
    times: Vec<f64>,
    /// Leaf and its values, one per time.
    leaves: Vec<(usize, Vec<f64>)>,
    message: Vec<f64>,
    stamp: Option<usize>,
}

impl Playback {
    fn new(context: &NodeContext, layout: &Layout, initial: &[f64]) -> Result<Self, NodeError> {
        let Parameters { file, times, leaves: given } = context.parameters()?;
        let wrong = |problem: String| context.parameter_error(problem);
        let file = match file {
            Some(path) if times.is_empty() && given.is_empty() => CommandFile::read(&path)
                .map_err(|error: CommandFileError| wrong(format!("`file`: {error}")))?,
            Some(_) => return Err(wrong("give either `file`, or `times` and `leaves`".into())),
            None if times.is_empty() => {
                return Err(wrong("`file` must name a command file (CSV with the columns time,LEAF)".into()));
            }
            None => {
                let increasing = times.windows(2).all(|pair| pair[0] < pair[1]);
                let fits = given.values().all(|values| values.len() == times.len());
                if !increasing || !fits {
                    return Err(wrong(
                        "`times` must increase, and each of `leaves` hold one value a time".into(),
                    ));
                }
                CommandFile { times, signals: given.into_iter().collect(), ..CommandFile::default() }
            }
        };
        let leaves = leaves(&file, &context.name, layout).map_err(|error| wrong(error.to_string()))?;
        let (message, stamp) = (initial.to_vec(), layout.leaf(STAMP));
        Ok(Self { times: file.times, leaves, message, stamp })
    }
}

impl ErasedNode for Playback {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let time = to_seconds(step.due);
        // Half a nanosecond keeps a tick that falls on a stamp from missing it by rounding.
        let at = index_at(&self.times, time + 0.5e-9);
        for (leaf, values) in &self.leaves {
            self.message[*leaf] = values[at];
        }
        if let Some(stamp) = self.stamp {
            self.message[stamp] = time;
        }
        output.copy_from_slice(&self.message);
        Ok(())
    }
}
