//! Where, by the stamps alone: what each connection, node and signal did with time, against what the graph declares.
//!
//! [`timing`] measures a graph's recording: delays, jitter, losses, order, clocks, rates and overruns. [`signals`] measures
//! a log that only has stamps. What the stamps prove is no hypothesis: [`Timing::departures`] lists it as effects with
//! their parameters, to enter a diagnosis as known.

mod clock;
mod measure;
mod signal;

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, NodeSpec};
use parallax_runtime::recording::{NodeTrack, Recording};
use parallax_runtime::time::to_seconds;
use parallax_sim::delays::{self, Place};
use serde::{Deserialize, Serialize};

use crate::report::{FittedEffect, Value};

pub use clock::{Skew, skew};
pub use measure::Measure;
pub use signal::{RelativeClock, SignalTiming, signals};

/// Delays below which a place is not measured.
const ENOUGH: usize = 20;

/// Share of the receiver's period from which a difference of delays matters.
const MATTERS: f64 = 0.01;

/// What the stamps of a recording say.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Connections in the order of the graph.
    pub connections: Vec<ConnectionTiming>,
    /// Nodes in the order of the graph.
    pub nodes: Vec<NodeTiming>,
    /// Signals of a log, in its order.
    pub signals: Vec<SignalTiming>,
}

/// One connection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConnectionTiming {
    /// `connection:A->B`, with `.port` where the port is not named like the sender.
    pub place: String,
    /// Messages whose delay was measured.
    pub messages: usize,
    /// Messages that no step saw: when they arrived is not recorded.
    pub unseen: usize,
    /// Mean delay (s); absent with too few messages.
    pub delay: Option<Measure>,
    /// Standard deviation of the delay (s).
    pub jitter: Option<Measure>,
    /// Share of the messages that was lost.
    pub loss: Measure,
    /// Messages that arrived before one that was sent earlier.
    pub reordered: usize,
    /// Messages that arrived before they were sent: the two clocks disagree.
    pub negative: usize,
    /// The receiver's clock against the sender's, from the shortest delays.
    pub skew: Option<Skew>,
    /// The receiver's clock less the sender's (s), where messages also travel the other way and the shortest delays of
    /// both ways differ from what is declared.
    pub offset: Option<f64>,
}

/// One node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NodeTiming {
    /// `node:N`.
    pub place: String,
    /// Steps that were recorded.
    pub steps: usize,
    /// Steps a second.
    pub rate: Option<Measure>,
    /// Mean time that a step takes (s).
    pub computation: Option<Measure>,
    /// Its standard deviation (s).
    pub jitter: Option<Measure>,
    /// Share of steps that ended after the next one was due.
    pub overruns: Measure,
    /// Mean time from when a step was due to when it started (s).
    pub lateness: f64,
    /// The longest such time (s).
    pub latest: f64,
    /// Steps that are missing between the first and the last.
    pub missing: u64,
}

/// Measures a graph's recording. Of an imported log, which has no graph, nothing is measured: see [`signals`].
#[must_use]
pub fn timing(recording: &Recording) -> Timing {
    if recording.is_imported() {
        return Timing { signals: signals(&recording.log()), ..Timing::default() };
    }
    let measured = delays::measured(recording);
    let mut found = Timing::default();
    for delays::Measured { place, delays, left_out, .. } in &measured {
        let seconds: Vec<f64> = delays.iter().map(|d| to_seconds(*d)).collect();
        match place {
            Place::Computation { node } => {
                let spec = recording.graph.nodes.iter().find(|n| n.name == *node);
                if let (Some(spec), Some(track)) = (spec, recording.node(node)) {
                    found.nodes.push(of_node(spec, track, &seconds));
                }
            }
            Place::Communication { from, to, port } => {
                let specs = &recording.graph.connections;
                let spec = specs.iter().find(|c| c.from == *from && c.to == *to && c.port() == port);
                if let Some(spec) = spec {
                    let label = format!("connection:{place}");
                    found.connections.push(of_connection(recording, spec, label, &seconds, *left_out));
                }
            }
        }
    }
    offsets(recording, &mut found);
    found
}

