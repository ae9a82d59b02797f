//! A compiled graph runs every step after what it consumes, and finds every message where its tables say.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::ops::Range;

use crate::support::{DURATION, graph};
use parallax_runtime::graph::Graph;
use parallax_sim::compiled::{
    CompileError, CompileOptions, CompiledGraph, InputRows, Interpolation, OutputDelays, TrainableConnection,
    compile,
};
use parallax_sim::supergraph::{Cut, Method, StartUp, SupergraphError};
use parallax_sim::{Episode, generate_many};
use proptest::prelude::*;

/// What lies in a place of a history: the number of the step that wrote it, −1 for the initial message.
type Histories = Vec<Vec<i64>>;

/// Goes through an episode's slots as an executor does, and checks every message that is read. Gives, per node, the steps
/// that ran.
fn run(compiled: &CompiledGraph, graph: &Graph, episode: usize, source: &Episode) -> Vec<Vec<usize>> {
    let mut histories: Histories = compiled.nodes.iter().map(|node| vec![-1; node.history]).collect();
    let mut ran = vec![Vec::new(); compiled.nodes.len()];
    for pass in 0..compiled.passes() {
        let row = compiled.row(episode, pass);
        for (place, slot) in compiled.slots.iter().enumerate() {
            let rows = &slot.rows;
            let last = place + 1 == compiled.slots.len();
            let inside = pass < compiled.warm_up + compiled.lengths[episode] as usize;
            if last {
                assert_eq!(slot.node, graph.supervisor());
                let runs = inside && pass >= compiled.warm_up;
                assert_eq!(rows.run[row] == 1, runs, "the supervisor runs in every pass after the warm-up");
                assert!(!runs || rows.seq[row] as usize == pass - compiled.warm_up);
            }
            for input in &rows.inputs {
                let places = &input.read[row * input.candidates..(row + 1) * input.candidates];
                for (&place, constant) in places.iter().zip(&input.constant_read) {
                    assert!(
                        (place as usize) < compiled.nodes[input.from].history,
                        "valid where nothing runs too"
                    );
                    assert!(constant.is_none_or(|constant| constant == place));
                }
            }
            assert!((rows.write[row] as usize) < compiled.nodes[slot.node].history);
            assert!(rows.constant_write.is_none_or(|constant| constant == rows.write[row]));
            if rows.run[row] == 0 {
                assert!(!(slot.always && inside), "no mask is needed");
                continue;
            }
            assert!(inside);
            let seq = rows.seq[row] as usize;
            assert_eq!(rows.due[row], source.nodes[slot.node].due[seq]);
            assert_eq!(rows.start[row], source.nodes[slot.node].start[seq]);
            for input in &rows.inputs {
                let candidates = row * input.candidates..(row + 1) * input.candidates;
                if input.trainable.is_none() {
                    assert_eq!(input.candidates, input.window);
                    let consumption = &source.connections[input.connection];
                    let told: Vec<i64> = candidates.clone().map(|at| i64::from(input.seq[at])).collect();
                    assert_eq!(told, consumption.seqs(seq));
                    assert_eq!(&input.received[candidates.clone()], consumption.arrivals(seq));
                } else {
                    windows_of_all_delays(
                        input,
                        candidates.clone(),
                        rows.start[row],
                        &source.nodes[input.from].end,
                    );
                }
                for at in candidates {
                    let (message, place) = (i64::from(input.seq[at]), input.read[at] as usize);
                    assert_eq!(histories[input.from][place], message, "found at its place");
                    let sent = usize::try_from(message).map_or(0, |seq| source.nodes[input.from].end[seq]);
                    assert_eq!(input.sent[at], sent);
                }
            }
            histories[slot.node][rows.write[row] as usize] = seq as i64;
            ran[slot.node].push(seq);
        }
    }
    for (node, steps) in compiled.nodes.iter().zip(&ran) {
        assert!(steps.windows(2).all(|pair| pair[0] < pair[1]), "{}: steps in their order", node.name);
        let whole = steps.iter().enumerate().all(|(place, &seq)| place == seq);
        assert!(whole || !node.stateful, "{}: a node that remembers leaves out no step", node.name);
    }
    ran
}

