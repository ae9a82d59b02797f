//! Node steps per second of the simulated clock: every event, every message, recorded in memory or to a file.
//!
//! Each line gives the rate and the time beside that of the nodes' steps alone: the same nodes, stepped on what they saw,
//! without a schedule, messages or a recording.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench prints, and stops where it cannot go on"
)]

use std::time::Instant;

use parallax_nodes::{graph, registry};
use parallax_runtime::graph::Graph;
use parallax_runtime::node::{InputWindow, Step};
use parallax_runtime::recording::{Description, MemorySink, NoSink, Recording, RecordingWriter};
use parallax_sim::{Executor, generate};

const DURATION: i64 = 20_000_000_000;

fn main() {
    println!("{:<20} {:<22} {:>12} {:>10}", "graph", "recorded", "steps/s", "x nodes");
    for name in ["pendulum", "pendulum-simulated", "quadrotor-simulated"] {
        let Some(spec) = graph(name) else { continue };
        measure(name, &spec.validate(&registry()).unwrap());
    }
}

fn measure(name: &str, graph: &Graph) {
    let executor = Executor::new(graph.clone(), 1);
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.mcap");
    let recording = executor.record(DURATION).unwrap();
    let steps = recording.nodes.iter().map(|track| track.steps.len()).sum::<usize>() as f64;
    let seen = windows(graph, &recording);

    // The best of three: what else runs on the machine only slows.
    let best = |run: &dyn Fn()| {
        let times = (0..3).map(|_| {
            let began = Instant::now();
            run();
            began.elapsed().as_secs_f64()
        });
        times.fold(f64::INFINITY, f64::min)
    };
    let alone = best(&|| alone(graph, &recording, &seen));
    let report = |what: &str, time: f64| {
        println!("{name:<20} {what:<22} {:>12.0} {:>10.2}", steps / time, time / alone);
    };
    report("nodes alone", alone);
    report("timing only", best(&|| drop(generate(graph, 1, DURATION).unwrap())));
    report("nothing", best(&|| drop(executor.run(DURATION, &mut NoSink).unwrap())));
    report(
        "in memory",
        best(&|| {
            let mut sink = MemorySink::new(graph, executor.clock());
            executor.run(DURATION, &mut sink).unwrap();
            std::hint::black_box(sink.finish(DURATION));
        }),
    );
    report(
        "to an MCAP file",
        best(&|| {
            let description = Description::new(graph, executor.clock());
            let mut writer = RecordingWriter::create(&path, &description).unwrap();
            executor.run(DURATION, &mut writer).unwrap();
            writer.finish(DURATION).unwrap();
        }),
    );
}

/// Everything that every step of a run saw, node by node.
fn windows(graph: &Graph, recording: &Recording) -> Vec<Vec<Vec<InputWindow>>> {
    let nodes = graph.nodes().iter().zip(&recording.nodes).map(|(plan, track)| {
        let steps = track.steps.iter().map(|step| {
            let inputs = plan.inputs.iter().zip(&step.inputs).map(|(&connection, input)| {
                let edge = &graph.connections()[connection];
                let sender = &recording.nodes[edge.from];
                let mut window = InputWindow::new(edge.port.clone(), edge.leaves, edge.window);
                window.clear(input.superseded);
                for &stamp in &input.consumed {
                    let message = stamp.seq.map(|seq| &sender.message(seq).unwrap().payload);
                    window.push(stamp, message.unwrap_or(&sender.initial));
                }
                window
            });
            inputs.collect()
        });
        steps.collect()
    });
    nodes.collect()
}

/// Steps every node on what it saw.
fn alone(graph: &Graph, recording: &Recording, windows: &[Vec<Vec<InputWindow>>]) {
    for (index, (track, windows)) in recording.nodes.iter().zip(windows).enumerate() {
        let mut node = graph.build(index, 1).unwrap();
        let mut output = track.initial.clone();
        for (step, windows) in track.steps.iter().zip(windows) {
            node.step_into(&Step::new(step.seq, step.due, step.start, windows), &mut output).unwrap();
        }
        std::hint::black_box(&output);
    }
}
