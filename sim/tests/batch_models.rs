//! Batches step models that prepare constants, and nodes that see their own outputs.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::graph::GraphBuilder;
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_sim::batch::{Batch, Precision};
use parallax_sim::compiled::{CompileOptions, compile};
use parallax_sim::{Executor, generate_many};

#[derive(Tree, Clone, Debug, Default)]
struct Pair<T = f64> {
    last: T,
    sum: T,
}
impl Message for Pair {
    const NAME: &'static str = "test/Pair";
}

#[derive(Tree, Clone, Debug)]
struct Divisor<T> {
    divisor: T,
}

const OWN: Port<Pair> = Port::new("own");

/// Adds the reciprocal of its parameter to what it sent two steps before.
struct Adder;
impl NodeModel for Adder {
    const NAME: &'static str = "adder";
    const PREPARED: usize = 1;
    type Params<T: Scalar> = Divisor<T>;
    type State<T: Scalar> = ();
    type Output<T: Scalar> = Pair<T>;
    fn prepare<T: Scalar>(p: &Divisor<T>, prepared: &mut [T]) {
        prepared[0] = T::constant(1.0) / p.divisor;
    }
    fn step<T: Scalar>(_: &Divisor<T>, (): (), step: &NodeStep<'_, T>) -> ((), Pair<T>) {
        let seen = step.message::<Pair<T>>(OWN.name(), 0).message;
        ((), Pair { last: seen.sum, sum: seen.sum + step.prepared[0] })
    }
}

#[test]
fn a_node_sees_its_own_outputs_and_what_it_prepared() {
    let adder = NodeKind::model::<Adder>(|_| Ok((Divisor { divisor: 3.0 }, ()))).input(OWN);
    let registry = Registry::new().with("adder", adder);
    let mut graph = GraphBuilder::new("adding");
    let adder = graph.model::<Adder>("adder", "adder", 50.0).add();
    graph.connect(adder, adder, OWN).window(2).skip().add();
    let graph = graph.supervisor(adder).validate(&registry).unwrap();

    let recording = Executor::new(graph.clone(), 1).record(1_000_000_000).unwrap();
    let recorded: Vec<_> = (0..40)
        .map(|step| recording.node("adder").unwrap().message(step).unwrap().payload.to_vec())
        .collect();
    assert!(recorded[39][1] > 6.0, "{:?}", recorded[39]);

    let episodes = generate_many(&graph, 1, 1_000_000_000, 2).unwrap();
    let compiled = compile(&graph, &episodes, &CompileOptions::default()).unwrap();
    let batch = Batch::new(&graph, &compiled, 1).unwrap();
    let divisors: Vec<f64> = (0..75).map(|index| 3.0 + f64::from(index)).collect();
    let mut environments = batch.environments(divisors.len());
    environments.set_param("adder", "divisor", &divisors).unwrap();
    let run = |precision| batch.rollout(&environments, precision, &["adder"]).unwrap();
    let (plain, lanes, single) =
        (run(Precision::Double), run(Precision::DoubleLanes), run(Precision::SingleLanes));
    for (environment, divisor) in divisors.iter().enumerate() {
        let mut sums = [0.0; 2];
        for (step, recorded) in recorded.iter().enumerate() {
            let expected = [sums[0], sums[0] + 1.0 / divisor];
            sums = [sums[1], expected[1]];
            assert_eq!(plain.outputs[0].message(environment, step), expected, "{environment} {step}");
            assert_eq!(lanes.outputs[0].message(environment, step), expected, "{environment} {step}");
            let [_, sum] = single.outputs[0].message(environment, step) else { panic!("a pair") };
            assert!((sum - expected[1]).abs() < 1e-4, "{environment} {step}: {sum}");
            if environment == 0 {
                assert_eq!(recorded, &expected, "{step}");
            }
        }
    }
}
