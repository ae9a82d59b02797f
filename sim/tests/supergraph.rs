//! What holds for the partitions and the supergraph of any episode, tried on random ones.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::BTreeMap;

use parallax_sim::supergraph::{
    Cut, Dag, DagInput, DagNode, Embedding, Method, Partition, Partitioning, PlanOptions, StartUp,
    Supergraph, SupergraphError, partition, plan, supergraph,
};
use proptest::prelude::*;

const METHODS: [Method; 3] = [Method::Mcs { backtrack: 20 }, Method::Topological, Method::Generational];
const CUTS: [Cut; 3] = [Cut::Ancestors, Cut::Balanced { ahead: 0 }, Cut::Balanced { ahead: 2 }];
const STARTS: [StartUp; 2] = [StartUp::First, StartUp::Passes];

/// Owned data behind a [`Dag`]; node 0 is the supervisor.
#[derive(Debug, Clone)]
struct Run {
    nodes: Vec<Steps>,
}

#[derive(Debug, Clone)]
struct Steps {
    start: Vec<i64>,
    stateful: bool,
    keep: bool,
    inputs: Vec<(u32, usize, Vec<i64>)>,
}

impl Run {
    fn dag(&self) -> Dag<'_> {
        Dag {
            nodes: self
                .nodes
                .iter()
                .map(|node| DagNode {
                    start: &node.start,
                    stateful: node.stateful,
                    keep: node.keep,
                    inputs: node
                        .inputs
                        .iter()
                        .map(|(from, window, seq)| DagInput { from: *from, window: *window, seq })
                        .collect(),
                })
                .collect(),
        }
    }

    /// What a step depends on, by node and number.
    fn inputs(&self, (node, step): (u32, u32)) -> Vec<(u32, u32)> {
        let steps = &self.nodes[node as usize];
        let mut found: Vec<(u32, u32)> = Vec::new();
        if step > 0 && (steps.stateful || node == 0) {
            found.push((node, step - 1));
        }
        for (from, window, seq) in &steps.inputs {
            let seen = &seq[step as usize * window..(step as usize + 1) * window];
            found.extend(seen.iter().filter(|&&seq| seq >= 0).map(|&seq| (*from, seq as u32)));
        }
        found
    }
}

#[derive(Debug, Clone)]
struct NodeShape {
    rate: f64,
    phase: f64,
    jitter: f64,
    stateful: bool,
    keep: bool,
}

fn node() -> impl Strategy<Value = NodeShape> {
    let rate = prop_oneof![Just(100.0), Just(50.0), Just(60.0), Just(30.0), 10.0..150.0];
    (rate, 0.0..0.08, prop_oneof![Just(0.0), 0.0..0.4], any::<bool>(), prop::bool::weighted(0.2))
        .prop_map(|(rate, phase, jitter, stateful, keep)| NodeShape { rate, phase, jitter, stateful, keep })
}

/// Steps at jittered times; each sees the last messages of every sender that it is connected to, sent a delay before.
fn run() -> impl Strategy<Value = Run> {
    (2usize..6)
        .prop_flat_map(|count| {
            let connection = prop::option::weighted(0.5, (1usize..4, 0.0..0.05));
            (
                prop::collection::vec(node(), count),
                prop::collection::vec(connection, count * count),
                prop::collection::vec(-1.0..1.0f64, 64),
            )
        })
        .prop_map(|(shapes, connections, noise)| {
            let count = shapes.len();
            let mut draw = noise.iter().cycle();
            let starts: Vec<Vec<i64>> = shapes
                .iter()
                .map(|shape| {
                    let steps = (0.7 * shape.rate) as usize;
                    let times = (0..steps).map(|step| {
                        let time = shape.phase
                            + (step as f64 + 0.5 + shape.jitter * draw.next().unwrap()) / shape.rate;
                        (time * 1e9) as i64
                    });
                    times.collect()
                })
                .collect();
            let nodes = shapes.iter().enumerate().map(|(to, shape)| {
                let inputs = (0..count).filter(|&from| from != to).filter_map(|from| {
                    let (window, delay) = connections[from * count + to]?;
                    // Backward connections see nothing that starts at the same time.
                    let delay = (delay * 1e9) as i64 + 1;
                    let seq = starts[to].iter().flat_map(|&start| {
                        let seen = starts[from].partition_point(|&sent| sent + delay <= start) as i64;
                        (seen - window as i64..seen).map(|seq| seq.max(-1))
                    });
                    Some((from as u32, window, seq.collect()))
                });
                Steps {
                    start: starts[to].clone(),
                    stateful: shape.stateful,
                    keep: shape.keep,
                    inputs: inputs.collect(),
                }
            });
            Run { nodes: nodes.collect() }
        })
}

