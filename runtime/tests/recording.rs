//! Recordings as files: what is written is read, what is cut is recovered, what is wrong is named.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::fs;
use std::path::Path;

use parallax_runtime::data::Data;
use parallax_runtime::graph::{GraphSpec, NodeSpec};
use parallax_runtime::node::{Consumed, Layout};
use parallax_runtime::recording::{
    Access, Change, ChangeKind, Clock, Description, Fault, FaultKind, InputRecord, Loss, LossReason,
    MessageRecord, NodeDescription, NodeTrack, Packing, Recording, RecordingError, RecordingWriter,
    StepRecord, join, write,
};
use proptest::prelude::*;

fn consumed() -> impl Strategy<Value = Consumed> {
    prop_oneof![
        Just(Consumed::INITIAL),
        (any::<u64>(), any::<i64>(), any::<i64>()).prop_map(|(seq, sent, received)| Consumed {
            seq: Some(seq),
            sent,
            received
        }),
    ]
}

fn track(index: usize) -> impl Strategy<Value = NodeTrack> {
    let leaves = prop::collection::vec("[a-zA-Z_.0-9é]{0,6}", 0..4);
    let input = ("[a-z]{1,4}", prop::collection::vec(consumed(), 0..4), any::<u64>())
        .prop_map(|(port, consumed, superseded)| InputRecord { port, consumed, superseded });
    let times = -1_000_000_000_000i64..1_000_000_000_000;
    let step = (times.clone(), times.clone(), times.clone(), prop::collection::vec(input, 0..3)).boxed();
    ("[a-z/]{1,5}", leaves, any::<bool>()).prop_flat_map(move |(type_name, leaves, stand_in)| {
        let count = leaves.len();
        let payload = prop::collection::vec(any::<u64>().prop_map(f64::from_bits), count);
        let data = prop_oneof![Just(vec![]), prop::collection::vec(any::<u8>(), 0..20)];
        let messages = prop::collection::vec((any::<u32>(), times.clone(), payload, data), 0..12);
        let steps = prop::collection::vec((any::<u32>(), step.clone()), 0..12);
        let initial =
            prop::collection::vec(prop_oneof![any::<f64>(), Just(f64::NAN), Just(f64::INFINITY)], count);
        (messages, steps, initial).prop_map(move |(messages, steps, initial)| NodeTrack {
            name: format!("node{index}"),
            layout: Layout { name: type_name.clone(), leaves: leaves.clone() },
            initial,
            stand_in,
            messages: messages
                .into_iter()
                .map(|(seq, sent, payload, data)| MessageRecord {
                    seq: seq.into(),
                    sent,
                    payload,
                    data: Data::from(&data[..]),
                })
                .collect(),
            steps: steps
                .into_iter()
                .map(|(seq, (due, start, end, inputs))| StepRecord {
                    seq: seq.into(),
                    due,
                    start,
                    end,
                    inputs,
                })
                .collect(),
        })
    })
}

fn recording() -> impl Strategy<Value = Recording> {
    let loss = ("[a-z]{1,3}", any::<u64>(), any::<i64>()).prop_map(|(from, seq, time)| Loss {
        from,
        to: "b".into(),
        port: "a".into(),
        seq,
        time,
        reason: LossReason::Transport,
    });
    let fault = (any::<i64>(), "\\PC{0,8}").prop_map(|(time, message)| Fault {
        node: "node0".into(),
        time,
        kind: FaultKind::Died { message },
    });
    let set = ("[a-z.]{1,4}", "[a-z ]{0,3}", -1e300..1e300, any::<i32>()).prop_map(
        |(parameter, unit, old, new)| ChangeKind::Set { parameter, unit, old, new: f64::from(new) / 3.0 },
    );
    let change = (any::<u64>(), any::<i64>(), "\\PC{0,8}", prop_oneof![set, Just(ChangeKind::Reset)])
        .prop_map(|(step, time, by, kind)| Change { node: "node0".into(), step, time, by, kind });
    let clock = prop_oneof![
        any::<u64>().prop_map(|seed| Clock::Simulated { seed }),
        (any::<i64>(), any::<u64>()).prop_map(|(start, seed)| Clock::Wall {
            start,
            host: "here".into(),
            seed
        }),
    ];
    let tracks = (0usize..4).prop_flat_map(|count| (0..count).map(track).collect::<Vec<_>>());
    let losses = prop::collection::vec(loss, 0..3);
    let (faults, changes) = (prop::collection::vec(fault, 0..3), prop::collection::vec(change, 0..3));
    (tracks, clock, any::<i64>(), losses, faults, changes).prop_map(
        |(nodes, clock, duration, losses, faults, changes)| {
            let specs = nodes.iter().map(|track| NodeSpec::new(&track.name, "kind nobody knows", 10.0));
            let graph = GraphSpec {
                name: "test".into(),
                supervisor: "node0".into(),
                nodes: specs.collect(),
                connections: vec![],
                plant: None,
            };
            Recording {
                graph,
                clock,
                duration,
                nodes,
                losses,
                faults,
                changes,
                hosts: Default::default(),
                clocks: Vec::new(),
                truncated: None,
            }
        },
    )
}

