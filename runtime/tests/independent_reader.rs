//! The public Python packages for MCAP and ROS 2 messages read our recordings, message by message, bit by bit.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::{Path, PathBuf};
use std::process::Command;

use parallax_model::tree::Tree as _;
use parallax_runtime::data::Data;
use parallax_runtime::graph::{GraphSpec, NodeSpec};
use parallax_runtime::image::{CompressedImage, Encoding, Format, Image};
use parallax_runtime::node::{Consumed, Layout};
use parallax_runtime::recording::ros2msg::field_names;
use parallax_runtime::recording::{
    Change, ChangeKind, Clock, Fault, FaultKind, InputRecord, Loss, LossReason, MessageRecord, NodeTrack,
    Recording, StepRecord, write,
};
use serde_json::{Value, json};

/// What the script prints about a recording.
fn read_with_python(recording: &Path) -> Value {
    read_with("read_recording.py", recording)
}

fn read_with(script: &str, recording: &Path) -> Value {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let python: PathBuf = root.join(".venv/bin/python");
    assert!(
        python.exists(),
        "{} does not exist. `make test` creates it, with the packages of tests/requirements.txt",
        python.display()
    );
    let output =
        Command::new(python).arg(root.join("tests/python").join(script)).arg(recording).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}\nIf a package is missing: `make test` installs it");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn bits(value: f64) -> Value {
    json!({ "f64": value.to_bits() })
}

/// Messages of every shape that a recording can hold.
fn recording() -> Recording {
    let layouts = [
        ("pendulum/State", vec!["angle", "speed", "Limits.low[0]", "Limits.low[1]", "2nd"]),
        // Another message of the same name, and one without leaves.
        ("pendulum/state", vec!["angle"]),
        ("Step", vec![]),
    ];
    let track = |(index, (name, leaves)): (usize, &(&str, Vec<&str>))| NodeTrack {
        name: format!("node_{index}"),
        layout: Layout { name: (*name).into(), leaves: leaves.iter().map(|leaf| (*leaf).into()).collect() },
        initial: vec![0.0; leaves.len()],
        stand_in: false,
        messages: (0..300u64)
            .map(|seq| MessageRecord {
                seq,
                sent: seq as i64 * 10_000_000 + index as i64,
                payload: (0..leaves.len()).map(|leaf| special(seq as usize + leaf)).collect(),
                data: Data::from(&[seq as u8; 7][..if index == 0 { seq as usize % 8 } else { 0 }]),
            })
            .collect(),
        steps: (0..300u64)
            .map(|seq| StepRecord {
                seq,
                due: seq as i64 * 10_000_000 - 5,
                start: seq as i64 * 10_000_000,
                end: seq as i64 * 10_000_000 + index as i64,
                inputs: (0..index)
                    .map(|input| InputRecord {
                        port: format!("port_{input}"),
                        consumed: (0..seq % 3)
                            .map(|k| match k {
                                0 => Consumed::INITIAL,
                                _ => Consumed { seq: Some(u64::MAX - seq), sent: -7, received: i64::MAX },
                            })
                            .collect(),
                        superseded: seq,
                    })
                    .collect(),
            })
            .collect(),
    };
    let nodes: Vec<NodeTrack> = layouts.iter().enumerate().map(track).collect();
    let (from, to) = ("node_0".to_owned(), "node_1".to_owned());
    Recording {
        graph: GraphSpec {
            name: "shapes".into(),
            supervisor: "node_0".into(),
            nodes: nodes.iter().map(|track| NodeSpec::new(&track.name, "any", 100.0)).collect(),
            connections: vec![],
            plant: None,
        },
        clock: Clock::Simulated { seed: u64::MAX },
        duration: 3_000_000_000,
        nodes,
        losses: vec![Loss { from, to, port: "a".into(), seq: 3, time: 40, reason: LossReason::Overflow }],
        faults: vec![Fault {
            node: "node_2".into(),
            time: 50,
            kind: FaultKind::Died { message: "signal 9, \"SIGKILL\" – überall".into() },
        }],
        changes: vec![Change {
            node: "node_1".into(),
            step: 7,
            time: 60,
            by: "somebody".into(),
            kind: ChangeKind::Set {
                parameter: "gain".into(),
                unit: "V/rad".into(),
                old: 0.1 + 0.2,
                new: -5e-324,
            },
        }],
        hosts: Default::default(),
        clocks: Vec::new(),
        truncated: None,
    }
}

fn special(index: usize) -> f64 {
    [0.0, -0.0, 1.0 / 3.0, f64::MAX, 5e-324, f64::NAN, f64::NEG_INFINITY, -1e-300][index % 8]
}

