//! Runs a graph in real time: one process or thread per node, started together, watched and stopped in order.
//!
//! [`run`] makes a corner of shared memory for the run, creates every channel, starts the nodes, checks that
//! every sender reaches all its receivers, and gives them one common start. It ends when the time is over, on
//! Ctrl-C, or when a node dies that others need; the recording is complete up to there in every case, and no
//! shared memory is left.
//!
//! A node process is this same program under the hidden subcommand [`NODE_COMMAND`]: its `main` has to call
//! [`node_main`] there.
//!
//! ```no_run
//! use parallax_runtime::graph::GraphSpec;
//! use parallax_runtime::launch::{RunOptions, run};
//! use parallax_runtime::registry::Registry;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let (text, registry) = (String::new(), Registry::new());
//! let graph = GraphSpec::from_toml(&text)?;
//! let options = RunOptions {
//!     duration: Some(20_000_000_000),
//!     recording: Some("recording.mcap".into()),
//!     ..RunOptions::default()
//! };
//! let report = run(&graph, &registry, options)?;
//! println!("{} nodes, start-up {} ms", report.nodes.len(), report.startup / 1_000_000);
//! # Ok(())
//! # }
//! ```

mod about;
mod account;
mod control;
mod cores;
mod crew;
mod desk;
mod door;
mod ending;
mod error;
mod event;
mod launcher;
mod ledger;
mod link;
mod live;
mod orders;
mod plan;
mod priority;
mod record;
mod recorder;
mod records;
mod report;
mod resolve;
mod settings;
pub mod signals;
mod stepper;
mod supervise;
mod unpack;
mod vitals;
mod watch;
mod worker;
mod worker_main;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use about::Phase;
pub use desk::Told;
pub use door::{AskError, read_node, reset_state, set_parameters};
pub use error::RunError;
pub use event::{Event, EventKind, Watcher};
pub use launcher::run;
pub use link::{ConnectionLaunch, Crossing, HostSpec, LinkPriority, LinkSpec, OnGone};
pub use live::{
    ConnectionView, LiveError, LiveRun, NodeState, NodeView, RecorderView, RunName, Sample, Snapshot,
    live_runs,
};
pub use report::{
    End, Exit, InputReport, LinkReport, NodeReport, NonFinite, Percentiles, RecordingReport, RunReport,
};
pub use settings::{
    LaunchSpec, NodeLaunch, NodeSettings, OnDeadline, OnHang, OnNonFinite, Policy, Refused, Restart, RunAs,
    SettingsError, WaitStrategy,
};
pub use watch::Watch;
pub use worker_main::{NODE_COMMAND, node_main};

use crate::recording::Packing;
use crate::time::Nanos;

/// How nodes run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Mode {
    /// Each in a process of its own: one that crashes takes no other with it.
    #[default]
    Processes,
    /// Each in a thread of this process: quicker to start, and visible to a debugger as one program.
    Threads,
}

/// What a run tells while it goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Time since the common start; negative before it.
    pub elapsed: Nanos,
    /// When the run will end, if that is known.
    pub duration: Option<Nanos>,
}

/// When a file of a recording is long enough.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rotate {
    /// At so many bytes, about.
    Bytes(u64),
    /// After such a time.
    Time(Nanos),
}

/// Takes warnings as they come up.
pub type Warner = Box<dyn FnMut(&str)>;

/// Settings of a run.
pub struct RunOptions {
    /// How long to run, from the common start; without it, until Ctrl-C.
    pub duration: Option<Nanos>,
    /// Seed of the nodes' random streams.
    pub seed: u64,
    /// The MCAP file to write.
    pub recording: Option<PathBuf>,
    /// When the recording goes on in a new file: `run.mcap`, `run.1.mcap`, and so on. Each can be read by itself.
    pub rotate: Option<Rotate>,
    /// How the recording is packed.
    pub packing: Packing,
    /// How single nodes are run, and what happens when they fail. It goes before [`mode`](Self::mode),
    /// [`spin`](Self::spin) and [`real_time`](Self::real_time), which hold for nodes of which it says nothing.
    pub launch: LaunchSpec,
    /// Which of the machines in the launch settings this one is; `None` for graphs on one machine.
    pub host: Option<String>,
    /// Processes or threads.
    pub mode: Mode,
    /// Environment variables for the processes of single nodes, by node. They are not recorded.
    pub private: BTreeMap<String, BTreeMap<String, String>>,
    /// How long before its time a step stops sleeping and polls instead, and how long after it a late message
    /// is polled for: punctual to a microsecond, at the price of the core's time. For nodes that have a core to
    /// themselves.
    pub spin: Nanos,
    /// Whether nodes ask the system to run them before all ordinary programs (`SCHED_FIFO`), and processes to
    /// keep their memory from being paged out. It takes a privilege (`CAP_SYS_NICE`, or an `rtprio` limit); a
    /// node that is refused says so in the warnings and runs like any program.
    pub real_time: bool,
    /// Whether nodes without a core are spread over the cores that exist, or left to the system.
    pub spread: bool,
    /// Whether Ctrl-C and requests to terminate stop the run in order.
    pub signals: bool,
    /// The program's arguments under which it calls [`node_main`].
    pub node_command: Vec<String>,
    /// Programs that run single nodes in place of this one, by node: each is a command to which what
    /// [`node_main`] takes is added. Nodes of [external](crate::registry::NodeKind::external) kinds need one.
    pub programs: BTreeMap<String, Vec<String>>,
    /// How long a node may take to be built, to connect, and to end.
    pub patience: Duration,
    /// Called about twenty times a second while the nodes get ready and while the run goes on; `false` stops it.
    pub progress: Option<Box<dyn FnMut(Progress) -> bool>>,
    /// Called with each warning, such as a setting that the system refuses, as soon as it is known. The
    /// [report](RunReport::warnings) has them, too.
    pub warn: Option<Warner>,
    /// Called when something happens to a node. The [report](RunReport::events) has it, too.
    pub events: Option<Watcher>,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            duration: None,
            seed: 0,
            recording: None,
            rotate: None,
            packing: Packing::default(),
            launch: LaunchSpec::default(),
            host: None,
            mode: Mode::default(),
            private: BTreeMap::new(),
            spin: 0,
            real_time: false,
            spread: true,
            signals: true,
            node_command: vec![NODE_COMMAND.into()],
            programs: BTreeMap::new(),
            patience: Duration::from_secs(10),
            progress: None,
            warn: None,
            events: None,
        }
    }
}

impl RunOptions {
    /// What holds for nodes of which the launch settings say nothing.
    fn base(&self) -> NodeSettings {
        let (policy, lock_memory) =
            if self.real_time { (Policy::Fifo, true) } else { (Policy::Other, false) };
        NodeSettings {
            run_as: match self.mode {
                Mode::Processes => RunAs::Process,
                Mode::Threads => RunAs::Thread,
            },
            policy,
            lock_memory,
            spin: self.spin,
            ..NodeSettings::default()
        }
    }
}

impl std::fmt::Debug for RunOptions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The private variables stay private here too.
        f.debug_struct("RunOptions")
            .field("duration", &self.duration)
            .field("seed", &self.seed)
            .field("recording", &self.recording)
            .field("launch", &self.launch)
            .field("host", &self.host)
            .field("mode", &self.mode)
            .field("programs", &self.programs)
            .field("spin", &self.spin)
            .field("real_time", &self.real_time)
            .field("spread", &self.spread)
            .finish_non_exhaustive()
    }
}
