//! What is in the recording of a graph.

use std::collections::{BTreeMap, BTreeSet};

use parallax_runtime::graph::ConnectionSpec;
use parallax_runtime::recording::{Clock, ClockReading, NodeTrack, Recording, StepRecord};
use parallax_runtime::time::{Nanos, to_seconds};
use serde::Serialize;
use serde_json::json;

use super::log;
use crate::cli::failure::Failure;
use crate::cli::output;
use crate::cli::sim::describe_all;

/// What is to be said of some durations, in seconds.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Spread {
    mean_s: f64,
    p50_s: f64,
    p99_s: f64,
    max_s: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        if values.is_empty() {
            return Self::default();
        }
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Self {
            mean_s: values.iter().sum::<f64>() / values.len() as f64,
            p50_s: at(0.5),
            p99_s: at(0.99),
            max_s: at(1.0),
        }
    }

    fn cells(self) -> Vec<String> {
        [self.mean_s, self.p99_s, self.max_s].map(output::seconds).to_vec()
    }
}

#[derive(Serialize)]
struct Node {
    name: String,
    kind: String,
    rate_hz: f64,
    stand_in: bool,
    steps: usize,
    messages: usize,
    /// Steps that ended later than a period after they could begin: after they were due, and what they waited for had come.
    overruns: usize,
    /// Its machine, where the graph ran on several.
    #[serde(skip_serializing_if = "Option::is_none")]
    host: Option<String>,
    computation: Spread,
    /// How much later than due steps started.
    lateness: Spread,
}

#[derive(Serialize)]
struct Connection {
    name: String,
    consumed: usize,
    superseded: u64,
    lost: usize,
    /// On the receiver's clock; where the sender's machine was another, to within `clock_bound_s`.
    delay: Spread,
    expected_delay_s: f64,
    /// How far the estimate of the sender's clock can be wrong: known where messages went from one machine to another.
    #[serde(skip_serializing_if = "Option::is_none")]
    clock_bound_s: Option<f64>,
}

pub(super) fn show(recording: &Recording, as_json: bool) -> Result<(), Failure> {
    let nodes: Vec<Node> = recording.nodes.iter().map(|track| node(recording, track)).collect();
    let connections: Vec<Connection> =
        recording.graph.connections.iter().map(|c| connection(recording, c)).collect();
    let signals = recording.log();
    let faults = describe_all(&recording.faults);
    let changes: Vec<String> = recording.changes.iter().map(ToString::to_string).collect();
    if as_json {
        return output::json(&json!({
            "kind": "recording", "graph": recording.graph.name, "clock": recording.clock,
            "duration_s": to_seconds(recording.duration), "truncated": recording.truncated,
            "has_system": recording.graph.plant.is_some(), "nodes": nodes, "connections": connections,
            "signals": signals.signals.iter().map(log::describe).collect::<Vec<_>>(),
            "losses": recording.losses.len(), "faults": faults, "changes": recording.changes,
            "notes": signals.notes, "clocks": last_clocks(recording),
        }));
    }
    let clock = match &recording.clock {
        Clock::Wall { host, .. } => format!("in real time on {host}"),
        Clock::Simulated { seed } => format!("under a simulated clock, seed {seed}"),
    };
    output::line(format!("{}: {:.3} s {clock}", recording.graph.name, to_seconds(recording.duration)));
    let rows: Vec<Vec<String>> = nodes
        .iter()
        .map(|node| {
            let start = [
                if node.stand_in {
                    format!("{} (stands in for hardware)", node.name)
                } else {
                    node.name.clone()
                },
                node.rate_hz.to_string(),
                node.steps.to_string(),
                node.messages.to_string(),
                node.overruns.to_string(),
            ];
            [start.to_vec(), node.computation.cells(), vec![output::seconds(node.lateness.p99_s)]].concat()
        })
        .collect();
    output::table(
        &[
            "node",
            "rate (Hz)",
            "steps",
            "messages",
            "overruns",
            "computation",
            "99 %",
            "largest",
            "late, 99 %",
        ],
        &rows,
    );
    let rows: Vec<Vec<String>> = connections
        .iter()
        .map(|c| {
            let counts = [c.consumed.to_string(), c.superseded.to_string(), c.lost.to_string()];
            let expected = vec![output::seconds(c.expected_delay_s)];
            let name = match c.clock_bound_s {
                Some(bound) => format!("{} (+-{})", c.name, output::seconds(bound)),
                None => c.name.clone(),
            };
            [vec![name], counts.to_vec(), c.delay.cells(), expected].concat()
        })
        .collect();
    output::table(
        &["connection", "consumed", "superseded", "lost", "delay", "99 %", "largest", "expected"],
        &rows,
    );
    if !recording.hosts.is_empty() {
        machines(recording);
    }
    log::signals(&signals);
    faults
        .into_iter()
        .chain(changes.into_iter().map(|change| format!("changed: {change}")))
        .for_each(output::line);
    Ok(())
}

