//! Computation delays that follow from outputs: tables that decide at run time give the windows of the executor.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use crate::support::DURATION;
use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{Graph, GraphBuilder, GraphSpec, JitterPolicy};
use parallax_runtime::node::{Message, Port};
use parallax_runtime::recording::Recording;
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::{Nanos, from_seconds};
use parallax_sim::batch::{Batch, Precision};
use parallax_sim::compiled::{
    CompileError, CompileOptions, CompiledGraph, InputRows, Interpolation, OutputDelays, TrainableConnection,
    compile,
};
use parallax_sim::{Episode, Executor, generate};
use proptest::prelude::*;

const MILLISECOND: Nanos = 1_000_000;

fn at_run_time() -> CompileOptions {
    CompileOptions { output_delays: OutputDelays::AtRunTime, ..CompileOptions::default() }
}

/// Number, time of sending and time of arrival.
type Stamp = (i64, Nanos, Nanos);

/// What the executor saw on a connection.
fn recorded(graph: &Graph, recording: &Recording, connection: usize, step: usize) -> Vec<Stamp> {
    let plan = &graph.connections()[connection];
    let track = recording.node(&graph.nodes()[plan.to].name).unwrap();
    let input = track.steps[step].inputs.iter().find(|input| input.port == plan.port).unwrap();
    let consumed = input.consumed.iter();
    consumed.map(|seen| (seen.seq.map_or(-1, |seq| seq as i64), seen.sent, seen.received)).collect()
}

/// What a row says a step sees, by the words of the documentation; `leaf` is the value of a message's leaf.
fn window(input: &InputRows, row: usize, start: Nanos, leaf: impl Fn(i64, usize) -> f64) -> Vec<Stamp> {
    let candidates = (row * input.candidates..(row + 1) * input.candidates)
        .map(|at| (i64::from(input.seq[at]), input.sent[at], input.received[at]));
    let Some(delay) = input.from_output else { return candidates.collect() };
    let rule = delay.computation;
    let arrived = candidates.filter_map(|(seq, started, earliest)| {
        if seq < 0 {
            return Some((-1, 0, 0));
        }
        let seconds = (rule.offset + rule.scale * leaf(seq, rule.leaf)).max(rule.min).min(rule.max);
        let sent = started + from_seconds(seconds);
        let received = sent + delay.travel;
        assert!(received >= earliest);
        let there = if delay.skip { received < start } else { received <= start };
        there.then_some((seq, sent, received))
    });
    let arrived: Vec<Stamp> = arrived.collect();
    arrived[arrived.len() - input.window..].to_vec()
}

/// Goes through the slots, and holds every window against what the executor saw. Gives how many windows it compared of
/// connections that are decided at run time, and how many of them are not those of the schedule.
fn hold(compiled: &CompiledGraph, graph: &Graph, recording: &Recording, scheduled: &Episode) -> [usize; 2] {
    let mut histories: Vec<Vec<i64>> = compiled.nodes.iter().map(|node| vec![-1; node.history]).collect();
    let mut counts = [0; 2];
    for pass in 0..compiled.passes() {
        let row = compiled.row(0, pass);
        for slot in compiled.slots.iter().filter(|slot| slot.rows.run[row] == 1) {
            let rows = &slot.rows;
            let seq = rows.seq[row] as usize;
            let step = &recording.node(&graph.nodes()[slot.node].name).unwrap().steps[seq];
            assert_eq!((rows.due[row], rows.start[row]), (step.due, step.start));
            for input in &rows.inputs {
                let places = row * input.candidates..(row + 1) * input.candidates;
                for at in places {
                    assert_eq!(histories[input.from][input.read[at] as usize], i64::from(input.seq[at]));
                }
                let sender = recording.node(&graph.nodes()[input.from].name).unwrap();
                let leaf = |seq: i64, leaf: usize| sender.message(seq as u64).unwrap().payload[leaf];
                let found = window(input, row, rows.start[row], leaf);
                let expected = recorded(graph, recording, input.connection, seq);
                if input.from_output.is_some() {
                    let seqs: Vec<i64> = found.iter().map(|(seq, ..)| *seq).collect();
                    counts[0] += 1;
                    counts[1] += usize::from(seqs != scheduled.connections[input.connection].seqs(seq));
                } else {
                    assert_eq!(input.candidates, input.window);
                }
                assert_eq!(found, expected, "{} step {seq}", graph.connection_name(input.connection));
            }
            histories[slot.node][rows.write[row] as usize] = seq as i64;
        }
    }
    counts
}

