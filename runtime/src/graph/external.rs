//! Nodes whose messages follow from the graph: those that another program runs, and kinds that are made for one node.
//!
//! A kind of node says what its messages are. The kinds of another program are not known here, so a graph says it: a
//! node's inputs take what its senders send, and it sends what its receivers expect, or what its parameters declare:
//! `output = { message = "robot/Torque", leaves = ["torque"] }`. What receivers see before its first message are zeros, or
//! `initial = { torque = 1.0 }`.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::{ConnectionSpec, GraphError, GraphSpec, NodeSpec};
use crate::node::Layout;
use crate::registry::{ExternalInput, InputPort, NodeKind, Registry};

/// What the parameters of an external node say of its messages.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Output {
    message: String,
    leaves: Vec<String>,
    #[serde(default)]
    data: usize,
}

/// What an external node sends.
struct Sent {
    layout: Layout,
    data: usize,
}

/// The kind of a node: as the registry has it, or, for an external one, with the messages that the graph implies.
/// `None` when the registry does not know it.
pub(super) fn kind(
    spec: &GraphSpec,
    node: &NodeSpec,
    registry: &Registry,
) -> Result<Option<NodeKind>, GraphError> {
    let Some(kind) = registry.get(&node.kind) else { return Ok(None) };
    if let Some(make) = kind.maker() {
        let layout = |name: &str| messages(spec, name, registry, true);
        return make(spec, node, &layout).map(Some).map_err(|problem| wrong(node, problem));
    }
    if !kind.is_external() {
        return Ok(Some(kind.clone()));
    }
    let Sent { layout, data } = sent(spec, node, registry)?;
    let mut inputs: Vec<ExternalInput> = Vec::new();
    for connection in spec.connections.iter().filter(|connection| connection.to == node.name) {
        // A sender that is not there is told of where connections are checked.
        let Some(sender) = spec.nodes.iter().find(|other| other.name == connection.from) else { continue };
        let layout = match registry.get(&sender.kind) {
            Some(kind) if kind.is_external() => sent(spec, sender, registry)?.layout,
            _ => match messages(spec, &sender.name, registry, true) {
                Some(layout) => layout,
                None => continue,
            },
        };
        if !inputs.iter().any(|input| input.port.name == connection.port()) {
            let port = InputPort { name: connection.port().to_owned(), layout };
            inputs.push(ExternalInput { port, window: connection.window });
        }
    }
    let initial = initial(node, &layout)?;
    Ok(Some(kind.shaped(inputs, layout, initial, data)))
}

/// What the node called `name` sends, as far as that can be told. `follow`: also where it follows from the graph itself; one
/// such node is not asked what another one sends, for they could ask each other.
fn messages(spec: &GraphSpec, name: &str, registry: &Registry, follow: bool) -> Option<Layout> {
    let node = spec.nodes.iter().find(|node| node.name == name)?;
    let kind = registry.get(&node.kind)?;
    if let Some(make) = kind.maker() {
        let layout = |name: &str| messages(spec, name, registry, false);
        return if follow { Some(make(spec, node, &layout).ok()?.output().clone()) } else { None };
    }
    if kind.is_external() {
        Some(sent(spec, node, registry).ok()?.layout)
    } else {
        Some(kind.output().clone())
    }
}

fn wrong(node: &NodeSpec, problem: impl Into<String>) -> GraphError {
    GraphError::External { node: node.name.clone(), problem: problem.into() }
}

/// What a node sends: what it declares, or what its receivers expect.
fn sent(spec: &GraphSpec, node: &NodeSpec, registry: &Registry) -> Result<Sent, GraphError> {
    if let Some(declared) = node.parameters.get("output") {
        let Output { message, leaves, data } = serde_json::from_value(declared.clone())
            .map_err(|error| wrong(node, format!("parameter `output`: {error}")))?;
        return Ok(Sent { layout: Layout { name: message, leaves }, data });
    }
    let expected = |connection: &ConnectionSpec| {
        let receiver = spec.nodes.iter().find(|other| other.name == connection.to)?;
        let ports = registry.get(&receiver.kind)?.inputs();
        ports.iter().find(|port| port.name == connection.port()).map(|port| port.layout.clone())
    };
    let mut receivers = spec.connections.iter().filter(|connection| connection.from == node.name);
    let layout = receivers.find_map(expected).ok_or_else(|| {
        wrong(
            node,
            "no receiver says what it sends; declare it: parameters = { output = { message = \"robot/Torque\", leaves = \
             [\"torque\"] }, … }",
        )
    })?;
    Ok(Sent { layout, data: 0 })
}

fn initial(node: &NodeSpec, layout: &Layout) -> Result<Vec<f64>, GraphError> {
    let Some(declared) = node.parameters.get("initial") else { return Ok(vec![0.0; layout.leaves.len()]) };
    let values: BTreeMap<String, f64> = serde_json::from_value(declared.clone())
        .map_err(|error| wrong(node, format!("parameter `initial`: {error}")))?;
    if let Some(unknown) = values.keys().find(|name| layout.leaf(name).is_none()) {
        return Err(wrong(node, format!("parameter `initial` names `{unknown}`, and it sends {layout}")));
    }
    Ok(layout.leaves.iter().map(|leaf| values.get(leaf).copied().unwrap_or(0.0)).collect())
}
