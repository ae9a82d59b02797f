//! The parts of a recording that went on in new files, made one again.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::{Change, ClockReading, NodeTrack, Recording, RecordingError};

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
/// Where the graph ran on several machines, a part may also be the copy that a machine kept of what its own nodes recorded: what
/// the parts before it lack of these nodes is taken from it.
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
        if next.hosts != whole.hosts {
            return Err(foreign("its nodes were on other machines"));
        }
        if next.clock == whole.clock {
            for (track, more) in whole.nodes.iter_mut().zip(next.nodes) {
                add(track, more).map_err(|(node, step)| JoinError::Twice { part: path(), node, step })?;
            }
            whole.losses.extend(next.losses);
            whole.faults.extend(next.faults);
            whole.changes.extend(next.changes);
            whole.clocks.extend(next.clocks);
            // A part in the middle whose end is missing leaves a hole, and one at the end makes the recording end there.
            whole.truncated = next.truncated.or(whole.truncated);
        } else if !whole.hosts.is_empty() && next.clock.seed() == whole.clock.seed() {
            let mut common = 0;
            for (track, copy) in whole.nodes.iter_mut().zip(next.nodes) {
                common += fill(track, copy).map_err(foreign)?;
            }
            if common == 0 {
                return Err(foreign("it shares no step with it, and began by another clock"));
            }
            unite(&mut whole.losses, next.losses, |loss| (loss.to.clone(), loss.port.clone(), loss.seq));
            unite(&mut whole.faults, next.faults, |fault| (fault.node.clone(), fault.time));
            let change = |change: &Change| (change.node.clone(), change.time, change.to_string());
            unite(&mut whole.changes, next.changes, change);
            let reading =
                |reading: &ClockReading| (reading.host.clone(), reading.other.clone(), reading.time);
            unite(&mut whole.clocks, next.clocks, reading);
        } else {
            return Err(foreign("it began at another time, on another machine or with another seed"));
        }
        whole.duration = whole.duration.max(next.duration);
    }
    Ok(whole)
}

/// Adds what is not there yet, as the key tells.
fn unite<T, K: Ord>(all: &mut Vec<T>, more: Vec<T>, key: impl Fn(&T) -> K) {
    let known: BTreeSet<K> = all.iter().map(&key).collect();
    all.extend(more.into_iter().filter(|one| !known.contains(&key(one))));
}

/// Takes from a copy the messages and steps that are missing; gives how many steps the two have in common.
fn fill(track: &mut NodeTrack, copy: NodeTrack) -> Result<usize, &'static str> {
    let known = track.steps.len();
    let mut common = 0;
    for step in copy.steps {
        match track.steps[..known].binary_search_by_key(&step.seq, |step| step.seq) {
            Ok(place) if track.steps[place] == step => common += 1,
            Ok(_) => return Err("it is a copy of another run: a step of the same number ran otherwise"),
            Err(_) => track.steps.push(step),
        }
    }
    track.steps.sort_by_key(|step| step.seq);
    let known = track.messages.len();
    for message in copy.messages {
        if track.messages[..known].binary_search_by_key(&message.seq, |message| message.seq).is_err() {
            track.messages.push(message);
        }
    }
    track.messages.sort_by_key(|message| message.seq);
    Ok(common)
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
