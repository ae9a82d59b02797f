//! What holds for every valid graph, tried on random ones.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::BTreeMap;

use crate::support::{DURATION, graph, registry};
use parallax_runtime::graph::Graph;
use parallax_runtime::recording::{MemorySink, Recording};
use parallax_runtime::schedule::verify;
use parallax_sim::{Episode, Executor, Outcome, ReplayOptions, generate, generate_many, replay};
use proptest::prelude::*;

fn run(graph: &Graph, seed: u64) -> (Recording, Outcome) {
    let executor = Executor::new(graph.clone(), seed);
    let mut sink = MemorySink::new(graph, executor.clock());
    let outcome = executor.run(DURATION, &mut sink).unwrap();
    (sink.finish(DURATION), outcome)
}

fn config() -> ProptestConfig {
    ProptestConfig { cases: 200, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn a_generated_schedule_is_that_of_the_run(graph in graph(), seed in any::<u64>()) {
        let recording = Executor::new(graph.clone(), seed).record(DURATION).unwrap();
        let recorded = Episode::from_recording(&graph, &recording).unwrap();
        prop_assert_eq!(generate(&graph, seed, DURATION).unwrap(), recorded);
        let many = generate_many(&graph, seed, DURATION, 3).unwrap();
        prop_assert_eq!(&generate_many(&graph, seed, DURATION, 2).unwrap()[..], &many[..2]);
    }

    #[test]
    fn every_run_follows_the_rules(graph in graph(), seed in any::<u64>()) {
        let (recording, outcome) = run(&graph, seed);
        for (index, plan) in graph.nodes().iter().enumerate() {
            let track = recording.node(&plan.name).unwrap();
            // No valid graph blocks itself: every node gets going, and keeps going.
            prop_assert!(track.steps.len() > 3, "node {} made {} steps", plan.name, track.steps.len());
            let check = verify(&recording, &graph, index, &track.steps);
            prop_assert_eq!(check.deviation, None);
            prop_assert_eq!(check.largest_lateness, 0);

            for (input, &connection) in plan.inputs.iter().enumerate() {
                let plan = &graph.connections()[connection];
                let sender = &graph.nodes()[plan.from].grid;
                let mut arrivals = BTreeMap::new();
                let mut newest = None;
                for step in &track.steps {
                    let consumed = &step.inputs[input].consumed;
                    prop_assert_eq!(consumed.len(), plan.window);
                    let initial = consumed.iter().take_while(|c| c.seq.is_none()).count();
                    let seqs: Vec<u64> = consumed[initial..].iter().map(|c| c.seq.unwrap()).collect();
                    prop_assert!(seqs.windows(2).all(|pair| pair[1] == pair[0] + 1), "contiguous: {seqs:?}");
                    prop_assert!(seqs.last().copied() >= newest, "windows never go back");
                    newest = seqs.last().copied();
                    for c in &consumed[initial..] {
                        // The future is never seen.
                        prop_assert!(c.sent <= c.received && c.received <= step.start);
                        prop_assert!(!plan.skip || plan.blocking || c.received < step.start);
                        arrivals.insert(c.seq, c.received);
                    }
                    if plan.blocking {
                        let until = if plan.skip { step.due - 1 } else { step.due };
                        prop_assert_eq!(newest.map_or(0, |seq| seq + 1), sender.count_until(until));
                    }
                }
                let times: Vec<i64> = arrivals.values().copied().collect();
                prop_assert!(times.windows(2).all(|pair| pair[0] <= pair[1]), "messages overtake");
            }
        }
        for (plan, account) in graph.connections().iter().zip(&outcome.connections) {
            let a = account.account;
            let sum = a.consumed + a.superseded + account.in_flight + a.lost_transport + a.lost_overflow;
            prop_assert_eq!(sum, account.sent, "{}: {:?}", &account.connection, account);
            let sent = recording.nodes[plan.from].messages.len() as u64;
            prop_assert_eq!(account.sent, sent);
        }
    }

    #[test]
    fn a_seed_repeats_bit_for_bit_and_replays_exactly(graph in graph(), seed in any::<u64>()) {
        let (recording, outcome) = run(&graph, seed);
        let (again, again_outcome) = run(&graph, seed);
        prop_assert_eq!(&recording, &again);
        prop_assert_eq!(outcome, again_outcome);
        let report = replay(&recording, &registry(), &ReplayOptions::default()).unwrap();
        prop_assert!(report.is_exact(), "{:?}", report);
        let steps: usize = recording.nodes.iter().map(|track| track.steps.len()).sum();
        prop_assert_eq!(report.steps(), steps as u64);
    }

    #[test]
    fn advance_never_starts_later(graph in graph(), seed in any::<u64>()) {
        let mut spec = graph.spec().clone();
        for node in &mut spec.nodes {
            node.advance = false;
        }
        let (with, _) = run(&graph, seed);
        let (without, _) = run(&spec.validate(&registry()).unwrap(), seed);
        for (with, without) in with.nodes.iter().zip(&without.nodes) {
            prop_assert!(with.steps.len() >= without.steps.len());
            for (with, without) in with.steps.iter().zip(&without.steps) {
                prop_assert!(with.start <= without.start);
            }
        }
    }
}
