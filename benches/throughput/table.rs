//! The report for a person: a table for each case, other values, and what was aimed at.

use std::fmt::Write as _;

use crate::line::Line;
use crate::native::{LIMIT, OURS};

/// The name under which the Python package reports.
const JAX: &str = "Parallax, jax";

/// Everything as text, in Markdown.
pub(crate) fn text(lines: &[Line]) -> String {
    let mut text = String::new();
    let mut cases: Vec<&str> = Vec::new();
    for line in lines.iter().filter(|line| !line.case.is_empty() && !line.case.contains("growth")) {
        if !cases.contains(&line.case.as_str()) {
            cases.push(&line.case);
        }
    }
    for case in cases {
        throughput(&mut text, case, lines);
    }
    values(&mut text, lines);
    growth(&mut text, lines);
    aims(&mut text, lines);
    text
}

/// One row for each peer, one column for each number of environments.
fn throughput(text: &mut String, case: &str, lines: &[Line]) {
    let of_case: Vec<&Line> = lines.iter().filter(|line| line.case == case).collect();
    let mut envs: Vec<usize> = of_case.iter().map(|line| line.envs).collect();
    envs.sort_unstable();
    envs.dedup();
    let mut rows: Vec<(String, &str, &str)> = Vec::new();
    for line in &of_case {
        let row = (line.peer.clone(), line.way.as_str(), line.dtype.as_str());
        if !rows.contains(&row) {
            rows.push(row);
        }
    }
    let _ = writeln!(
        text,
        "\n### {case}\n\nMillion supervisor steps a second on one core: the best repetition (the median).\n"
    );
    let head: Vec<String> = envs.iter().map(|envs| format!(" {envs} |")).collect();
    let _ = writeln!(text, "| | precision |{}", head.concat());
    let _ = writeln!(text, "| :-- | :-- |{}", " --: |".repeat(envs.len()));
    for (peer, way, dtype) in rows {
        let name = if way.is_empty() { peer.clone() } else { format!("{peer} ({way})") };
        let _ = write!(text, "| {name} | {dtype} |");
        for envs in &envs {
            let found = of_case.iter().find(|line| {
                line.peer == peer && line.way == way && line.dtype == dtype && line.envs == *envs
            });
            match found {
                Some(line) => {
                    let _ = write!(text, " {} ({}) |", millions(line.best()), millions(line.median()));
                }
                None => text.push_str(" |"),
            }
        }
        text.push('\n');
    }
}

fn values(text: &mut String, lines: &[Line]) {
    let _ = writeln!(text, "\n### Other figures\n\n| | | | |\n| :-- | :-- | --: | :-- |");
    for line in lines {
        if let Some(amount) = line.amount {
            let amount = significant(amount);
            let _ = writeln!(
                text,
                "| {} | {} | {amount} {} | {} |",
                line.value, line.peer, line.unit, line.detail
            );
        }
    }
}

/// Seconds over environments and over steps.
fn growth(text: &mut String, lines: &[Line]) {
    let grown: Vec<&Line> = lines.iter().filter(|line| line.case.contains("growth")).collect();
    if grown.is_empty() {
        return;
    }
    let _ = writeln!(text, "\n### Growth\n\n| | environments | million steps/s |\n| :-- | --: | --: |");
    for line in grown {
        let _ = writeln!(
            text,
            "| {} | {} | {} ({}) |",
            line.case,
            line.envs,
            millions(line.best()),
            millions(line.median())
        );
    }
}

/// The best of the lines that are meant.
fn best(lines: &[Line], peer: &str, case: &str, dtype: &str, envs: usize) -> Option<f64> {
    let meant = |line: &&Line| {
        line.peer.starts_with(peer)
            && line.case == case
            && line.envs == envs
            && (dtype.is_empty() || line.dtype == dtype)
    };
    lines.iter().filter(meant).map(Line::best).max_by(f64::total_cmp)
}

fn amount(lines: &[Line], peer: &str, value: &str) -> Option<f64> {
    lines.iter().find(|line| line.peer.starts_with(peer) && line.value == value).and_then(|line| line.amount)
}

/// What was aimed at, and what is reached.
fn aims(text: &mut String, lines: &[Line]) {
    let _ = writeln!(text, "\n### Aims\n\n| | aim | measured | |\n| :-- | --: | --: | :-- |");
    let mut aim = |what: &str, least: bool, wanted: f64, measured: Option<f64>, unit: &str| {
        let sign = if least { "≥" } else { "≤" };
        let (shown, verdict) = match measured {
            None => ("not measured".to_owned(), ""),
            Some(value) if (value >= wanted) == least || value == wanted => (significant(value), "reached"),
            Some(value) => (significant(value), "short"),
        };
        let _ =
            writeln!(text, "| {what} | {sign} {}{unit} | {shown}{unit} | {verdict} |", significant(wanted));
    };
    let ratio = |a: Option<f64>, b: Option<f64>| Some(a? / b?);
    for case in ["pendulum", "quadrotor"] {
        let graph = format!("{case}, graph with delays");
        let bare = format!("{case}, bare");
        let million = |value: Option<f64>| value.map(|value| value / 1e6);
        if case == "pendulum" {
            let one = million(best(lines, OURS, &graph, "f64", 1));
            aim("pendulum, native, graph, f64, 1 environment", true, 3.0, one, " M/s");
            let many = million(best(lines, OURS, &graph, "f64", 1024));
            aim("pendulum, native, graph, f64, 1,024 environments", true, 60.0, many, " M/s");
            for dtype in ["f64", "f32"] {
                let (ours, limit) =
                    (best(lines, OURS, &bare, dtype, 1024), best(lines, LIMIT, &bare, dtype, 1024));
                let what = format!("pendulum, bare, {dtype}, over the loop written by hand");
                aim(&what, true, 0.5, ratio(ours, limit), "");
            }
            let steps = amount(lines, OURS, "pendulum, node steps under the simulated clock");
            aim("node steps under the simulated clock", true, 1.0, million(steps), " M/s");
            let state = amount(lines, JAX, "pendulum, state per environment of 10 s");
            aim("pendulum, state for each environment", false, 2000.0, state, " B");
        }
        for dtype in ["f32", "f64"] {
            let scan = best(lines, "lax.scan", &bare, dtype, 1024);
            let ours = best(lines, JAX, &graph, dtype, 1024);
            let what = format!("{case}, JAX, graph, {dtype}, 1,024 environments, over lax.scan");
            aim(&what, true, 0.8, ratio(ours, scan), "");
        }
        for envs in [1, 128, 1024] {
            let rex = best(lines, "rex-lib", &graph, "f32", envs);
            let ours = best(lines, JAX, &graph, "f32", envs);
            let what =
                format!("{case}, JAX, graph, f32, environments: {envs}, over rex-lib on the better jax");
            aim(&what, true, 1.0, ratio(ours, rex), "");
        }
        let first = amount(lines, JAX, &format!("{case}, from graph to first rollout"));
        aim(&format!("{case}, JAX, from graph to first rollout"), false, 3.0, first, " s");
    }
}

fn millions(rate: f64) -> String {
    significant(rate / 1e6)
}

/// Three significant digits, as far as they are digits after the point.
fn significant(value: f64) -> String {
    let digits = (2 - value.abs().max(1e-6).log10().floor() as i32).max(0) as usize;
    format!("{value:.digits$}")
}
