//! Graphs whose nodes run on several machines.
//!
//! Each machine runs the launcher with the same graph and the same launch settings, and its own nodes. One process, the link,
//! carries the messages of connections that cross, in place of the nodes on the other machines; it is iceoryx2's own
//! link over zenoh. For the launcher the nodes of other machines are members like any other, whose signs of life the link copies.

mod bridge;
#[cfg(feature = "link")]
mod carrier;
#[cfg(feature = "link")]
mod clock;
mod connections;
mod hosts;
#[cfg(feature = "link")]
mod mirror;
mod page;
#[cfg(feature = "link")]
mod post;
#[cfg(feature = "link")]
mod serve;
#[cfg(feature = "link")]
mod session;
#[cfg(feature = "link")]
mod wire;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

pub(super) use bridge::{Begin, Bridge, Turn};
pub use connections::{ConnectionLaunch, LinkPriority};
pub(super) use connections::{next_that_crosses, that_cross};
pub(super) use hosts::Placement;
pub use hosts::{HostSpec, LinkSpec, OnGone};
pub(super) use page::ClockPage;
#[cfg(feature = "link")]
pub(super) use serve::serve;

use super::report::Exit;
use crate::recording::{ClockReading, Fault};
use crate::time::Nanos;

/// What the link is called among nodes, whose names are made of letters, digits and underscores.
pub(super) const NAME: &str = "@link";
/// What its wake-up is called.
pub(super) const WAKE: &str = "@link/wake";

/// Why a machine's run is over when it has come to its end.
pub(super) const TIME_OVER: &str = "its time is over";

/// From the launcher to its link.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Word {
    /// All nodes of this machine wait for the common start.
    Ready,
    /// The run goes on; its clock has this epoch.
    Started { epoch: Nanos },
    /// How nodes of this machine ended, as far as they have.
    Exits { exits: BTreeMap<String, Exit> },
    /// Something happened to a node of this machine, which another one records.
    Fault { fault: Fault },
    /// All nodes of this machine have stopped, for this reason.
    Over { why: String, exits: BTreeMap<String, Exit> },
}

/// From the link to its launcher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum News {
    /// These machines are not ready yet.
    Waits { waits_for: Vec<String> },
    /// All machines wait for the common start.
    AllReady,
    /// The leading machine has begun: at this time of this machine's monotonic clock. Or the run goes on without this machine,
    /// which takes part again.
    Begin { epoch: Nanos, again: bool },
    /// Nothing has come from a machine for so long.
    Silent { host: String, silent: Nanos },
    /// It is heard again.
    Back { host: String },
    /// It has been silent for so long that it counts as gone.
    Gone { host: String, silent: Nanos },
    /// Its run is over.
    Over { host: String, why: String },
    /// It was started again, and takes part again.
    Again { host: String },
    /// Something happened to nodes of another machine: to be recorded.
    Faults { faults: Vec<Fault> },
    /// Nodes of it ended.
    Exits { host: String, exits: BTreeMap<String, Exit> },
    /// How the clocks stand to each other.
    Clocks { readings: Vec<ClockReading> },
    /// Something does not work as it should; the link goes on.
    Trouble { text: String },
    /// Everything has been passed on that will be.
    Finished { crossings: Vec<Crossing>, exits: BTreeMap<String, Exit> },
}

/// What became of the messages of one channel that crosses.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Crossing {
    /// The node, or `NODE/record` for its records.
    pub channel: String,
    /// Messages that were handed to the network here.
    pub sent: u64,
    /// Messages that were held back here, because the connection lets only [one of so many](ConnectionLaunch::every) cross.
    #[serde(default)]
    pub held_back: u64,
    /// Messages that came from the network.
    pub received: u64,
    /// Messages that another machine handed to the network and that did not come.
    pub lost: u64,
    /// Messages that came with a length that they cannot have; they are passed on as empty ones, for receivers to count.
    pub malformed: u64,
    /// Bytes sent and received.
    pub bytes: u64,
}
