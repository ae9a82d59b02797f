//! From a graph as written to a graph that can run.

use std::collections::BTreeMap;

use parallax_model::system::Suggestion;

use super::error::MAX_WINDOW;
use super::external;
use super::{
    ConnectionPlan, ConnectionSpec, Graph, GraphError, GraphSpec, GraphWarning, NodePlan, SafeOutput,
};
use crate::registry::Registry;
use crate::time::Grid;

/// How long a receiver may fall behind its sender before messages are lost, s.
const BACKLOG: f64 = 1.0;
/// Bounds on the messages that this backlog is worth.
const MIN_BACKLOG: usize = 16;
const MAX_BACKLOG: usize = 8192;
/// Bytes of data that may wait at one place, unless they are of two messages only.
const WAITING_BYTES: usize = 32 << 20;

impl GraphSpec {
    /// Checks the graph against the kinds of node in `registry`, and plans it.
    ///
    /// Whether the cores exist is a question to the machine: [`Graph::check_cores`].
    ///
    /// # Errors
    ///
    /// The first [`GraphError`], in the order: nodes, connections, inputs that are not connected, cycles.
    pub fn validate(&self, registry: &Registry) -> Result<Graph, GraphError> {
        let mut nodes = plan_nodes(self, registry)?;
        let supervisor = nodes.iter().position(|node| node.name == self.supervisor).ok_or_else(|| {
            GraphError::UnknownSupervisor {
                name: self.supervisor.clone(),
                suggestion: nearest_node(&self.supervisor, &nodes),
            }
        })?;
        let connections = plan_connections(self, &mut nodes)?;
        let edges = |keep: fn(&ConnectionPlan) -> bool| -> Vec<(usize, usize)> {
            connections.iter().filter(|plan| keep(plan)).map(|plan| (plan.from, plan.to)).collect()
        };
        let name = |cycle: Vec<usize>| cycle.into_iter().map(|node| nodes[node].name.clone()).collect();
        let order = sort(nodes.len(), &edges(|plan| !plan.skip))
            .map_err(|cycle| GraphError::Cycle { nodes: name(cycle) })?;
        let advancing: Vec<(usize, usize)> = edges(|_| true)
            .into_iter()
            .filter(|&(from, to)| nodes[from].advance && nodes[to].advance)
            .collect();
        sort(nodes.len(), &advancing).map_err(|cycle| GraphError::AdvanceCycle { nodes: name(cycle) })?;

        // A sender's phase is known before those of its receivers.
        for (rank, &node) in order.iter().enumerate() {
            let phase = nodes[node]
                .inputs
                .iter()
                .map(|&connection| &connections[connection])
                .filter(|plan| !plan.skip)
                .map(|plan| nodes[plan.from].grid.phase().saturating_add(plan.expected))
                .max()
                .unwrap_or(0);
            nodes[node].grid = nodes[node].grid.with_phase(phase);
            nodes[node].rank = rank;
        }
        let warnings = shared_cores(&nodes);
        Ok(Graph { spec: self.clone(), nodes, connections, order, supervisor, warnings })
    }
}

fn plan_nodes(spec: &GraphSpec, registry: &Registry) -> Result<Vec<NodePlan>, GraphError> {
    if spec.nodes.is_empty() {
        return Err(GraphError::NoNodes { graph: spec.name.clone() });
    }
    let mut nodes: Vec<NodePlan> = Vec::with_capacity(spec.nodes.len());
    for node in &spec.nodes {
        let name = node.name.clone();
        let legal = name.starts_with(|c: char| c.is_ascii_alphabetic())
            && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        if !legal {
            return Err(GraphError::NodeName { name });
        }
        if nodes.iter().any(|other| other.name == name) {
            return Err(GraphError::DuplicateNode { name });
        }
        let kind = external::kind(spec, node, registry)?.ok_or_else(|| GraphError::UnknownKind {
            node: name.clone(),
            kind: node.kind.clone(),
            suggestion: Suggestion::nearest(&node.kind, registry.names()),
            known: list(registry.names()),
        })?;
        let grid = Grid::new(0, node.rate)
            .ok_or_else(|| GraphError::Rate { node: name.clone(), rate: node.rate })?;
        if let Some(problem) = node.computation.problem() {
            return Err(GraphError::Delay { what: format!("computation delay of node `{name}`"), problem });
        }
        if let Some(leaf) = node.computation.leaf()
            && kind.output().leaf(leaf).is_none()
        {
            let leaves = || kind.output().leaves.iter().map(String::as_str);
            return Err(GraphError::DelayLeaf {
                node: name,
                leaf: leaf.to_owned(),
                suggestion: Suggestion::nearest(leaf, leaves()),
                known: list(leaves()),
            });
        }
        let safe = SafeOutput::plan(&name, node.safe.as_ref(), &kind)?;
        nodes.push(NodePlan {
            name,
            kind,
            grid,
            computation: node.computation.clone(),
            scheduling: node.scheduling,
            advance: node.advance,
            on_dead_sender: node.on_dead_sender,
            core: node.core,
            safe,
            inputs: Vec::new(),
            outputs: Vec::new(),
            rank: 0,
        });
    }
    Ok(nodes)
}