/// Checks a cut against what every executor relies on.
fn check_cut(run: &Run, cut: Cut, start: StartUp, found: &Partitioning) {
    let supervisor = run.nodes[0].start.len();
    assert_eq!(found.partitions.len(), found.warm_up + supervisor);
    let mut place = BTreeMap::new();
    for (index, (partition, steps)) in found.partitions.iter().zip(&found.steps).enumerate() {
        assert_eq!(partition.labels.len(), steps.len());
        let mut local = BTreeMap::new();
        for (vertex, (&label, &step)) in partition.labels.iter().zip(steps).enumerate() {
            assert_eq!(label, step.0);
            assert!(place.insert(step, (index, vertex)).is_none(), "{step:?} runs twice");
            local.insert(step, vertex as u32);
        }
        // The edges are those of the steps, and no others.
        let mut expected = Vec::new();
        for (&step, &to) in &local {
            for input in run.inputs(step) {
                if let Some(&from) = local.get(&input) {
                    expected.push((from, to));
                }
            }
        }
        let mut edges = partition.edges.clone();
        edges.sort_unstable();
        expected.sort_unstable();
        expected.dedup();
        assert_eq!(edges, expected);
        let own = index.checked_sub(found.warm_up).map(|step| (0, step as u32));
        assert_eq!(steps.iter().filter(|step| step.0 == 0).copied().collect::<Vec<_>>(), Vec::from_iter(own));
        assert!(own.is_none() || steps.last() == own.as_ref());
    }
    // Exactly what the supervisor or a kept step depends on runs, all of it after what it depends on.
    let mut needed: Vec<(u32, u32)> = (0..supervisor as u32).map(|step| (0, step)).collect();
    let end = run.nodes[0].start.last().copied().unwrap_or(i64::MIN);
    for (node, steps) in run.nodes.iter().enumerate().filter(|(_, steps)| steps.keep) {
        // A kept step that starts before the supervisor's last one, and does not depend on that, runs.
        for step in (0..steps.start.len()).filter(|&step| steps.start[step] < end) {
            needed.push((node as u32, step as u32));
        }
    }
    let mut expected = std::collections::BTreeSet::new();
    while let Some(step) = needed.pop() {
        if expected.insert(step) {
            needed.extend(run.inputs(step));
        }
    }
    assert!(place.keys().eq(expected.iter()));
    for (step, at) in &place {
        for input in run.inputs(*step) {
            assert!(place[&input] < *at, "{step:?} runs before {input:?}");
        }
        if step.1 > 0
            && let Some(before) = place.get(&(step.0, step.1 - 1))
        {
            assert!(before < at, "the steps of node {} do not keep their order", step.0);
        }
    }
    if start == StartUp::First || cut == Cut::Ancestors {
        assert_eq!(found.warm_up, 0);
    }
}