/// Whatever the delay between its bounds is, the window that a step sees is among its candidates.
fn windows_of_all_delays(input: &InputRows, candidates: Range<usize>, start: i64, ends: &[i64]) {
    let delay = input.trainable.unwrap();
    let there = |sent: i64, d: i64| if delay.skip { sent + d < start } else { sent + d <= start };
    for share in 0..=8 {
        let d = delay.min + (delay.max - delay.min) * share / 8;
        let newest = ends.iter().filter(|&&end| there(end, d)).count() as i64;
        let expected: Vec<i64> = (newest - input.window as i64..newest).map(|seq| seq.max(-1)).collect();
        let arrived = candidates.clone().filter(|&at| input.seq[at] < 0 || there(input.sent[at], d));
        let arrived: Vec<i64> = arrived.map(|at| i64::from(input.seq[at])).collect();
        assert_eq!(arrived[arrived.len() - input.window..], expected, "under a delay of {d} ns");
        // The message on the other side of `start − d`, where it is sent by then.
        let after = newest as usize;
        if delay.interpolation == Interpolation::Linear && after < ends.len() && there(ends[after], 0) {
            assert!(candidates.clone().any(|at| i64::from(input.seq[at]) == newest));
        }
    }
}

fn options() -> impl Strategy<Value = CompileOptions> {
    let cut = prop_oneof![Just(Cut::Ancestors), Just(Cut::default())];
    let start = prop_oneof![Just(StartUp::First), Just(StartUp::Passes)];
    let method = prop_oneof![Just(Method::Topological), Just(Method::Generational), Just(Method::default())];
    let nodes = || prop::collection::vec(0usize..5, 0..3);
    let stateful = prop::collection::vec(any::<bool>(), 5);
    (cut, start, method, nodes(), nodes(), stateful).prop_map(
        |(cut, start, method, keep, pinned, stateful)| CompileOptions {
            cut,
            start,
            method,
            keep,
            pinned,
            stateful: Some(stateful),
            trainable: Vec::new(),
            output_delays: OutputDelays::AsScheduled,
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn every_message_is_where_the_tables_say(
        graph in graph(),
        seed in any::<u64>(),
        options in options(),
        bounds in (0i64..20_000_000, 0i64..30_000_000),
        train in any::<bool>(),
        linear in any::<bool>(),
    ) {
        let mut options = options;
        let count = graph.nodes().len();
        for list in [&mut options.keep, &mut options.pinned] {
            list.retain(|&node| node < count);
        }
        options.stateful.iter_mut().for_each(|stateful| stateful.truncate(count));
        if train {
            let (min, max) = (bounds.0, bounds.0 + bounds.1);
            let interpolation = if linear { Interpolation::Linear } else { Interpolation::Hold };
            let open = (0..graph.connections().len()).filter(|&index| !graph.connections()[index].blocking);
            options.trainable =
                open.map(|connection| TrainableConnection { connection, min, max, interpolation }).collect();
        }
        let episodes = generate_many(&graph, seed, DURATION, 3).unwrap();
        if episodes.iter().any(|episode| episode.nodes[graph.supervisor()].is_empty()) {
            return Ok(());
        }
        let compiled = match compile(&graph, &episodes, &options) {
            Ok(compiled) => compiled,
            // Steps that take no time may see each other under a shorter delay than the drawn one.
            Err(CompileError::Supergraph(SupergraphError::Cycle { .. })) if train => return Ok(()),
            Err(error) => panic!("{error}"),
        };
        let mut vertices = 0;
        for (index, episode) in episodes.iter().enumerate() {
            let ran = run(&compiled, &graph, index, episode);
            vertices += ran.iter().map(Vec::len).sum::<usize>();
            prop_assert_eq!(ran[graph.supervisor()].len(), episode.nodes[graph.supervisor()].len());
        }
        prop_assert_eq!(compiled.executed, vertices);
        prop_assert!(compiled.efficiency() > 0.0 && compiled.efficiency() <= 1.0);
    }
}
