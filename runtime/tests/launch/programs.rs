//! Nodes that another program runs.

use std::collections::BTreeMap;

use parallax_runtime::graph::{GraphError, GraphSpec};
use parallax_runtime::launch::{Exit, Mode, NODE_COMMAND, RunError, RunOptions, run};
use parallax_runtime::node::{ErasedNode, NodeError, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use serde_json::json;

use crate::Test;
use crate::nodes::{graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("another_program_runs_a_node", another_program_runs_a_node),
    ("what_another_program_needs_is_said", what_another_program_needs_is_said),
];

/// Adds up the last number at each of its inputs.
struct Foreign;
impl ErasedNode for Foreign {
    fn step_into(&mut self, step: &Step<'_>, output: &mut [f64]) -> Result<(), NodeError> {
        let newest = |input: &parallax_runtime::node::InputWindow| input.payload(input.stamps().len() - 1)[0];
        output[0] = step.inputs().iter().map(newest).sum();
        Ok(())
    }
}

pub(crate) fn kinds(registry: Registry) -> Registry {
    let foreign = NodeKind::external(|context, inputs, output| {
        assert_eq!((inputs.len(), inputs[0].window, output.name.as_str()), (1, 2, "foreign/Sum"));
        match context.name.as_str() {
            "adder" => Ok(Box::new(Foreign)),
            other => Err(NodeError::failed(format!("nobody asked for {other}"))),
        }
    });
    registry.with("foreign", foreign)
}

/// [`graph`] with an adder that another program runs.
fn foreign() -> GraphSpec {
    let mut graph = graph();
    let adder = graph.node_mut("adder").unwrap();
    adder.kind = "foreign".into();
    adder.parameters.insert("output".into(), json!({ "message": "foreign/Sum", "leaves": ["sum"] }));
    adder.parameters.insert("initial".into(), json!({ "sum": 2.5 }));
    graph
}

fn another_program_runs_a_node() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    // The same program by its path: what it is called with is what another one would be called with.
    let own = std::env::current_exe().unwrap().to_str().unwrap().to_owned();
    let programs = BTreeMap::from([("adder".to_owned(), vec![own, NODE_COMMAND.to_owned()])]);
    let report = run(&foreign(), &registry(), RunOptions { programs, ..options(0.5, &path) }).unwrap();
    assert!(report.clean(), "{report:#?}");
    let recording = Recording::read(&path).unwrap();
    let (counter, adder) = (&recording.nodes[0], &recording.nodes[1]);
    assert_eq!((&*adder.layout.name, &adder.initial), ("foreign/Sum", &vec![2.5]));
    assert!(adder.messages.len() > 3);
    for (step, message) in adder.steps.iter().zip(&adder.messages) {
        let seen = step.inputs[0].consumed.last().unwrap().seq.unwrap();
        assert_eq!(message.payload[0], counter.message(seen).unwrap().payload[0]);
    }
}

fn what_another_program_needs_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let options = || options(0.2, &folder.path().join("run.mcap"));
    let attempt = |graph: &GraphSpec, options| run(graph, &registry(), options).unwrap_err();
    let error = attempt(&foreign(), options());
    assert!(matches!(&error, RunError::NoProgram { node } if node == "adder"), "{error}");

    let absent = || BTreeMap::from([("adder".to_owned(), vec!["/no/such/program".to_owned()])]);
    let error = attempt(&foreign(), RunOptions { programs: absent(), mode: Mode::Threads, ..options() });
    assert!(matches!(&error, RunError::ProgramNeedsProcess { node } if node == "adder"), "{error}");
    let error = attempt(&foreign(), RunOptions { programs: absent(), ..options() });
    assert!(matches!(&error, RunError::Spawn { node, .. } if node == "adder"), "{error}");
    let falling = BTreeMap::from([("adder".to_owned(), vec!["/bin/false".to_owned()])]);
    let error = attempt(&foreign(), RunOptions { programs: falling, ..options() });
    assert!(matches!(&error, RunError::Start { exit: Exit::Died { .. }, .. }), "{error}");

    let mut silent = foreign();
    silent.node_mut("adder").unwrap().parameters.remove("output");
    let error = attempt(&silent, options());
    assert!(matches!(&error, RunError::Graph(GraphError::External { .. })), "{error}");
    assert!(error.to_string().contains("no receiver says what it sends"), "{error}");
}