fn check_found(partitions: &[Partition], supervisor: u32, found: &Supergraph, embeddings: &[Embedding]) {
    assert_eq!(embeddings.len(), partitions.len());
    for (partition, embedding) in partitions.iter().zip(embeddings) {
        // Written out here, not by the function under test.
        let taken: std::collections::BTreeSet<u32> = embedding.slots.iter().copied().collect();
        assert_eq!(taken.len(), partition.labels.len(), "a slot is given twice");
        for (&label, &slot) in partition.labels.iter().zip(&embedding.slots) {
            assert_eq!(found.labels[slot as usize], label);
        }
        for &(from, to) in &partition.edges {
            let edge = (embedding.slots[from as usize], embedding.slots[to as usize]);
            assert!(edge.0 < edge.1);
            assert!(found.edges.binary_search(&edge).is_ok());
        }
        if partition.labels.last() == Some(&supervisor) {
            assert_eq!(*embedding.slots.last().unwrap() as usize, found.labels.len() - 1);
        }
        assert!(found.embeds(partition, embedding));
    }
    let last = found.labels.len() as u32 - 1;
    assert_eq!(found.labels.iter().rposition(|&label| label == supervisor), Some(last as usize));
    assert_eq!(found.labels.iter().filter(|&&label| label == supervisor).count(), 1);
    assert_eq!(found.generations.last(), Some(&vec![last]));
    assert_eq!(found.generations.concat(), (0..=last).collect::<Vec<_>>());
    let mut generation = vec![0; found.labels.len()];
    for (index, slots) in found.generations.iter().enumerate() {
        slots.iter().for_each(|&slot| generation[slot as usize] = index);
        let labels: std::collections::BTreeSet<u32> =
            slots.iter().map(|&slot| found.labels[slot as usize]).collect();
        assert_eq!(labels.len(), slots.len(), "two slots of one node in a generation");
    }
    for &(from, to) in &found.edges {
        assert!(generation[from as usize] < generation[to as usize]);
    }
    assert!(found.labels.len() >= found.bound);
}

fn check_supergraph(partitions: &[Partition], supervisor: u32) {
    let mut slots = Vec::new();
    for method in METHODS {
        let (found, embeddings) = supergraph(partitions, supervisor, method).unwrap();
        check_found(partitions, supervisor, &found, &embeddings);
        slots.push(found.labels.len());
        assert_eq!(supergraph(partitions, supervisor, method).unwrap(), (found, embeddings));
    }
    assert!(slots[0] <= slots[1] && slots[0] <= slots[2] && slots[2] <= slots[1], "{slots:?}");
}

/// Any small labelled DAG; label 0 is the supervisor's.
fn any_partition() -> impl Strategy<Value = Partition> {
    (prop::collection::vec(1u32..5, 0..9), prop::collection::vec(prop::bool::weighted(0.3), 64)).prop_map(
        |(mut labels, chosen)| {
            let count = labels.len() as u32;
            let pairs = (0..count).flat_map(|to| (0..to).map(move |from| (from, to)));
            let mut edges: Vec<_> =
                pairs.zip(chosen).filter(|(_, chosen)| *chosen).map(|(pair, _)| pair).collect();
            if count > 0 {
                edges.push((count - 1, count));
            }
            labels.push(0);
            Partition { labels, edges }
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, ..ProptestConfig::default() })]

    #[test]
    fn every_episode_is_cut_and_every_partition_embeds(run in run()) {
        for cut in CUTS {
            for start in STARTS {
                let found = partition(&run.dag(), 0, cut, start).unwrap();
                check_cut(&run, cut, start, &found);
                check_supergraph(&found.partitions, 0);
            }
        }
    }

    #[test]
    fn plans_hold_every_episode_in_no_more_slots(mut runs in prop::collection::vec(run(), 1..4)) {
        // Episodes of one graph differ in their times and in what was consumed, not in their nodes.
        let count = runs.iter().map(|run| run.nodes.len()).min().unwrap();
        for run in &mut runs {
            run.nodes.truncate(count);
            run.nodes.iter_mut().for_each(|node| node.inputs.retain(|input| (input.0 as usize) < count));
        }
        let dags: Vec<Dag<'_>> = runs.iter().map(Run::dag).collect();
        for cut in CUTS {
            for start in STARTS {
                let options = PlanOptions { cut, start, method: METHODS[0] };
                let found = plan(&dags, 0, &options).unwrap();
                let mut apart = Vec::new();
                for ((run, episode), embeddings) in runs.iter().zip(&found.episodes).zip(&found.embeddings) {
                    prop_assert_eq!(episode.warm_up, found.episodes[0].warm_up);
                    check_cut(run, cut, start, episode);
                    check_found(&episode.partitions, 0, &found.supergraph, embeddings);
                    apart.extend(partition(&run.dag(), 0, cut, start).unwrap().partitions);
                }
                let (apart, _) = supergraph(&apart, 0, METHODS[0]).unwrap();
                prop_assert!(found.supergraph.labels.len() <= apart.labels.len());
                prop_assert_eq!(&plan(&dags, 0, &options).unwrap(), &found);
            }
        }
    }

    #[test]
    fn any_partitions_embed(partitions in prop::collection::vec(any_partition(), 1..12)) {
        check_supergraph(&partitions, 0);
    }
}

