//! Batches compute what the executor computes, whatever they are computed with and however they are divided.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{Graph, GraphBuilder};
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_runtime::time::to_seconds;
use parallax_sim::batch::{Batch, BatchError, Environments, Given, Precision, Rollout};
use parallax_sim::compiled::{CompileOptions, CompiledGraph, Interpolation, TrainableConnection, compile};
use parallax_sim::{Episode, Executor, generate_many};

const SECOND: i64 = 1_000_000_000;

fn pendulum() -> Graph {
    parallax_nodes::pendulum::simulated().validate(&parallax_nodes::registry()).unwrap()
}

fn compiled(graph: &Graph, seconds: i64, episodes: usize, options: &CompileOptions) -> CompiledGraph {
    let episodes = generate_many(graph, 3, seconds * SECOND, episodes).unwrap();
    compile(graph, &episodes, options).unwrap()
}

/// One environment on plain numbers is the run itself, noise included: every message has the bits that were recorded.
#[test]
fn one_environment_repeats_the_executor_bit_for_bit() {
    for name in ["pendulum-simulated", "quadrotor-simulated"] {
        let graph = parallax_nodes::graph(name).unwrap().validate(&parallax_nodes::registry()).unwrap();
        for seed in [1, 2] {
            let recording = Executor::new(graph.clone(), seed).record(3 * SECOND).unwrap();
            let episode = Episode::from_recording(&graph, &recording).unwrap();
            let compiled = compile(&graph, &[episode], &CompileOptions::default()).unwrap();
            let batch = Batch::new(&graph, &compiled, seed).unwrap();
            let mut environments = batch.environments(1);
            environments.set_seeds(&[seed]).unwrap();
            let names: Vec<&str> = graph.nodes().iter().map(|node| node.name.as_str()).collect();
            let rollout = batch.rollout(&environments, Precision::Double, &names).unwrap();
            let lanes = batch.rollout(&environments, Precision::DoubleLanes, &names).unwrap();
            let mut compared = 0;
            for (kept, lanes) in rollout.outputs.iter().zip(&lanes.outputs) {
                let track = recording.node(&kept.node).unwrap();
                for step in 0..kept.steps {
                    let message = kept.message(0, step);
                    if message[0].is_nan() {
                        // Nothing depends on it; so it does not run.
                        continue;
                    }
                    assert_eq!(
                        message,
                        track.message(step as u64).unwrap().payload,
                        "{name} {} {step}",
                        kept.node
                    );
                    for (a, b) in message.iter().zip(lanes.message(0, step)) {
                        assert!(
                            (a - b).abs() <= 1e-8 * a.abs().max(1.0),
                            "{name} {} {step}: {a} {b}",
                            kept.node
                        );
                    }
                    compared += 1;
                }
            }
            assert!(compared > 700, "{name}: {compared} messages");
        }
    }
}

/// Environments that differ in everything that may differ, more than one group of some episodes, none of them whole.
fn varied<'a>(batch: &'a Batch<'a>, count: usize) -> Environments<'a> {
    let mut environments = batch.environments(count);
    let spread = |low: f64, high: f64| -> Vec<f64> {
        (0..count).map(|index| low + (high - low) * (index * 7 % count) as f64 / count as f64).collect()
    };
    environments.set_param("world", "pendulum.mass", &spread(0.04, 0.06)).unwrap();
    environments.set_param("world", "pendulum.friction", &spread(0.0, 2e-3)).unwrap();
    environments.set_state("world", "angle", &spread(-3.0, 3.0)).unwrap();
    environments
        .set_episodes(&(0..count).map(|index| (index * index % 3) as u32).collect::<Vec<_>>())
        .unwrap();
    environments
}

