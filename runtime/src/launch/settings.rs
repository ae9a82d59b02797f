//! How the nodes of a run are run: what a `launch.toml` says, checked and resolved for each node.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use parallax_model::system::Suggestion;
use serde::{Deserialize, Serialize};

use crate::graph::{Graph, GraphSpec, SafeValue};
use crate::time::{Nanos, from_seconds};

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
    /// What holds for every node that says nothing else.
    #[serde(default)]
    pub defaults: NodeLaunch,
    /// Settings of single nodes, by name.
    #[serde(rename = "node", default)]
    pub nodes: BTreeMap<String, NodeLaunch>,
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

    /// Changes one setting, written `NODE.SETTING=VALUE` as in the file; `defaults` in place of a node changes it for all
    /// nodes, also for those that have a setting of their own.
    ///
    /// # Errors
    ///
    /// [`SettingsError::Override`] when there is no such setting, or no such value of it.
    pub fn change(&mut self, text: &str) -> Result<(), SettingsError> {
        let fail = |problem: String| SettingsError::Override { text: text.into(), problem };
        let form = || fail("it must look like NODE.SETTING=VALUE, such as agent.policy=fifo".into());
        let (place, value) = text.split_once('=').ok_or_else(form)?;
        let (node, field) = place.split_once('.').ok_or_else(form)?;
        if node.is_empty() || field.is_empty() || value.is_empty() {
            return Err(form());
        }
        // A plain word is a string.
        let parse = |value: &str| toml::from_str::<NodeLaunch>(&format!("{field} = {value}"));
        let one = parse(value)
            .or_else(|_| parse(&format!("{value:?}")))
            .map_err(|error| fail(error.message().to_owned()))?;
        if node == "defaults" {
            self.defaults.take(&one);
            self.nodes.values_mut().for_each(|node| node.forget(&one));
        } else {
            self.nodes.entry(node.into()).or_default().take(&one);
        }
        Ok(())
    }

    pub(super) fn name(&self) -> String {
        self.file.as_ref().map_or("launch settings".into(), |file| file.display().to_string())
    }

    /// Puts what belongs to the graph there: cores and safe outputs.
    ///
    /// # Errors
    ///
    /// [`SettingsError::UnknownNode`].
    pub fn put_into(&self, spec: &mut GraphSpec) -> Result<(), SettingsError> {
        for (name, node) in &self.nodes {
            let names: Vec<String> = spec.nodes.iter().map(|node| node.name.clone()).collect();
            let Some(place) = spec.node_mut(name) else {
                return Err(SettingsError::UnknownNode {
                    file: self.name(),
                    node: name.clone(),
                    suggestion: Suggestion::nearest(name, names.iter().map(String::as_str)),
                    known: names.join(", "),
                });
            };
            place.core = node.core.or(place.core);
            if let Some(safe) = &node.safe {
                place.safe = Some(safe.clone());
            }
        }
        Ok(())
    }

    /// The settings of every node of a graph, in its order. Where nothing is said, `base` holds.
    ///
    /// # Errors
    ///
    /// [`SettingsError`], with the table and the setting.
    pub fn resolve(&self, graph: &Graph, base: &NodeSettings) -> Result<Vec<NodeSettings>, SettingsError> {
        let fail = |place: &str| {
            let (file, place) = (self.name(), place.to_owned());
            move |(field, problem)| SettingsError::Value { file, place, field, problem }
        };
        let defaults = &self.defaults;
        defaults.check().map_err(fail("defaults"))?;
        for (field, given) in [("core", defaults.core.is_some()), ("safe", defaults.safe.is_some())] {
            if given {
                let problem = "belongs to one node; put it into [node.NAME]".into();
                return Err(fail("defaults")((field, problem)));
            }
        }
        let none = NodeLaunch::default();
        let resolve = |node: &crate::graph::NodePlan| {
            let own = self.nodes.get(&node.name).unwrap_or(&none);
            let place = format!("node.{}", node.name);
            own.check().map_err(fail(&place))?;
            let settings = own.over(&defaults.over(base));
            let settings = NodeSettings { core: node.core, ..settings };
            own.check_resolved(&settings, node.safe.is_some()).map_err(fail(&place))?;
            Ok(settings)
        };
        graph.nodes().iter().map(resolve).collect()
    }
}