/// The shortest sequence of `labels` labels into which all partitions (without the supervisor) fit, by trying all.
fn shortest(partitions: &[Partition], labels: u32) -> usize {
    fn fits(partition: &Partition, sequence: &[u32]) -> bool {
        let inner = partition.labels.len() - 1;
        let mut placed = vec![false; inner];
        for &label in sequence {
            let ready = (0..inner).find(|&vertex| {
                !placed[vertex]
                    && partition.labels[vertex] == label
                    && partition
                        .edges
                        .iter()
                        .all(|&(from, to)| to as usize != vertex || placed[from as usize])
            });
            if let Some(vertex) = ready {
                placed[vertex] = true;
            }
        }
        placed.into_iter().all(|placed| placed)
    }
    let mut level: Vec<Vec<u32>> = vec![Vec::new()];
    loop {
        if let Some(found) = level.iter().find(|sequence| partitions.iter().all(|one| fits(one, sequence))) {
            return found.len();
        }
        let longer = |sequence: &Vec<u32>| {
            (1..=labels).map(|label| [sequence.as_slice(), &[label]].concat()).collect::<Vec<_>>()
        };
        level = level.iter().flat_map(longer).collect();
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, ..ProptestConfig::default() })]

    /// Chains of three labels, so that the smallest supergraph can be found by trying all. The search is a heuristic: it
    /// may miss the smallest, by a slot.
    #[test]
    fn small_supergraphs_are_the_smallest_to_a_slot(words in prop::collection::vec(prop::collection::vec(1u32..4, 1..4), 1..5)) {
        let (found, least) = found_and_least(words);
        prop_assert!(least <= found && found <= least + 1, "{} slots where {} would do", found, least);
    }
}

/// The slots found for chains of labels, and how few would do.
fn found_and_least(words: Vec<Vec<u32>>) -> (usize, usize) {
    let partitions: Vec<Partition> = words
        .into_iter()
        .map(|mut labels| {
            labels.push(0);
            let edges = (1..labels.len() as u32).map(|to| (to - 1, to)).collect();
            Partition { labels, edges }
        })
        .collect();
    let (found, _) = supergraph(&partitions, 0, Method::default()).unwrap();
    (found.labels.len(), shortest(&partitions, 3) + 1)
}

#[test]
fn most_small_supergraphs_are_the_smallest() {
    // Two chains of two labels beside one of three, all of them.
    let pairs: Vec<Vec<u32>> = (1..4).flat_map(|a| (1..4).map(move |b| vec![a, b])).collect();
    let triples: Vec<Vec<u32>> = (0..27).map(|k| vec![1 + k % 3, 1 + k / 3 % 3, 1 + k / 9]).collect();
    let (mut all, mut least) = (0, 0);
    for a in &pairs {
        for b in &pairs {
            for c in &triples {
                let (found, smallest) = found_and_least(vec![a.clone(), b.clone(), c.clone()]);
                all += 1;
                least += usize::from(found == smallest);
            }
        }
    }
    assert!(least * 100 >= all * 99, "{least} of {all}");
}

