//! Measured delays by percentile: one panel for each size of message and way of waiting, one line for each carrier.

use parallax_gap::plot::draw::{Anchor, Pen};
use parallax_gap::plot::format::number;
use parallax_runtime::latency::{Carrier, Case, Report, Row};

use super::{Drawing, Figure, NARROW, WIDE};

const PANEL: f64 = 190.0;
const TITLE: f64 = 26.0;
const AXIS: f64 = 34.0;
const LEFT: f64 = 48.0;
/// Room for the names at the ends of the lines.
const NAMES: f64 = 128.0;
const BETWEEN: f64 = 22.0;
/// Percentiles at the ticks of the horizontal axis, on which each is as far from the last as the share beyond it shrinks.
const TICKS: [f64; 5] = [0.0, 90.0, 99.0, 99.9, 99.99];

/// Cases that differ only in what carries the messages.
struct Group<'a> {
    like: Case,
    rows: Vec<&'a Row>,
}

/// The distributions of the one-way delays.
pub(crate) fn figure(report: &Report) -> Figure {
    let groups = groups(report);
    Figure {
        title: "One way, from node to node".into(),
        note: "Share of the messages (horizontal) that took at most so long (vertical, logarithmic). Lines end where \
               the samples end."
            .into(),
        wide: panels(&groups, 2, WIDE),
        narrow: panels(&groups, 1, NARROW),
    }
}

fn groups(report: &Report) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for row in report.rows.iter().filter(|row| !row.one_way.is_empty()) {
        let like = Case { carrier: Carrier::Graph, ..row.case };
        match groups.iter_mut().find(|group| group.like == like) {
            Some(group) => group.rows.push(row),
            None => groups.push(Group { like, rows: vec![row] }),
        }
    }
    groups
}

fn panels(groups: &[Group<'_>], columns: usize, width: f64) -> Drawing {
    let mut pen = Pen::default();
    let panel = (width - BETWEEN * (columns - 1) as f64) / columns as f64;
    let height = TITLE + PANEL + AXIS;
    for (index, group) in groups.iter().enumerate() {
        let x = (panel + BETWEEN) * (index % columns) as f64;
        draw(&mut pen, group, (x, height * (index / columns) as f64), panel);
    }
    Drawing { pen, height: height * groups.len().div_ceil(columns) as f64 }
}

/// How a carrier's line looks.
fn class(carrier: Carrier) -> &'static str {
    match carrier {
        Carrier::Graph => "after",
        Carrier::RecordedGraph => "measured",
        Carrier::Channel => "fit",
        Carrier::Iceoryx2 => "before",
        Carrier::UnixSocket => "latest",
        Carrier::Crossbeam => "skip",
        Carrier::Futex => "link",
    }
}

/// What all cases of a panel share, in words.
pub(crate) fn describe(case: &Case) -> String {
    let size = match case.payload {
        bytes if bytes % (1 << 20) == 0 => format!("{} MiB", bytes >> 20),
        bytes if bytes % 1024 == 0 => format!("{} KiB", bytes >> 10),
        bytes => format!("{bytes} B"),
    };
    let pinned = if case.pinned { "" } else { ", not pinned" };
    let fifo = if case.fifo { ", FIFO" } else { "" };
    format!("{}, {size}{pinned}{fifo}", case.wait)
}

fn draw(pen: &mut Pen, group: &Group<'_>, (x, y): (f64, f64), width: f64) {
    pen.text("head", (x, y + 14.0), Anchor::Start, &describe(&group.like));
    let (left, right) = (x + LEFT, x + width - NAMES);
    let (top, bottom) = (y + TITLE, y + TITLE + PANEL);
    let decades = (TICKS.len() - 1) as f64;
    let across = |percent: f64| {
        let beyond = (1.0 - percent / 100.0).max(1e-9);
        left + (right - left) * (-beyond.log10() / decades).clamp(0.0, 1.0)
    };
    let all = || group.rows.iter().flat_map(|row| row.one_way.curve()).map(|point| point.ns as f64);
    let low = all().fold(f64::INFINITY, f64::min).max(1.0).log10().floor();
    let high = all().fold(1.0, f64::max).log10().ceil().max(low + 1.0);
    let up = |ns: f64| bottom - PANEL * ((ns.max(1.0).log10() - low) / (high - low)).clamp(0.0, 1.0);
    for decade in low as i32..=high as i32 {
        let (ns, place) = (10f64.powi(decade), up(10f64.powi(decade)));
        pen.line("grid", (left, place), (right, place));
        pen.text("tick", (left - 6.0, place + 4.0), Anchor::End, &time(ns));
    }
    for percent in TICKS {
        let place = across(percent);
        pen.line("axis", (place, bottom), (place, bottom + 4.0));
        pen.text("tick", (place, bottom + 16.0), Anchor::Middle, &format!("{} %", number(percent, 4)));
    }
    pen.line("axis", (left, bottom), (right, bottom));
    let mut names = Vec::new();
    for row in &group.rows {
        let curve = row.one_way.curve();
        let line: Vec<(f64, f64)> =
            curve.iter().map(|point| (across(point.percent), up(point.ns as f64))).collect();
        if let Some(&end) = line.last() {
            names.push((end, row.case.carrier));
        }
        pen.runs(class(row.case.carrier), &[line]);
    }
    // Names keep a line's distance from each other, in the order of the ends.
    names.sort_by(|a, b| a.0.1.total_cmp(&b.0.1));
    let mut next = top + 4.0;
    for ((end_x, end_y), carrier) in names {
        let place = end_y.max(next);
        next = place + 13.0;
        pen.line("leader", (end_x, end_y), (right + 8.0, place));
        pen.text("small", (right + 11.0, place + 4.0), Anchor::Start, &carrier.to_string());
    }
}

/// A power of ten of nanoseconds.
fn time(ns: f64) -> String {
    match ns {
        ns if ns < 1e3 => format!("{} ns", number(ns, 3)),
        ns if ns < 1e6 => format!("{} µs", number(ns / 1e3, 3)),
        ns if ns < 1e9 => format!("{} ms", number(ns / 1e6, 3)),
        ns => format!("{} s", number(ns / 1e9, 3)),
    }
}
