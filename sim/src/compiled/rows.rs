//! Writes the rows of one slot.

use super::build::{Edge, Track};
use super::{InputRows, Rows, Slot};

/// The slot `index` of `slots`, in which `node` steps, along all episodes. `inputs` are the connections that it reads.
pub(super) fn slot(
    tracks: &[Track<'_>],
    index: usize,
    slots: usize,
    node: usize,
    inputs: &[(usize, &Edge)],
    lengths: &[u32],
    warm_up: usize,
) -> Slot {
    let passes = tracks.first().map_or(0, |track| track.at.len() / slots);
    let room = passes * tracks.len();
    let mut rows = Rows {
        run: Vec::with_capacity(room),
        seq: Vec::with_capacity(room),
        due: Vec::with_capacity(room),
        start: Vec::with_capacity(room),
        write: Vec::with_capacity(room),
        constant_write: None,
        inputs: inputs.iter().map(|&(connection, edge)| empty(connection, edge, room)).collect(),
    };
    let mut always = true;
    for (track, &length) in tracks.iter().zip(lengths) {
        for pass in 0..passes {
            match usize::try_from(track.at[pass * slots + index]) {
                Ok(seq) => push(&mut rows, track, node, seq, inputs),
                Err(_) => {
                    always &= pass >= warm_up + length as usize;
                    repeat(&mut rows);
                }
            }
        }
    }
    // What comes before the first step is like the first step.
    if let Some(first) = rows.run.iter().position(|&run| run == 1) {
        backfill(&mut rows.seq, first, 1);
        backfill(&mut rows.due, first, 1);
        backfill(&mut rows.start, first, 1);
        backfill(&mut rows.write, first, 1);
        for input in &mut rows.inputs {
            backfill(&mut input.seq, first, input.candidates);
            backfill(&mut input.sent, first, input.candidates);
            backfill(&mut input.received, first, input.candidates);
            backfill(&mut input.read, first, input.candidates);
        }
    }
    rows.constant_write = constant(rows.write.iter().copied());
    for input in &mut rows.inputs {
        let column = |candidate| input.read.iter().skip(candidate).step_by(input.candidates).copied();
        input.constant_read = (0..input.candidates).map(|candidate| constant(column(candidate))).collect();
    }
    Slot { node, always, rows }
}

fn empty(connection: usize, edge: &Edge, room: usize) -> InputRows {
    let room = room * edge.candidates;
    InputRows {
        connection,
        from: edge.from,
        window: edge.window,
        candidates: edge.candidates,
        seq: Vec::with_capacity(room),
        sent: Vec::with_capacity(room),
        received: Vec::with_capacity(room),
        read: Vec::with_capacity(room),
        constant_read: Vec::new(),
        trainable: edge.trainable,
        from_output: edge.from_output,
    }
}

/// A pass in which step `seq` runs.
fn push(rows: &mut Rows, track: &Track<'_>, node: usize, seq: usize, inputs: &[(usize, &Edge)]) {
    let steps = &track.episode.nodes[node];
    rows.run.push(1);
    rows.seq.push(seq as i32);
    rows.due.push(steps.due[seq]);
    rows.start.push(steps.start[seq]);
    rows.write.push(track.place[node][seq]);
    for (rows, &(connection, edge)) in rows.inputs.iter_mut().zip(inputs) {
        let row = seq * edge.candidates..(seq + 1) * edge.candidates;
        for (offset, &number) in track.seen[connection][row.clone()].iter().enumerate() {
            let (sent, earliest) = edge.times(track.episode, number);
            rows.seq.push(number as i32);
            rows.sent.push(sent);
            rows.received.push(
                earliest
                    .unwrap_or_else(|| track.episode.connections[connection].received[row.start + offset]),
            );
            rows.read.push(match usize::try_from(number) {
                Ok(number) => track.place[edge.from][number],
                Err(_) => track.initial[edge.from],
            });
        }
    }
}

/// A pass in which nothing runs: as the last one in which something did.
fn repeat(rows: &mut Rows) {
    rows.run.push(0);
    again(&mut rows.seq, 1);
    again(&mut rows.due, 1);
    again(&mut rows.start, 1);
    again(&mut rows.write, 1);
    for input in &mut rows.inputs {
        again(&mut input.seq, input.candidates);
        again(&mut input.sent, input.candidates);
        again(&mut input.received, input.candidates);
        again(&mut input.read, input.candidates);
    }
}

/// Appends the last row of a column once more, zeros where there is none.
fn again<T: Copy + Default>(column: &mut Vec<T>, width: usize) {
    match column.len().checked_sub(width) {
        Some(last) => column.extend_from_within(last..),
        None => column.resize(width, T::default()),
    }
}

/// Copies row `first` of a column into all rows before it.
fn backfill<T: Copy>(column: &mut [T], first: usize, width: usize) {
    for row in 0..first {
        column.copy_within(first * width..(first + 1) * width, row * width);
    }
}

/// The value that all have.
fn constant(mut values: impl Iterator<Item = u32>) -> Option<u32> {
    let first = values.next()?;
    values.all(|value| value == first).then_some(first)
}
