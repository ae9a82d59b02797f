//! Takes the records of all nodes from shared memory and writes them to a file.

use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use super::error::RunError;
use super::plan::{self, CONSUMED, INITIAL, INPUT_HEAD, LOSS, LOSS_WORDS, STEP, STEP_HEAD};
use crate::channel::{Endpoint, Space, Subscriber};
use crate::graph::Graph;
use crate::node::Consumed;
use crate::recording::{
    Clock, Description, Fault, InputRecord, Loss, RecordingError, RecordingWriter, StepRecord,
};
use crate::time::Nanos;

/// Time between two visits to the channels: short against the seconds of room that they have, long against a step.
const VISIT: Duration = Duration::from_millis(4);

/// What the launcher tells the recorder.
enum Order {
    Start(Clock),
    Fault(Fault),
    Finish(Nanos),
}

/// Records that did not reach the recorder, by node.
pub(super) type Lost = Vec<(String, u64)>;

/// The thread that records.
pub(super) struct Recorder {
    orders: Sender<Order>,
    thread: Option<JoinHandle<Result<Lost, RunError>>>,
    /// The file, while it is empty because no run has begun.
    empty: Option<PathBuf>,
}

impl Recorder {
    /// Starts the recorder; it listens to all nodes when this returns.
    pub(super) fn start(graph: &Graph, space: &Space, path: &Path) -> Result<Self, RunError> {
        // Found out now, and not when the run is over. An older recording stays until the new one begins.
        let existed = path.exists();
        let create = |source| RecordingError::Io { path: path.into(), what: "create the file", source };
        drop(OpenOptions::new().write(true).create(true).truncate(false).open(path).map_err(create)?);
        let empty = (!existed).then(|| path.to_path_buf());
        let (orders, inbox) = channel();
        let (ready, opened) = channel();
        let (graph, path, run) = (graph.clone(), path.to_path_buf(), space.path().to_path_buf());
        let body = move || {
            let streams = match open(&graph, &run) {
                Ok(streams) => streams,
                Err(error) => {
                    // The launcher waits for this very message.
                    let _ = ready.send(Some(error));
                    return Ok(Vec::new());
                }
            };
            let _ = ready.send(None);
            record(&graph, path, streams, &inbox)
        };
        let thread =
            std::thread::Builder::new().name("recorder".into()).spawn(body).map_err(RunError::Thread)?;
        match opened.recv() {
            Ok(None) => Ok(Self { orders, thread: Some(thread), empty }),
            Ok(Some(error)) => Err(error),
            Err(_) => Err(RunError::Recorder),
        }
    }

    /// The run's clock is known: writing can begin.
    pub(super) fn begin(&mut self, clock: Clock) {
        self.empty = None;
        self.tell(Order::Start(clock));
    }

    pub(super) fn fault(&self, fault: Fault) {
        self.tell(Order::Fault(fault));
    }

    fn tell(&self, order: Order) {
        // A recorder that has ended says why when it is joined.
        let _ = self.orders.send(order);
    }

    /// Whether it ended before it was told to: then something is wrong with the file.
    pub(super) fn ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Takes what is left and closes the file; gives the records that did not arrive, by node.
    pub(super) fn finish(mut self, duration: Nanos) -> Result<Lost, RunError> {
        self.tell(Order::Finish(duration));
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            _ => Err(RunError::Recorder),
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // After a run that was not made, the thread must be gone before the run's shared memory is.
        if let Some(thread) = self.thread.take() {
            self.tell(Order::Finish(0));
            let _ = thread.join();
        }
        if let Some(path) = self.empty.take() {
            // A file that cannot be removed is empty, and the reader says so.
            let _ = std::fs::remove_file(path);
        }
    }
}

/// One node's records.
struct Stream {
    subscriber: Subscriber,
    /// Number of the record that comes next.
    next: u64,
    lost: u64,
}

fn open(graph: &Graph, run: &Path) -> Result<Vec<Stream>, RunError> {
    let endpoint = Endpoint::new(&Space::attach(run)?)?;
    (0..graph.nodes().len())
        .map(|node| {
            let subscriber = endpoint.open(&plan::records(graph, node))?.subscriber()?;
            Ok(Stream { subscriber, next: 0, lost: 0 })
        })
        .collect()
}

/// A record taken from a channel.
struct Taken {
    time: Nanos,
    node: usize,
    words: Vec<u64>,
}

