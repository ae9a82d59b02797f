//! Nodes that play command files: they send what the file says when it says it, and refuse what does not fit.

use parallax_nodes::command_file::CommandFile;
use parallax_nodes::{pendulum, playback, registry};
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::node::{NodeContext, Step};
use parallax_runtime::time::from_seconds;
use serde_json::json;

fn commands() -> CommandFile {
    CommandFile::parse("time,motor.voltage,agent.voltage\n0,0,9\n0.5,2.5,9\n1.0,-1,9\n", "c.csv")
        .expect("valid")
}

fn playing() -> GraphSpec {
    let mut graph = pendulum::graph();
    playback::put(&mut graph, "motor", &commands(), &registry()).expect("it fits");
    graph
}

#[test]
fn a_step_sends_what_holds_at_its_due_time() {
    let graph = playing();
    let spec = graph.nodes.iter().find(|node| node.name == "motor").expect("it stays");
    let context =
        NodeContext { name: "motor".into(), rate: spec.rate, seed: 1, parameters: spec.parameters.clone() };
    let mut node = registry().get(&spec.kind).expect("known").build(&context).expect("it starts");
    let mut sent = |seconds: f64| {
        let mut message = [f64::NAN];
        let due = from_seconds(seconds);
        node.step_into(&Step::new(0, due, due + 1_000_000, &[]), &mut message).expect("it steps");
        message[0]
    };
    assert_eq!([0.0, 0.499, 0.5, 0.99, 1.0, 60.0].map(&mut sent), [0.0, 0.0, 2.5, 2.5, -1.0, -1.0]);
}

#[test]
fn the_graph_keeps_its_shape_and_carries_the_commands() {
    let graph = playing();
    let text = serde_json::to_string(&graph).expect("a graph is JSON");
    let again: GraphSpec = serde_json::from_str(&text).expect("and back");
    let valid = again.validate(&registry()).expect("connections still fit");
    assert_eq!(valid.connections().len(), pendulum::graph().connections.len());
    assert!(text.contains("2.5"), "the commands travel with the graph");
}

#[test]
fn what_does_not_fit_is_named() {
    let refused = |node: &str, text: &str, parts: &[&str]| {
        let file = CommandFile::parse(text, "c.csv").expect("a command file");
        let error =
            playback::put(&mut pendulum::graph(), node, &file, &registry()).expect_err("refused").to_string();
        for part in parts {
            assert!(error.contains(part), "`{error}` lacks `{part}`");
        }
    };
    refused("moter", "time,motor.voltage\n0,0\n", &["`moter`", "did you mean `motor`"]);
    refused("motor", "time,motor.current\n0,0\n", &["`motor.current`", "voltage"]);
    refused("motor", "time,agent.voltage\n0,0\n", &["no column for node `motor`", "agent.voltage"]);
    refused("camera", "time,stamp\n0,0\n", &["`stamp`", "angle"]);
}

#[test]
fn a_graph_that_states_no_commands_is_refused() {
    let build = |parameters: serde_json::Value| {
        let serde_json::Value::Object(parameters) = parameters else { panic!("an object") };
        let context = NodeContext { name: "motor".into(), rate: 100.0, seed: 1, parameters };
        let kind = registry().get("playback/pendulum/motor").expect("known").clone();
        kind.build(&context).err().map(|error| error.to_string()).unwrap_or_default()
    };
    assert!(build(json!({})).contains("`file`"));
    assert!(build(json!({ "file": "nowhere.csv" })).contains("nowhere.csv"));
    assert!(build(json!({ "times": [0.0, 0.0], "leaves": { "voltage": [1.0, 2.0] } })).contains("`times`"));
    assert_eq!(build(json!({ "times": [0.0], "leaves": { "voltage": [1.0] } })), "");
}
