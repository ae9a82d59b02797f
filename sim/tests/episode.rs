//! Episodes of recordings that are whole, and of those that are not; schedules whose delays follow from outputs.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use crate::support::registry;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Graph, GraphSpec, NodeSpec};
use parallax_runtime::recording::Recording;
use parallax_sim::compiled::{CompileError, CompileOptions, Interpolation, TrainableConnection, compile};
use parallax_sim::episode::EpisodeError;
use parallax_sim::{Episode, Executor, SimError, generate};

fn graph(computation: Delay) -> Graph {
    let mut source = NodeSpec::new("source", "mixer_0", 100.0);
    source.computation = computation;
    let edge = ConnectionSpec {
        port: Some("in_0".into()),
        window: 2,
        delay: Delay::constant(0.001),
        ..ConnectionSpec::new("source", "sink")
    };
    let spec = GraphSpec {
        name: "two".into(),
        supervisor: "sink".into(),
        nodes: vec![source, NodeSpec::new("sink", "mixer_1", 50.0)],
        connections: vec![edge],
        plant: None,
    };
    spec.validate(&registry()).unwrap()
}

fn recording(graph: &Graph) -> Recording {
    Executor::new(graph.clone(), 1).record(200_000_000).unwrap()
}

#[test]
fn what_a_recording_lacks_is_named() {
    let graph = graph(Delay::constant(0.002));
    let whole = recording(&graph);
    let episode = Episode::from_recording(&graph, &whole).unwrap();
    assert_eq!(episode.check(&graph), Ok(()));
    assert_eq!((episode.nodes[0].len(), episode.nodes[1].len(), episode.steps()), (20, 10, 30));
    // The sink is due 3 ms after the source, when its first message has come.
    assert_eq!(episode.connections[0].seqs(0), [-1, 0]);
    assert_eq!(episode.connections[0].arrivals(1), [13_000_000, 23_000_000]);

    let damaged = |damage: fn(&mut Recording)| {
        let mut recording = whole.clone();
        damage(&mut recording);
        Episode::from_recording(&graph, &recording).unwrap_err()
    };
    let hole = damaged(|recording| drop(recording.nodes[0].steps.remove(3)));
    assert_eq!(hole, EpisodeError::MissingStep { node: "source".into(), expected: 3, found: 4 });
    let late = damaged(|recording| drop(recording.nodes[1].steps.remove(0)));
    assert_eq!(late, EpisodeError::MissingStep { node: "sink".into(), expected: 0, found: 1 });
    let gone = damaged(|recording| drop(recording.nodes.remove(0)));
    assert_eq!(gone, EpisodeError::MissingNode { node: "source".into() });
    let cut = damaged(|recording| recording.nodes[0].steps.truncate(5));
    assert!(matches!(cut, EpisodeError::MissingMessage { step: 3, seq: 5, .. }), "{cut}");
    // A recording that is known to be cut is taken as far as it goes.
    let mut beginning = whole.clone();
    beginning.nodes[0].steps.truncate(5);
    beginning.truncated = Some("after 50 ms".into());
    let episode = Episode::from_recording(&graph, &beginning).unwrap();
    assert_eq!((episode.nodes[0].len(), episode.nodes[1].len()), (5, 3));
    assert_eq!(episode.check(&graph), Ok(()));
    let narrow = damaged(|recording| recording.nodes[1].steps[4].inputs[0].consumed.truncate(1));
    assert!(matches!(narrow, EpisodeError::Input { step: 4, .. }), "{narrow}");
}

#[test]
fn a_delay_that_follows_from_an_output_is_drawn_as_expected() {
    let by_output = |expected| Delay::Output {
        leaf: "seq".into(),
        offset: 0.0,
        scale: 0.001,
        min: 0.001,
        max: 0.007,
        expected,
    };
    // The run takes longer from step to step; a schedule without values takes what the graph states.
    let run = Episode::from_recording(&graph(by_output(None)), &recording(&graph(by_output(None)))).unwrap();
    assert!(run.nodes[0].end[5] - run.nodes[0].start[5] > run.nodes[0].end[2] - run.nodes[0].start[2]);
    for (expected, nanos) in [(None, 4_000_000), (Some(0.002), 2_000_000)] {
        let drawn = generate(&graph(by_output(expected)), 1, 200_000_000).unwrap();
        let steps = &drawn.nodes[0];
        assert!(steps.start.iter().zip(&steps.end).all(|(start, end)| end - start == nanos));
    }
    assert!(matches!(generate(&graph(Delay::ZERO), 1, 0), Err(SimError::Duration { .. })));
}

#[test]
fn what_cannot_be_compiled_is_named() {
    let graph = graph(Delay::ZERO);
    let episode = generate(&graph, 1, 200_000_000).unwrap();
    let tried = |episodes: &[Episode], change: fn(&mut CompileOptions)| {
        let mut options = CompileOptions::default();
        change(&mut options);
        compile(&graph, episodes, &options).unwrap_err()
    };
    let one = std::slice::from_ref(&episode);
    assert_eq!(tried(&[], |_| ()), CompileError::NoEpisodes);
    assert_eq!(tried(one, |o| o.keep.push(2)), CompileError::NoNode { node: 2, nodes: 2 });
    assert_eq!(tried(one, |o| o.stateful = Some(vec![true])), CompileError::Stateful { found: 1, nodes: 2 });
    let bounds = tried(one, |o| {
        o.trainable.push(TrainableConnection {
            connection: 0,
            min: 2,
            max: 1,
            interpolation: Interpolation::Hold,
        });
    });
    assert!(matches!(bounds, CompileError::Trainable { connection: 0, .. }));
    let idle = generate(&graph, 1, 500_000).unwrap();
    assert_eq!(tried(&[idle], |_| ()), CompileError::NoSteps { node: "sink".into() });
    let mut foreign = episode.clone();
    foreign.connections[0].seq[3] = 99;
    assert!(matches!(tried(&[episode.clone(), foreign], |_| ()), CompileError::Episode { episode: 1, .. }));
}
