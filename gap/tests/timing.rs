//! What the stamps of a recording prove, on the graphs that come with Parallax.

use parallax_gap::timing::{Timing, signals, timing};
use parallax_nodes::registry;
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::recording::log::{Log, Role, Signal};
use parallax_runtime::recording::{Loss, LossReason, Recording};
use parallax_runtime::time::from_seconds;
use parallax_sim::Executor;

fn recorded(spec: &GraphSpec, seed: u64) -> Recording {
    let graph = spec.validate(&registry()).expect("the graph is valid");
    Executor::new(graph, seed).record(from_seconds(20.0)).expect("it runs")
}

/// A recording of a graph that is not the one it declares.
fn departed(name: &str, change: impl Fn(&mut GraphSpec)) -> Recording {
    let declared = parallax_nodes::graph(name).expect("it is there");
    let mut truth = declared.clone();
    change(&mut truth);
    let mut recording = recorded(&truth, 1);
    recording.graph = declared;
    recording
}

fn labels(timing: &Timing) -> Vec<String> {
    timing.departures().iter().map(|e| format!("{}@{}", e.name, e.place)).collect()
}

#[test]
fn graphs_that_run_as_declared_depart_from_nothing() {
    for name in parallax_nodes::GRAPHS {
        for seed in [1, 2] {
            let spec = parallax_nodes::graph(name).expect("it is there");
            let found = timing(&recorded(&spec, seed));
            assert!(labels(&found).is_empty(), "{name}: {:#?}", found.departures());
            assert_eq!(found.connections.len(), spec.connections.len());
            assert_eq!(found.nodes.len(), spec.nodes.len());
            assert!(found.nodes.iter().all(|n| n.missing == 0 && !n.rate.is_some_and(|r| r.significant)));
        }
    }
}

fn connection<'a>(spec: &'a mut GraphSpec, from: &str, to: &str) -> &'a mut Delay {
    let found = spec.connections.iter_mut().find(|c| c.from == from && c.to == to);
    &mut found.expect("it is there").delay
}

#[test]
fn a_slower_connection_is_named_with_its_delay() {
    let recording = departed("pendulum-simulated", |spec| {
        *connection(spec, "agent", "motor") = Delay::Normal { mean: 4e-3, std: 0.3e-3 };
    });
    let found = timing(&recording);
    assert_eq!(labels(&found), ["delay@connection:agent->motor"]);
    let delay = &found.departures()[0].parameters["delay"];
    assert!((delay.value - 3e-3).abs() < 1e-4, "{delay:?}");
}

#[test]
fn a_jumpy_connection_and_a_slow_node_are_named() {
    let recording = departed("pendulum-simulated", |spec| {
        *connection(spec, "agent", "motor") = Delay::Normal { mean: 1e-3, std: 0.3e-3 };
        *connection(spec, "encoder", "agent") = Delay::Uniform { low: 0.0, high: 2e-3 };
        let motor = spec.nodes.iter_mut().find(|n| n.name == "motor").expect("it is there");
        motor.computation = Delay::Normal { mean: 3e-3, std: 0.2e-3 };
    });
    let found = timing(&recording);
    assert_eq!(labels(&found), ["jitter@connection:encoder->agent.estimator", "delay@node:motor"]);
    let spread = &found.departures()[0].parameters["spread"];
    assert!((spread.value - 2e-3 / 12.0_f64.sqrt()).abs() < 5e-5, "{spread:?}");
}

#[test]
fn losses_and_clocks_are_named() {
    let mut recording = departed("pendulum-simulated", |_| ());
    for seq in 0..60 {
        recording.losses.push(Loss {
            from: "agent".into(),
            to: "motor".into(),
            port: "agent".into(),
            seq: 10 * seq,
            time: 0,
            reason: LossReason::Transport,
        });
    }
    let agent = recording.nodes.iter_mut().find(|n| n.name == "agent").expect("it is there");
    for message in agent.steps.iter_mut().flat_map(|s| &mut s.inputs).flat_map(|i| &mut i.consumed) {
        message.received += (message.received as f64 * 2e-4) as i64;
    }
    let found = timing(&recording);
    let labels = labels(&found);
    assert_eq!(labels, ["clock_skew@connection:encoder->agent.estimator", "drops@connection:agent->motor"]);
    let skew = found.connections.iter().find_map(|c| c.skew.filter(|s| s.significant)).expect("one has");
    assert!((skew.skew - 2e-4).abs() < 2e-5_f64.max(3.3 * skew.std), "{skew:?}");
    let lost = found.connections.iter().find(|c| c.loss.significant).expect("one has");
    assert!((lost.loss.value - 0.06).abs() < 0.01, "{lost:?}");
}

fn signal(name: &str, times: Vec<i64>) -> Signal {
    let values = times.iter().map(|t| *t as f64).collect();
    Signal::new(name, Role::Measurement, "", times, values)
}

#[test]
fn stamps_of_a_log_tell_rates_gaps_and_clocks() {
    let even: Vec<i64> = (0..2000).map(|k| k * 10_000_000).collect();
    let holes: Vec<i64> = even.iter().copied().filter(|t| t / 10_000_000 % 100 != 50).collect();
    let fast: Vec<i64> = (0..4000).map(|k| (k as f64 * 5_001_000.0) as i64).collect();
    let signals = signals(&Log {
        signals: vec![signal("a", even), signal("b", holes), signal("c", fast)],
        ..Log::default()
    });
    assert!((signals[0].rate - 100.0).abs() < 1e-6 && signals[0].gaps == 0 && signals[0].clock.is_none());
    assert_eq!((signals[1].gaps, signals[1].missing), (20, 20));
    assert!(signals[1].clock.is_none());
    let clock = signals[2].clock.as_ref().expect("it runs apart");
    assert_eq!(clock.against, "a");
    assert!((clock.skew - 2e-4).abs() < 1e-5, "{clock:?}");
}
