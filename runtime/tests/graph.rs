//! What a graph may not be, and what a valid one means.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_model::tree::Tree;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, GraphError, GraphSpec, GraphWarning, NodeSpec};
use parallax_runtime::node::{Message, Node, NodeError, Port, Step};
use parallax_runtime::registry::{NodeKind, Registry};

#[derive(Tree, Clone, Default)]
struct Angle {
    angle: f64,
}
impl Message for Angle {
    const NAME: &'static str = "test/Angle";
}

#[derive(Tree, Clone, Default)]
struct Torque {
    torque: f64,
}
impl Message for Torque {
    const NAME: &'static str = "test/Torque";
}

struct Constant<M>(M);
impl<M: Message> Node for Constant<M> {
    type Output = M;
    fn step(&mut self, _: &Step<'_>) -> Result<M, NodeError> {
        Ok(self.0.clone())
    }
}

fn registry() -> Registry {
    let torque = || NodeKind::new(|_| Ok(Constant(Torque::default())));
    Registry::new()
        .with("camera", NodeKind::new(|_| Ok(Constant(Angle::default()))))
        .with("agent", torque().input(Port::<Angle>::new("camera")))
        .with("motor", torque().input(Port::<Torque>::new("agent")))
        .with("relay", torque().input(Port::<Torque>::new("in")))
        .with("mixer", torque().input(Port::<Torque>::new("a")).input(Port::<Torque>::new("b")))
}

/// camera (100 Hz, 4 ms) -> agent (50 Hz, 10 ms) -> motor (100 Hz).
fn spec() -> GraphSpec {
    let mut camera = NodeSpec::new("camera", "camera", 100.0);
    camera.computation = Delay::constant(0.004);
    let mut agent = NodeSpec::new("agent", "agent", 50.0);
    agent.computation = Delay::constant(0.010);
    let motor = NodeSpec::new("motor", "motor", 100.0);
    let mut look = ConnectionSpec::new("camera", "agent");
    look.delay = Delay::constant(0.001);
    let mut act = ConnectionSpec::new("agent", "motor");
    act.delay = Delay::constant(0.002);
    GraphSpec {
        name: "test".into(),
        supervisor: "agent".into(),
        nodes: vec![camera, agent, motor],
        connections: vec![look, act],
        plant: None,
    }
}

fn relays(names: &[&str], connections: Vec<ConnectionSpec>) -> GraphSpec {
    GraphSpec {
        name: "relays".into(),
        supervisor: names[0].into(),
        nodes: names.iter().map(|name| NodeSpec::new(*name, "relay", 10.0)).collect(),
        connections,
        plant: None,
    }
}

fn feed(from: &str, to: &str) -> ConnectionSpec {
    ConnectionSpec { port: Some("in".into()), ..ConnectionSpec::new(from, to) }
}

/// The error of the test graph after a change, and its text.
fn error(change: impl FnOnce(&mut GraphSpec)) -> (GraphError, String) {
    let mut spec = spec();
    change(&mut spec);
    let error = spec.validate(&registry()).expect_err("the graph is not valid");
    let text = error.to_string();
    (error, text)
}

#[test]
fn phases_add_expected_delays_along_the_graph() {
    let graph = spec().validate(&registry()).unwrap();
    let phases: Vec<i64> = graph.nodes().iter().map(|node| node.grid.phase()).collect();
    assert_eq!(phases, [0, 5_000_000, 17_000_000]);
    assert_eq!(graph.order(), [0, 1, 2]);
    assert_eq!(graph.connection_name(0), "camera->agent");
}

#[test]
fn a_phase_is_the_largest_over_the_inputs_without_skip() {
    let mut spec = relays(&["slow", "fast"], vec![]);
    spec.nodes[0].computation = Delay::constant(0.03);
    spec.nodes.push(NodeSpec::new("mixer", "mixer", 10.0));
    let connect = |from: &str, to: &str, port: &str| ConnectionSpec {
        port: Some(port.into()),
        ..ConnectionSpec::new(from, to)
    };
    spec.connections = vec![
        ConnectionSpec { skip: true, ..feed("mixer", "slow") },
        ConnectionSpec { skip: true, ..feed("mixer", "fast") },
        connect("slow", "mixer", "a"),
        connect("fast", "mixer", "b"),
    ];
    let phase = |spec: &GraphSpec| spec.validate(&registry()).unwrap().nodes()[2].grid.phase();
    assert_eq!(phase(&spec), 30_000_000);
    spec.connections[2].skip = true;
    assert_eq!(phase(&spec), 0);
}

#[test]
fn a_cycle_without_skip_is_named_node_by_node() {
    let mut spec = relays(&["a", "b", "c"], vec![feed("a", "b"), feed("b", "c"), feed("c", "a")]);
    let error = spec.validate(&registry()).unwrap_err();
    assert_eq!(error, GraphError::Cycle { nodes: vec!["a".into(), "b".into(), "c".into()] });
    assert!(error.to_string().starts_with("a -> b -> c -> a is a cycle"), "{error}");
    spec.connections[2].skip = true;
    assert_eq!(spec.validate(&registry()).unwrap().order(), [0, 1, 2]);
    let own = relays(&["a"], vec![feed("a", "a")]);
    assert_eq!(own.validate(&registry()).unwrap_err(), GraphError::Cycle { nodes: vec!["a".into()] });
}

