//! Why a run could not be made.

use std::io;

use super::report::Exit;
use super::settings::SettingsError;
use crate::channel::ChannelError;
use crate::graph::GraphError;
use crate::recording::RecordingError;

/// Why a run could not be made. A run that began and then lost a node is no error of this kind: its
/// [`RunReport`](super::RunReport) says so, and its recording is complete up to then.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The graph cannot run.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// The launch settings do not fit the graph.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The system refused settings, and the run was to stop then.
    #[error(
        "the system refuses what the launch settings ask for, and `refused = \"stop\"` is set: {}",
        refused.join("; ")
    )]
    Refused {
        /// What was refused, and what to do about it.
        refused: Vec<String>,
    },
    /// The recording cannot be shared with this group.
    #[error("the recording cannot be shared with the group {group}: {source}")]
    Group {
        /// The group.
        group: String,
        /// Why.
        source: io::Error,
    },
    /// Shared memory or a channel in it does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The recording cannot be written.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A node did not come up.
    #[error("node {node} did not start: it {exit}. What it printed above may say more")]
    Start {
        /// The node.
        node: String,
        /// How it ended.
        exit: Exit,
    },
    /// A node said nothing for too long while the run was prepared.
    #[error(
        "node {node} did not {what} within {seconds} s. If it needs longer to build, raise `RunOptions::patience`"
    )]
    Silent {
        /// The node.
        node: String,
        /// What it was to do.
        what: &'static str,
        /// How long the launcher waited.
        seconds: f64,
    },
    /// A sender is not connected to all its receivers.
    #[error("node {node} reaches {got} of its {expected} receivers, so nothing was started. Run again")]
    Receivers {
        /// The node.
        node: String,
        /// Receivers and recorders that it reaches.
        got: usize,
        /// Those that the graph gives it.
        expected: usize,
    },
    /// The system refused to start a process or a thread.
    #[error("cannot start node {node}: {source}")]
    Spawn {
        /// The node.
        node: String,
        /// The system's answer.
        source: io::Error,
    },
    /// The recorder's thread could not be started.
    #[error("cannot start the recorder: {0}")]
    Thread(io::Error),
    /// The recorder ended without saying why.
    #[error("the recorder could not begin: {reason}")]
    Recorder {
        /// What it said, or how it died.
        reason: String,
    },
    /// A node is of a kind that another program runs, and nobody says which.
    #[error(
        "node {node} is run by another program, and none is given for it; name one in `RunOptions::programs`"
    )]
    NoProgram {
        /// The node.
        node: String,
    },
    /// A node that another program runs was to be a thread of this one.
    #[error(
        "node {node} is run by another program and cannot be a thread of this one; remove run_as = \"thread\""
    )]
    ProgramNeedsProcess {
        /// The node.
        node: String,
    },
    /// The graph runs on several machines, and this program cannot.
    #[error(
        "the launch settings name several machines, and this program was built without the link between them; build it \
         with `--features link`"
    )]
    NoLink,
    /// The link to the other machines could not begin.
    #[error("the link to the other machines could not begin: {reason}")]
    Link {
        /// What it said, or how it died.
        reason: String,
    },
    /// A recording is asked for where none is made, or none is where one is.
    #[error("{problem}")]
    RecorderElsewhere {
        /// What is wrong, and what to do.
        problem: String,
    },
    /// Somebody stopped the run before it began.
    #[error("stopped before all nodes were ready")]
    Interrupted,
    /// Signals cannot be watched.
    #[error("cannot watch for Ctrl-C: {0}")]
    Signals(io::Error),
    /// Threads share the environment of their process.
    #[error(
        "private environment variables were given for node {node}, but nodes run as threads; run them as processes"
    )]
    PrivateNeedsProcesses {
        /// The node.
        node: String,
    },
    /// Private variables for a node that does not exist.
    #[error("private environment variables were given for node {node}, which is not in the graph")]
    PrivateForNobody {
        /// The name that was given.
        node: String,
    },
    /// A node process was started by hand, or by another version.
    #[error("a node process is started by the launcher only: {reason}")]
    NotLaunched {
        /// What was wrong with the call.
        reason: String,
    },
}
