//! How the nodes of a run are run: what a `launch.toml` says, checked and resolved for each node.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use parallax_model::system::Suggestion;
use serde::{Deserialize, Serialize};

use super::link::{ConnectionLaunch, HostSpec, LinkSpec};
use crate::graph::SafeValue;
use crate::time::Nanos;

/// How the nodes of a run are run, as it stands in a `launch.toml`: defaults for all nodes, and settings of single
/// ones. Everything is optional; [`NodeSettings::default`] says what holds without a setting.
///
/// ```
/// use parallax_runtime::launch::{LaunchSpec, Policy, Restart};
/// let launch = LaunchSpec::from_toml("launch.toml", r#"
///     refused = "stop"
///
///     [defaults]
///     policy = "fifo"
///     lock_memory = true
///
///     [node.agent]
///     core = 2
///     priority = 30
///     restart = "on-failure"
///     safe = { torque = 0.0 }
/// "#)?;
/// assert_eq!(launch.defaults.policy, Some(Policy::Fifo));
/// assert_eq!(launch.nodes["agent"].restart, Some(Restart::OnFailure));
/// # Ok::<(), parallax_runtime::launch::SettingsError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LaunchSpec {
    /// What to do when the system refuses a setting.
    #[serde(default)]
    pub refused: Refused,
    /// The group that may read the recordings, by name or number; without one, their owner alone may.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// What holds for every node that says nothing else.
    #[serde(default)]
    pub defaults: NodeLaunch,
    /// Settings of single nodes, by name.
    #[serde(rename = "node", default)]
    pub nodes: BTreeMap<String, NodeLaunch>,
    /// The machines that the graph runs on, by name; none for a graph on one machine.
    #[serde(rename = "host", default, skip_serializing_if = "BTreeMap::is_empty")]
    pub hosts: BTreeMap<String, HostSpec>,
    /// How they are connected.
    #[serde(default)]
    pub link: LinkSpec,
    /// What holds for single connections between machines, by `FROM->TO`.
    #[serde(rename = "connection", default, skip_serializing_if = "BTreeMap::is_empty")]
    pub connections: BTreeMap<String, ConnectionLaunch>,
    /// The file it was read from, for messages.
    #[serde(skip)]
    pub file: Option<PathBuf>,
}

/// What to do when the system refuses a setting: no permission for a real-time policy, a core that is not there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refused {
    /// Say so in the warnings, and go on without it.
    #[default]
    Continue,
    /// Say so, and do not start.
    Stop,
}

/// Whether a node is a process or a thread.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunAs {
    /// A process of its own: one that crashes takes no other with it.
    #[default]
    Process,
    /// A thread of the launcher's process.
    Thread,
}

/// The scheduling policy of a node, as in `sched(7)`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Policy {
    /// `SCHED_OTHER`: like any program.
    #[default]
    Other,
    /// `SCHED_FIFO`: before all ordinary programs, until it sleeps.
    Fifo,
    /// `SCHED_RR`: as `fifo`, taking turns with those of the same priority.
    Rr,
}

/// How a node waits for its next step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WaitStrategy {
    /// It sleeps.
    #[default]
    Block,
    /// It polls for the time `spin` before its step is due and after that for a late message, and sleeps otherwise.
    SpinThenBlock,
    /// It always polls: most punctual, and it takes a core.
    Spin,
}

/// When a node that ended is started again; named as systemd's `Restart=`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Restart {
    /// Not at all.
    #[default]
    Never,
    /// When it ended by a signal, a panic, an error, an exit status other than 0, or was ended because it hung.
    OnFailure,
    /// However it ended before the run did.
    Always,
}

/// What to do about a node that gives no sign of life.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnHang {
    /// Say so, and wait for it.
    #[default]
    Warn,
    /// Kill it, and treat it as its restart policy says.
    Restart,
    /// Stop the run.
    Stop,
}

/// What to do about a step that ended too late.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnDeadline {
    /// Count it, for the report.
    #[default]
    Count,
    /// Count it, and say so while the run goes on.
    Warn,
    /// Send the node's safe output in place of the late one.
    Safe,
    /// Stop the run.
    Stop,
}

/// What to do about an output that holds a NaN or an infinity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnNonFinite {
    /// Send it, and say so.
    #[default]
    Warn,
    /// Send the node's safe output in its place.
    Safe,
    /// End the node: its receivers react as to a dead sender.
    Fail,
}

/// Settings of one node, or of all of them, as written: what is absent is left to the defaults.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NodeLaunch {
    /// The machine it runs on, where there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// Process or thread.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run_as: Option<RunAs>,
    /// The core it is pinned to; goes before the graph's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub core: Option<usize>,
    /// Its scheduling policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy: Option<Policy>,
    /// Its real-time priority, 1 to 99.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub priority: Option<u8>,
    /// Whether its memory is kept from being paged out (`mlockall`).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lock_memory: Option<bool>,
    /// How it waits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wait: Option<WaitStrategy>,
    /// How long it polls before and after its time, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spin: Option<f64>,
    /// When it is started again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart: Option<Restart>,
    /// Time between its end and the first restart, s; it doubles with every further one in a row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart_delay: Option<f64>,
    /// The longest such time, s. A node that has run for so long starts from the first delay again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart_delay_max: Option<f64>,
    /// How often it is restarted in one run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restart_limit: Option<u32>,
    /// How long it may give no sign of life, s; `inf` for as long as it likes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heartbeat: Option<f64>,
    /// What to do when it does not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_hang: Option<OnHang>,
    /// How long after it could begin, at the latest, a step has to end, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deadline: Option<f64>,
    /// What to do when it does not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_deadline: Option<OnDeadline>,
    /// What to do about an output that is no number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub on_non_finite: Option<OnNonFinite>,
    /// Whether a fresh process stops the node's hardware when the node died and does not come back: it builds the node
    /// and calls [`Node::stop`](crate::node::Node::stop), as systemd's `ExecStopPost=` would.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop_after_crash: Option<bool>,
    /// Its safe output; goes before the graph's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe: Option<BTreeMap<String, SafeValue>>,
    /// The interpreter of a node that is written in another language: a path, or a name that is looked for in `PATH`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interpreter: Option<PathBuf>,
}

