//! What the stamps and the recorded edges prove, before any fit: timing, and each node by itself.

use super::{Report, format};
use crate::nodes::Verdict;

/// Departures that are listed; more are counted.
const LISTED: usize = 4;

/// Lines of text, each under `timing` or `nodes`; none where nothing of the kind was recorded.
pub(super) fn lines(report: &Report) -> Vec<(&'static str, String)> {
    let mut lines = Vec::new();
    if let Some(timing) = &report.timing {
        let departures = timing.departures();
        if departures.is_empty() && !timing.connections.is_empty() {
            lines.push(("timing", "nothing beyond what the graph declares".to_owned()));
        }
        for departure in departures.iter().take(LISTED) {
            let parameters: Vec<String> = departure
                .parameters
                .iter()
                .map(|(name, value)| format!("{name} {}", format::uncertain(value)))
                .collect();
            let text = format!(
                "{}@{} beyond what the graph declares: {}",
                departure.name,
                departure.place,
                parameters.join(", ")
            );
            lines.push(("timing", text));
        }
        if departures.len() > LISTED {
            lines.push(("timing", format!("and {} more in report.json", departures.len() - LISTED)));
        }
    }
    if let Some(found) = &report.nodes {
        let of = |verdict: Verdict| -> Vec<&str> {
            found.nodes.iter().filter(|n| n.verdict == verdict).map(|n| n.place.as_str()).collect()
        };
        let cleared = of(Verdict::Cleared);
        if !cleared.is_empty() {
            let verb = if cleared.len() > 1 { "give their outputs" } else { "gives its output" };
            lines.push(("nodes", format!("{} {verb} again from the recorded inputs", cleared.join(", "))));
        }
        for node in found.nodes.iter().filter(|n| n.verdict == Verdict::Differs) {
            let gap = format::number(node.gap, 3);
            lines.push((
                "nodes",
                format!("{} does not give its recorded output: {gap} units of its resolution", node.place),
            ));
        }
        let stretches: Vec<String> =
            found.unrecorded.iter().map(|s| format!("{} to {}", s.actuator, s.sensor)).collect();
        if !stretches.is_empty() {
            lines.push(("nodes", format!("no node records the stretch from {}", stretches.join(", "))));
        }
    }
    lines
}
