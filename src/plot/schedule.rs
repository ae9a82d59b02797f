//! A stretch of a schedule: which node worked when, and which step consumed which message.

use parallax_gap::plot::axis::{multiples, step};
use parallax_gap::plot::draw::{Anchor, Pen};
use parallax_gap::plot::format::{clip, number};
use parallax_runtime::graph::Graph;
use parallax_runtime::time::{Nanos, SECOND, to_seconds};
use parallax_sim::Episode;

use super::{Drawing, Figure, NARROW, WIDE};

const LANE: f64 = 16.0;
const BETWEEN: f64 = 30.0;
/// More lines than this are a grey surface.
const MOST_LINES: usize = 3000;

/// The first periods after all nodes have come to run: four of the slowest node, but not more than forty of the fastest.
pub(crate) fn default_range(graph: &Graph, episode: &Episode) -> (Nanos, Nanos) {
    let periods = graph.nodes().iter().map(|node| node.grid.period());
    let (fastest, slowest) = periods
        .fold((Nanos::MAX, 1), |(fastest, slowest), period| (fastest.min(period), slowest.max(period)));
    let from = episode.nodes.iter().filter_map(|steps| steps.start.first()).copied().max().unwrap_or(0);
    let span = slowest.saturating_mul(4).min(fastest.saturating_mul(40)).clamp(1, 100 * SECOND);
    // What comes just before belongs to it.
    ((from - span / 20).max(0), span)
}

/// Draws what happened from `from` on for `span`, a lane a node.
pub(crate) fn figure(graph: &Graph, episode: &Episode, from: Nanos, span: Nanos) -> Figure {
    let (unit, per_second) = unit(from.saturating_add(span));
    Figure {
        title: "Schedule".into(),
        note: format!(
            "From {} {unit} on. Boxes: steps, from start to end. Lines: messages, from sent to the start of the step that \
             saw them first.",
            number(to_seconds(from) * per_second, 4)
        ),
        wide: lanes(graph, episode, (from, span), WIDE, 96.0),
        // A narrow page shows the beginning at the same scale as far as it goes.
        narrow: lanes(graph, episode, (from, (span / 2).max(1)), NARROW, 66.0),
    }
}

fn lanes(graph: &Graph, episode: &Episode, (from, span): (Nanos, Nanos), width: f64, left: f64) -> Drawing {
    let mut pen = Pen::default();
    let right = width - 4.0;
    let to = from.saturating_add(span);
    let x = |time: Nanos| left + (right - left) * (time - from) as f64 / span as f64;
    let clamped = |time: Nanos| x(time.clamp(from, to));
    // Senders above their receivers, so that most lines lead down.
    let mut row = vec![0; graph.nodes().len()];
    for (place, &node) in graph.order().iter().enumerate() {
        row[node] = place;
    }
    let top = |node: usize| 8.0 + (LANE + BETWEEN) * row[node] as f64;
    let bottom = 8.0 + (LANE + BETWEEN) * row.len() as f64 - BETWEEN + 10.0;

    let (unit, per_second) = unit(to);
    let (low, high) = (to_seconds(from) * per_second, to_seconds(to) * per_second);
    let tick = step((high - low) / (width / 90.0));
    for value in multiples(low, high, tick) {
        let at = left + (right - left) * (value - low) / (high - low);
        pen.line("grid", (at, 2.0), (at, bottom));
        if at < right - 16.0 {
            pen.text("tick", (at, bottom + 14.0), Anchor::Middle, &number(value, 6));
        }
    }
    pen.text("tick", (right, bottom + 14.0), Anchor::End, unit);

    for (index, node) in graph.nodes().iter().enumerate() {
        let y = top(index);
        pen.text("plain", (0.0, y + 12.0), Anchor::Start, &clip(&node.name, (left / 7.0) as usize));
        pen.rect("lane", (left, y), (right - left, LANE));
    }
    let mut lines = 0;
    for (index, plan) in graph.connections().iter().enumerate() {
        let class = super::graph::class(plan);
        for (sent, start) in travels(graph, episode, index) {
            if start < from || sent > to || lines == MOST_LINES {
                continue;
            }
            lines += 1;
            let (mut a, mut b) = ((x(sent), top(plan.from)), (x(start), top(plan.to)));
            if row[plan.from] < row[plan.to] {
                a.1 += LANE;
            } else {
                b.1 += LANE;
            }
            // What leaves the picture is cut at its edge, in the direction in which it leaves.
            let cut = |end: (f64, f64), other: (f64, f64)| {
                let edge = end.0.clamp(left, right);
                if edge == end.0 {
                    end
                } else {
                    (edge, end.1 + (other.1 - end.1) * (edge - end.0) / (other.0 - end.0))
                }
            };
            let (a, b) = (cut(a, b), cut(b, a));
            pen.line(class, a, b);
        }
    }
    for index in 0..graph.nodes().len() {
        let class = if index == graph.supervisor() { "lead-work" } else { "work" };
        let steps = &episode.nodes[index];
        let times = steps.start.iter().zip(&steps.end);
        for (&start, &end) in times.filter(|(start, end)| **end >= from && **start < to) {
            let (start, end) = (clamped(start), clamped(end));
            // A step that takes no time is still to be seen.
            pen.rect(class, (start, top(index)), ((end - start).max(1.4), LANE));
        }
    }
    super::graph::with_legend(Drawing { pen, height: bottom + 20.0 }, width)
}

/// The unit in which times up to `end` are read best, and how many of it are a second.
fn unit(end: Nanos) -> (&'static str, f64) {
    if end < 2 * SECOND { ("ms", 1e3) } else { ("s", 1.0) }
}

/// When each message of a connection was sent, and when the first step that saw it started.
fn travels(graph: &Graph, episode: &Episode, connection: usize) -> Vec<(Nanos, Nanos)> {
    let plan = &graph.connections()[connection];
    let (sent, starts) = (&episode.nodes[plan.from].end, &episode.nodes[plan.to].start);
    let mut travels = Vec::new();
    let mut newest = -1;
    for (step, &start) in starts.iter().enumerate() {
        for &seq in episode.connections[connection].seqs(step) {
            if seq > newest {
                newest = seq;
                travels.push((sent[seq as usize], start));
            }
        }
    }
    travels
}
