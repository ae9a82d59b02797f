//! What was found as a graph that runs.

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{GraphSpec, NodeSpec};
use parallax_runtime::node::NodeContext;
use parallax_runtime::registry::{NodeKind, Registry};
use serde_json::{Map, Value};

use super::coordinate::Sort;
use super::identified::{Estimate, Hump, Identified};
use super::location::parameter;
use super::problem::Problem;
use crate::batch::Place;

/// Which number of a model a parameter in a graph is to set.
#[derive(Clone, Copy)]
enum Number {
    Param(usize),
    State(usize),
}

/// The graph of a problem with what was found in it: simulators, parameters, first states (of the first recording) and
/// hidden delays. Also what could not be written into it, in sentences: a kind may not let a graph set every number that
/// its model has.
pub fn identified_graph(
    problem: &Problem,
    found: &Identified,
    registry: &Registry,
) -> (GraphSpec, Vec<String>) {
    let mut spec = problem.graph().spec().clone();
    let mut notes = Vec::new();
    let mut pending = Vec::new();
    for (coordinate, estimate) in problem.coordinates.iter().zip(&found.estimates) {
        if coordinate.recording.is_some_and(|recording| recording > 0) {
            continue;
        }
        for place in &coordinate.places {
            match *place {
                Place::Delay { connection } => {
                    spec.connections[connection].delay = delay(found, estimate);
                }
                Place::Param { node, leaf } => pending.push((estimate, node, Number::Param(leaf))),
                Place::State { node, leaf } => pending.push((estimate, node, Number::State(leaf))),
            }
        }
    }
    for estimate in found.estimates.iter().filter(|estimate| estimate.sort == Sort::Linear) {
        match parameter(problem, &estimate.name) {
            Some(Place::Param { node, leaf }) => pending.push((estimate, node, Number::Param(leaf))),
            _ => notes
                .push(format!("the coefficient `{}` is no parameter that the graph can set", estimate.name)),
        }
    }
    // A kind may take one number only when another is there: those that were refused are tried again.
    let mut before = usize::MAX;
    while pending.len() < before {
        before = pending.len();
        pending.retain(|&(estimate, node, number)| {
            !set(&mut spec.nodes[node], &problem.graph().nodes()[node].kind, number, estimate.value)
        });
    }
    for (estimate, node, _) in pending {
        let node = &spec.nodes[node].name;
        notes.push(format!("the kind of node `{node}` does not let a graph set `{}`", estimate.name));
    }
    if let Err(error) = spec.validate(registry) {
        notes.push(format!("the graph cannot run as it is: {error}"));
    }
    (spec, notes)
}

/// The distribution that was found of a delay.
fn delay(found: &Identified, estimate: &Estimate) -> Delay {
    if let Some(found) = found.humps.iter().find(|humps| humps.delay == estimate.name) {
        let list = |of: fn(&Hump) -> f64| found.humps.iter().map(of).collect();
        return Delay::Mixture {
            weights: list(|hump| hump.share.value),
            means: list(|hump| hump.mean.value),
            stds: list(|hump| hump.spread.value),
        };
    }
    match found.estimate(&format!("{}.spread", estimate.name)) {
        Some(spread) => Delay::Normal { mean: estimate.value, std: spread.value },
        None => Delay::constant(estimate.value),
    }
}

/// Sets the entry of a node's parameters that moves a number of its model, if there is one: named like the whole leaf, as
/// tables within tables, or like its last part.
fn set(node: &mut NodeSpec, kind: &NodeKind, number: Number, value: f64) -> bool {
    let Some(model) = kind.node_model() else { return false };
    let leaf = match number {
        Number::Param(leaf) => model.model().params().get(leaf).cloned(),
        Number::State(leaf) => model.model().state().get(leaf).cloned(),
    };
    let Some(leaf) = leaf else { return false };
    let parts: Vec<&str> = leaf.split('.').collect();
    let section = match number {
        Number::Param(_) => "parameters",
        Number::State(_) => "initial",
    };
    let last = &parts[parts.len() - 1..];
    for path in [&parts[..], last, &[&[section], &parts[..]].concat()] {
        let mut changed = node.clone();
        if !insert(&mut changed.parameters, path, value) {
            continue;
        }
        let context = NodeContext {
            name: changed.name.clone(),
            rate: changed.rate,
            seed: 0,
            parameters: changed.parameters.clone(),
        };
        let Ok(start) = model.start(&context) else { continue };
        let now = match number {
            Number::Param(leaf) => start.params[leaf],
            Number::State(leaf) => start.state[leaf],
        };
        if (now - value).abs() <= 1e-12 * value.abs() {
            *node = changed;
            return true;
        }
    }
    false
}

fn insert(parameters: &mut Map<String, Value>, path: &[&str], value: f64) -> bool {
    match path {
        [] => false,
        [last] => {
            parameters.insert((*last).to_owned(), Value::from(value));
            true
        }
        [first, rest @ ..] => {
            let inner = parameters.entry((*first).to_owned()).or_insert_with(|| Value::Object(Map::new()));
            inner.as_object_mut().is_some_and(|inner| insert(inner, rest, value))
        }
    }
}
