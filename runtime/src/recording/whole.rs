//! Writes a recording that is whole already.

use std::path::Path;

use super::{
    Access, Description, MessageRecord, NodeDescription, NodeTrack, Packing, Recording, RecordingError,
    RecordingWriter, StepRecord,
};
use crate::time::Nanos;

/// Writes a whole recording.
///
/// # Errors
///
/// As [`RecordingWriter`].
pub fn write(path: &Path, recording: &Recording) -> Result<(), RecordingError> {
    let description = Description {
        graph: recording.graph.clone(),
        clock: recording.clock.clone(),
        nodes: recording
            .nodes
            .iter()
            .map(|track| NodeDescription {
                name: track.name.clone(),
                layout: track.layout.clone(),
                initial: track.initial.clone(),
                stand_in: track.stand_in,
                data: track.messages.iter().map(|message| message.data.len()).max().unwrap_or(0),
            })
            .collect(),
        hosts: recording.hosts.clone(),
    };
    let records = in_order(&recording.nodes);
    let origin = records.iter().map(|record| record.time).min().unwrap_or(0).min(0);
    let mut writer =
        RecordingWriter::with_origin(path, &description, origin, Access::Owner, Packing::default())?;
    for Timed { node, record, .. } in records {
        match record {
            Record::Message(MessageRecord { seq, sent, payload, data }) => {
                writer.message_with_data(node, *seq, *sent, payload, data)?
            }
            Record::Step(step) => writer.step_record(node, step)?,
        }
    }
    recording.losses.iter().try_for_each(|loss| writer.loss(loss))?;
    recording.faults.iter().try_for_each(|fault| writer.fault(fault))?;
    recording.changes.iter().try_for_each(|change| writer.change(change))?;
    recording.clocks.iter().try_for_each(|reading| writer.clock(reading))?;
    writer.finish(recording.duration)
}

/// One record of a recording, and when it happened.
struct Timed<'a> {
    /// The latest time of its track so far: each track keeps its own order, whatever its times say.
    at: Nanos,
    time: Nanos,
    node: usize,
    record: Record<'a>,
}

enum Record<'a> {
    Message(&'a MessageRecord),
    Step(&'a StepRecord),
}

/// All records in the order of their times.
fn in_order(tracks: &[NodeTrack]) -> Vec<Timed<'_>> {
    let mut records = Vec::new();
    for (node, track) in tracks.iter().enumerate() {
        let mut at = Nanos::MIN;
        for message in &track.messages {
            at = at.max(message.sent);
            records.push(Timed { at, time: message.sent, node, record: Record::Message(message) });
        }
        at = Nanos::MIN;
        for step in &track.steps {
            at = at.max(step.end);
            records.push(Timed { at, time: step.end, node, record: Record::Step(step) });
        }
    }
    records.sort_by_key(|record| record.at);
    records
}
