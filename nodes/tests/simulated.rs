//! The simulated loops: every node is a model, they do what their agents want, and each model's program gives the bits
//! of its step on numbers.

use parallax_model::node_model::PortShape;
use parallax_model::program::Workspace;
use parallax_nodes::{GRAPHS, graph, registry};
use parallax_runtime::graph::Graph;
use parallax_runtime::model_node::ModelNode;
use parallax_runtime::node::{Consumed, ErasedNode, InputWindow, Step};
use parallax_runtime::time::{SECOND, to_seconds};
use proptest::prelude::*;

fn loops() -> impl Iterator<Item = Graph> {
    GRAPHS
        .into_iter()
        .filter(|name| name.ends_with("-simulated"))
        .map(|name| graph(name).expect("a name from the list").validate(&registry()).expect("valid"))
}

#[test]
fn every_named_graph_is_valid_and_simulated_ones_are_models_alone() {
    assert!(graph("no such graph").is_none());
    for name in GRAPHS {
        let spec = graph(name).expect("a name from the list");
        assert_eq!(spec.name, name);
        assert!(spec.validate(&registry()).expect("valid").warnings().is_empty());
    }
    for graph in loops() {
        assert!(graph.nodes().iter().all(|node| node.kind.node_model().is_some()));
    }
}

/// A node's ports as its graph connects it.
fn ports(graph: &Graph, node: usize) -> Vec<PortShape> {
    let node = &graph.nodes()[node];
    let windows = node.inputs.iter().map(|&connection| graph.connections()[connection].window);
    let shapes = node.kind.inputs().iter().zip(windows).map(|(port, window)| PortShape {
        name: port.name.clone(),
        leaves: port.layout.leaves.clone(),
        window,
    });
    shapes.collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn programs_give_the_bits_of_the_steps(
        numbers in prop::collection::vec(-2.0..2.0f64, 64),
        seq in 0u64..1000,
        sent in prop::option::of(0u64..1000),
    ) {
        for graph in loops() {
            for (index, plan) in graph.nodes().iter().enumerate() {
                let model = plan.kind.node_model().expect("a model");
                let mut node: ModelNode = model.node(&graph.context(index, 3)).expect("it starts");
                let mut next = numbers.iter().copied().cycle();
                let windows: Vec<InputWindow> = ports(&graph, index)
                    .iter()
                    .map(|port| {
                        let mut window = InputWindow::new(&port.name, port.leaves.len(), port.window);
                        for _ in 0..port.window {
                            let payload: Vec<f64> = next.by_ref().take(port.leaves.len()).collect();
                            let stamp = sent.map_or(Consumed::INITIAL, |seq| {
                                Consumed { seq: Some(seq), sent: SECOND / 7, received: SECOND / 3 }
                            });
                            window.push(stamp, &payload);
                        }
                        window
                    })
                    .collect();
                let step = Step::new(seq, SECOND, SECOND + 12_345, &windows);
                let before = node.state().to_vec();
                let mut output = vec![0.0; plan.kind.output().leaves.len()];
                node.step_into(&step, &mut output).expect("models do not fail");

                let program = model.model().program(&ports(&graph, index));
                let mut inputs = [node.params(), &before].concat();
                inputs.extend([seq as f64, to_seconds(SECOND), to_seconds(SECOND + 12_345)]);
                inputs.extend(node.noise());
                for window in &windows {
                    for (place, stamp) in window.stamps().iter().enumerate() {
                        inputs.push(stamp.seq.map_or(-1.0, |seq| seq as f64));
                        inputs.extend([to_seconds(stamp.sent), to_seconds(stamp.received)]);
                        inputs.extend(window.payload(place));
                    }
                }
                let mut outputs = vec![0.0; program.outputs().len()];
                program.evaluate(&inputs, &mut Workspace::new(), &mut outputs);
                let expected = [node.state(), &output].concat();
                let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
                prop_assert_eq!(bits(&outputs), bits(&expected), "{} of {}", plan.name, graph.spec().name);
            }
        }
    }
}