/// A world at 100 Hz that a supervisor at 50 Hz sees with jitter: one to three steps between two of the supervisor.
fn jittered_world() -> Run {
    let jitter = [0, 7, -6, 3, 8, -8, 2, -3, 6, -7, 5];
    let world: Vec<i64> = (0..100).map(|step| step * 10).collect();
    let agent: Vec<i64> = (0..49).map(|step| 12 + 20 * step + jitter[step as usize % jitter.len()]).collect();
    let seen = |starts: &[i64], delay: i64, by: &[i64]| -> Vec<i64> {
        by.iter().map(|&start| starts.partition_point(|&sent| sent + delay <= start) as i64 - 1).collect()
    };
    let commands = seen(&agent, 25, &world);
    let images = seen(&world, 1, &agent);
    Run {
        nodes: vec![
            Steps { start: agent, stateful: true, keep: false, inputs: vec![(1, 1, images)] },
            Steps { start: world, stateful: true, keep: false, inputs: vec![(0, 1, commands)] },
        ],
    }
}

#[test]
fn a_world_at_twice_the_rate_has_two_slots_in_spite_of_jitter() {
    let run = jittered_world();
    let slots = |cut, start| {
        let found = partition(&run.dag(), 0, cut, start).unwrap();
        supergraph(&found.partitions, 0, Method::default()).unwrap().0.labels.len()
    };
    assert_eq!(slots(Cut::Ancestors, StartUp::First), 4);
    assert_eq!(slots(Cut::default(), StartUp::Passes), 3);
}

#[test]
fn a_slow_start_costs_no_slots() {
    // The supervisor's first step comes when the world has taken ten.
    let world: Vec<i64> = (0..100).map(|step| step * 10).collect();
    let agent: Vec<i64> = (0..44).map(|step| 95 + 20 * step).collect();
    let images = agent.iter().map(|&start| world.partition_point(|&sent| sent < start) as i64 - 1).collect();
    let run = Run {
        nodes: vec![
            Steps { start: agent, stateful: true, keep: false, inputs: vec![(1, 1, images)] },
            Steps { start: world, stateful: true, keep: false, inputs: vec![] },
        ],
    };
    let slots = |start| {
        let found = partition(&run.dag(), 0, Cut::default(), start).unwrap();
        let slots = supergraph(&found.partitions, 0, Method::default()).unwrap().0.labels.len();
        (slots, found.warm_up)
    };
    assert_eq!(slots(StartUp::First), (11, 0));
    assert_eq!(slots(StartUp::Passes), (3, 4));
}

#[test]
fn what_cannot_be_cut_or_embedded_is_an_error_with_its_place() {
    let edge = Partition { labels: vec![1, 0], edges: vec![(1, 0)] };
    let expected = SupergraphError::Edge { partition: 0, from: 1, to: 0, vertices: 2 };
    assert_eq!(supergraph(&[edge], 0, Method::default()), Err(expected));
    let twice = Partition { labels: vec![0, 1, 0], edges: vec![] };
    let expected = SupergraphError::Supervisor { partition: 1 };
    assert_eq!(supergraph(&[Partition::default(), twice], 0, Method::default()), Err(expected));

    let one = |seq: i64| Run {
        nodes: vec![
            Steps { start: vec![0, 1], stateful: true, keep: false, inputs: vec![(1, 1, vec![-1, seq])] },
            Steps { start: vec![0, 1], stateful: false, keep: false, inputs: vec![(0, 1, vec![-1, 1])] },
        ],
    };
    let cut = |seq| partition(&one(seq).dag(), 0, Cut::default(), StartUp::Passes);
    assert!(cut(0).is_ok());
    let expected = SupergraphError::NoMessage { node: 0, step: 1, from: 1, seq: 7, steps: 2 };
    assert_eq!(cut(7), Err(expected));
    assert_eq!(cut(1), Err(SupergraphError::Cycle { node: 0, step: 1 }));
    let nodes = Run { nodes: one(0).nodes[..1].to_vec() };
    let expected = SupergraphError::Nodes { episode: 1, found: 1, expected: 2 };
    assert_eq!(plan(&[one(0).dag(), nodes.dag()], 0, &PlanOptions::default()), Err(expected));
    let expected = SupergraphError::NoSupervisor { supervisor: 5, nodes: 2 };
    assert_eq!(partition(&one(0).dag(), 5, Cut::default(), StartUp::Passes), Err(expected));
}