fn on_threads(threads: usize, work: impl FnOnce() -> Rollout + Send) -> Rollout {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// The same bits, where what did not run counts as equal.
fn same(a: &Rollout, b: &Rollout) -> bool {
    let bits = |rollout: &Rollout| -> Vec<u64> {
        let outputs = rollout.outputs.iter().flat_map(|kept| &kept.values);
        outputs.chain(rollout.states.iter().flatten()).map(|value| value.to_bits()).collect()
    };
    bits(a) == bits(b)
}

#[test]
fn neither_threads_nor_company_change_a_bit() {
    let graph = pendulum();
    let compiled = compiled(&graph, 1, 3, &CompileOptions::default());
    let batch = Batch::new(&graph, &compiled, 5).unwrap();
    let count = 150;
    let environments = varied(&batch, count);
    for precision in [Precision::Double, Precision::DoubleLanes, Precision::SingleLanes] {
        let run = || batch.rollout(&environments, precision, &["world", "agent"]).unwrap();
        let together = on_threads(1, run);
        assert!(same(&together, &on_threads(3, run)), "{precision:?}");
        assert!(together.states[0].iter().all(|value| value.is_finite()));
        for alone in [0, 63, 149] {
            // Everything of one environment, set for a batch of its own.
            let mut one = batch.environments(1);
            let index = alone * 7 % count;
            let between = |low: f64, high: f64| [low + (high - low) * index as f64 / count as f64];
            one.set_param("world", "pendulum.mass", &between(0.04, 0.06)).unwrap();
            one.set_param("world", "pendulum.friction", &between(0.0, 2e-3)).unwrap();
            one.set_state("world", "angle", &between(-3.0, 3.0)).unwrap();
            one.set_episodes(&[(alone * alone % 3) as u32]).unwrap();
            one.set_seeds(&[parallax_runtime::random::derived(5, &format!("environment {alone}"))]).unwrap();
            let one = batch.rollout(&one, precision, &["world", "agent"]).unwrap();
            for (one, together) in one.outputs.iter().zip(&together.outputs) {
                for step in 0..one.steps {
                    let bits =
                        |message: &[f64]| message.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
                    assert_eq!(
                        bits(one.message(0, step)),
                        bits(together.message(alone, step)),
                        "{precision:?}"
                    );
                }
            }
        }
    }
}

/// Step by step lanes agree with plain numbers to 1e-12; the pendulum then multiplies what rounding left, as it does every
/// difference.
#[test]
fn lanes_agree_with_plain_numbers() {
    let graph = pendulum();
    let compiled = compiled(&graph, 1, 3, &CompileOptions::default());
    let batch = Batch::new(&graph, &compiled, 5).unwrap();
    let environments = varied(&batch, 40);
    let run = |precision| batch.rollout(&environments, precision, &["world"]).unwrap();
    let (plain, lanes, single) =
        (run(Precision::Double), run(Precision::DoubleLanes), run(Precision::SingleLanes));
    let early = |rollout: &Rollout, step: usize| -> Vec<f64> {
        (0..40).flat_map(|environment| rollout.outputs[0].message(environment, step).to_vec()).collect()
    };
    for step in 0..90 {
        let tolerance = if step < 4 { 1e-12 } else { 1e-9 };
        let all = early(&plain, step).into_iter().zip(early(&lanes, step)).zip(early(&single, step));
        for ((a, b), c) in all {
            assert!((a - b).abs() <= tolerance * a.abs().max(1.0), "step {step}: {a} {b}");
            assert!((a - c).abs() <= 2e-3 * a.abs().max(1.0), "step {step}: {a} {c} in single precision");
        }
    }
    assert!(!same(&plain, &single));
}

#[derive(Tree, Clone, Debug, Default)]
struct Number<T = f64> {
    value: T,
}
impl Message for Number {
    const NAME: &'static str = "test/Number";
}

const WINDOW: usize = 2;

/// All that a step saw: number, sent, received and value of every message.
#[derive(Tree, Clone, Debug, Default)]
struct Report<T = f64> {
    seq: [T; WINDOW],
    sent: [T; WINDOW],
    received: [T; WINDOW],
    value: [T; WINDOW],
}
impl Message for Report {
    const NAME: &'static str = "test/Report";
}

/// Counts, and sends the sine of what it counts, times a gain.
struct Source;
impl NodeModel for Source {
    const NAME: &'static str = "source";
    type Params<T: Scalar> = Number<T>;
    type State<T: Scalar> = Number<T>;
    type Output<T: Scalar> = Number<T>;
    fn step<T: Scalar>(p: &Number<T>, state: Number<T>, _: &NodeStep<'_, T>) -> (Number<T>, Number<T>) {
        let value = state.value * p.value;
        (Number { value: state.value + 1.0 }, Number { value })
    }
}

const SOURCE: Port<Number> = Port::new("source");

struct Reporter;
impl NodeModel for Reporter {
    const NAME: &'static str = "reporter";
    type Params<T: Scalar> = ();
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Report<T>;
    fn step<T: Scalar>((): &(), (): (), step: &NodeStep<'_, T>) -> ((), Report<T>) {
        let seen: [_; WINDOW] = std::array::from_fn(|index| step.message::<Number<T>>(SOURCE.name(), index));
        let report = Report {
            seq: seen.each_ref().map(|seen| seen.seq()),
            sent: seen.each_ref().map(|seen| seen.sent()),
            received: seen.each_ref().map(|seen| seen.received()),
            value: seen.map(|seen| seen.message.value),
        };
        ((), report)
    }
}

fn reporting() -> Graph {
    let start = Number { value: 1.0 };
    let registry = Registry::new()
        .with("source", NodeKind::model::<Source>(move |_| Ok((start.clone(), Number { value: 1.0 }))))
        .with("reporter", NodeKind::model::<Reporter>(|_| Ok(((), ()))).input(SOURCE));
    let mut graph = GraphBuilder::new("reporting");
    let source = graph
        .model::<Source>("source", "source", 90.0)
        .computation(Delay::Normal { mean: 2e-3, std: 0.5e-3 })
        .add();
    let reporter = graph.model::<Reporter>("reporter", "reporter", 50.0).add();
    graph.connect(source, reporter, SOURCE).window(WINDOW).delay(Delay::constant(5e-3)).add();
    graph.supervisor(reporter).validate(&registry).unwrap()
}

/// What a step should see under a delay, found by looking at all messages of the sender.
fn expected(
    episode: &Episode,
    step: usize,
    delay: f64,
    gain: f64,
    interpolation: Interpolation,
) -> [[f64; 4]; WINDOW] {
    let start = to_seconds(episode.nodes[1].start[step]);
    let sent: Vec<f64> = episode.nodes[0].end.iter().map(|&end| to_seconds(end)).collect();
    let arrived = sent.iter().take_while(|&&sent| sent <= start - delay).count() as i64;
    let value = |seq: i64| if seq < 0 { 0.0 } else { (seq + 1) as f64 * gain };
    let time = |seq: i64| usize::try_from(seq).map_or(0.0, |seq| sent[seq]);
    std::array::from_fn(|index| {
        let seq = (arrived - (WINDOW - index) as i64).max(-1);
        let received = if seq < 0 { 0.0 } else { time(seq) + delay };
        let mut payload = value(seq);
        let next = sent.get((seq + 1) as usize);
        // The step cannot see what is sent after its start, under any delay.
        if let (Interpolation::Linear, 0.., Some(&next)) =
            (interpolation, seq, next.filter(|&&next| next <= start))
        {
            let look = start - delay - (time(arrived - 1) - time(seq));
            let share = ((look - time(seq)) / (next - time(seq))).clamp(0.0, 1.0);
            payload += share * (value(seq + 1) - payload);
        }
        if interpolation == Interpolation::Smooth && seq >= 0 {
            let look = start - delay - (time(arrived - 1) - time(seq));
            let is_there = |seq: i64| seq >= 0 && sent.get(seq as usize).is_some_and(|&sent| sent <= start);
            // Lagrange's polynomial.
            let through = |seqs: &[i64]| -> f64 {
                let factor = |a: i64, b: i64| (look - time(b)) / (time(a) - time(b));
                let others = |a: i64| seqs.iter().filter(move |&&b| b != a);
                seqs.iter().map(|&a| value(a) * others(a).map(|&b| factor(a, b)).product::<f64>()).sum()
            };
            let middle = if is_there(seq + 1) { seq } else { seq - 1 };
            let all: Vec<i64> = (middle - 1..middle + 3).filter(|&seq| is_there(seq)).collect();
            payload = match (middle, &all[..]) {
                (..0, _) => value(seq),
                (_, &[a, b, c, d]) => 0.5 * (through(&[a, b, c]) + through(&[b, c, d])),
                (_, some) => through(some),
            };
        }
        [seq as f64, time(seq), received, payload]
    })
}

#[test]
fn trainable_delays_select_for_every_environment() {
    let graph = reporting();
    let episodes = generate_many(&graph, 1, 2 * SECOND, 2).unwrap();
    for interpolation in [Interpolation::Hold, Interpolation::Linear, Interpolation::Smooth] {
        let trainable = TrainableConnection { connection: 0, min: 0, max: 50_000_000, interpolation };
        let options = CompileOptions { trainable: vec![trainable], ..CompileOptions::default() };
        let compiled = compile(&graph, &episodes, &options).unwrap();
        let batch = Batch::new(&graph, &compiled, 1).unwrap();
        let count = 45;
        let alphas: Vec<f64> = (0..count).map(|index| index as f64 / (count - 1) as f64).collect();
        let gains: Vec<f64> = (0..count).map(|index| 1.0 + 0.1 * index as f64).collect();
        let mut environments = batch.environments(count);
        environments.set_delay("source->reporter", &alphas).unwrap();
        environments.set_param("source", "value", &gains).unwrap();
        for (precision, tolerance) in [(Precision::Double, 1e-11), (Precision::DoubleLanes, 1e-11)] {
            let rollout = batch.rollout(&environments, precision, &["reporter"]).unwrap();
            for environment in 0..count {
                let episode = &episodes[environment % 2];
                for step in 0..episode.nodes[1].len() {
                    let delay = alphas[environment] * 0.05;
                    let expected = expected(episode, step, delay, gains[environment], interpolation);
                    let message = rollout.outputs[0].message(environment, step);
                    for (index, expected) in expected.iter().enumerate() {
                        for (what, expected) in expected.iter().enumerate() {
                            let found = message[what * WINDOW + index];
                            assert!(
                                (found - expected).abs() <= tolerance * expected.abs().max(1.0),
                                "{interpolation:?} {environment} {step} message {index}, {what}: {found}, {expected}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn given_outputs_take_the_place_of_computed_ones() {
    let graph = pendulum();
    let agent = graph.supervisor();
    let options = CompileOptions { pinned: vec![agent], ..CompileOptions::default() };
    let episodes = generate_many(&graph, 3, SECOND, 2).unwrap();
    let pinned = compile(&graph, &episodes, &options).unwrap();
    let free = compile(&graph, &episodes, &CompileOptions::default()).unwrap();
    let computing = Batch::new(&graph, &free, 5).unwrap();
    let count = 21;
    let computed =
        computing.rollout(&computing.environments(count), Precision::DoubleLanes, &["agent", "world"]);
    let [actions, worlds] = computed.unwrap().outputs.try_into().unwrap();

    let batch = Batch::new(&graph, &pinned, 5).unwrap();
    let mut environments = batch.environments(count);
    let missing = batch.rollout(&environments, Precision::DoubleLanes, &[]);
    assert!(matches!(missing, Err(BatchError::NotGiven { node }) if node == "agent"));
    let given = Given::PerEnvironment { steps: actions.steps, values: &actions.values };
    environments.give("agent", given).unwrap();
    let again = batch.rollout(&environments, Precision::DoubleLanes, &["world"]).unwrap();
    for environment in 0..count {
        for step in 0..worlds.steps {
            let (a, b) = (worlds.message(environment, step), again.outputs[0].message(environment, step));
            assert!(
                a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits()),
                "{environment} {step}: {a:?} {b:?}"
            );
        }
    }
    // A reduction sees the same: here the largest speed of every environment.
    let fastest = batch
        .fold(
            &environments,
            Precision::DoubleLanes,
            |members| vec![0.0f64; members.len()],
            |fastest, moment| {
                for (position, fastest) in fastest.iter_mut().enumerate() {
                    *fastest = fastest.max(moment.output(0, position, 1).abs());
                }
            },
        )
        .unwrap();
    let mut seen = 0;
    for (members, fastest) in fastest {
        for (member, fastest) in members.into_iter().zip(fastest) {
            let all = (0..worlds.steps).map(|step| worlds.message(member, step)[1].abs());
            let largest = all.filter(|speed| !speed.is_nan()).fold(0.0, f64::max);
            assert!(fastest <= largest && fastest > 0.5 * largest, "{fastest} of {largest}");
            seen += 1;
        }
    }
    assert_eq!(seen, count);
}

#[test]
fn what_does_not_fit_is_an_error() {
    let graph = pendulum();
    let compiled = compiled(&graph, 1, 2, &CompileOptions::default());
    let batch = Batch::new(&graph, &compiled, 5).unwrap();
    let mut environments = batch.environments(3);
    let text = |error: BatchError| error.to_string();
    assert!(text(environments.set_param("wrld", "x", &[]).unwrap_err()).contains("no node `wrld`"));
    let error = text(environments.set_param("world", "mass", &[1.0; 3]).unwrap_err());
    assert!(error.contains("pendulum.mass"), "{error}");
    assert!(text(environments.set_state("world", "angle", &[1.0]).unwrap_err()).contains("expected 3"));
    assert!(matches!(
        environments.set_episodes(&[0, 1, 2]),
        Err(BatchError::NoEpisode { episode: 2, episodes: 2 })
    ));
    assert!(matches!(
        environments.set_delay("motor->world", &[0.0; 3]),
        Err(BatchError::NotTrainable { .. })
    ));
    let given = Given::PerEpisode { steps: 50, values: &[0.0; 100] };
    assert!(matches!(environments.give("agent", given), Err(BatchError::NotPinned { .. })));
    assert!(batch.rollout(&environments, Precision::Double, &["camera"]).is_err());
    let plain = parallax_nodes::pendulum::graph().validate(&parallax_nodes::registry()).unwrap();
    let episodes = generate_many(&plain, 3, SECOND, 1).unwrap();
    let tables = compile(&plain, &episodes, &CompileOptions::default()).unwrap();
    assert!(matches!(Batch::new(&plain, &tables, 1), Err(BatchError::NoModel { .. })));
}