/// The last reading of each pair of clocks.
fn last_clocks(recording: &Recording) -> Vec<&ClockReading> {
    let mut last: BTreeMap<(&str, &str), &ClockReading> = BTreeMap::new();
    recording.clocks.iter().for_each(|reading| _ = last.insert((&reading.host, &reading.other), reading));
    last.into_values().collect()
}

/// Which node was where, and how the clocks stood to each other.
fn machines(recording: &Recording) {
    let mut of: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    recording.hosts.iter().for_each(|(node, host)| of.entry(host).or_default().push(node));
    of.iter().for_each(|(host, nodes)| output::line(format!("machine {host}: {}", nodes.join(", "))));
    for reading in last_clocks(recording) {
        output::line(clock(reading));
    }
    output::line(
        "A delay between machines is stated on the receiver's clock, to within the bound in brackets.",
    );
}

/// How another clock stood to one's own, in words.
pub(crate) fn clock(reading: &ClockReading) -> String {
    let time = |nanos: i64| output::seconds(to_seconds(nanos));
    format!(
        "clock of {} against {}: ahead by {} (+-{}) in the run, {} in all; faster by {:.2} ppm (+-{:.2}); shortest round \
         trip {}, {} exchanges",
        reading.other,
        reading.host,
        time(reading.ahead),
        time(reading.bound),
        time(reading.offset),
        reading.skew * 1e6,
        reading.skew_bound * 1e6,
        time(reading.round_trip),
        reading.exchanges
    )
}

fn node(recording: &Recording, track: &NodeTrack) -> Node {
    let spec = recording.graph.node(&track.name);
    let rate = spec.map_or(0.0, |spec| spec.rate);
    let spread =
        |of: &dyn Fn(usize) -> i64| Spread::of((0..track.steps.len()).map(|i| to_seconds(of(i))).collect());
    Node {
        name: track.name.clone(),
        kind: spec.map_or_else(String::new, |spec| spec.kind.clone()),
        rate_hz: rate,
        stand_in: track.stand_in,
        steps: track.steps.len(),
        messages: track.messages.len(),
        host: recording.hosts.get(&track.name).cloned(),
        overruns: {
            let before = std::iter::once(0).chain(track.steps.iter().map(|step| step.end));
            let steps = track.steps.iter().zip(before);
            steps.filter(|(step, end)| to_seconds(overdue(recording, track, step, *end)) * rate > 1.0).count()
        },
        computation: spread(&|i| track.steps[i].end - track.steps[i].start),
        lateness: spread(&|i| track.steps[i].start - track.steps[i].due),
    }
}

/// How long after it could begin a step ended: after its due time, after the step before, and after what it waited for had come.
fn overdue(recording: &Recording, track: &NodeTrack, step: &StepRecord, before: Nanos) -> Nanos {
    let connections = &recording.graph.connections;
    let blocking =
        |port: &str| connections.iter().any(|c| c.blocking && c.to == track.name && c.port() == port);
    let awaited = step.inputs.iter().filter(|input| blocking(&input.port)).flat_map(|input| &input.consumed);
    let came = awaited.filter(|message| message.seq.is_some()).map(|message| message.received).max();
    step.end - step.due.max(before).max(came.unwrap_or(before))
}

fn connection(recording: &Recording, spec: &ConnectionSpec) -> Connection {
    let port = spec.port();
    let inputs = recording
        .node(&spec.to)
        .into_iter()
        .flat_map(|track| &track.steps)
        .flat_map(|step| &step.inputs)
        .filter(|input| input.port == port);
    let (mut seen, mut delays, mut superseded) = (BTreeSet::new(), Vec::new(), 0);
    for input in inputs {
        superseded += input.superseded;
        for message in &input.consumed {
            // A window shows a message to several steps.
            if message.seq.is_some_and(|seq| seen.insert(seq)) {
                delays.push(to_seconds(message.received - message.sent));
            }
        }
    }
    let lost = recording.losses.iter().filter(|loss| loss.to == spec.to && loss.port == port).count();
    Connection {
        name: if port == spec.from {
            format!("{}->{}", spec.from, spec.to)
        } else {
            format!("{}->{}.{port}", spec.from, spec.to)
        },
        consumed: seen.len(),
        superseded,
        lost,
        delay: Spread::of(delays),
        expected_delay_s: spec.delay.expected(),
        clock_bound_s: recording.clock_bound(&spec.from, &spec.to).map(to_seconds),
    }
}
