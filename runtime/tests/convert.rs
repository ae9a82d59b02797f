//! Logs as recordings, and recordings as logs.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::Path;

use parallax_runtime::graph::{ConnectionSpec, GraphSpec, NodeSpec};
use parallax_runtime::import;
use parallax_runtime::node::Layout;
use parallax_runtime::recording::log::{Log, Role, Signal, Source};
use parallax_runtime::recording::{Clock, MessageRecord, NodeTrack, Recording, write};

fn track(name: &str, stand_in: bool, leaves: &[&str], messages: &[(i64, &[f64])]) -> NodeTrack {
    NodeTrack {
        name: name.into(),
        layout: Layout { name: "test/M".into(), leaves: leaves.iter().map(|leaf| (*leaf).into()).collect() },
        initial: vec![0.0; leaves.len()],
        stand_in,
        messages: (0..)
            .zip(messages)
            .map(|(seq, (sent, payload))| MessageRecord {
                seq,
                sent: *sent,
                payload: payload.to_vec(),
                data: Default::default(),
            })
            .collect(),
        steps: Vec::new(),
    }
}

#[test]
fn a_graphs_leaves_become_signals() {
    let names = ["world", "camera", "agent", "motor"];
    let recording = Recording {
        graph: GraphSpec {
            name: "pendulum".into(),
            supervisor: "agent".into(),
            nodes: names.iter().map(|name| NodeSpec::new(*name, "k", 10.0)).collect(),
            connections: vec![
                ConnectionSpec::new("world", "camera"),
                ConnectionSpec::new("camera", "agent"),
                ConnectionSpec::new("agent", "motor"),
                ConnectionSpec::new("motor", "world"),
            ],
            plant: None,
        },
        clock: Clock::Simulated { seed: 1 },
        duration: 100,
        nodes: vec![
            track("world", true, &["angle"], &[(5, &[0.1])]),
            track(
                "camera",
                false,
                &["angle", "stamp"],
                &[
                    (200, &[1.0, 2e-8]),
                    (300, &[2.0, 1e-8]),
                    (400, &[3.0, 2e-8]),
                    (500, &[f64::NAN, 3e-8]),
                    (600, &[9.0, f64::NAN]),
                ],
            ),
            track("agent", false, &["torque.x", "torque.y"], &[(15, &[4.0, 5.0])]),
            track("motor", false, &["torque"], &[(16, &[4.0])]),
        ],
        losses: vec![],
        faults: vec![],
        changes: vec![],
        hosts: Default::default(),
        clocks: Vec::new(),
        truncated: None,
    };
    let log = recording.log();
    let names: Vec<_> = log.signals.iter().map(|signal| (signal.name.as_str(), signal.role)).collect();
    assert_eq!(
        names,
        [
            ("camera.angle", Role::Measurement),
            ("agent.torque.x", Role::Reference),
            ("agent.torque.y", Role::Reference),
            ("motor.torque", Role::Command),
        ]
    );
    // Its own stamps count, in order; of two messages with one stamp the later counts.
    let angle = log.signal("camera.angle").unwrap();
    assert_eq!((&angle.times[..], &angle.values[..]), (&[10, 20][..], &[2.0, 3.0][..]));
    assert_eq!(log.signal("motor.torque").unwrap().times, [16]);
    assert_eq!(
        log.notes,
        [
            "camera.angle: 2 samples without a finite value or stamp left out",
            "camera.angle: 1 samples left out that others with the same stamp follow",
        ]
    );
}

#[test]
fn an_imported_log_survives_a_file() {
    let log = Log {
        title: "a cart".into(),
        license: "CC0".into(),
        constants: vec![("kp".into(), 100.0), ("mass".into(), 0.1 + 0.2)],
        signals: vec![
            Signal {
                name: "motor.torque".into(),
                role: Role::Command,
                unit: "N m".into(),
                times: vec![-5, 7, 1_000_000_000],
                values: vec![1.0, -2.5e-300, 0.1 + 0.2],
                source: Source { file: "log.csv".into(), column: "u".into() },
            },
            Signal::new("log", Role::Context, "", vec![3], vec![12.0]),
        ],
        notes: vec![],
    };
    assert_eq!(log.recording().log(), log);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    write(&path, &log.recording()).unwrap();
    let read = Recording::read(&path).unwrap();
    assert!(read.is_imported());
    assert_eq!(read.log(), log);
}

#[test]
fn a_real_log_survives_a_file() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/servo-xl330/sin_sin_kp100_00");
    if !data.exists() {
        println!("not run: {} does not exist", data.display());
        return;
    }
    let log = import::folder(&data).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    write(&path, &log.recording()).unwrap();
    assert_eq!(Recording::read(&path).unwrap().log(), log);
}