fn period(recording: &Recording, node: &str) -> f64 {
    recording.graph.nodes.iter().find(|n| n.name == node).map_or(f64::INFINITY, |n| 1.0 / n.rate)
}

fn of_connection(
    recording: &Recording,
    spec: &ConnectionSpec,
    place: String,
    delays: &[f64],
    left_out: delays::LeftOut,
) -> ConnectionTiming {
    let matters = MATTERS * period(recording, &spec.to);
    // A step that takes what has come sees those messages that were quick; one that waits sees the ones it waits for.
    let hidden = if spec.blocking { 0 } else { left_out.unseen };
    let (delay, jitter) = distribution(delays, &spec.delay, matters, hidden);
    let travelled = travelled(recording, spec);
    let lost = recording
        .losses
        .iter()
        .filter(|l| l.from == spec.from && l.to == spec.to && l.port == spec.port())
        .count();
    let sent = recording.node(&spec.from).map_or(0, |track| track.messages.len());
    ConnectionTiming {
        place,
        messages: delays.len(),
        unseen: left_out.unseen,
        delay,
        jitter,
        loss: Measure::share(lost, sent, 0.0),
        reordered: travelled.windows(2).filter(|w| w[1].1 < w[0].1).count(),
        negative: left_out.negative,
        skew: skew(&travelled),
        offset: None,
    }
}

/// When each message of a connection was sent and received (s), in the order of its numbers, each once.
fn travelled(recording: &Recording, spec: &ConnectionSpec) -> Vec<(f64, f64)> {
    let inputs = recording.node(&spec.to).into_iter().flat_map(|track| &track.steps).flat_map(|s| &s.inputs);
    let consumed = inputs.filter(|input| input.port == spec.port()).flat_map(|input| &input.consumed);
    let mut all: Vec<_> = consumed.filter_map(|c| Some((c.seq?, c.sent, c.received))).collect();
    all.sort_unstable();
    all.dedup_by_key(|m| m.0);
    all.into_iter().map(|(_, sent, received)| (to_seconds(sent), to_seconds(received))).collect()
}

/// Mean and standard deviation of delays, against those of a declared distribution.
fn distribution(
    delays: &[f64],
    declared: &Delay,
    matters: f64,
    unseen: usize,
) -> (Option<Measure>, Option<Measure>) {
    if delays.len() < ENOUGH {
        return (None, None);
    }
    let (mean, std) = match measure::moments(declared) {
        Some((mean, std)) => (Some(mean), Some(std)),
        None => (None, None),
    };
    // What messages that no step saw could change is part of the interval.
    let hidden = unseen as f64 / (unseen + delays.len()) as f64;
    let delay = Measure::mean(delays, hidden).against(mean, matters);
    let jitter = Measure::deviation(delays, hidden).against(std, matters);
    (Some(delay), Some(jitter))
}

fn of_node(spec: &NodeSpec, track: &NodeTrack, computation: &[f64]) -> NodeTiming {
    let period = 1.0 / spec.rate;
    let starts: Vec<f64> = track.steps.iter().map(|s| to_seconds(s.start)).collect();
    let gaps: Vec<f64> = starts.windows(2).map(|w| w[1] - w[0]).collect();
    let late: Vec<f64> = track.steps.iter().map(|s| to_seconds(s.start - s.due)).collect();
    let (computed, jitter) = distribution(computation, &spec.computation, MATTERS * period, 0);
    let over = |s: &parallax_runtime::recording::StepRecord| to_seconds(s.end - s.due) > period;
    let declared = spec.computation.cdf(period).map_or(0.0, |p| 1.0 - p);
    let (first, last) = (track.steps.first().map_or(0, |s| s.seq), track.steps.last().map_or(0, |s| s.seq));
    let expected = if track.steps.is_empty() { 0 } else { last - first + 1 };
    // Steps follow their grid: what one loses the next gains, and the rate is as certain as both ends.
    let rate = (starts.len() > ENOUGH).then(|| {
        let span = starts[starts.len() - 1] - starts[0];
        let value = (starts.len() - 1) as f64 / span.max(1e-9);
        let ends = 2.0 * Measure::deviation(&late, 0.0).value;
        let error = 3.3 * value * ends / span.max(1e-9);
        let measure =
            Measure { value, low: value - error, high: value + error, declared: None, significant: false };
        measure.against(Some(spec.rate), 1e-3 * spec.rate)
    });
    NodeTiming {
        place: format!("node:{}", spec.name),
        steps: track.steps.len(),
        rate: rate.filter(|_| !gaps.is_empty()),
        computation: computed,
        jitter,
        overruns: Measure::share(track.steps.iter().filter(|s| over(s)).count(), track.steps.len(), declared),
        lateness: late.iter().sum::<f64>() / late.len().max(1) as f64,
        latest: late.iter().copied().fold(0.0, f64::max),
        missing: expected - track.steps.len() as u64,
    }
}

