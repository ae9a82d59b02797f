//! The parts of a recording that went on in new files, made one again.

use std::path::{Path, PathBuf};

use super::{NodeTrack, Recording, RecordingError};

/// Why parts cannot be joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// There is nothing to join.
    #[error("there is no part to join")]
    Nothing,
    /// A part cannot be read.
    #[error(transparent)]
    Part(#[from] RecordingError),
    /// A part is of another run.
    #[error("{part} is no part of the run of {first}: {problem}")]
    Foreign {
        /// The first part.
        first: PathBuf,
        /// The part that does not belong to it.
        part: PathBuf,
        /// What differs.
        problem: &'static str,
    },
    /// Two parts hold the same step.
    #[error(
        "{part} holds step {step} of node `{node}`, which an earlier part holds: it was given twice, or in another order"
    )]
    Twice {
        /// The later part.
        part: PathBuf,
        /// The node.
        node: String,
        /// The step.
        step: u64,
    },
}

/// Reads the parts of one run, in the order of time, as one recording.
///
/// # Errors
///
/// [`JoinError`]: a part cannot be read, is of another run, or was given before.
pub fn join<P: AsRef<Path>>(parts: &[P]) -> Result<Recording, JoinError> {
    let (first, others) = parts.split_first().ok_or(JoinError::Nothing)?;
    let mut whole = Recording::read(first)?;
    for part in others {
        let path = || part.as_ref().to_path_buf();
        let next = Recording::read(part)?;
        let foreign =
            |problem| JoinError::Foreign { first: first.as_ref().to_path_buf(), part: path(), problem };
        if next.graph != whole.graph {
            return Err(foreign("it is of another graph"));
        }
        if next.clock != whole.clock {
            return Err(foreign("it began at another time, on another machine or with another seed"));
        }
        if next.hosts != whole.hosts {
            return Err(foreign("its nodes were on other machines"));
        }
        for (track, more) in whole.nodes.iter_mut().zip(next.nodes) {
            add(track, more).map_err(|(node, step)| JoinError::Twice { part: path(), node, step })?;
        }
        whole.losses.extend(next.losses);
        whole.faults.extend(next.faults);
        whole.changes.extend(next.changes);
        whole.clocks.extend(next.clocks);
        whole.duration = whole.duration.max(next.duration);
        // A part in the middle whose end is missing leaves a hole, and one at the end makes the recording end there.
        whole.truncated = next.truncated.or(whole.truncated);
    }
    Ok(whole)
}

/// Adds the messages and steps of a later part; gives the first step that is there already.
fn add(track: &mut NodeTrack, more: NodeTrack) -> Result<(), (String, u64)> {
    let last = track.steps.last().map(|step| step.seq);
    if let (Some(last), Some(step)) = (last, more.steps.first())
        && step.seq <= last
    {
        return Err((track.name.clone(), step.seq));
    }
    track.messages.extend(more.messages);
    track.steps.extend(more.steps);
    Ok(())
}