/// The settings of one node, resolved. The default is what holds where nothing is said.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeSettings {
    /// Process or thread.
    pub run_as: RunAs,
    /// The core it is pinned to.
    pub core: Option<usize>,
    /// Its scheduling policy.
    pub policy: Policy,
    /// Its priority under a real-time policy, 1 to 99.
    pub priority: u8,
    /// Whether its memory is kept from being paged out.
    pub lock_memory: bool,
    /// How long before its time a step polls, and how long after it a late message is polled for. 0 is never;
    /// [`ALWAYS`](Self::ALWAYS) is always.
    pub spin: Nanos,
    /// When it is started again.
    pub restart: Restart,
    /// Time between its end and the first restart.
    pub restart_delay: Nanos,
    /// The longest such time.
    pub restart_delay_max: Nanos,
    /// How often it is restarted in one run.
    pub restart_limit: u32,
    /// How long it may give no sign of life.
    pub heartbeat: Nanos,
    /// What to do when it does not.
    pub on_hang: OnHang,
    /// How long after it could begin a step has to end.
    pub deadline: Option<Nanos>,
    /// What to do when it does not.
    pub on_deadline: OnDeadline,
    /// What to do about an output that is no number.
    pub on_non_finite: OnNonFinite,
    /// Whether a fresh process stops its hardware when it died for good.
    pub stop_after_crash: bool,
}

impl NodeSettings {
    /// The spin time of a node that always polls.
    pub const ALWAYS: Nanos = Nanos::MAX / 8;
    /// Polling before and after a step's time, where a node is to spin and then block and no time is given.
    pub const SPIN: Nanos = 100_000;
    /// The priority under a real-time policy where none is given.
    pub const PRIORITY: u8 = 10;
}

impl Default for NodeSettings {
    fn default() -> Self {
        Self {
            run_as: RunAs::Process,
            core: None,
            policy: Policy::Other,
            priority: Self::PRIORITY,
            lock_memory: false,
            spin: 0,
            restart: Restart::Never,
            restart_delay: 100_000_000,
            restart_delay_max: 5_000_000_000,
            restart_limit: 5,
            heartbeat: 1_000_000_000,
            on_hang: OnHang::Warn,
            deadline: None,
            on_deadline: OnDeadline::Count,
            on_non_finite: OnNonFinite::Warn,
            stop_after_crash: false,
        }
    }
}

/// What is wrong with launch settings: in which file, about which node, and what to do.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// The file cannot be read.
    #[error("{file} cannot be read: {problem}")]
    File {
        /// The file.
        file: String,
        /// What the system says.
        problem: String,
    },
    /// The text is no launch settings.
    #[error("{file}: {problem}")]
    Text {
        /// The file.
        file: String,
        /// What the parser says, with line and column.
        problem: String,
    },
    /// Settings of a node that is not in the graph.
    #[error("{file}: [node.{node}]: the graph has no node `{node}`{suggestion} (it has: {known})")]
    UnknownNode {
        /// The file.
        file: String,
        /// The node.
        node: String,
        /// The nearest node.
        suggestion: Suggestion,
        /// All nodes.
        known: String,
    },
    /// A value that cannot be, or that does not fit the others.
    #[error("{file}: [{place}] {field}: {problem}")]
    Value {
        /// The file.
        file: String,
        /// The table: `defaults` or `node.NAME`.
        place: String,
        /// The setting.
        field: &'static str,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// A setting that is not written as one.
    #[error("`{text}` is no setting: {problem}")]
    Override {
        /// What was given.
        text: String,
        /// What is wrong.
        problem: String,
    },
}

impl LaunchSpec {
    /// Reads the text of a `launch.toml`; `file` is its name, for messages.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Text`] with line and column.
    pub fn from_toml(file: impl Into<PathBuf>, text: &str) -> Result<Self, SettingsError> {
        let file = file.into();
        let spec: Self = toml::from_str(text).map_err(|error| SettingsError::Text {
            file: file.display().to_string(),
            problem: error.to_string(),
        })?;
        Ok(Self { file: Some(file), ..spec })
    }

    /// Reads a `launch.toml`.
    ///
    /// # Errors
    ///
    /// [`SettingsError::File`], [`SettingsError::Text`].
    pub fn read(path: &Path) -> Result<Self, SettingsError> {
        let text = std::fs::read_to_string(path).map_err(|error| SettingsError::File {
            file: path.display().to_string(),
            problem: error.to_string(),
        })?;
        Self::from_toml(path, &text)
    }
}
