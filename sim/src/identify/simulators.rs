//! The recorded graph with simulators in the place of what no machine records, and with the delays that are to be found.

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, NodeSpec};

use super::error::IdentifyError;
use super::spec::{HiddenDelay, Simulated, Specification};
use crate::augment::{Augmentation, EdgeDelay};
use crate::compiled::Interpolation;

/// The longest a delay without an upper bound is looked for at first, s.
const FIRST_LONGEST: f64 = 0.05;

fn change(node: &mut NodeSpec, simulated: &Simulated) {
    let other = simulated.kind.as_ref().is_some_and(|kind| *kind != node.kind);
    if let Some(kind) = &simulated.kind {
        node.kind.clone_from(kind);
    }
    match &simulated.parameters {
        Some(parameters) => node.parameters.clone_from(parameters),
        None if other => node.parameters.clear(),
        None => {}
    }
}

/// What a specification adds to a recorded graph.
pub(super) fn augmentation<'a>(
    graph: &'a Graph,
    specification: &Specification,
) -> Result<Augmentation<'a>, IdentifyError> {
    let mut augmentation = Augmentation::new(graph);
    let mut added = Vec::new();
    for simulated in &specification.nodes {
        let whose = format!("nodes.{}", simulated.node);
        let wrong = |problem: String| Err(IdentifyError::Value { whose: whose.clone(), problem });
        let mut node = match (graph.spec().node(&simulated.node), &simulated.kind, simulated.rate) {
            (Some(node), _, _) => node.clone(),
            (None, Some(kind), Some(rate)) => NodeSpec::new(&simulated.node, kind, rate),
            _ => {
                let known: Vec<&str> = graph.nodes().iter().map(|node| node.name.as_str()).collect();
                return wrong(format!(
                    "the recorded graph has no such node (it has {}); a new one needs a `kind` and a `rate`",
                    known.join(", ")
                ));
            }
        };
        change(&mut node, simulated);
        let Some(rate) = simulated.rate else {
            augmentation = augmentation.recast(node);
            continue;
        };
        if !(rate.is_finite() && rate > 0.0) {
            return wrong(format!("the rate {rate} has to be above zero"));
        }
        added.push(node.name.clone());
        let node = NodeSpec { rate, computation: Delay::ZERO, advance: false, ..node };
        augmentation = augmentation.node(node, 0.0);
    }
    for edge in &specification.connections {
        augmentation = known(augmentation, edge, &added);
    }
    // What flows from and to simulators, and is not to be found, takes as long as the graph expects.
    for edge in &graph.spec().connections {
        let touches = added.contains(&edge.from) || added.contains(&edge.to);
        let hidden = specification.delays.iter().any(|delay| feeds(delay, edge));
        let same = |new: &ConnectionSpec| new.to == edge.to && new.port() == edge.port();
        if touches && !hidden && !specification.connections.iter().any(same) {
            augmentation = known(augmentation, edge, &added);
        }
    }
    for delay in &specification.delays {
        let whose = format!("delays.\"{}\"", delay.name);
        let edge = graph.spec().connections.iter().find(|edge| feeds(delay, edge)).cloned();
        let edge = edge.unwrap_or_else(|| ConnectionSpec {
            port: delay.port.clone(),
            ..ConnectionSpec::new(&delay.from, &delay.to)
        });
        for end in [&delay.from, &delay.to] {
            let is_there = graph.index(end).is_some() || added.contains(end);
            if !is_there {
                let known: Vec<&str> = graph.nodes().iter().map(|node| node.name.as_str()).collect();
                let new = added.iter().map(String::as_str).filter(|name| graph.index(name).is_none());
                let known = known.iter().copied().chain(new);
                return Err(IdentifyError::Unknown {
                    whose,
                    what: "node",
                    name: end.clone(),
                    known: known.collect::<Vec<_>>().join(", "),
                });
            }
        }
        let max = longest(delay);
        if !(delay.min >= 0.0 && delay.min < max && max.is_finite()) {
            let problem = format!("the bounds {} and {max} s need 0 <= min < max", delay.min);
            return Err(IdentifyError::Value { whose, problem });
        }
        let simulator = added.contains(&delay.to);
        let suited = match (simulator, added.contains(&delay.from)) {
            (true, _) => Interpolation::Hold,
            (false, true) => Interpolation::Smooth,
            (false, false) => Interpolation::Linear,
        };
        let interpolation = delay.interpolation.unwrap_or(suited);
        let whole = simulator && interpolation == Interpolation::Hold;
        let window = delay.window.unwrap_or(if whole { edge.window.max(3) } else { edge.window });
        // What arrives at the very tick is of the next one; so loops through a simulator are none.
        let skip = edge.skip || simulator;
        let edge = ConnectionSpec { blocking: false, skip, window, ..edge.clone() };
        augmentation =
            augmentation.connect(edge, EdgeDelay::Trainable { min: delay.min, max, interpolation });
    }
    Ok(augmentation)
}

/// A connection whose delay is known. What a simulator sends is seen between its ticks.
fn known<'a>(augmentation: Augmentation<'a>, edge: &ConnectionSpec, added: &[String]) -> Augmentation<'a> {
    let seconds = edge.delay.expected();
    let simulator = added.contains(&edge.to);
    let window = if simulator { edge.window.max(3) } else { edge.window };
    let edge = ConnectionSpec { blocking: false, skip: edge.skip || simulator, window, ..edge.clone() };
    let delay = match added.contains(&edge.from) {
        true => EdgeDelay::Trainable { min: seconds, max: seconds, interpolation: Interpolation::Smooth },
        false => EdgeDelay::Given(Delay::constant(seconds)),
    };
    augmentation.connect(edge, delay)
}

/// The longest a delay can be, s.
pub(super) fn longest(delay: &HiddenDelay) -> f64 {
    delay.max.unwrap_or(delay.min + FIRST_LONGEST)
}

/// Whether a hidden delay is that of this connection.
pub(super) fn feeds(delay: &HiddenDelay, edge: &ConnectionSpec) -> bool {
    edge.from == delay.from
        && edge.to == delay.to
        && delay.port.as_deref().is_none_or(|port| edge.port() == port)
}
