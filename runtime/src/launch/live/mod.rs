//! Running graphs, seen from outside: found, looked at, never disturbed.
//!
//! A [`LiveRun`] maps the pages that the nodes write anyhow, for reading only. Two [`Sample`]s of it, taken some time
//! apart, make a [`Snapshot`]: rates and percentiles of what happened between them, and the counts so far. No node is
//! asked for anything.
//!
//! ```no_run
//! use parallax_runtime::launch::{LiveRun, live_runs};
//! # fn main() -> Result<(), parallax_runtime::launch::LiveError> {
//! for name in live_runs()? {
//!     println!("{}: {}", name.id, name.graph);
//! }
//! let run = LiveRun::find(None)?;
//! let before = run.sample();
//! std::thread::sleep(std::time::Duration::from_secs(1));
//! for node in run.snapshot(&before, &run.sample()).nodes {
//!     println!("{} makes {:?} steps a second", node.node, node.rate);
//! }
//! # Ok(())
//! # }
//! ```

mod sample;
mod snapshot;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use sample::Sample;
pub use snapshot::{ConnectionView, NodeState, NodeView, RecorderView, Snapshot};

use super::about::{About, Phase, RunPage};
use super::ledger::Ledger;
use super::report::End;
use super::vitals::VitalsView;
use super::watch::Watch;
use crate::channel::{ChannelError, live_directories};
use crate::time::Nanos;

/// What a running graph is called.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunName {
    /// Its own name on this machine: the launcher's process and a number.
    pub id: String,
    /// The graph's name.
    pub graph: String,
    /// The launcher's process.
    pub launcher: u32,
    /// When it was started, ns since 1970-01-01 UTC.
    pub started: Nanos,
    /// Its nodes.
    pub nodes: Vec<String>,
}

impl RunName {
    /// Whether somebody who writes `text` may mean this run: its id, the launcher's process, or the graph's name.
    fn answers_to(&self, text: &str) -> bool {
        self.id == text || self.graph == text || self.launcher.to_string() == text
    }
}

/// Why a running graph cannot be looked at or spoken to.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// Nothing runs.
    #[error("no graph of this user is running; start one with `parallax run`")]
    None,
    /// Nothing of that name runs.
    #[error("no graph of this user that is called {name} is running (there is: {known})")]
    Unknown {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// Several run.
    #[error("several graphs are running, say which one by its first column:\n{list}")]
    Several {
        /// One line for each.
        list: String,
    },
    /// Shared memory does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The run was there, and ended before it could be looked at.
    #[error("the run {name} has ended")]
    Ended {
        /// Its name.
        name: String,
    },
}

/// The graphs of this user that run on this machine, sorted by name. One that is still being made is not among them.
///
/// # Errors
///
/// [`LiveError::Channel`] when there is no shared memory.
pub fn live_runs() -> Result<Vec<RunName>, LiveError> {
    Ok(found()?.into_iter().map(|found| found.name).collect())
}

/// A run, found.
pub(super) struct Found {
    pub(super) path: PathBuf,
    pub(super) name: RunName,
    about: About,
}

fn found() -> Result<Vec<Found>, LiveError> {
    let describe = |path: PathBuf| {
        // One that is being made, or removed, has none.
        let about = About::read(&path).ok()?;
        let name = RunName {
            id: path.file_name()?.to_str()?.to_owned(),
            graph: about.graph.clone(),
            launcher: about.launcher,
            started: about.started,
            nodes: about.nodes.iter().map(|node| node.name.clone()).collect(),
        };
        Some(Found { path, name, about })
    };
    Ok(live_directories()?.into_iter().filter_map(describe).collect())
}

/// The run that is meant: by its id, its launcher's process, its graph's name, or because it is the only one.
pub(super) fn find(name: Option<&str>) -> Result<Found, LiveError> {
    let mut runs = found()?;
    if runs.is_empty() {
        return Err(LiveError::None);
    }
    let known = || runs.iter().map(|run| format!("{} ({})", run.name.id, run.name.graph)).collect::<Vec<_>>();
    if let Some(name) = name {
        let known = known();
        runs.retain(|run| run.name.answers_to(name));
        if runs.is_empty() {
            return Err(LiveError::Unknown { name: name.into(), known: known.join(", ") });
        }
    }
    match (runs.len(), runs.pop()) {
        (1, Some(run)) => Ok(run),
        (_, last) => {
            let line = |run: &Found| {
                let RunName { id, graph, nodes, .. } = &run.name;
                format!("  {id}  {graph}  ({})", nodes.join(", "))
            };
            let list: Vec<String> = runs.iter().chain(&last).map(line).collect();
            Err(LiveError::Several { list: list.join("\n") })
        }
    }
}

/// A running graph, looked at from outside.
#[derive(Debug)]
pub struct LiveRun {
    name: RunName,
    path: PathBuf,
    about: About,
    page: RunPage,
    nodes: Vec<VitalsView>,
}

impl LiveRun {
    /// Finds a run of this user: by its id, its launcher's process or its graph's name; without a name the only one that
    /// there is.
    ///
    /// # Errors
    ///
    /// [`LiveError`]: none, several, or not that one.
    pub fn find(name: Option<&str>) -> Result<Self, LiveError> {
        let Found { path, name, about } = find(name)?;
        let ended = |_| LiveError::Ended { name: name.id.clone() };
        let page = RunPage::look_at(&path).map_err(ended)?;
        let nodes = about.nodes.iter().map(|node| VitalsView::open(&path, &node.name, node.inputs.len()));
        let nodes: Vec<VitalsView> = nodes.collect::<Result<_, _>>()?;
        Ok(Self { name, path, about, page, nodes })
    }

    /// What it is called.
    pub fn name(&self) -> &RunName {
        &self.name
    }

    /// The run's directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How far it is.
    pub fn phase(&self) -> Phase {
        match self.page.phase() {
            Phase::Over => Phase::Over,
            // Its directory is removed last, by whoever is last.
            _ if !self.path.exists() => Phase::Over,
            _ if !sample::alive(self.about.launcher) => Phase::Abandoned,
            phase => phase,
        }
    }

    /// Why it ended, if it has said so.
    pub fn end(&self) -> Option<End> {
        self.page.end(&self.about)
    }

    /// The files that it has been recorded in so far, in the order of time; `None` where it is not recorded on this machine.
    pub fn recording(&self) -> Option<Vec<PathBuf>> {
        self.about.recording.as_ref()?;
        Some(Ledger::look_at(&self.path).map_or_else(Vec::new, |ledger| ledger.files))
    }

    /// Lets the recorder hand on what it has ten times a second, for as long as the watch is kept up.
    ///
    /// # Errors
    ///
    /// What the system says; the run may be over.
    pub fn watch(&self) -> std::io::Result<Watch> {
        Watch::begin(&self.path)
    }

    /// Reads all counts.
    pub fn sample(&self) -> Sample {
        Sample::take(self)
    }

    /// What happened between two samples, and what has been counted until the second.
    pub fn snapshot(&self, before: &Sample, after: &Sample) -> Snapshot {
        Snapshot::between(self, before, after)
    }
}