/// How a node's delay follows from its output: bounds as shares of its period, offset and scale as shares of the span
/// between them.
type Rule = (f64, f64, f64, f64);

/// The graph with some nodes' computation following from what they saw, without what such a node may not have.
fn opened(graph: &Graph, rules: &[Option<Rule>], skip: bool) -> Graph {
    let mut spec = graph.spec().clone();
    for (node, rule) in rules.iter().enumerate().take(spec.nodes.len()) {
        let Some((low, span, offset, scale)) = *rule else { continue };
        // In whole nanoseconds, so that no rounding of ticks is shorter.
        let period = (1e9 / spec.nodes[node].rate).floor() * 1e-9;
        let (min, max) = (low * period, (low + span).min(1.0) * period);
        spec.nodes[node].computation = Delay::Output {
            leaf: "hash".into(),
            offset: min + offset * (max - min),
            scale: scale * (max - min),
            min,
            max,
            expected: None,
        };
        let name = spec.nodes[node].name.clone();
        spec.nodes[node].advance = false;
        for connection in &mut spec.connections {
            if connection.from == name {
                connection.blocking = false;
                connection.jitter = JitterPolicy::Latest;
                connection.skip |= skip;
                connection.delay = Delay::constant(connection.delay.expected());
            }
            // So that it starts when it is due.
            connection.blocking &= connection.to != name;
        }
    }
    // Nobody can advance who does not wait for all inputs.
    for node in &mut spec.nodes {
        node.advance &= spec.connections.iter().all(|edge| edge.to != node.name || edge.blocking);
    }
    spec.validate(&crate::support::registry()).unwrap()
}

fn rules() -> impl Strategy<Value = Vec<Option<Rule>>> {
    let low = prop_oneof![Just(0.0), 0.0..0.5];
    let span = prop_oneof![1 => Just(0.0), 3 => 0.0..1.0, 2 => Just(1.0)];
    prop::collection::vec(prop::option::weighted(0.6, (low, span, -0.2..1.2, -1.5..1.5)), 5)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn run_time_windows_are_those_of_the_executor(
        graph in crate::support::graph(),
        rules in rules(),
        seed in any::<u64>(),
        skip in any::<bool>(),
    ) {
        let graph = opened(&graph, &rules, skip);
        let recording = Executor::new(graph.clone(), seed).record(DURATION).unwrap();
        let drawn = generate(&graph, seed, DURATION).unwrap();
        if drawn.nodes[graph.supervisor()].is_empty() {
            return Ok(());
        }
        let options = CompileOptions { keep: (0..graph.nodes().len()).collect(), ..at_run_time() };
        let compiled = compile(&graph, std::slice::from_ref(&drawn), &options).unwrap();
        hold(&compiled, &graph, &recording, &drawn);
        // Drawn without values or recorded with them: the tables are the same, because they hold no value.
        let known = Episode::from_recording(&graph, &recording).unwrap();
        prop_assert!(compile(&graph, &[known], &options).unwrap() == compiled);
    }
}

/// The leaf that decides how long the source computes.
#[derive(Tree, Clone, Debug, Default)]
struct Load<T = f64> {
    count: T,
    load: T,
}
impl Message for Load {
    const NAME: &'static str = "test/Load";
}

const MOST: usize = 3;

/// All that a step saw.
#[derive(Tree, Clone, Debug, Default)]
struct Report<T = f64> {
    seq: [T; MOST],
    sent: [T; MOST],
    received: [T; MOST],
    load: [T; MOST],
}
impl Message for Report {
    const NAME: &'static str = "test/Report";
}

const SOURCE: Port<Load> = Port::new("source");
const REPORTER: Port<Report> = Port::new("reporter");

/// Its load swings, and follows from how old the last report is: what arrives when decides what arrives when.
struct Source;
impl NodeModel for Source {
    const NAME: &'static str = "source";
    type Params<T: Scalar> = Load<T>;
    type State<T: Scalar> = Load<T>;
    type Output<T: Scalar> = Load<T>;
    fn step<T: Scalar>(p: &Load<T>, state: Load<T>, step: &NodeStep<'_, T>) -> (Load<T>, Load<T>) {
        let report = step.latest::<Report<T>>(REPORTER.name());
        let age = step.start - report.received();
        let next = Load { count: state.count + 1.0, load: state.load + p.load };
        let load = next.load.sin() + age * 20.0 + report.message.load[0] * 0.1;
        (next, Load { count: state.count, load })
    }
}

