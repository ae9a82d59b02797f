//! What a model went through is told from its recording: running the model from it gives the recorded outputs again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use parallax_model::node_model::{NodeModel, NodeStep};
use parallax_model::{Scalar, Tree};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, NodeSpec};
use parallax_runtime::node::{Message, Port};
use parallax_runtime::registry::{NodeKind, Registry};
use parallax_sim::{Executor, trajectories};

#[derive(Tree, Clone, Default)]
struct Walk<T = f64> {
    place: T,
}
impl Message for Walk {
    const NAME: &'static str = "test/Walk";
}

/// A random walk that its partner draws to itself.
struct Walker;
impl NodeModel for Walker {
    const NAME: &'static str = "walker";
    const NOISE: usize = 2;
    type Params<T: Scalar> = Walk<T>;
    type State<T: Scalar> = Walk<T>;
    type Output<T: Scalar> = Walk<T>;

    fn step<T: Scalar>(p: &Walk<T>, state: Walk<T>, step: &NodeStep<'_, T>) -> (Walk<T>, Walk<T>) {
        let other = step.latest::<Walk<T>>("partner").message.place;
        let place =
            state.place + p.place * (other - state.place) + step.noise[0] + step.noise[1] * step.start;
        (Walk { place }, Walk { place: place + step.seq })
    }
}

const PARTNER: Port<Walk> = Port::new("partner");

fn registry() -> Registry {
    let kind = NodeKind::model::<Walker>(|_| Ok((Walk { place: 0.25 }, Walk { place: 3.0 })));
    Registry::new().with("walker", kind.input(PARTNER))
}

fn graph() -> Graph {
    let connection = |from: &str, to: &str, delay, skip| ConnectionSpec {
        port: Some("partner".into()),
        delay,
        skip,
        ..ConnectionSpec::new(from, to)
    };
    let spec = GraphSpec {
        name: "two walkers".into(),
        supervisor: "slow".into(),
        nodes: vec![NodeSpec::new("fast", "walker", 100.0), NodeSpec::new("slow", "walker", 40.0)],
        connections: vec![
            connection("fast", "slow", Delay::Normal { mean: 0.004, std: 0.002 }, false),
            connection("slow", "fast", Delay::constant(0.001), true),
        ],
        plant: None,
    };
    spec.validate(&registry()).unwrap()
}

/// The equation of the walker, written a second time.
fn next(before: f64, other: f64, noise: &[f64], start: f64) -> f64 {
    before + 0.25 * (other - before) + noise[0] + noise[1] * start
}

#[test]
fn states_noise_and_inputs_give_the_recorded_outputs() {
    let recording = Executor::new(graph(), 5).record(2_000_000_000).unwrap();
    let trajectories = trajectories(&recording, &registry()).unwrap();
    assert_eq!(trajectories.len(), 2);
    for (walk, track) in trajectories.iter().zip(&recording.nodes) {
        assert_eq!(
            (walk.name.as_str(), walk.steps, walk.differing),
            (track.name.as_str(), track.steps.len(), 0)
        );
        assert_eq!(walk.params, [0.25]);
        assert_eq!(walk.state(0), [3.0]);
        let partner = &recording.nodes[1 - walk.node];
        for (k, step) in track.steps.iter().enumerate() {
            let other = match step.inputs[0].consumed[0].seq {
                Some(seq) => partner.message(seq).unwrap().payload[0],
                None => partner.initial[0],
            };
            let noise = &walk.noise[2 * k..2 * k + 2];
            let after = next(walk.state(k)[0], other, noise, step.start as f64 * 1e-9);
            assert!((walk.state(k + 1)[0] - after).abs() < 1e-9, "step {k} of {}", walk.name);
            assert_eq!(walk.outputs[k].to_bits(), track.messages[k].payload[0].to_bits());
        }
    }
    assert_ne!(
        trajectories[0].noise[..2],
        trajectories[1].noise[..2],
        "every node draws from its own stream"
    );
}

#[test]
fn a_recording_of_something_else_is_told() {
    let mut recording = Executor::new(graph(), 5).record(500_000_000).unwrap();
    recording.nodes[0].messages[7].payload[0] += 1e-9;
    let trajectories = trajectories(&recording, &registry()).unwrap();
    assert_eq!(trajectories[0].differing, 1);
    assert!(trajectories[1].differing > 0, "it consumed the changed message");
}