fn plan_connections(spec: &GraphSpec, nodes: &mut [NodePlan]) -> Result<Vec<ConnectionPlan>, GraphError> {
    // Which connection feeds each input of each node.
    let mut fed: Vec<Vec<Option<usize>>> =
        nodes.iter().map(|node| vec![None; node.kind.inputs().len()]).collect();
    let mut connections: Vec<ConnectionPlan> = Vec::with_capacity(spec.connections.len());
    for connection in &spec.connections {
        let plan = plan_connection(spec, connection, nodes)?;
        if let Some(first) = fed[plan.to][plan.input].replace(connections.len()) {
            return Err(GraphError::DuplicateConnection {
                node: connection.to.clone(),
                port: plan.port,
                first: nodes[connections[first].from].name.clone(),
                second: connection.from.clone(),
            });
        }
        nodes[plan.from].outputs.push(connections.len());
        connections.push(plan);
    }
    for (node, fed) in nodes.iter_mut().zip(fed) {
        for (port, feed) in node.kind.inputs().iter().zip(fed) {
            node.inputs.push(feed.ok_or_else(|| GraphError::Unconnected {
                node: node.name.clone(),
                port: port.name.clone(),
            })?);
        }
    }
    for node in nodes.iter().filter(|node| node.advance) {
        if node.inputs.is_empty() {
            return Err(GraphError::AdvanceWithoutInputs { node: node.name.clone() });
        }
        for plan in node.inputs.iter().map(|&input| &connections[input]) {
            if !plan.blocking {
                return Err(GraphError::AdvanceNotBlocking {
                    node: node.name.clone(),
                    from: nodes[plan.from].name.clone(),
                });
            }
        }
    }
    Ok(connections)
}

fn plan_connection(
    spec: &GraphSpec,
    connection: &ConnectionSpec,
    nodes: &[NodePlan],
) -> Result<ConnectionPlan, GraphError> {
    let ConnectionSpec { from, to, .. } = connection;
    let find = |name: &str| {
        nodes.iter().position(|node| node.name == name).ok_or_else(|| GraphError::UnknownNode {
            from: from.clone(),
            to: to.clone(),
            name: name.to_owned(),
            suggestion: nearest_node(name, nodes),
        })
    };
    let (sender, receiver) = (find(from)?, find(to)?);
    let ports = nodes[receiver].kind.inputs();
    let port = connection.port();
    let input = ports.iter().position(|input| input.name == port).ok_or_else(|| GraphError::UnknownPort {
        from: from.clone(),
        to: to.clone(),
        port: port.to_owned(),
        suggestion: Suggestion::nearest(port, ports.iter().map(|input| input.name.as_str())),
        known: list(ports.iter().map(|input| input.name.as_str())),
    })?;
    let (sent, taken) = (nodes[sender].kind.output(), &ports[input].layout);
    if sent != taken {
        return Err(GraphError::LayoutMismatch {
            from: from.clone(),
            to: to.clone(),
            port: port.to_owned(),
            sent: sent.to_string(),
            taken: taken.to_string(),
        });
    }
    if connection.window == 0 || connection.window > MAX_WINDOW {
        return Err(GraphError::Window { from: from.clone(), to: to.clone(), window: connection.window });
    }
    if let Some(problem) = connection.delay.problem() {
        return Err(GraphError::Delay { what: format!("delay of connection {from} -> {to}"), problem });
    }
    if let Some(leaf) = connection.delay.leaf() {
        let (from, to) = (from.clone(), to.clone());
        return Err(GraphError::DelayOfOutput { from, to, leaf: leaf.to_owned() });
    }
    let expected = nodes[sender].computation.expected() + connection.delay.expected();
    let data = nodes[sender].kind.data_capacity();
    Ok(ConnectionPlan {
        from: sender,
        to: receiver,
        input,
        port: port.to_owned(),
        blocking: connection.blocking,
        window: connection.window,
        skip: connection.skip,
        jitter: connection.jitter,
        delay: connection.delay.clone(),
        expected: nodes[sender]
            .computation
            .expected_nanos()
            .saturating_add(connection.delay.expected_nanos()),
        capacity: capacity(connection.window, spec.nodes[sender].rate, expected, data),
        leaves: sent.leaves.len(),
        data,
    })
}

