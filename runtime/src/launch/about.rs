//! What a run says of itself to whoever looks on: a file that does not change, and a page that says how far it is.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::{Acquire, Release};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::plan::Settings;
use super::report::End;
use super::settings::NodeSettings;
use crate::channel::futex::SharedPage;
use crate::channel::{ChannelError, Space};
use crate::graph::Graph;
use crate::time::Nanos;

/// The file in the run's directory. A node's files have its name and no hyphen in it.
const FILE: &str = "about-run.json";
/// The page beside it.
const PAGE: &str = "about-run.page";

/// What does not change while a run goes on.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct About {
    /// The graph's name.
    pub(super) graph: String,
    /// The launcher's process.
    pub(super) launcher: u32,
    /// When it was started, ns since 1970-01-01 UTC.
    pub(super) started: Nanos,
    pub(super) duration: Option<Nanos>,
    pub(super) recording: Option<PathBuf>,
    pub(super) nodes: Vec<NodeAbout>,
}

/// A node, as it was declared.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct NodeAbout {
    pub(super) name: String,
    pub(super) kind: String,
    /// Hz.
    pub(super) rate: f64,
    pub(super) settings: NodeSettings,
    pub(super) inputs: Vec<InputAbout>,
}

/// An input, as it was declared.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct InputAbout {
    /// The sender's place among the nodes.
    pub(super) from: usize,
    pub(super) port: String,
    pub(super) blocking: bool,
    pub(super) window: usize,
    pub(super) capacity: usize,
}

impl About {
    pub(super) fn new(graph: &Graph, settings: &Settings) -> Self {
        let input = |&connection: &usize| {
            let plan = &graph.connections()[connection];
            InputAbout {
                from: plan.from,
                port: plan.port.clone(),
                blocking: plan.blocking,
                window: plan.window,
                capacity: plan.capacity,
            }
        };
        let nodes = graph.nodes().iter().zip(&graph.spec().nodes).zip(&settings.nodes);
        let nodes = nodes.map(|((plan, spec), settings)| NodeAbout {
            name: plan.name.clone(),
            kind: spec.kind.clone(),
            rate: spec.rate,
            settings: settings.clone(),
            inputs: plan.inputs.iter().map(input).collect(),
        });
        Self {
            graph: graph.spec().name.clone(),
            launcher: std::process::id(),
            started: SystemTime::now()
                .duration_since(UNIX_EPOCH)
                .map_or(0, |now| Nanos::try_from(now.as_nanos()).unwrap_or(Nanos::MAX)),
            duration: settings.duration,
            recording: settings.recorder.as_ref().map(|recorder| recorder.path.clone()),
            nodes: nodes.collect(),
        }
    }

    /// Writes it into the run's directory: from then on the run is found by others.
    pub(super) fn write(&self, space: &Space) -> Result<(), ChannelError> {
        let path = space.path().join(FILE);
        let io = |source| ChannelError::Io { what: "cannot describe the run in", path, source };
        let text = serde_json::to_vec(self).map_err(|error| io(error.into()))?;
        space.replace(FILE, &text)
    }

    /// Reads it from a run's directory.
    pub(super) fn read(run: &Path) -> io::Result<Self> {
        Ok(serde_json::from_slice(&std::fs::read(run.join(FILE))?)?)
    }
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Its nodes come up.
    Starting,
    /// It goes on.
    Running,
    /// Its nodes are told to stop.
    Stopping,
    /// It is over.
    Over,
    /// Its launcher is gone without a word; its nodes stop by themselves.
    Abandoned,
}

const PHASE: usize = 0;
const END: usize = 1;
const END_NODE: usize = 2;
const EPOCH: usize = 3;

/// The page of the launcher.
#[derive(Debug)]
pub(super) struct RunPage(SharedPage);

impl RunPage {
    /// The launcher's own.
    pub(super) fn create(space: &Space) -> Result<Self, ChannelError> {
        let path = space.path().join(PAGE);
        let page = SharedPage::create(&path);
        let io = |source| ChannelError::Io { what: "cannot make the page of the run", path, source };
        page.map(Self).map_err(io)
    }

    /// Somebody else's, to look at.
    pub(super) fn look_at(run: &Path) -> io::Result<Self> {
        SharedPage::look_at(&run.join(PAGE)).map(Self)
    }

    fn set(&self, cell: usize, value: u64) {
        self.0.cell(cell).store(value, Release);
    }

    fn get(&self, cell: usize) -> u64 {
        self.0.cell(cell).load(Acquire)
    }

    /// The run has begun: its clock has this epoch.
    pub(super) fn running(&self, epoch: Nanos) {
        self.set(EPOCH, epoch as u64);
        self.set(PHASE, 1);
    }

    /// The run ends, for this reason.
    pub(super) fn stopping(&self, end: &End, graph: &Graph) {
        let (kind, node) = match end {
            End::Duration => (1, 0),
            End::Signal => (2, 0),
            End::Node { node } => (3, graph.index(node).unwrap_or(0)),
            End::Host { .. } => (4, 0),
            End::Link { .. } => (5, 0),
        };
        self.set(END_NODE, node as u64);
        self.set(END, kind);
        self.set(PHASE, 2);
    }

    pub(super) fn over(&self) {
        self.set(PHASE, 3);
    }

    pub(super) fn phase(&self) -> Phase {
        match self.get(PHASE) {
            0 => Phase::Starting,
            1 => Phase::Running,
            2 => Phase::Stopping,
            _ => Phase::Over,
        }
    }

    /// Why it ended, if it has.
    pub(super) fn end(&self, about: &About) -> Option<End> {
        let node = || about.nodes.get(self.get(END_NODE) as usize).map(|node| node.name.clone());
        match self.get(END) {
            1 => Some(End::Duration),
            2 => Some(End::Signal),
            3 => node().map(|node| End::Node { node }),
            // What it was is in the report.
            4 => Some(End::Host { host: String::new(), why: String::new() }),
            5 => Some(End::Link { problem: String::new() }),
            _ => None,
        }
    }

    /// The reading of the monotonic clock at the common start; `None` before it is known.
    pub(super) fn epoch(&self) -> Option<Nanos> {
        (self.get(PHASE) > 0).then(|| self.get(EPOCH) as Nanos)
    }
}