struct Reporter;
impl NodeModel for Reporter {
    const NAME: &'static str = "reporter";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Report<T>;
    fn step<T: Scalar>((): &(), (): (), step: &NodeStep<'_, T>) -> ((), Report<T>) {
        let window = step.window(SOURCE.name());
        let seen: [_; MOST] = std::array::from_fn(|index| {
            (index < window).then(|| step.message::<Load<T>>(SOURCE.name(), index))
        });
        let each = |of: fn(&parallax_model::node_model::Seen<'_, T, Load<T>>) -> T| {
            seen.each_ref().map(|seen| seen.as_ref().map_or(T::constant(-2.0), of))
        };
        let report = Report {
            seq: each(|seen| seen.seq()),
            sent: each(|seen| seen.sent()),
            received: each(|seen| seen.received()),
            load: each(|seen| seen.message.load),
        };
        ((), report)
    }
}

/// `pace` is how far the source's phase goes in a step. The bounds are such that messages arrive exactly when the reporter
/// starts: after the shortest delay, or, with `skip`, after the longest.
fn reporting(pace: f64, window: usize, skip: bool, change: impl Fn(&mut GraphSpec)) -> Graph {
    let registry = Registry::new()
        .with(
            "source",
            NodeKind::model::<Source>(move |_| Ok((Load { count: 0.0, load: pace }, Load::default())))
                .input(REPORTER),
        )
        .with("reporter", NodeKind::model::<Reporter>(|_| Ok(((), ()))).input(SOURCE));
    let mut graph = GraphBuilder::new("reporting");
    let load = Delay::Output {
        leaf: "load".into(),
        offset: 6e-3,
        scale: 4e-3,
        min: 4e-3,
        max: 8e-3,
        expected: Some(4e-3),
    };
    let source = graph.model::<Source>("source", "source", 100.0).computation(load).add();
    let reporter =
        graph.model::<Reporter>("reporter", "reporter", 50.0).computation(Delay::constant(1e-3)).add();
    let connection = graph.connect(source, reporter, SOURCE).window(window).delay(Delay::constant(2e-3));
    if skip {
        connection.skip().add()
    } else {
        connection.add()
    }
    graph.connect(reporter, source, REPORTER).skip().delay(Delay::constant(1e-3)).add();
    let mut spec = graph.supervisor(reporter);
    change(&mut spec);
    spec.validate(&registry).unwrap()
}

#[test]
fn batches_decide_for_every_environment_as_the_executor_does() {
    let seed = 4;
    let paces = [0.0, 0.1, 0.37, 0.9, 1.7, 2.6];
    for (window, skip) in [(1, false), (2, true), (MOST, false), (MOST, true)] {
        let graph = |pace| reporting(pace, window, skip, |_| ());
        let drawn = generate(&graph(0.0), seed, 600 * MILLISECOND).unwrap();
        let compiled = compile(&graph(0.0), std::slice::from_ref(&drawn), &at_run_time()).unwrap();
        let base = graph(0.0);
        let batch = Batch::new(&base, &compiled, seed).unwrap();
        let mut environments = batch.environments(paces.len());
        environments.set_param("source", "load", &paces).unwrap();
        let run = |precision| batch.rollout(&environments, precision, &["source", "reporter"]).unwrap();
        let (plain, lanes) = (run(Precision::Double), run(Precision::DoubleLanes));
        let single = run(Precision::SingleLanes);
        let mut unlike = 0;
        for (environment, &pace) in paces.iter().enumerate() {
            let recording = Executor::new(graph(pace), seed).record(600 * MILLISECOND).unwrap();
            let [_, other] = hold(&compiled, &graph(pace), &recording, &drawn);
            unlike += other;
            for (kept, lanes) in plain.outputs.iter().zip(&lanes.outputs) {
                let track = recording.node(&kept.node).unwrap();
                assert!(kept.steps >= 28);
                for step in 0..kept.steps {
                    let message = kept.message(environment, step);
                    let expected = &track.message(step as u64).unwrap().payload;
                    assert_eq!(message, expected, "{} {pace} step {step}", kept.node);
                    for (a, b) in message.iter().zip(lanes.message(environment, step)) {
                        // Times are rounded to nanoseconds, so that a difference in the last bit may become one.
                        assert!(
                            (a - b).abs() <= 1e-7 * a.abs().max(1.0),
                            "{} {pace} {step}: {a} {b}",
                            kept.node
                        );
                    }
                }
            }
            let reports = &single.outputs[1];
            for step in 0..reports.steps {
                let seqs = &reports.message(environment, step)[..window];
                assert!(seqs.windows(2).all(|pair| pair[1] == pair[0] + 1.0 || pair[0] == -1.0));
            }
        }
        assert!(unlike > 20, "outputs decide: {unlike} windows are not those of the expected delays");
    }
}

