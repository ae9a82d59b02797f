//! Why nothing can be identified.

use parallax_model::fit::FitError;
use parallax_runtime::graph::GraphError;

use crate::augment::AugmentError;
use crate::batch::BatchError;
use crate::compiled::CompileError;
use crate::episode::EpisodeError;

/// Why parameters cannot be identified.
#[derive(Debug, thiserror::Error)]
pub enum IdentifyError {
    /// There is nothing to learn from.
    #[error("no recording is given")]
    NoRecording,
    /// Recordings are of different graphs.
    #[error("recording {recording} is of another graph than the first one; identify each graph by itself")]
    OtherGraph {
        /// Its number, from 1.
        recording: usize,
    },
    /// A recording cannot be used.
    #[error("recording {recording}: {source}")]
    Episode {
        /// Its number, from 1.
        recording: usize,
        /// Why.
        source: EpisodeError,
    },
    /// Something is named that is not there.
    #[error("{whose}: there is no {what} `{name}`; there is {known}")]
    Unknown {
        /// The entry that names it.
        whose: String,
        /// A node, a leaf, a parameter, a connection.
        what: &'static str,
        /// The name.
        name: String,
        /// The names that there are.
        known: String,
    },
    /// Bounds, start or prior of something are impossible.
    #[error("{whose}: {problem}")]
    Value {
        /// The entry.
        whose: String,
        /// What is wrong, and what to do.
        problem: String,
    },
    /// Nothing is to be found.
    #[error("nothing is to be identified: name at least one parameter, initial state or delay")]
    NoUnknown,
    /// Nothing is compared.
    #[error("nothing is compared with the recording: name at least one output")]
    NoOutput,
    /// Nothing is left of an output.
    #[error("{output}: no recorded value lies in the time that counts")]
    NoData {
        /// The output.
        output: String,
    },
    /// The loss is not finite anywhere that was tried.
    #[error(
        "no point that was tried gives finite predictions; narrow the bounds, or simulate at a higher rate"
    )]
    NotFinite,
    /// It was stopped before any point was known.
    #[error("stopped before anything was found")]
    Stopped,
    /// A checkpoint is of something else.
    #[error("the checkpoint is of another identification ({problem}); remove it, or take up that one")]
    Checkpoint {
        /// What differs.
        problem: String,
    },
    /// The recorded graph cannot be simulated with these changes.
    #[error(transparent)]
    Graph(#[from] GraphError),
    /// The computation graph cannot be made.
    #[error(transparent)]
    Augment(#[from] AugmentError),
    /// It cannot be compiled.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// It cannot run.
    #[error(transparent)]
    Batch(#[from] BatchError),
    /// The solver cannot start.
    #[error(transparent)]
    Fit(#[from] FitError),
}