/// Where two nodes send to each other, half the difference of their shortest delays is the offset of their clocks
/// (Mills, "Internet time synchronization: the network time protocol", 1991), beyond what is declared.
fn offsets(recording: &Recording, found: &mut Timing) {
    let specs: Vec<&ConnectionSpec> = recording.graph.connections.iter().collect();
    if specs.len() != found.connections.len() {
        return;
    }
    let excess = |spec: &ConnectionSpec| {
        let all = travelled(recording, spec);
        let least = all.iter().map(|(sent, received)| received - sent).fold(f64::INFINITY, f64::min);
        (all.len() >= ENOUGH).then(|| least - spec.delay.bounds().0)
    };
    for (k, spec) in specs.iter().enumerate() {
        let back = specs.iter().find(|other| other.from == spec.to && other.to == spec.from);
        let Some((there, back)) = back.and_then(|back| Some((excess(spec)?, excess(back)?))) else {
            continue;
        };
        let offset = 0.5 * (there - back);
        // One way must be faster than it can be, or the difference may be the ways' own.
        if there.min(back) < -1e-6 {
            found.connections[k].offset = Some(offset);
        }
    }
}

impl Timing {
    /// What departs from what is declared, as effects: `delay` {delay: beyond the declared mean}, `jitter` {spread},
    /// `drops` {rate}, `clock_skew` {skew} at connections, `delay` and `jitter` at nodes that compute longer.
    #[must_use]
    pub fn departures(&self) -> Vec<FittedEffect> {
        let mut out = Vec::new();
        let mut add = |name: &str, parameter: &str, unit: &str, place: &str, value: f64, std: f64| {
            let value = Value { value, std, unit: unit.into() };
            let parameters = [(parameter.to_owned(), value)].into();
            out.push(FittedEffect { name: name.into(), place: place.into(), parameters });
        };
        for connection in &self.connections {
            let place = &connection.place;
            // Clocks that run apart look like a delay that grows.
            let apart = connection.skew.is_some_and(|s| s.significant);
            if let Some(m) = connection.delay.filter(|m| m.significant && !apart) {
                add("delay", "delay", "s", place, m.value - m.declared.unwrap_or(0.0), m.std());
            }
            if let Some(m) = connection.jitter.filter(|m| m.significant && !apart) {
                add("jitter", "spread", "s", place, m.value, m.std());
            }
            if connection.loss.significant {
                add("drops", "rate", "", place, connection.loss.value, connection.loss.std());
            }
            if let Some(skew) = connection.skew.filter(|s| s.significant) {
                add("clock_skew", "skew", "", place, skew.skew, skew.std);
            }
        }
        for node in &self.nodes {
            if let Some(m) = node.computation.filter(|m| m.significant) {
                add("delay", "delay", "s", &node.place, m.value - m.declared.unwrap_or(0.0), m.std());
            }
            if let Some(m) = node.jitter.filter(|m| m.significant) {
                add("jitter", "spread", "s", &node.place, m.value, m.std());
            }
        }
        out
    }
}