fn record(
    graph: &Graph,
    path: PathBuf,
    mut streams: Vec<Stream>,
    orders: &Receiver<Order>,
) -> Result<Lost, RunError> {
    let mut writer = None;
    let mut taken = Vec::new();
    loop {
        let mut finish = None;
        match orders.recv_timeout(VISIT) {
            Ok(Order::Start(clock)) => {
                writer = Some(RecordingWriter::create(&path, &Description::new(graph, clock))?);
            }
            Ok(Order::Fault(fault)) => {
                if let Some(writer) = &mut writer {
                    writer.fault(&fault)?;
                }
                continue;
            }
            Ok(Order::Finish(duration)) => finish = Some(duration),
            // The launcher is gone without a word: it failed before the run began.
            Err(RecvTimeoutError::Disconnected) => finish = Some(0),
            Err(RecvTimeoutError::Timeout) => {}
        }
        let Some(file) = &mut writer else {
            if finish.is_some() {
                return Ok(Vec::new());
            }
            continue;
        };
        take(&mut streams, &mut taken)?;
        // The order of the file is that of time, as far as one visit sees it.
        taken.sort_by_key(|record| record.time);
        for record in taken.drain(..) {
            write(graph, file, &record)?;
        }
        if let (Some(duration), Some(file)) = (finish, writer.take_if(|_| finish.is_some())) {
            file.finish(duration)?;
            let lost = streams.iter().zip(graph.nodes()).filter(|(stream, _)| stream.lost > 0);
            return Ok(lost.map(|(stream, node)| (node.name.clone(), stream.lost)).collect());
        }
    }
}

fn take(streams: &mut [Stream], taken: &mut Vec<Taken>) -> Result<(), RunError> {
    for (node, stream) in streams.iter_mut().enumerate() {
        let Stream { subscriber, next, lost } = stream;
        while subscriber.receive(|words| {
            let (number, time) = match *words {
                [LOSS, number, _, _, _, time, ..] | [STEP, number, _, _, _, time, ..] => {
                    (number, time as Nanos)
                }
                // Only our own nodes can write here, and both ends were checked to be of one layout.
                _ => return,
            };
            *lost += number.saturating_sub(*next);
            *next = number + 1;
            taken.push(Taken { time, node, words: words.to_vec() });
        })? {}
    }
    Ok(())
}

fn write(graph: &Graph, file: &mut RecordingWriter, record: &Taken) -> Result<(), RunError> {
    let Taken { node, words, .. } = record;
    if words[0] == LOSS {
        return losses(graph, *node, &words[..LOSS_WORDS]).try_for_each(|loss| Ok(file.loss(&loss)?));
    }
    let Some((step, payload)) = step(graph, *node, words) else { return Ok(()) };
    file.message(*node, step.seq, step.end, &payload)?;
    Ok(file.step_record(*node, &step)?)
}

/// The losses that a record tells of, one for each message.
fn losses<'a>(graph: &'a Graph, node: usize, words: &[u64]) -> impl Iterator<Item = Loss> + use<'a> {
    let (input, first, count, time) = (words[2] as usize, words[3], words[4], words[5] as Nanos);
    let reason = plan::reason_of(words[6]);
    let receiver = &graph.nodes()[node];
    let connection = receiver.inputs.get(input).map(|&connection| &graph.connections()[connection]);
    (first..first.saturating_add(count)).filter_map(move |seq| {
        connection.map(|connection| Loss {
            from: graph.nodes()[connection.from].name.clone(),
            to: receiver.name.clone(),
            port: connection.port.clone(),
            seq,
            time,
            reason,
        })
    })
}

/// A step and the payload that it sent.
fn step(graph: &Graph, node: usize, words: &[u64]) -> Option<(StepRecord, Vec<f64>)> {
    let (head, mut rest) = words.split_at_checked(STEP_HEAD)?;
    let mut inputs = Vec::new();
    for &connection in &graph.nodes()[node].inputs {
        let (input, after) = rest.split_at_checked(INPUT_HEAD)?;
        let (stamps, after) = after.split_at_checked(CONSUMED * input[1] as usize)?;
        let consumed = stamps.chunks_exact(CONSUMED).map(|stamp| Consumed {
            seq: (stamp[0] != INITIAL).then_some(stamp[0]),
            sent: stamp[1] as Nanos,
            received: stamp[2] as Nanos,
        });
        let port = graph.connections()[connection].port.clone();
        inputs.push(InputRecord { port, consumed: consumed.collect(), superseded: input[0] });
        rest = after;
    }
    let payload = rest.iter().map(|word| f64::from_bits(*word)).collect();
    let [seq, due, start, end] = [head[2], head[3], head[4], head[5]];
    let step = StepRecord { seq, due: due as Nanos, start: start as Nanos, end: end as Nanos, inputs };
    Some((step, payload))
}