type Problem = (&'static str, String);

impl NodeLaunch {
    /// Every setting that `other` has.
    fn take(&mut self, other: &Self) {
        macro_rules! take {
            ($($field:ident)*) => { $(if other.$field.is_some() { self.$field = other.$field.clone(); })* };
        }
        take!(run_as core policy priority lock_memory wait spin restart restart_delay restart_delay_max restart_limit);
        take!(heartbeat on_hang deadline on_deadline on_non_finite stop_after_crash safe);
    }

    /// Loses every setting that `other` has.
    fn forget(&mut self, other: &Self) {
        macro_rules! forget {
            ($($field:ident)*) => { $(if other.$field.is_some() { self.$field = None; })* };
        }
        forget!(run_as core policy priority lock_memory wait spin restart restart_delay restart_delay_max restart_limit);
        forget!(heartbeat on_hang deadline on_deadline on_non_finite stop_after_crash safe);
    }

    /// What is wrong with these settings by themselves.
    fn check(&self) -> Result<(), Problem> {
        let times = [
            ("spin", self.spin, 0.0),
            ("restart_delay", self.restart_delay, 0.0),
            ("restart_delay_max", self.restart_delay_max, 0.0),
            ("deadline", self.deadline, 1e-9),
            // A node that sleeps looks around every 20 ms.
            ("heartbeat", self.heartbeat, 0.05),
        ];
        for (field, value, least) in times {
            let Some(value) = value else { continue };
            let infinite = field == "heartbeat" && value == f64::INFINITY;
            if !(infinite || (value.is_finite() && value >= least)) {
                return Err((field, format!("{value} s cannot be; give at least {least} s")));
            }
        }
        if let Some(priority) = self.priority
            && !(1..=99).contains(&priority)
        {
            return Err((
                "priority",
                format!("{priority} cannot be; a real-time priority lies between 1 and 99"),
            ));
        }
        if let Some(core) = self.core
            && core >= libc::CPU_SETSIZE as usize
        {
            return Err((
                "core",
                format!("{core} cannot be; Linux counts cores from 0 to {}", libc::CPU_SETSIZE - 1),
            ));
        }
        Ok(())
    }

    /// These settings, and where they say nothing, `base`.
    fn over(&self, base: &NodeSettings) -> NodeSettings {
        let nanos = |seconds: Option<f64>, base: Nanos| seconds.map_or(base, from_seconds);
        let spin = match (self.wait, self.spin) {
            (Some(WaitStrategy::Block), _) => 0,
            (Some(WaitStrategy::Spin), _) => NodeSettings::ALWAYS,
            (Some(WaitStrategy::SpinThenBlock), spin) => nanos(spin, NodeSettings::SPIN),
            (None, spin) => nanos(spin, base.spin),
        };
        NodeSettings {
            run_as: self.run_as.unwrap_or(base.run_as),
            core: base.core,
            policy: self.policy.unwrap_or(base.policy),
            priority: self.priority.unwrap_or(base.priority),
            lock_memory: self.lock_memory.unwrap_or(base.lock_memory),
            spin,
            restart: self.restart.unwrap_or(base.restart),
            restart_delay: nanos(self.restart_delay, base.restart_delay),
            restart_delay_max: nanos(self.restart_delay_max, base.restart_delay_max),
            restart_limit: self.restart_limit.unwrap_or(base.restart_limit),
            heartbeat: nanos(self.heartbeat, base.heartbeat),
            on_hang: self.on_hang.unwrap_or(base.on_hang),
            deadline: self.deadline.map(from_seconds).or(base.deadline),
            on_deadline: self.on_deadline.unwrap_or(base.on_deadline),
            on_non_finite: self.on_non_finite.unwrap_or(base.on_non_finite),
            stop_after_crash: self.stop_after_crash.unwrap_or(base.stop_after_crash),
        }
    }

    /// What is wrong with these settings beside the others of the node. A setting that would have no effect is an error
    /// where it is the node's own, and none where all nodes got it.
    fn check_resolved(&self, all: &NodeSettings, safe: bool) -> Result<(), Problem> {
        if self.priority.is_some() && all.policy == Policy::Other {
            return Err((
                "priority",
                "has no effect under policy = \"other\"; choose \"fifo\" or \"rr\"".into(),
            ));
        }
        if self.spin.is_some() && matches!(self.wait, Some(WaitStrategy::Block | WaitStrategy::Spin)) {
            return Err(("spin", "is a time for wait = \"spin-then-block\"; remove one of the two".into()));
        }
        let of_restart = [
            ("restart_delay", self.restart_delay.is_some()),
            ("restart_delay_max", self.restart_delay_max.is_some()),
            ("restart_limit", self.restart_limit.is_some()),
        ];
        if let Some((field, _)) = of_restart.into_iter().find(|(_, given)| *given)
            && all.restart == Restart::Never
        {
            return Err((
                field,
                "has no effect with restart = \"never\"; choose \"on-failure\" or \"always\"".into(),
            ));
        }
        if all.restart_delay > all.restart_delay_max {
            return Err(("restart_delay", "is longer than restart_delay_max".into()));
        }
        if all.on_hang == OnHang::Restart && all.run_as == RunAs::Thread {
            return Err(("on_hang", "a thread that hangs cannot be ended; use run_as = \"process\"".into()));
        }
        if all.on_hang == OnHang::Restart && all.restart == Restart::Never {
            return Err(("on_hang", "\"restart\" needs restart = \"on-failure\" or \"always\"".into()));
        }
        if self.on_deadline.is_some() && all.deadline.is_none() {
            return Err(("on_deadline", "has no effect without a deadline; set deadline = SECONDS".into()));
        }
        let reactions = [
            ("on_deadline", all.on_deadline == OnDeadline::Safe && all.deadline.is_some()),
            ("on_non_finite", all.on_non_finite == OnNonFinite::Safe),
        ];
        if let Some((field, _)) = reactions.into_iter().find(|(_, wanted)| *wanted && !safe) {
            return Err((field, "\"safe\" needs a safe output; set safe = { LEAF = VALUE }".into()));
        }
        if self.stop_after_crash == Some(true) && all.run_as == RunAs::Thread {
            return Err((
                "stop_after_crash",
                "is for processes: a thread that ends has called stop itself".into(),
            ));
        }
        Ok(())
    }
}
