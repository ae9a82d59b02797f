//! How long it takes to draw schedules and to compile them, and how that grows.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench prints, and stops where it cannot go on"
)]

use std::time::Instant;

use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, NodeSpec};
use parallax_runtime::node::{ErasedNode, Layout, NodeError, Step};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_sim::compiled::{CompileOptions, compile};
use parallax_sim::generate_many;

const SECOND: i64 = 1_000_000_000;

struct Still;

impl ErasedNode for Still {
    fn step_into(&mut self, _: &Step<'_>, _: &mut [f64]) -> Result<(), NodeError> {
        Ok(())
    }
}

/// A graph of nodes with these rates and connections; each node is its kind's only one. The last supervises.
fn graph(rates: &[f64], edges: &[(usize, usize)]) -> Graph {
    let layout = || Layout { name: "bench/Number".into(), leaves: vec!["number".into()] };
    let mut registry = Registry::new();
    let mut nodes = Vec::new();
    for (index, &rate) in rates.iter().enumerate() {
        let inputs = edges.iter().filter(|edge| edge.1 == index);
        let kind = NodeKind::erased(layout(), vec![0.0], |_| Ok(Box::new(Still)));
        let kind = inputs.fold(kind, |kind, edge| kind.input_with_layout(format!("n{}", edge.0), layout()));
        registry.insert(format!("kind{index}"), kind);
        let mut node = NodeSpec::new(format!("n{index}"), format!("kind{index}"), rate);
        node.computation = Delay::Normal { mean: 0.1 / rate, std: 0.02 / rate };
        nodes.push(node);
    }
    let connections = edges.iter().map(|&(from, to)| ConnectionSpec {
        skip: from > to,
        delay: Delay::Normal { mean: 0.003, std: 0.001 },
        ..ConnectionSpec::new(format!("n{from}"), format!("n{to}"))
    });
    let spec = GraphSpec {
        name: "bench".into(),
        supervisor: format!("n{}", rates.len() - 1),
        connections: connections.collect(),
        nodes,
        plant: None,
    };
    spec.validate(&registry).unwrap()
}

fn measure(name: &str, graph: &Graph, episodes: usize, seconds: i64) {
    let began = Instant::now();
    let drawn = generate_many(graph, 1, seconds * SECOND, episodes).unwrap();
    let generated = began.elapsed().as_secs_f64();
    let began = Instant::now();
    let compiled = compile(graph, &drawn, &CompileOptions::default()).unwrap();
    let time = began.elapsed().as_secs_f64();
    let steps: usize = drawn.iter().map(|episode| episode.steps()).sum();
    let history: usize = compiled.nodes.iter().map(|node| node.history).sum();
    println!(
        "{name:<22} {episodes:>8} {seconds:>6} {steps:>9} {generated:>10.4} {time:>10.4} {:>6} {:>9.2} {history:>8} {:>8}",
        compiled.slots.len(),
        compiled.efficiency(),
        compiled.warm_up,
    );
}

fn main() {
    println!(
        "{:<22} {:>8} {:>6} {:>9} {:>10} {:>10} {:>6} {:>9} {:>8} {:>8}",
        "graph",
        "episodes",
        "s each",
        "steps",
        "generate s",
        "compile s",
        "slots",
        "filled",
        "history",
        "warm-up"
    );
    let loop_of_four = graph(&[100.0, 60.0, 30.0, 50.0], &[(0, 1), (1, 2), (2, 3), (1, 3), (3, 0)]);
    for (episodes, seconds) in [(1, 10), (5, 10), (20, 10), (80, 10), (20, 40)] {
        measure("100/60/30/50 Hz", &loop_of_four, episodes, seconds);
    }
    // Five connections a node, of a mixed multiplicative generator: most lead forward, some back.
    for nodes in [50usize, 100, 200] {
        let mut state = 1u64;
        let mut edges = Vec::new();
        while edges.len() < 5 * nodes {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let (a, b) = ((state >> 33) as usize % nodes, (state >> 48) as usize % nodes);
            let edge = if edges.len() % 10 == 0 { (a.max(b), a.min(b)) } else { (a.min(b), a.max(b)) };
            if a != b && !edges.contains(&edge) {
                edges.push(edge);
            }
        }
        let rates: Vec<f64> =
            (0..nodes).map(|node| [100.0, 50.0, 60.0, 30.0][(node + 1 + nodes) % 4]).collect();
        let graph = graph(&rates, &edges);
        measure(&format!("{nodes} nodes, {} edges", edges.len()), &graph, 2, 10);
    }
}
