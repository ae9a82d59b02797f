//! The graphs that are measured, and their nodes.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use serde::Deserialize;
use serde_json::json;

use super::{Carrier, Delays, LARGE, LatencyError, Options, Row, Wait, room, warm_up};
use crate::clock::monotonic;
use crate::data::DataSpace;
use crate::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use crate::launch::{self, End, Mode, RunOptions};
use crate::node::{ErasedNode, Layout, NodeContext, NodeError, Step};
use crate::registry::{NodeKind, Registry};
use crate::time::Nanos;

/// The hidden subcommand under which a program is a node of a measured graph.
pub const NODE_COMMAND: &str = "__latency-node";

/// The body of the hidden subcommand [`NODE_COMMAND`]; `arguments` are those after it.
pub fn node_main(mut arguments: impl Iterator<Item = String>) -> ExitCode {
    let number = |text: Option<String>| text.and_then(|text| text.parse().ok());
    let (Some(leaves), Some(data)) = (number(arguments.next()), number(arguments.next())) else {
        eprintln!("this subcommand is started by `parallax latency`");
        return ExitCode::FAILURE;
    };
    launch::node_main(arguments, &registry(leaves, data))
}

/// The kinds of node that are measured, for messages of so many numbers and so many bytes of data.
fn registry(leaves: usize, data: usize) -> Registry {
    let layout = Layout {
        name: "latency/Payload".into(),
        leaves: (0..leaves.max(2)).map(|leaf| format!("v{leaf}")).collect(),
    };
    let initial = vec![0.0; layout.leaves.len()];
    let kind = |port: &'static str, role: Role| {
        let kind = NodeKind::erased(layout.clone(), initial.clone(), move |context| {
            Ok(Box::new(Measuring::new(context, role)?))
        });
        kind.data(data).input_with_layout(port, layout.clone())
    };
    let alone = NodeKind::erased(layout.clone(), initial.clone(), |context| {
        Ok(Box::new(Measuring::new(context, Role::Alone)?))
    });
    Registry::new()
        .with("latency/ping", kind("pong", Role::Ping))
        .with("latency/pong", kind("ping", Role::Pong))
        .with("latency/busy", kind("slow", Role::Busy))
        .with("latency/alone", alone)
}

#[derive(Clone, Copy, PartialEq)]
enum Role {
    /// Sends the time, and notes how long answers take.
    Ping,
    /// Notes how long messages take, and answers.
    Pong,
    /// Notes how late it starts.
    Alone,
    /// Works longer than its period, and notes what passes between two steps.
    Busy,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Parameters {
    /// Where the noted delays go, 8 bytes each, when the node ends.
    samples: PathBuf,
    /// How many are expected.
    expected: usize,
    /// How many steps are not counted at first.
    warm_up: u64,
}

/// A node that measures. What it notes stays in memory taken at the start until the run is over.
struct Measuring {
    role: Role,
    path: PathBuf,
    noted: Vec<Nanos>,
    warm_up: u64,
    last: Option<u64>,
    left: Nanos,
}

impl Measuring {
    fn new(context: &NodeContext, role: Role) -> Result<Self, NodeError> {
        let Parameters { samples, expected, warm_up } = context.parameters()?;
        let noted = room(expected + 1024);
        Ok(Self { role, path: samples, noted, warm_up, last: None, left: 0 })
    }

    fn note(&mut self, seq: u64, delay: Nanos) {
        if seq >= self.warm_up && self.noted.len() < self.noted.capacity() {
            self.noted.push(delay);
        }
    }
}

impl ErasedNode for Measuring {
    fn step_with_data(
        &mut self,
        step: &Step<'_>,
        output: &mut [f64],
        data: &mut DataSpace<'_>,
    ) -> Result<(), NodeError> {
        // All of it is sent; as with the floors, nobody fills it.
        data.take(data.capacity())?;
        self.step_into(step, output)
    }

    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let now = monotonic();
        let newest = step.inputs().first().and_then(|input| {
            let at = input.stamps().len().checked_sub(1)?;
            Some((input.stamps()[at], input.payload(at)))
        });
        match (self.role, newest) {
            (Role::Ping, Some((stamp, payload))) => {
                if let Some(seq) = stamp.seq.filter(|seq| self.last != Some(*seq)) {
                    self.last = Some(seq);
                    // The answer holds when the question was sent, by the same clock.
                    self.note(step.seq, stamp.received - payload[1] as Nanos);
                }
            }
            (Role::Pong, Some((stamp, payload))) if stamp.seq.is_some() => {
                self.note(step.seq, now - payload[0] as Nanos);
                output[1] = stamp.sent as f64;
            }
            (Role::Alone, _) => self.note(step.seq, step.start - step.due),
            (Role::Busy, _) => {
                if step.seq > 0 {
                    self.note(step.seq, now - self.left);
                }
                while monotonic() < now + 2_000 {
                    std::hint::spin_loop();
                }
            }
            _ => {}
        }
        self.left = monotonic();
        // The last thing that the step does: from here on the message is on its way.
        output[0] = self.left as f64;
        Ok(())
    }
}

impl Drop for Measuring {
    fn drop(&mut self) {
        let bytes: Vec<u8> = self.noted.iter().flat_map(|delay| delay.to_le_bytes()).collect();
        // Whoever reads the file finds out when it is not there.
        let _ = std::fs::write(&self.path, bytes);
    }
}