#[test]
fn nodes_that_cannot_be() {
    let (found, _) = error(|spec| spec.nodes.clear());
    assert_eq!(found, GraphError::NoNodes { graph: "test".into() });
    let (found, _) = error(|spec| spec.nodes[0].name = "my camera".into());
    assert_eq!(found, GraphError::NodeName { name: "my camera".into() });
    let (found, _) = error(|spec| spec.nodes[1].name = "camera".into());
    assert_eq!(found, GraphError::DuplicateNode { name: "camera".into() });
    let (found, text) = error(|spec| spec.nodes[0].kind = "camra".into());
    assert!(matches!(found, GraphError::UnknownKind { .. }));
    assert!(text.contains("`camera`") && text.contains("node `camera`"), "{text}");
    let (found, text) = error(|spec| spec.supervisor = "agnt".into());
    assert!(matches!(found, GraphError::UnknownSupervisor { .. }));
    assert!(text.contains("`agent`"), "{text}");
    for rate in [0.0, -5.0, f64::NAN, f64::INFINITY, 1e9] {
        let (found, text) = error(|spec| spec.nodes[2].rate = rate);
        assert!(matches!(found, GraphError::Rate { node, .. } if node == "motor"), "{text}");
    }
    let (found, text) = error(|spec| spec.nodes[0].computation = Delay::constant(-1.0));
    assert!(matches!(found, GraphError::Delay { .. }) && text.contains("node `camera`"), "{text}");
}

#[test]
fn connections_that_cannot_be() {
    let (found, text) = error(|spec| spec.connections[0].from = "camara".into());
    assert!(matches!(found, GraphError::UnknownNode { .. }));
    assert!(text.contains("`camara`") && text.contains("`camera`"), "{text}");
    let (found, text) = error(|spec| spec.connections[0].port = Some("camara".into()));
    assert!(matches!(found, GraphError::UnknownPort { .. }));
    assert!(text.contains("its inputs are `camera`"), "{text}");
    let (found, _) = error(|spec| spec.connections.push(spec.connections[0].clone()));
    assert!(matches!(found, GraphError::DuplicateConnection { node, .. } if node == "agent"));
    let (found, text) = error(|spec| {
        spec.connections[1].from = "camera".into();
        spec.connections[1].port = Some("agent".into());
    });
    assert!(matches!(found, GraphError::LayoutMismatch { .. }));
    assert!(text.contains("test/Angle { angle }") && text.contains("test/Torque { torque }"), "{text}");
    let (found, _) = error(|spec| drop(spec.connections.pop()));
    assert_eq!(found, GraphError::Unconnected { node: "motor".into(), port: "agent".into() });
    for window in [0, 1_000_000] {
        let (found, _) = error(|spec| spec.connections[0].window = window);
        assert!(matches!(found, GraphError::Window { .. }));
    }
    let (found, text) = error(|spec| spec.connections[1].delay = Delay::Uniform { low: 2.0, high: 1.0 });
    assert!(matches!(found, GraphError::Delay { .. }) && text.contains("agent -> motor"), "{text}");
}

#[test]
fn advance_needs_blocking_inputs_and_a_tie_to_the_clock() {
    let (found, _) = error(|spec| spec.nodes[1].advance = true);
    assert_eq!(found, GraphError::AdvanceNotBlocking { node: "agent".into(), from: "camera".into() });
    let (found, _) = error(|spec| spec.nodes[0].advance = true);
    assert_eq!(found, GraphError::AdvanceWithoutInputs { node: "camera".into() });
    let blocking =
        |from: &str, to: &str, skip: bool| ConnectionSpec { blocking: true, skip, ..feed(from, to) };
    let mut spec = relays(&["a", "b"], vec![blocking("a", "b", false), blocking("b", "a", true)]);
    spec.nodes[0].advance = true;
    spec.validate(&registry()).unwrap();
    spec.nodes[1].advance = true;
    let error = spec.validate(&registry()).unwrap_err();
    assert_eq!(error, GraphError::AdvanceCycle { nodes: vec!["a".into(), "b".into()] });
}

#[test]
fn cores_are_checked_against_the_machine_and_shared_ones_are_a_warning() {
    let mut spec = spec();
    for node in &mut spec.nodes {
        node.core = Some(1);
    }
    spec.nodes[2].core = Some(64);
    let graph = spec.validate(&registry()).unwrap();
    assert_eq!(
        graph.warnings(),
        [GraphWarning::SharedCore { core: 1, nodes: vec!["camera".into(), "agent".into()] }]
    );
    let error = graph.check_cores(&[0, 1]).unwrap_err();
    assert!(matches!(&error, GraphError::UnknownCore { node, core: 64, .. } if node == "motor"));
    assert!(error.to_string().contains("cores 0, 1"), "{error}");
    graph.check_cores(&[1, 64]).unwrap();
}

#[test]
fn text_that_is_no_graph() {
    for text in ["name = 3", "nme = 'x'", "[[node]]\nname = 'a'", ""] {
        let error = GraphSpec::from_toml(text).unwrap_err();
        assert!(matches!(error, GraphError::Text { format: "TOML", .. }), "{error}");
    }
    assert!(GraphSpec::from_json("{").unwrap_err().to_string().contains("line 1"));
}
