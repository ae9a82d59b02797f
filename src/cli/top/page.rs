//! A snapshot as lines of text.

use parallax_runtime::launch::{ConnectionView, NodeState, NodeView, Phase, Policy, RecorderView, Snapshot};
use parallax_runtime::time::{Nanos, to_seconds};

use crate::cli::output;

/// How a piece of text is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Tone {
    Plain,
    Head,
    Alarm,
}

/// A line in pieces.
#[derive(Debug, Clone, Default)]
pub(super) struct Line(pub(super) Vec<(String, Tone)>);

impl Line {
    fn of(text: impl Into<String>, tone: Tone) -> Self {
        Self(vec![(text.into(), tone)])
    }

    /// Without colours.
    pub(super) fn text(&self) -> String {
        let text: String = self.0.iter().map(|(text, _)| text.as_str()).collect();
        text.trim_end().to_owned()
    }
}

/// A cell of a table.
struct Cell {
    text: String,
    alarm: bool,
    right: bool,
}

fn word(text: impl Into<String>) -> Cell {
    Cell { text: text.into(), alarm: false, right: false }
}

fn number(text: impl Into<String>) -> Cell {
    Cell { text: text.into(), alarm: false, right: true }
}

impl Cell {
    fn alarm_if(mut self, alarm: bool) -> Self {
        self.alarm = alarm;
        self
    }
}

/// Everything that a snapshot says.
pub(super) fn lines(snapshot: &Snapshot) -> Vec<Line> {
    let mut lines = vec![head(snapshot)];
    if let Some(recorder) = &snapshot.recorder {
        lines.push(recorded(recorder));
    }
    lines.push(Line::default());
    let nodes = snapshot.nodes.iter().map(node).collect();
    lines.extend(table(
        &[
            "node", "is", "rate", "of", "late", "99 %", "step", "99 %", "missed", "overruns", "restarts",
            "core", "policy", "cpu", "process", "thread",
        ],
        nodes,
    ));
    if !snapshot.connections.is_empty() {
        lines.push(Line::default());
        let connections = snapshot.connections.iter().map(connection).collect();
        lines.extend(table(
            &[
                "connection",
                "rate",
                "delay",
                "99 %",
                "max",
                "window",
                "waiting",
                "superseded",
                "replaced",
                "lost",
            ],
            connections,
        ));
    }
    lines
}

fn head(snapshot: &Snapshot) -> Line {
    let phase = match snapshot.phase {
        Phase::Starting => "starts",
        Phase::Running => "runs",
        Phase::Stopping => "stops",
        Phase::Over => "is over",
        Phase::Abandoned => "has lost its launcher",
    };
    let elapsed = format!("{:.1} s", to_seconds(snapshot.elapsed.max(0)));
    let of = snapshot.duration.map_or(String::new(), |duration| format!(" of {} s", to_seconds(duration)));
    let text = format!(
        "{} ({}) {phase}, {elapsed}{of}; rates, delays and shares of the last {:.1} s",
        snapshot.graph,
        snapshot.run,
        to_seconds(snapshot.interval)
    );
    Line::of(text, Tone::Head)
}

fn recorded(recorder: &RecorderView) -> Line {
    let RecorderView { files, records, lost, unwritten, problem } = recorder;
    let file = files.last().map_or_else(|| "no file yet".into(), |file| file.display().to_string());
    let more = if files.len() > 1 { format!(" ({} files)", files.len()) } else { String::new() };
    let bad = lost + unwritten > 0;
    let problem = problem.as_ref().filter(|_| bad).map_or(String::new(), |problem| format!("; {problem}"));
    let text = format!(
        "recording to {file}{more}: {records} records, {lost} lost, {unwritten} not written{problem}"
    );
    Line::of(text, if bad { Tone::Alarm } else { Tone::Plain })
}

fn time(nanos: Nanos) -> String {
    output::seconds(to_seconds(nanos))
}