/// A recording as text, and the bits of its payloads: equal for equal recordings, NaN included.
fn text(recording: &Recording) -> (String, Vec<u64>) {
    let payloads =
        recording.nodes.iter().flat_map(|track| &track.messages).flat_map(|message| &message.payload);
    (format!("{recording:?}"), payloads.map(|value| value.to_bits()).collect())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn what_is_written_is_read(recording in recording()) {
        let folder = tempfile::tempdir().unwrap();
        let (one, two) = (folder.path().join("1.mcap"), folder.path().join("2.mcap"));
        write(&one, &recording).unwrap();
        let back = Recording::read(&one).unwrap();
        prop_assert_eq!(text(&back), text(&recording));
        // The same recording gives the same bytes.
        write(&two, &back).unwrap();
        prop_assert_eq!(fs::read(&one).unwrap(), fs::read(&two).unwrap());
    }

    #[test]
    fn a_changed_byte_never_panics(recording in recording(), at in any::<prop::sample::Index>(), byte in any::<u8>()) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("changed.mcap");
        write(&path, &recording).unwrap();
        let mut bytes = fs::read(&path).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        fs::write(&path, &bytes).unwrap();
        let _ = Recording::read(&path);
    }
}

/// Three nodes over three seconds: several chunks.
fn sample() -> Recording {
    let nodes = ["world", "camera", "agent"].iter().enumerate().map(|(index, name)| NodeTrack {
        name: (*name).into(),
        layout: Layout { name: format!("test/{name}"), leaves: vec!["angle".into(), "Speed[0]".into()] },
        initial: vec![0.0, 0.0],
        stand_in: index == 0,
        messages: (0..90)
            .map(|seq| MessageRecord {
                seq,
                sent: seq as i64 * 33_000_000,
                payload: vec![seq as f64, index as f64],
                data: Data::default(),
            })
            .collect(),
        steps: (0..90)
            .map(|seq| StepRecord {
                seq,
                due: seq as i64 * 33_000_000,
                start: seq as i64 * 33_000_000 + 10,
                end: seq as i64 * 33_000_000 + 20,
                inputs: vec![InputRecord {
                    port: "in".into(),
                    consumed: vec![Consumed::INITIAL],
                    superseded: 2,
                }],
            })
            .collect(),
    });
    let nodes: Vec<NodeTrack> = nodes.collect();
    let graph = GraphSpec {
        name: "test".into(),
        supervisor: "agent".into(),
        nodes: nodes.iter().map(|track| NodeSpec::new(&track.name, "test/any", 30.0)).collect(),
        connections: vec![],
        plant: None,
    };
    let clock = Clock::Simulated { seed: 7 };
    Recording {
        graph,
        clock,
        duration: 3_000_000_000,
        nodes,
        losses: vec![],
        faults: vec![],
        changes: vec![],
        hosts: Default::default(),
        clocks: Vec::new(),
        truncated: None,
    }
}

fn written() -> (tempfile::TempDir, std::path::PathBuf, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("recording.mcap");
    write(&path, &sample()).unwrap();
    let bytes = fs::read(&path).unwrap();
    (folder, path, bytes)
}

#[test]
fn a_file_cut_anywhere_gives_its_beginning() {
    let (_folder, path, bytes) = written();
    let whole = sample();
    let (mut recovered, mut seen) = (0, std::collections::BTreeSet::new());
    for cut in (0..bytes.len()).step_by(61).chain(bytes.len() - 40..bytes.len()) {
        fs::write(&path, &bytes[..cut]).unwrap();
        match Recording::read(&path) {
            Ok(part) => {
                let reason = part.truncated.expect("the reader says that the end is missing");
                assert!(reason.contains(&cut.to_string()), "{reason}");
                for (part, whole) in part.nodes.iter().zip(&whole.nodes) {
                    assert!(whole.messages.starts_with(&part.messages), "cut at {cut}");
                    assert!(whole.steps.starts_with(&part.steps), "cut at {cut}");
                }
                assert_eq!(part.graph, whole.graph);
                seen.insert(part.nodes[2].messages.len());
                recovered += 1;
            }
            Err(RecordingError::Empty { .. }) => assert_eq!(cut, 0),
            Err(RecordingError::CutEarly { .. }) => {
                assert_eq!(recovered, 0, "cut at {cut}: what was there is gone")
            }
            Err(error) => panic!("cut at {cut}: {error}"),
        }
    }
    // A second or so is the most that a killed recorder loses.
    assert!(seen.len() >= 4 && seen.contains(&0) && seen.contains(&90), "{seen:?}");
}

