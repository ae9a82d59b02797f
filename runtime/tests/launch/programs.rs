//! Nodes that another program runs.

use std::collections::BTreeMap;

use std::process::ExitCode;

use parallax_model::tree::Tree;
use parallax_runtime::graph::{GraphError, GraphSpec, OnDeadSender};
use parallax_runtime::launch::{EventKind, Exit, Mode, NODE_COMMAND, RunError, RunOptions, node_main, run};
use parallax_runtime::node::{ErasedNode, Message, Node, NodeError, Port, Step};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use serde_json::json;

use crate::Test;
use crate::nodes::{graph, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("another_program_runs_a_node", another_program_runs_a_node),
    ("what_another_program_needs_is_said", what_another_program_needs_is_said),
    ("a_program_with_another_layout_is_refused", a_program_with_another_layout_is_refused),
    ("a_node_that_comes_back_with_another_layout_is_given_up", comes_back_with_another_layout),
];

/// The hidden subcommand of a program that was built from other messages than ours; its first argument is a file without
/// which it is our program yet.
pub(crate) const OTHER_COMMAND: &str = "__other-program";

/// As large as [`Number`](crate::nodes::Number), and called the same: what lies in it means something else.
#[derive(Tree, Clone, Default)]
struct Speed<T> {
    speed: T,
}

impl Message for Speed<f64> {
    const NAME: &'static str = "test/Number";
}

/// Sends a speed where others expect a number, and takes speeds for numbers.
struct Mistaken;
impl Node for Mistaken {
    type Output = Speed<f64>;

    fn step(&mut self, _: &Step<'_>) -> Result<Speed<f64>, NodeError> {
        Ok(Speed { speed: -1e6 })
    }
}

/// The body of the hidden subcommand [`OTHER_COMMAND`].
pub(crate) fn other(mut arguments: impl Iterator<Item = String>) -> ExitCode {
    let rebuilt = arguments.next().unwrap();
    if !std::path::Path::new(&rebuilt).exists() {
        return node_main(arguments, &registry());
    }
    const SOURCE: Port<Speed<f64>> = Port::new("source");
    let kinds = Registry::new()
        .with("counter", NodeKind::new(|_| Ok(Mistaken)))
        .with("adder", NodeKind::new(|_| Ok(Mistaken)).input(SOURCE));
    node_main(arguments, &kinds)
}

/// The program of a node that becomes another one when this file is there.
fn rebuilt(node: &str, file: &std::path::Path) -> BTreeMap<String, Vec<String>> {
    let own = std::env::current_exe().unwrap().to_str().unwrap().to_owned();
    BTreeMap::from([(node.to_owned(), vec![own, OTHER_COMMAND.into(), file.to_str().unwrap().into()])])
}

fn a_program_with_another_layout_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (path, file) = (folder.path().join("run.mcap"), folder.path().join("rebuilt"));
    let attempt = |node: &str| {
        run(&graph(), &registry(), RunOptions { programs: rebuilt(node, &file), ..options(0.3, &path) })
    };
    assert!(attempt("counter").unwrap().clean(), "before it is rebuilt it is our own program");
    std::fs::write(&file, "").unwrap();
    for node in ["counter", "adder"] {
        let error = attempt(node).unwrap_err();
        let RunError::Start { node: named, exit: Exit::Failed { reason } } = &error else {
            panic!("{error}");
        };
        assert_eq!(named, node, "{error}");
        for part in ["another layout", "channel", "one binary"] {
            assert!(reason.contains(part), "{reason}");
        }
    }
}

fn comes_back_with_another_layout() {
    let folder = tempfile::tempdir().unwrap();
    let (path, file) = (folder.path().join("run.mcap"), folder.path().join("rebuilt"));
    let mut graph = crate::nodes::troubled("kill", 20);
    // It dies once, and is another program from then on.
    graph.nodes[0].parameters.insert("once".into(), file.to_str().unwrap().into());
    graph.nodes[1].on_dead_sender = OnDeadSender::Continue;
    let settings = "[node.counter]\nrestart = \"on-failure\"\nrestart_delay = 0.02\nrestart_limit = 2\n";
    let options = RunOptions {
        programs: rebuilt("counter", &file),
        launch: crate::settings::launch(settings),
        ..options(1.5, &path)
    };
    let report = run(&graph, &registry(), options).unwrap();
    let [counter, adder] = &report.nodes[..] else { panic!("two nodes") };
    let Exit::Failed { reason } = &counter.exit else { panic!("{report:#?}") };
    assert!(reason.contains("another layout"), "{reason}");
    let given_up = |event: &&parallax_runtime::launch::Event| matches!(event.kind, EventKind::GivenUp { .. });
    assert_eq!(report.events.iter().filter(given_up).count(), 1, "{report:#?}");
    assert_eq!((counter.sent, &adder.exit), (20, &Exit::Clean), "{report:#?}");
    let recording = Recording::read(&path).unwrap();
    let seen = recording.nodes[1].messages.iter().map(|message| message.payload[0]);
    assert!(seen.clone().all(|value| value >= -1.0), "no speed was taken for a number");
    assert!(seen.count() > 50, "the adder goes on");
}

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