#[test]
fn python_reads_every_message() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("shapes.mcap");
    let recording = recording();
    write(&path, &recording).unwrap();
    let read = read_with_python(&path);

    let mut counted = 0;
    let mut schemas = std::collections::BTreeSet::new();
    for track in &recording.nodes {
        let topic = &read["topics"][format!("/{}", track.name)];
        assert!(
            schemas.insert(topic["schema"].as_str().unwrap().to_owned()),
            "every layout has a type of its own"
        );
        let fields = field_names(&track.layout.leaves);
        let expected: Vec<Value> = track
            .messages
            .iter()
            .map(|message| {
                let mut value: serde_json::Map<String, Value> =
                    fields.iter().cloned().zip(message.payload.iter().map(|value| bits(*value))).collect();
                if track.name == "node_0" {
                    value.insert("data".into(), json!(&*message.data));
                } else if fields.is_empty() {
                    value.insert("structure_needs_at_least_one_member".into(), json!(0));
                }
                json!([message.sent, message.sent, message.seq, value])
            })
            .collect();
        assert_eq!(topic["count"], track.messages.len());
        assert_eq!(topic["messages"], Value::Array(expected), "{}", track.name);

        let topic = &read["topics"][format!("/{}/steps", track.name)];
        assert_eq!(topic["schema"], "parallax_msgs/msg/Step");
        let expected: Vec<Value> = track.steps.iter().map(step).collect();
        assert_eq!(topic["messages"], Value::Array(expected), "{}", track.name);
        counted += track.messages.len() + track.steps.len();
    }
    for (topic, expected) in [
        ("/parallax/losses", serde_json::to_value(&recording.losses[0]).unwrap()),
        ("/parallax/faults", serde_json::to_value(&recording.faults[0]).unwrap()),
        ("/parallax/changes", serde_json::to_value(&recording.changes[0]).unwrap()),
    ] {
        let text = read["topics"][topic]["messages"][0][3]["json"].as_str().unwrap();
        assert_eq!(serde_json::from_str::<Value>(text).unwrap(), expected);
    }
    assert_eq!(read["counted"], counted + 3);
    assert_eq!(read["attachments"]["graph.json"]["graph"], serde_json::to_value(&recording.graph).unwrap());
}

#[test]
fn rosbags_reads_every_message() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("shapes.mcap");
    let recording = recording();
    write(&path, &recording).unwrap();
    let read = read_with("read_with_rosbags.py", &path);
    for track in &recording.nodes {
        let fields = field_names(&track.layout.leaves);
        let messages = read[format!("/{}", track.name)]["messages"].as_array().unwrap();
        assert_eq!(messages.len(), track.messages.len());
        for (read, written) in messages.iter().zip(&track.messages) {
            assert_eq!(read[0], written.sent);
            for (field, value) in fields.iter().zip(&written.payload) {
                assert_eq!(read[1][field], bits(*value), "{field} of {}", track.name);
            }
            if track.name == "node_0" {
                assert_eq!(read[1]["data"], json!(&*written.data));
            }
        }
        let steps = read[format!("/{}/steps", track.name)]["messages"].as_array().unwrap();
        assert_eq!(steps.len(), track.steps.len());
        assert!(steps.iter().zip(&track.steps).all(|(read, written)| read[1]["due"] == written.due));
    }
}

/// A step as the script prints it.
fn step(step: &StepRecord) -> Value {
    let inputs: Vec<Value> = step
        .inputs
        .iter()
        .map(|input| {
            let consumed: Vec<Value> = input
                .consumed
                .iter()
                .map(|c| {
                    json!({"initial": c.seq.is_none(), "seq": c.seq.unwrap_or(0), "sent": c.sent, "received": c.received})
                })
                .collect();
            json!({"port": input.port, "consumed": consumed, "superseded": input.superseded})
        })
        .collect();
    let value =
        json!({"seq": step.seq, "due": step.due, "start": step.start, "end": step.end, "inputs": inputs});
    json!([step.end, step.end, step.seq, value])
}

#[test]
fn python_sees_images() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("images.mcap");
    let mut recording = recording();
    recording.nodes.truncate(2);
    let images = [Image::new(3, 2, Encoding::Rgb8).to_vec(), CompressedImage::new(Format::Png).to_vec()];
    let layouts = [Layout::of::<Image>(), Layout::of::<CompressedImage>()];
    for ((track, payload), layout) in recording.nodes.iter_mut().zip(&images).zip(layouts) {
        (track.layout, track.initial) = (layout, payload.clone());
        for message in &mut track.messages {
            (message.payload, message.data) = (payload.clone(), Data::from(&[message.seq as u8; 18][..]));
        }
    }
    write(&path, &recording).unwrap();
    assert_eq!(Recording::read(&path).unwrap().nodes, recording.nodes);
    let read = read_with_python(&path);
    let stamp = json!({"sec": 1, "nanosec": 500_000_000});
    let data = json!(vec![150; 18]);
    let (raw, compressed) = (&read["topics"]["/node_0"], &read["topics"]["/node_1"]);
    assert_eq!((raw["schema"].as_str(), raw["count"].as_u64()), (Some("sensor_msgs/msg/Image"), Some(300)));
    let expected = json!({
        "header": {"stamp": stamp, "frame_id": "node_0"}, "height": 2, "width": 3, "encoding": "rgb8",
        "is_bigendian": 0, "step": 9, "data": data,
    });
    assert_eq!(raw["messages"][150][3], expected);
    assert_eq!(compressed["schema"], "sensor_msgs/msg/CompressedImage");
    assert_eq!(compressed["messages"][150][3]["format"], "png");
}