fn read(path: &Path) -> Result<Vec<Nanos>, LatencyError> {
    let bytes = std::fs::read(path).map_err(LatencyError::io("read what a node measured"))?;
    let (numbers, _) = bytes.as_chunks();
    Ok(numbers.iter().map(|number| Nanos::from_le_bytes(*number)).collect())
}

fn node(name: &str, kind: &str, rate: f64, samples: &Path, time: Duration) -> NodeSpec {
    let mut node = NodeSpec::new(name, kind, rate);
    node.parameters.insert("samples".into(), json!(samples));
    let expected = (time.as_secs_f64() * rate) as usize;
    node.parameters.insert("expected".into(), json!(expected));
    node.parameters.insert("warm_up".into(), json!(warm_up(expected)));
    node
}

fn run(
    graph: &GraphSpec,
    (leaves, data): (usize, usize),
    options: RunOptions,
    fifo: bool,
) -> Result<Vec<String>, LatencyError> {
    let options = RunOptions {
        mode: Mode::Processes,
        real_time: fifo,
        spread: false,
        signals: false,
        node_command: vec![NODE_COMMAND.into(), leaves.to_string(), data.to_string()],
        ..options
    };
    let report = launch::run(graph, &registry(leaves, data), options)?;
    match &report.end {
        End::Duration => Ok(report.warnings),
        _ => Err(LatencyError::Ended {
            reason: report.failure().unwrap_or_else(|| "the recorder stopped".into()),
        }),
    }
}

/// A folder for what nodes note and record; removed with everything in it.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Result<Self, LatencyError> {
        let path =
            std::env::temp_dir().join(format!("parallax-latency-{}-{}", std::process::id(), monotonic()));
        std::fs::create_dir(&path).map_err(LatencyError::io("make a temporary folder"))?;
        Ok(Self(path))
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What cannot be removed from a temporary folder is left to the system.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Adds a turn of `ping` and `pong` to a row; gives the launcher's warnings.
pub(super) fn exchange(
    row: &mut Row,
    options: &Options,
    time: Duration,
) -> Result<Vec<String>, LatencyError> {
    let case = row.case;
    let folder = Folder::new()?;
    let rate = case.rate(options.rate);
    let shape = if case.payload < LARGE { ((case.payload / 8).max(2), 0) } else { (2, case.payload) };
    let mut ping = node("ping", "latency/ping", rate, &folder.file("ping"), time);
    let mut pong = node("pong", "latency/pong", rate, &folder.file("pong"), time);
    pong.advance = true;
    if case.pinned {
        (ping.core, pong.core) = (Some(options.cores[0]), Some(options.cores[1]));
    }
    let graph = GraphSpec {
        name: "latency".into(),
        supervisor: "ping".into(),
        nodes: vec![ping, pong],
        connections: vec![
            ConnectionSpec { blocking: true, ..ConnectionSpec::new("ping", "pong") },
            ConnectionSpec { skip: true, ..ConnectionSpec::new("pong", "ping") },
        ],
        plant: None,
    };
    let recording = (case.carrier == Carrier::RecordedGraph).then(|| folder.file("recording.mcap"));
    let run_options = RunOptions {
        duration: Some(time.as_nanos() as Nanos),
        spin: case.wait.spin(),
        recording,
        ..RunOptions::default()
    };
    let warnings = run(&graph, shape, run_options, case.fifo)?;
    row.one_way.extend(read(&folder.file("pong"))?);
    row.round_trip.extend(read(&folder.file("ping"))?);
    Ok(warnings)
}

/// What the runtime spends between two steps of a node that is always late, with an input of a window of four.
pub(super) fn overhead(delays: &mut Delays, options: &Options, recorded: bool) -> Result<(), LatencyError> {
    let folder = Folder::new()?;
    let time = Duration::from_millis(100);
    let rate = 1e6;
    let mut busy = node("busy", "latency/busy", rate, &folder.file("busy"), time);
    let mut slow = node("slow", "latency/alone", 100.0, &folder.file("slow"), time);
    (busy.core, slow.core) = (Some(options.cores[0]), Some(options.cores[1]));
    let graph = GraphSpec {
        name: "step".into(),
        supervisor: "busy".into(),
        nodes: vec![busy, slow],
        connections: vec![ConnectionSpec { window: 4, ..ConnectionSpec::new("slow", "busy") }],
        plant: None,
    };
    let run_options = RunOptions {
        duration: Some(time.as_nanos() as Nanos),
        recording: recorded.then(|| folder.file("recording.mcap")),
        spin: Wait::Spin.spin(),
        ..RunOptions::default()
    };
    run(&graph, (8, 0), run_options, false)?;
    delays.extend(read(&folder.file("busy"))?);
    Ok(())
}

/// How late steps of a sleeping node start, at 1 kHz under `SCHED_FIFO`; gives the launcher's warnings.
pub(super) fn lateness(
    delays: &mut Delays,
    options: &Options,
    time: Duration,
) -> Result<Vec<String>, LatencyError> {
    let folder = Folder::new()?;
    let mut alone = node("alone", "latency/alone", 1000.0, &folder.file("alone"), time);
    alone.core = Some(options.cores[0]);
    let graph = GraphSpec {
        name: "lateness".into(),
        supervisor: "alone".into(),
        nodes: vec![alone],
        connections: Vec::new(),
        plant: None,
    };
    let run_options = RunOptions { duration: Some(time.as_nanos() as Nanos), ..RunOptions::default() };
    let warnings = run(&graph, (8, 0), run_options, true)?;
    delays.extend(read(&folder.file("alone"))?);
    Ok(warnings)
}
