//! What can go wrong while the machine is measured.

use std::io;

use crate::channel::ChannelError;
use crate::launch::RunError;

/// Why a measurement could not be made.
#[derive(Debug, thiserror::Error)]
pub enum LatencyError {
    /// The graph of two nodes could not be run.
    #[error("the graph of two nodes could not be run: {0}")]
    Run(#[from] RunError),
    /// A node of that graph ended before its time.
    #[error("the graph of two nodes ended early: {reason}")]
    Ended {
        /// What happened.
        reason: String,
    },
    /// A channel could not be made or used.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The system refused something.
    #[error("{what}: {source}. Check that temporary files can be written and processes started")]
    Io {
        /// What was tried.
        what: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// iceoryx2, used directly, refused an operation.
    #[error("raw iceoryx2: cannot {what} ({detail}); is shared memory full? (df /dev/shm)")]
    Iceoryx2 {
        /// What was tried.
        what: &'static str,
        /// What it says.
        detail: String,
    },
    /// The other process of a floor does not answer.
    #[error("the other process ({carrier}) did not answer within {seconds} s")]
    Silent {
        /// What was measured.
        carrier: String,
        /// How long was waited.
        seconds: u64,
    },
    /// Somebody stopped the measurement.
    #[error("the measurement was interrupted")]
    Interrupted,
}

impl LatencyError {
    /// An error of the system, with what was tried.
    pub(super) fn io(what: &'static str) -> impl Fn(io::Error) -> Self {
        move |source| Self::Io { what, source }
    }

    /// An error of iceoryx2, with what was tried.
    pub(super) fn iceoryx2(what: &'static str) -> impl Fn(&dyn std::fmt::Debug) -> Self {
        move |detail| Self::Iceoryx2 { what, detail: format!("{detail:?}") }
    }
}
