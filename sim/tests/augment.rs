//! Simulator nodes in recorded graphs: what stays is as it was recorded, what is new follows the rules.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use crate::support::{DURATION, graph, registry};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, NodeSpec};
use parallax_sim::augment::{AugmentError, Augmentation, EdgeDelay};
use parallax_sim::compiled::{CompileOptions, Interpolation, compile};
use parallax_sim::{Episode, Executor, generate};
use proptest::prelude::*;

const MS: i64 = 1_000_000;

fn node(name: &str, inputs: usize, rate: f64) -> NodeSpec {
    NodeSpec::new(name, format!("mixer_{inputs}"), rate)
}

fn edge(from: &str, to: &str, port: usize) -> ConnectionSpec {
    ConnectionSpec { port: Some(format!("in_{port}")), ..ConnectionSpec::new(from, to) }
}

/// A camera, an agent and a motor around a world that stood in for hardware.
fn recorded() -> (Graph, Episode) {
    let delay = Delay::Normal { mean: 0.004, std: 0.001 };
    let with = |mut edge: ConnectionSpec, blocking, skip| {
        edge.delay = delay.clone();
        edge.blocking = blocking;
        edge.skip = skip;
        edge
    };
    let spec = GraphSpec {
        name: "recorded".into(),
        supervisor: "agent".into(),
        nodes: vec![
            node("world", 1, 100.0),
            node("camera", 1, 50.0),
            node("agent", 1, 50.0),
            node("motor", 1, 50.0),
        ],
        connections: vec![
            with(edge("motor", "world", 0), false, true),
            with(edge("world", "camera", 0), true, false),
            with(edge("camera", "agent", 0), true, false),
            with(edge("agent", "motor", 0), true, false),
        ],
        plant: None,
    };
    let graph = spec.validate(&registry()).unwrap();
    let recording = Executor::new(graph.clone(), 3).record(1_000 * MS).unwrap();
    let episode = Episode::from_recording(&graph, &recording).unwrap();
    (graph, episode)
}

#[test]
fn a_simulator_takes_the_place_of_the_recorded_world() {
    let (graph, episode) = recorded();
    let hidden = EdgeDelay::Trainable { min: 0.002, max: 0.012, interpolation: Interpolation::Hold };
    let augmented = Augmentation::new(&graph)
        .node(node("world", 1, 200.0), 0.001)
        .connect(edge("world", "camera", 0), hidden)
        .apply(&registry(), std::slice::from_ref(&episode), 1)
        .unwrap();
    let new = &augmented.episodes[0];
    // The world steps on its ideal grid, and takes no time.
    assert_eq!(new.nodes[0].start[..3], [MS, 6 * MS, 11 * MS]);
    assert_eq!(new.nodes[0].end, new.nodes[0].start);
    assert_eq!(new.nodes[0].len(), 200);
    // What does not touch the world is as it was recorded.
    assert_eq!(new.nodes[1..], episode.nodes[1..]);
    assert_eq!(new.connections[2..], episode.connections[2..]);
    // The camera sees the newest state that is at least 7 ms old, the mean of the bounds.
    for (k, &start) in new.nodes[1].start.iter().enumerate() {
        let newest = new.nodes[0].end.iter().filter(|&&end| end + 7 * MS <= start).count() as i64 - 1;
        assert_eq!(new.connections[1].seqs(k), [newest]);
    }
    // The motor's messages are drawn again, from what the graph says of them; they never overtake.
    let arrivals = &new.connections[0];
    assert!(arrivals.received.windows(2).all(|pair| pair[0] <= pair[1]));
    for (k, &start) in new.nodes[0].start.iter().enumerate() {
        assert!(arrivals.seqs(k)[0] < 0 || arrivals.arrivals(k)[0] < start, "skip: before the start");
    }
    assert_eq!(augmented.trainable.len(), 1);
    assert_eq!((augmented.trainable[0].min, augmented.trainable[0].max), (2 * MS, 12 * MS));
    let options = CompileOptions { trainable: augmented.trainable, ..CompileOptions::default() };
    let compiled = compile(&augmented.graph, &augmented.episodes, &options).unwrap();
    let camera = compiled.slots.iter().find(|slot| slot.node == 1).unwrap();
    // States of 10 ms at 200 Hz: three beginnings of a window of one.
    assert_eq!(camera.rows.inputs[0].candidates, 3);
    assert_eq!(compiled.lengths, [episode.nodes[2].len() as u32]);
}

#[test]
fn nodes_go_and_mistakes_are_named() {
    let (graph, episode) = recorded();
    let one = std::slice::from_ref(&episode);
    let apply = |augmentation: Augmentation<'_>| augmentation.apply(&registry(), one, 1);
    // Without the motor, a source drives the world.
    let driven = Augmentation::new(&graph)
        .drop_node("motor")
        .node(node("wind", 0, 10.0), 0.0)
        .connect(edge("wind", "world", 0), EdgeDelay::Given(Delay::constant(0.05)));
    let augmented = apply(driven).unwrap();
    assert!(augmented.graph.index("motor").is_none());
    let wind = augmented.graph.index("wind").unwrap();
    assert_eq!(augmented.episodes[0].nodes[wind].len(), 10);
    assert!(augmented.trainable.is_empty());

    let unfed = apply(Augmentation::new(&graph).drop_node("motor"));
    assert!(matches!(unfed, Err(AugmentError::Graph(_))), "the world's port has no sender");
    assert!(matches!(apply(Augmentation::new(&graph).drop_node("mtor")), Err(AugmentError::NoNode { .. })));
    let blocking = ConnectionSpec { blocking: true, ..edge("world", "camera", 0) };
    let blocking = Augmentation::new(&graph).connect(blocking, EdgeDelay::Given(Delay::ZERO));
    assert!(matches!(apply(blocking), Err(AugmentError::Blocking { .. })));
    let reversed = EdgeDelay::Trainable { min: 0.1, max: 0.0, interpolation: Interpolation::Hold };
    let reversed = Augmentation::new(&graph).connect(edge("world", "camera", 0), reversed);
    assert!(matches!(apply(reversed), Err(AugmentError::Bounds { .. })));
    let late = Augmentation::new(&graph).node(node("world", 1, 100.0), f64::NAN);
    assert!(matches!(apply(late), Err(AugmentError::Phase { .. })));
    let mut cut = episode.clone();
    cut.nodes[0].start.pop();
    let cut = Augmentation::new(&graph).apply(&registry(), &[cut], 1);
    assert!(matches!(cut, Err(AugmentError::Episode { episode: 0, .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    /// Connections without jitter that are given anew have the windows that the executor gives them.
    #[test]
    fn a_new_connection_follows_the_executors_rules(graph in graph(), seed in any::<u64>()) {
        let mut spec = graph.spec().clone();
        for edge in &mut spec.connections {
            edge.blocking = false;
            edge.delay = Delay::constant(edge.delay.expected().min(0.02));
        }
        for node in &mut spec.nodes {
            node.advance = false;
        }
        let graph = spec.validate(&registry()).unwrap();
        let episode = generate(&graph, seed, DURATION).unwrap();
        let mut augmentation = Augmentation::new(&graph);
        for edge in &spec.connections {
            augmentation = augmentation.connect(edge.clone(), EdgeDelay::Given(edge.delay.clone()));
        }
        let again = augmentation.apply(&registry(), std::slice::from_ref(&episode), seed).unwrap();
        for (index, (new, old)) in again.episodes[0].connections.iter().zip(&episode.connections).enumerate() {
            prop_assert_eq!(new, old, "connection {}: {:?}", index, spec.connections[index]);
        }
    }
}
