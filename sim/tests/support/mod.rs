//! Random graphs of every policy, for property tests.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

pub(crate) mod delayed;

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, JitterPolicy, NodeSpec, Scheduling};
use parallax_runtime::node::{ErasedNode, Layout, NodeError, Step};
use parallax_runtime::registry::{NodeKind, Registry};
use proptest::prelude::*;

/// How long a random graph runs.
pub(crate) const DURATION: i64 = 700_000_000;
const MOST_NODES: usize = 5;

fn layout() -> Layout {
    Layout { name: "test/Pair".into(), leaves: vec!["seq".into(), "hash".into()] }
}

/// Sends its step's number, and a mix of everything that it saw: a difference anywhere upstream shows.
struct Mixer;

impl ErasedNode for Mixer {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let mut hash = 0.5;
        for input in step.inputs() {
            for (index, stamp) in input.stamps().iter().enumerate() {
                hash = (hash * 31.7 + input.payload(index)[1] + stamp.received as f64 * 1e-9).sin();
            }
        }
        output.copy_from_slice(&[step.seq as f64, hash]);
        Ok(())
    }
}

/// A kind for every number of inputs: `mixer_2` has `in_0` and `in_1`.
pub(crate) fn registry() -> Registry {
    (0..MOST_NODES + 1).fold(Registry::new(), |registry, inputs| {
        let kind = NodeKind::erased(layout(), vec![0.0, 0.25], |_| Ok(Box::new(Mixer)));
        let kind =
            (0..inputs).fold(kind, |kind, input| kind.input_with_layout(format!("in_{input}"), layout()));
        registry.with(format!("mixer_{inputs}"), kind)
    })
}

fn delay() -> impl Strategy<Value = Delay> {
    prop_oneof![
        Just(Delay::ZERO),
        (0.0..0.01).prop_map(Delay::constant),
        (0.0..0.005, 0.0..0.004).prop_map(|(mean, std)| Delay::Normal { mean, std }),
        (0.0..0.004, 0.0..0.01).prop_map(|(low, span)| Delay::Uniform { low, high: low + span }),
        (0.0005..0.004, 0.0..0.008).prop_map(|(mean, std)| Delay::LogNormal { mean, std }),
    ]
}

fn node() -> impl Strategy<Value = NodeSpec> {
    let rate = prop_oneof![Just(50.0), Just(100.0), Just(33.3), 20.0..120.0];
    (rate, delay(), any::<bool>(), any::<bool>()).prop_map(|(rate, computation, phase, advance)| {
        let mut node = NodeSpec::new("", "", rate);
        node.computation = computation;
        node.scheduling = if phase { Scheduling::Phase } else { Scheduling::Frequency };
        node.advance = advance;
        node
    })
}

/// Whether there is a connection, and of what sort; a connection that leads back gets `skip`.
fn connection() -> impl Strategy<Value = Option<ConnectionSpec>> {
    let shape = (any::<bool>(), 1usize..5, any::<bool>(), any::<bool>(), delay());
    prop::option::of(shape.prop_map(|(blocking, window, skip, buffer, delay)| ConnectionSpec {
        blocking,
        window,
        skip,
        jitter: if buffer { JitterPolicy::Buffer } else { JitterPolicy::Latest },
        delay,
        ..ConnectionSpec::new("", "")
    }))
}

/// A valid graph of up to five nodes; any of them supervises.
pub(crate) fn graph() -> impl Strategy<Value = Graph> {
    (1..=MOST_NODES)
        .prop_flat_map(|count| {
            (
                prop::collection::vec(node(), count),
                prop::collection::vec(connection(), count * count),
                0..count,
            )
        })
        .prop_map(|(mut nodes, connections, supervisor)| {
            let count = nodes.len();
            let mut kept = Vec::new();
            for (place, connection) in connections.into_iter().enumerate() {
                let (from, to) = (place / count, place % count);
                if let Some(mut connection) = connection {
                    connection.skip |= from >= to;
                    connection.from = format!("n{from}");
                    connection.to = format!("n{to}");
                    kept.push((to, connection));
                }
            }
            for (index, node) in nodes.iter_mut().enumerate() {
                let inputs = kept.iter_mut().filter(|(to, _)| *to == index).map(|(_, connection)| connection);
                let (mut number, mut all_blocking) = (0, true);
                for connection in inputs {
                    connection.port = Some(format!("in_{number}"));
                    number += 1;
                    all_blocking &= connection.blocking;
                }
                node.name = format!("n{index}");
                node.kind = format!("mixer_{number}");
                node.advance &= number > 0 && all_blocking;
            }
            let mut spec = GraphSpec {
                name: "random".into(),
                supervisor: format!("n{supervisor}"),
                nodes,
                connections: kept.into_iter().map(|(_, connection)| connection).collect(),
                plant: None,
            };
            spec.validate(&registry()).unwrap_or_else(|_| {
                // Every node of some cycle advances: the only error that is left.
                for node in &mut spec.nodes {
                    node.advance = false;
                }
                spec.validate(&registry()).unwrap()
            })
        })
}
