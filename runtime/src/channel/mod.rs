//! Shared-memory channels between nodes, over iceoryx2.
//!
//! A [`Space`] is one run's own corner of shared memory: its own directory and its own file prefix, so that
//! two runs on one machine never meet and cleaning up is the removal of a directory. An [`Endpoint`] is one
//! process's (or thread's) access to a space; it opens [`Publisher`]s, [`Subscriber`]s and [`Waker`]s for
//! [`Topic`]s.
//!
//! Messages are short slices of 64-bit words, which are valid for any bit pattern; their length is checked
//! on arrival, and the hash of the message layout is an attribute of the service, so that two programs that
//! disagree about a layout cannot exchange a message.
//!
//! What is large, such as an image, need not be copied: [`Publisher::loan`] gives the place in shared memory where the
//! message is to be written, [`Subscriber::take`] the place where it lies, for as long as the [`View`] is kept. 8 MB
//! then cost what 64 bytes cost.
//!
//! ```
//! use parallax_runtime::channel::{Endpoint, Space, Topic};
//!
//! # fn main() -> Result<(), parallax_runtime::channel::ChannelError> {
//! let space = Space::create()?;
//! let topic = Topic { name: "camera".into(), layout: 7, words: 4, buffer: 8, subscribers: 1, held: 0 };
//! let here = Endpoint::new(&space)?;
//! let service = here.create(&topic)?;
//! let subscriber = service.subscriber()?;
//! let publisher = service.publisher()?;
//! assert_eq!(publisher.send(2, |i| i as u64)?, 1);
//! let mut got = Vec::new();
//! subscriber.receive(|words| got.extend_from_slice(words))?;
//! assert_eq!(got, [0, 1]);
//! # Ok(())
//! # }
//! ```

mod endpoint;
pub(crate) mod futex;
mod place;
mod populate;
mod publisher;
mod space;
mod stale;
mod subscriber;
mod wake;

use std::fmt::Debug;
use std::io;
use std::path::PathBuf;

pub use endpoint::{Endpoint, Service};
pub use publisher::{Loan, Publisher};
pub use space::Space;
pub(crate) use space::free_bytes;
pub use stale::clean_stale;
pub(crate) use stale::{live_directories, stale_runs};
pub use subscriber::{Subscriber, View};
pub use wake::{Listener, Waker};

/// The kind of iceoryx2's service that everything here is one of.
type Ipc = iceoryx2::service::ipc::Service;

/// What the two ends of a channel must agree on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Name of the channel, unique in the run.
    pub name: String,
    /// Hash of the layout of its messages.
    pub layout: u64,
    /// Largest length of a message, in 64-bit words.
    pub words: usize,
    /// Messages that a subscriber can have waiting; the oldest is replaced when one more arrives, which the
    /// subscriber sees as a gap in the sequence numbers.
    pub buffer: usize,
    /// Number of subscribers that the graph gives this topic.
    pub subscribers: usize,
    /// Messages that a subscriber may keep in place at a time, as [`View`]s.
    pub held: usize,
}

impl Topic {
    /// Shared memory that this topic needs, in bytes, roughly: the samples of its publisher and a page for
    /// each of the small segments around them.
    pub fn memory(&self) -> u64 {
        let samples = self.subscribers * (self.buffer + self.borrowed()) + LOANED;
        let sample = self.words * 8 + SAMPLE_OVERHEAD;
        (samples * sample) as u64 + (self.subscribers as u64 + 4) * 4096
    }

    /// Samples that one subscriber holds at a time: those it keeps, and the one being looked at.
    fn borrowed(&self) -> usize {
        self.held + 1
    }
}

/// Samples that one publisher fills at a time.
const LOANED: usize = 1;
/// Bytes around the payload of a sample: header and allocator bookkeeping.
const SAMPLE_OVERHEAD: usize = 96;

/// What can go wrong with shared memory and the channels in it.
#[derive(Debug, thiserror::Error)]
pub enum ChannelError {
    /// The machine offers no shared memory where it is expected.
    #[error(
        "there is no shared memory at {path}: {reason}. Mount a tmpfs there (mount -t tmpfs tmpfs {path}), or in a \
         container pass --shm-size or --ipc=host"
    )]
    NoSharedMemory {
        /// Where it was looked for.
        path: PathBuf,
        /// What was found instead.
        reason: String,
    },
    /// Shared memory exists, and is full.
    #[error(
        "shared memory at {path} has {free} bytes free and the graph needs about {needed}. Remove what fills it, \
         enlarge it (mount -o remount,size=1G {path}; in a container --shm-size), or use smaller windows"
    )]
    Full {
        /// Where shared memory lies.
        path: PathBuf,
        /// Bytes that the graph needs.
        needed: u64,
        /// Bytes that are free.
        free: u64,
    },
    /// A file operation in the run's directory failed.
    #[error("{what} {path}: {source}. Check that the directory belongs to you and that there is space")]
    Io {
        /// What was tried, as a verb.
        what: &'static str,
        /// On which path.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// Somebody else owns the directory of this user's runs.
    #[error("{path} belongs to another user or is no directory; ask its owner to remove it")]
    ForeignDirectory {
        /// The directory.
        path: PathBuf,
    },
    /// Two ends disagree about the layout of a message.
    #[error(
        "channel {topic} carries messages of another layout than expected here (expected hash {expected:016x}). \
         Both ends must be built from the same message types: rebuild and start all nodes from one binary"
    )]
    Layout {
        /// Name of the channel.
        topic: String,
        /// Hash of the layout on this side.
        expected: u64,
    },
    /// A message is longer than the channel allows.
    #[error("a message of {words} words does not fit channel {topic}, made for {limit}")]
    TooLong {
        /// Name of the channel.
        topic: String,
        /// Words of the message.
        words: usize,
        /// Words that the channel was made for.
        limit: usize,
    },
    /// iceoryx2 refused an operation.
    #[error(
        "channel {topic}: cannot {what} ({detail}). If a run was killed, starting again cleans up after it"
    )]
    Transport {
        /// Name of the channel.
        topic: String,
        /// What was tried.
        what: &'static str,
        /// What iceoryx2 says.
        detail: String,
    },
}

/// A transport error with the channel's name and what was tried.
fn failed(topic: &str, what: &'static str) -> impl Fn(&dyn Debug) -> ChannelError {
    move |detail| ChannelError::Transport { topic: topic.into(), what, detail: format!("{detail:?}") }
}