fn node(node: &NodeView) -> Vec<Cell> {
    let seen = node.rate.is_some();
    let duration = |value: Nanos| number(if seen { time(value) } else { "-".into() });
    let state = match &node.state {
        NodeState::Starting => "starting".into(),
        NodeState::Idle => "idle".into(),
        NodeState::Stepping { .. } => "stepping".into(),
        NodeState::Waiting { sender } => format!("waits for {sender}"),
        NodeState::Silent { since } => format!("silent {:.1} s", to_seconds(*since)),
        NodeState::Gone => "gone".into(),
    };
    let bad = matches!(node.state, NodeState::Silent { .. } | NodeState::Gone);
    let slow = node.rate.is_some_and(|rate| rate < 0.95 * node.declared_rate);
    let core = match (node.core, node.on_core) {
        (Some(core), _) => core.to_string(),
        (None, Some(core)) => format!("any, {core}"),
        (None, None) => "any".into(),
    };
    let policy = match (node.policy, node.priority) {
        (Policy::Fifo, Some(priority)) => format!("fifo {priority}"),
        (Policy::Rr, Some(priority)) => format!("rr {priority}"),
        _ => "other".into(),
    };
    let missed = node.deadline.map_or_else(|| "-".into(), |_| node.late.to_string());
    let id = |id: Option<u32>| number(id.map_or_else(|| "-".into(), |id| id.to_string()));
    vec![
        word(&node.node),
        word(state).alarm_if(bad),
        number(node.rate.map_or_else(|| "-".into(), |rate| format!("{rate:.1}"))).alarm_if(slow),
        number(format!("{}", node.declared_rate)),
        duration(node.lateness.p50),
        duration(node.lateness.p99),
        duration(node.computation.p50),
        duration(node.computation.p99),
        number(missed).alarm_if(node.late_now > 0),
        number(node.overruns.to_string()),
        number(node.restarts.to_string()).alarm_if(node.restarts > 0),
        word(core),
        word(policy),
        number(node.cpu.map_or_else(|| "-".into(), |cpu| format!("{:.1} %", 100.0 * cpu))),
        id(node.process),
        id(node.thread),
    ]
}

fn connection(connection: &ConnectionView) -> Vec<Cell> {
    let ConnectionView { from, to, port, delay, .. } = connection;
    let name = if port == from { format!("{from} -> {to}") } else { format!("{from} -> {to}.{port}") };
    let seen = connection.delay.max > 0;
    let duration = |value: Nanos| number(if seen { time(value) } else { "-".into() });
    let lost: Vec<String> = connection
        .lost
        .iter()
        .map(|(reason, count)| format!("{count} ({})", reason.name()))
        .chain((connection.not_sent > 0).then(|| format!("{} never sent", connection.not_sent)))
        .chain((connection.held_back > 0).then(|| format!("{} held back", connection.held_back)))
        .collect();
    vec![
        word(name),
        number(format!("{:.1}", connection.rate)),
        duration(delay.p50),
        duration(delay.p99),
        duration(delay.max),
        number(format!("{}/{}", connection.filled, connection.window)),
        number(format!("{}/{}", connection.waiting, connection.capacity)),
        number(connection.superseded.to_string()),
        number(connection.safe.to_string()).alarm_if(connection.safe > 0),
        if lost.is_empty() { number("0") } else { word(lost.join(", ")).alarm_if(connection.lost_now > 0) },
    ]
}

/// Rows below a header, in columns as wide as they need.
fn table(header: &[&str], rows: Vec<Vec<Cell>>) -> Vec<Line> {
    let width = |column: usize| {
        let cells = rows.iter().map(|row| row[column].text.chars().count());
        cells.chain([header[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..header.len()).map(width).collect();
    let right: Vec<bool> = (0..header.len())
        .map(|column| !rows.is_empty() && rows.iter().all(|row| row[column].right))
        .collect();
    let pad = |text: &str, column: usize| {
        let space = " ".repeat(widths[column] - text.chars().count());
        if right[column] { format!("  {space}{text}") } else { format!("  {text}{space}") }
    };
    let head: String = header.iter().enumerate().map(|(column, text)| pad(text, column)).collect();
    let line = |row: &Vec<Cell>| {
        let cell = |(column, cell): (usize, &Cell)| {
            (pad(&cell.text, column), if cell.alarm { Tone::Alarm } else { Tone::Plain })
        };
        Line(row.iter().enumerate().map(cell).collect())
    };
    [Line::of(head, Tone::Head)].into_iter().chain(rows.iter().map(line)).collect()
}