#[test]
fn errors_name_the_file_and_the_remedy() {
    let (folder, path, bytes) = written();
    let read = |path: &Path| Recording::read(path).expect_err("this must not be readable").to_string();
    let check = |text: String, parts: &[&str]| {
        for part in parts {
            assert!(text.contains(part), "{part:?} is missing in: {text}");
        }
        assert!(text.contains("mcap"), "{text}");
    };
    check(read(&folder.path().join("none.mcap")), &["none.mcap", "no such file", "Give the path"]);
    fs::create_dir(folder.path().join("folder.mcap")).unwrap();
    check(read(&folder.path().join("folder.mcap")), &["folder.mcap", "cannot read the file"]);
    fs::write(&path, "").unwrap();
    check(read(&path), &["recording.mcap", "empty", "Record again"]);
    fs::write(&path, "time,angle\n0,1\n").unwrap();
    check(read(&path), &["not an MCAP file", "import"]);
    fs::write(&path, &bytes[..20]).unwrap();
    check(read(&path), &["cut at byte 20", "before the graph"]);

    // A byte inside a chunk: find a message's payload, 89.0, and change it.
    let payload = 89.0f64.to_le_bytes();
    let at = bytes.windows(8).rposition(|window| window == payload).unwrap();
    let mut damaged = bytes.clone();
    damaged[at + 3] ^= 1;
    fs::write(&path, &damaged).unwrap();
    check(read(&path), &["checksum", "at byte", "damaged"]);
}

/// What a recording's file says of it first; its nodes have so many bytes of data.
fn described(recording: &Recording, data: [usize; 3]) -> Description {
    let nodes = recording.nodes.iter().zip(data).map(|(track, data)| NodeDescription {
        name: track.name.clone(),
        layout: track.layout.clone(),
        initial: track.initial.clone(),
        stand_in: track.stand_in,
        data,
    });
    Description {
        graph: recording.graph.clone(),
        clock: recording.clock.clone(),
        nodes: nodes.collect(),
        hosts: recording.hosts.clone(),
    }
}

#[test]
fn pictures_are_packed_and_numbers_are_not_unless_somebody_says_so() {
    let folder = tempfile::tempdir().unwrap();
    // White but for one place.
    let picture = |seq: u64| {
        let mut picture = vec![255; 10_000];
        picture[seq as usize] = 0;
        Data::from(&picture[..])
    };
    let mut pictures = sample();
    pictures.nodes[1].messages.iter_mut().for_each(|message| message.data = picture(message.seq));
    for (recording, most) in [(&pictures, 10_000), (&sample(), 0)] {
        let size = |packing| {
            let path = folder.path().join(format!("{packing:?}.mcap"));
            let description = described(recording, [0, most, 0]);
            let mut writer =
                RecordingWriter::create_for(&path, &description, Access::Owner, packing).unwrap();
            for (node, track) in recording.nodes.iter().enumerate() {
                for MessageRecord { seq, sent, payload, data } in &track.messages {
                    writer.message_with_data(node, *seq, *sent, payload, data).unwrap();
                }
            }
            writer.finish(recording.duration).unwrap();
            let read = Recording::read(&path).unwrap();
            for (read, track) in read.nodes.iter().zip(&recording.nodes) {
                assert_eq!(read.messages, track.messages, "{packing:?}");
            }
            fs::metadata(&path).unwrap().len()
        };
        let [suited, plain, zstd] = [Packing::Suited, Packing::Plain, Packing::Zstd].map(size);
        assert!(zstd < plain, "{zstd} {plain}");
        assert_eq!(suited, if most > 0 { zstd } else { plain });
        assert!(most == 0 || zstd < plain / 20, "{zstd} {plain}");
    }
}