/// Room for the window, for what arrives while the receiver is late, and for what a jitter buffer holds back. Messages
/// with data keep their places in shared memory: of these there are fewer where they are large.
fn capacity(window: usize, sender_rate: f64, expected_delay: f64, data: usize) -> usize {
    let behind = (sender_rate * (BACKLOG + expected_delay)).ceil() as usize;
    let behind = behind.clamp(MIN_BACKLOG, MAX_BACKLOG);
    window + if data > 0 { behind.min(few(data)) } else { behind }
}

/// How many messages with so much data may wait at one place.
pub(crate) fn few(data: usize) -> usize {
    (WAITING_BYTES / data.max(1)).max(2)
}

fn nearest_node(name: &str, nodes: &[NodePlan]) -> Suggestion {
    Suggestion::nearest(name, nodes.iter().map(|node| node.name.as_str()))
}

fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<String> = names.map(|name| format!("`{name}`")).collect();
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

fn shared_cores(nodes: &[NodePlan]) -> Vec<GraphWarning> {
    let mut cores: BTreeMap<usize, Vec<String>> = BTreeMap::new();
    for node in nodes {
        if let Some(core) = node.core {
            cores.entry(core).or_default().push(node.name.clone());
        }
    }
    cores
        .into_iter()
        .filter(|(_, nodes)| nodes.len() > 1)
        .map(|(core, nodes)| GraphWarning::SharedCore { core, nodes })
        .collect()
}

/// Orders `count` nodes such that every edge leads forward; among those that could come next, the one declared first.
/// The error is a cycle, in the direction of its edges, beginning with its node declared first.
fn sort(count: usize, edges: &[(usize, usize)]) -> Result<Vec<usize>, Vec<usize>> {
    let mut order = Vec::with_capacity(count);
    let mut placed = vec![false; count];
    while order.len() < count {
        let blocked = |node: usize| edges.iter().any(|&(from, to)| to == node && !placed[from]);
        let Some(next) = (0..count).find(|&node| !placed[node] && !blocked(node)) else {
            return Err(cycle_among(&placed, edges));
        };
        placed[next] = true;
        order.push(next);
    }
    Ok(order)
}

/// Every node that is not placed has a sender that is not placed either: going back along such senders must come to a
/// node for the second time.
fn cycle_among(placed: &[bool], edges: &[(usize, usize)]) -> Vec<usize> {
    let sender_of =
        |node: usize| edges.iter().find(|&&(from, to)| to == node && !placed[from]).map(|&(from, _)| from);
    let mut trail = Vec::new();
    let mut node = placed.iter().position(|placed| !placed);
    while let Some(current) = node {
        if let Some(start) = trail.iter().position(|&seen| seen == current) {
            let mut cycle = trail.split_off(start);
            cycle.reverse();
            let first = (0..cycle.len()).min_by_key(|&index| cycle[index]).unwrap_or(0);
            cycle.rotate_left(first);
            return cycle;
        }
        trail.push(current);
        node = sender_of(current);
    }
    trail
}