#[test]
fn a_batch_under_the_schedule_sees_other_messages() {
    let graph = reporting(0.9, MOST, false, |_| ());
    let episode = generate(&graph, 4, 600 * MILLISECOND).unwrap();
    let rollout = |options: &CompileOptions| {
        let compiled = compile(&graph, std::slice::from_ref(&episode), options).unwrap();
        let batch = Batch::new(&graph, &compiled, 4).unwrap();
        batch.rollout(&batch.environments(1), Precision::Double, &["reporter"]).unwrap()
    };
    assert_ne!(rollout(&CompileOptions::default()), rollout(&at_run_time()));
}

#[test]
fn what_a_run_time_delay_may_not_have_is_named() {
    let tried = |change: fn(&mut GraphSpec), options: &CompileOptions| {
        let graph = reporting(0.9, 2, false, change);
        let episode = generate(&graph, 1, 300 * MILLISECOND).unwrap();
        compile(&graph, &[episode], options)
    };
    let problem = |change: fn(&mut GraphSpec)| {
        // What cannot be decided at run time can be taken as scheduled.
        assert!(tried(change, &CompileOptions::default()).is_ok());
        match tried(change, &at_run_time()) {
            Err(CompileError::OutputDelay { node, problem }) if node == "source" => problem,
            other => panic!("{other:?}"),
        }
    };
    assert!(tried(|_| (), &at_run_time()).is_ok());
    assert!(problem(|spec| spec.connections[0].blocking = true).contains("`source->reporter` waits"));
    assert!(problem(|spec| spec.connections[0].jitter = JitterPolicy::Buffer).contains("jitter buffer"));
    assert!(
        problem(|spec| spec.connections[0].delay = Delay::Uniform { low: 0.0, high: 1e-3 })
            .contains("constant")
    );
    // That of a connection which the node does not feed is of no matter.
    let normal = Delay::Normal { mean: 2e-3, std: 1e-3 };
    let graph = reporting(0.9, 2, false, |spec| spec.connections[1].delay = normal.clone());
    assert!(compile(&graph, &[generate(&graph, 1, 300 * MILLISECOND).unwrap()], &at_run_time()).is_ok());
    assert!(problem(|spec| spec.nodes[0].rate = 130.0).contains("more than the node's period"));
    assert!(
        problem(|spec| {
            spec.connections[1].blocking = true;
            spec.nodes[0].advance = true;
        })
        .contains("`advance`")
    );
    // It waits for reports, and so starts too late to end in time.
    assert!(
        problem(|spec| {
            spec.connections[1].blocking = true;
            spec.connections[1].delay = Delay::constant(6e-3);
        })
        .contains("after the next one is due")
    );
    let trainable =
        TrainableConnection { connection: 0, min: 0, max: MILLISECOND, interpolation: Interpolation::Hold };
    let options = CompileOptions { trainable: vec![trainable], ..at_run_time() };
    let error = tried(|_| (), &options).unwrap_err().to_string();
    assert!(error.contains("`source->reporter` is trainable") && error.contains("node `source`"), "{error}");
    // Without a choice there is nothing to decide: whatever the connections are, the schedule is right.
    let certain = |spec: &mut GraphSpec| {
        spec.connections[0].blocking = true;
        if let Delay::Output { min, max, expected, .. } = &mut spec.nodes[0].computation {
            (*min, *max, *expected) = (3e-3, 3e-3, None);
        }
    };
    assert!(tried(certain, &at_run_time()).is_ok());
}