#[test]
fn a_file_has_one_writer_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let description = described(&sample(), [0; 3]);
    let first = RecordingWriter::create(&path, &description).unwrap();
    let refused = RecordingWriter::create(&path, &description).err().unwrap().to_string();
    assert!(refused.contains("run.mcap") && refused.contains("another run"), "{refused}");
    first.finish(1_000).unwrap();
    assert_eq!(Recording::read(&path).unwrap().duration, 1_000);
    RecordingWriter::create(&path, &description).unwrap().finish(2_000).unwrap();
    assert_eq!(Recording::read(&path).unwrap().duration, 2_000);
}

#[test]
fn files_of_others_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("foreign.mcap");
    let file = fs::File::create(&path).unwrap();
    let mut writer =
        mcap::WriteOptions::new().compression(None).create(std::io::BufWriter::new(file)).unwrap();
    let channel = writer.add_channel(0, "/odometry", "cdr", &Default::default()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id: channel, sequence: 0, log_time: 0, publish_time: 0 };
    writer.write_to_known_channel(&header, &[0, 1, 0, 0]).unwrap();
    writer.finish().unwrap();
    drop(writer);
    let text = Recording::read(&path).expect_err("Parallax did not write it").to_string();
    assert!(text.contains("graph.json") && text.contains("/odometry") && text.contains("import"), "{text}");
}

#[test]
fn a_payload_of_another_length_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut recording = sample();
    recording.nodes[1].messages[5].payload.push(1.0);
    let text =
        write(&folder.path().join("a.mcap"), &recording).expect_err("three values, two leaves").to_string();
    assert!(text.contains("camera") && text.contains("message 5") && text.contains("2 leaves"), "{text}");
}

/// A machine crashed, and what it had not sent is missing from the recording: the copy that it kept has it.
#[test]
fn what_a_machine_kept_fills_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, recording: &Recording| {
        let path = folder.path().join(name);
        write(&path, recording).unwrap();
        path
    };
    let far = |start: i64, range: std::ops::Range<u64>, lost: &[u64]| {
        let mut recording = sample();
        recording.clock = Clock::Wall { start, host: format!("host{start}"), seed: 3 };
        recording.hosts =
            recording.nodes.iter().map(|track| (track.name.clone(), "plant".to_owned())).collect();
        recording.nodes[1..].iter_mut().for_each(|track| {
            track.steps.clear();
            track.messages.clear();
        });
        let track = &mut recording.nodes[0];
        let (step, message) = (track.steps[0].clone(), track.messages[0].clone());
        let time = |seq: u64| seq as i64 * 10;
        let steps = range.clone().map(|seq| StepRecord { seq, due: time(seq), ..step.clone() });
        track.steps = steps.map(|step| StepRecord { start: step.due, end: step.due + 1, ..step }).collect();
        let messages = range.map(|seq| MessageRecord { seq, sent: time(seq) + 1, ..message.clone() });
        track.messages = messages.collect();
        let loss = |&seq: &u64| Loss {
            from: "b".into(),
            to: "a".into(),
            port: "b".into(),
            seq,
            time: time(seq),
            reason: LossReason::Transport,
        };
        recording.losses = lost.iter().map(loss).collect();
        recording.faults.clear();
        recording
    };
    // Steps 4 and 5 are in the copy alone, and one loss in both.
    let mut holed = far(1, 0..8, &[2]);
    holed.nodes[0].steps.retain(|step| !(4..6).contains(&step.seq));
    holed.nodes[0].messages.retain(|message| !(4..6).contains(&message.seq));
    let (run, copy) = (put("run.mcap", &holed), put("copy.mcap", &far(2, 0..6, &[2, 4])));
    let whole = join(&[&run, &copy]).unwrap();
    let seqs: Vec<u64> = whole.nodes[0].steps.iter().map(|step| step.seq).collect();
    assert_eq!(seqs, (0..8).collect::<Vec<_>>());
    assert_eq!(whole.nodes[0].messages.iter().map(|message| message.seq).collect::<Vec<_>>(), seqs);
    assert_eq!(whole.losses.iter().map(|loss| loss.seq).collect::<Vec<_>>(), [2, 4]);
    assert_eq!(whole.clock, holed.clock);

    // What is no copy of this run is said to be none.
    let mut other = far(3, 0..6, &[]);
    other.nodes[0].steps[3].start += 1;
    let refused = |path: &Path| join(&[run.as_path(), path]).unwrap_err().to_string();
    assert!(refused(&put("other.mcap", &other)).contains("a copy of another run"));
    assert!(refused(&put("later.mcap", &far(4, 20..30, &[]))).contains("shares no step"));
    let mut seeded = far(5, 0..6, &[]);
    seeded.clock = Clock::Wall { start: 5, host: "host5".into(), seed: 4 };
    assert!(refused(&put("seeded.mcap", &seeded)).contains("another seed"));
}
