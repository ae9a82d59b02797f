//! Logs of other programs: how they are written, what is found in them, and what becomes of them.
//!
//! The bag and the Parquet files beside this one were written by `make_bag.py` and `make_tables.py`.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};

use parallax_runtime::import::folder;
use parallax_runtime::import::foreign::{
    Choice, Converted, Dialect, ForeignError, Found, Group, Plan, TimeUnit, UnitFrom, convert, read, series,
    write_folder,
};
use parallax_runtime::recording::log::{Role, Signal};
use proptest::prelude::*;
use tempfile::TempDir;

fn found(text: impl AsRef<[u8]>) -> Result<Found, String> {
    with(text, &Dialect::default())
}

fn with(text: impl AsRef<[u8]>, dialect: &Dialect) -> Result<Found, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.csv");
    fs::write(&path, text).unwrap();
    read(&path, dialect, &mut |_| {}).map_err(|error| error.to_string())
}

fn choice(series: &str, role: Role) -> Choice {
    Choice { series: series.into(), name: series.into(), role, unit: None, scale: 1.0 }
}

/// All series as measurements.
fn all(found: &Found) -> Plan {
    let choices = found.series().map(|(_, series)| choice(&series.name, Role::Measurement)).collect();
    Plan { choices, ..Plan::default() }
}

fn converted(found: &Found, plan: &Plan) -> Result<Converted, String> {
    convert(std::slice::from_ref(found), plan).map_err(|error| error.to_string())
}

#[track_caller]
fn signal<'a>(converted: &'a Converted, name: &str) -> &'a Signal {
    converted.log.signal(name).unwrap()
}

fn seconds(signal: &Signal) -> Vec<f64> {
    signal.times.iter().map(|time| *time as f64 / 1e9).collect()
}

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/foreign").join(name)
}

fn open(name: &str) -> Found {
    read(&data(name), &Dialect::default(), &mut |_| {}).unwrap()
}

#[track_caller]
fn says<T: std::fmt::Debug>(result: Result<T, String>, expected: &[&str]) {
    let message = result.expect_err("it was accepted");
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn an_untidy_log_becomes_signals() {
    // A preamble, German numbers, degrees in Latin-1, a hole, a word for a hole, a text column, and a row cut off.
    let text = b"Rig 7;;;\nStart;10:00;;\n\nZeit [ms];Spannung [V];Winkel [\xb0];Modus\n0;1,5;10;RUN\n10;-1,5;;RUN\n20;2,5;30;RUN\n30;3,5;#N/A;STOP\n40;4,5;50;RUN\n50;1";
    let found = found(text).unwrap();
    assert_eq!(found.form, "CSV, columns separated by semicolons, decimal comma");
    let names: Vec<_> = found.series().map(|(_, s)| (s.name.as_str(), s.unit.as_str(), s.role)).collect();
    assert_eq!(names, [("Spannung", "V", Some(Role::Command)), ("Winkel", "deg", Some(Role::Measurement))]);
    assert!(
        found.notes.iter().any(|note| note.contains("`Modus` holds text, such as `RUN`")),
        "{:?}",
        found.notes
    );
    assert!(
        found.notes.iter().any(|note| note.contains("line 10 is cut off (2 of 4 cells)")),
        "{:?}",
        found.notes
    );
    let mut plan = Plan::suggested(std::slice::from_ref(&found));
    plan.choices[1].unit = Some("rad".into());
    let converted = converted(&found, &plan).unwrap();
    let (voltage, angle) = (signal(&converted, "Spannung"), signal(&converted, "Winkel"));
    assert_eq!(
        (seconds(voltage), &voltage.values),
        (vec![0.0, 0.01, 0.02, 0.03, 0.04], &vec![1.5, -1.5, 2.5, 3.5, 4.5])
    );
    let radians = [10.0, 30.0, 50.0].map(|degrees: f64| degrees * (std::f64::consts::PI / 180.0));
    assert_eq!(
        (seconds(angle), &angle.values[..], angle.unit.as_str()),
        (vec![0.0, 0.02, 0.04], &radians[..], "rad")
    );
    assert!(converted.changed[1].starts_with("times 0.01745"), "{:?}", converted.changed);
}

#[test]
fn what_was_written_reads_as_it_was_meant() {
    let found = found("t,u,x\n1700000000.5,1,0.1\n1700000000.6,2,\n1700000000.7,3,1e-300\n").unwrap();
    let converted = converted(&found, &all(&found)).unwrap();
    assert_eq!(converted.origin, 1_700_000_000_500_000_000);
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("my \"log\"");
    write_folder(&out, &converted).unwrap();
    let log = folder(&out).unwrap();
    assert_eq!(seconds(log.signal("u").unwrap()), [0.0, 0.1, 0.2]);
    assert_eq!(
        (seconds(log.signal("x").unwrap()), log.signal("x").unwrap().values[1]),
        (vec![0.0, 0.2], 1e-300)
    );
    // Signals of other stamps have a file of their own, and nothing else is left behind.
    let mut files: Vec<_> = fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    files.sort();
    assert_eq!(files, ["01_u.csv", "02_x.csv", "recording.toml"]);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    let text = fs::read_to_string(out.join("recording.toml")).unwrap();
    assert!(text.contains("2023-11-14 22:13:20.5"), "{text}");
    assert!(matches!(write_folder(&out, &converted), Err(ForeignError::Exists { .. })));
}

#[test]
fn a_unit_that_nothing_tells_is_asked_for() {
    let found = found("t,x\n0,1\n20,2\n40,3\n").unwrap();
    assert_eq!(found.groups[0].clocks[0].unit, None);
    let mut plan = all(&found);
    says(
        converted(&found, &plan),
        &["column `t` says no unit", "steps of 20", "--time-unit s, ms, us or ns"],
    );
    plan.time_unit = Some(TimeUnit::Ms);
    assert_eq!(seconds(signal(&converted(&found, &plan).unwrap(), "x")), [0.0, 0.02, 0.04]);
}

#[test]
fn clocks_of_all_kinds_are_understood() {
    let times = |text: &str| {
        let found = found(text).unwrap();
        let converted = converted(&found, &all(&found)).unwrap();
        (seconds(&converted.log.signals[0]), found.groups[0].clocks[0].unit.unwrap().1)
    };
    for (text, from) in [
        ("time_us,x\n0,1\n1000,2\n", UnitFrom::Stated),
        ("Time (ms),x\n0,1\n1.0,2\n", UnitFrom::Stated),
        ("stamp,x\n1700000000000000000,1\n1700000000001000000,2\n", UnitFrom::Epoch),
        ("stamp,x\n2024-05-01T12:00:00.000Z,1\n2024-05-01T12:00:00.001Z,2\n", UnitFrom::Dates),
        ("Date,Time,x\n2024-05-01,12:00:00.000,1\n2024-05-01,12:00:00.001,2\n", UnitFrom::Dates),
        (
            "header.stamp.sec,header.stamp.nanosec,x\n1700000000,5000000,1\n1700000000,6000000,2\n",
            UnitFrom::Stated,
        ),
        ("t,x\n0.000,1\n0.001,2\n", UnitFrom::Steps),
    ] {
        assert_eq!(times(text), (vec![0.0, 0.001], from), "{text}");
    }
}

#[test]
fn each_column_goes_by_the_time_beside_it() {
    let found = found("t_cmd [s],u,t_meas [s],q\n0,1,0.005,10\n0.1,2,0.105,20\n0.2,3,0.205,30\n").unwrap();
    let mut plan = all(&found);
    let first = converted(&found, &plan).unwrap();
    assert_eq!(seconds(signal(&first, "u")), [0.0, 0.1, 0.2]);
    assert_eq!(seconds(signal(&first, "q")), [0.005, 0.105, 0.205]);
    plan.clocks = vec![(Some("q".into()), "t_cmd [s]".into())];
    assert_eq!(seconds(signal(&converted(&found, &plan).unwrap(), "q")), [0.0, 0.1, 0.2]);
    plan.clocks = vec![(None, "t_mes [s]".into())];
    says(converted(&found, &plan), &["no time `t_mes [s]`", "did you mean `t_meas [s]`?"]);
}

#[test]
fn a_log_without_times_has_a_rate_or_an_error() {
    let found = found("u,q\n1,2\n3,4\n").unwrap();
    let mut plan = all(&found);
    says(converted(&found, &plan), &["no column that looks like a time (it has: u, q)", "--rate HZ"]);
    plan.rate = Some(50.0);
    assert_eq!(seconds(signal(&converted(&found, &plan).unwrap(), "q")), [0.0, 0.02]);
}

#[test]
fn cells_may_be_lists() {
    // As loggers of arms write them; times are microseconds, which nothing says.
    let found = found(
        "type,timestamp,positions,velocities\nSTATE,4.898,\"[-0.0084, 0.5714]\",\"[0.0, 1.0]\"\n\
         STATE,20084.474,\"[-0.0094, 0.5724]\",[]\nSTATE,40142.218,\"[-0.0104, 0.5734]\",\"[2.0, 3.0]\"\n",
    )
    .unwrap();
    let names: Vec<_> = found.series().map(|(_, series)| series.name.as_str()).collect();
    assert_eq!(names, ["positions_0", "positions_1", "velocities_0", "velocities_1"]);
    let plan = Plan { time_unit: Some(TimeUnit::Us), ..all(&found) };
    let converted = converted(&found, &plan).unwrap();
    assert_eq!(signal(&converted, "positions_1").values, [0.5714, 0.5724, 0.5734]);
    assert_eq!(seconds(signal(&converted, "velocities_0")), [4.898e-6, 0.040142218]);
}

#[test]
fn stamps_that_repeat_or_go_back_are_counted() {
    let found = found("t [ms],x\n0,1\n1,2\n1,3\n3,5\n2,4\n4,6\n").unwrap();
    let run = found.groups[0].clocks[0].run(&Plan::default()).unwrap();
    assert_eq!((run.repeated, run.backwards), (1, 1));
    let mut plan = all(&found);
    let converted_ = converted(&found, &plan).unwrap();
    // The last of equal stamps counts, and the rest is in order.
    assert_eq!(signal(&converted_, "x").values, [1.0, 3.0, 4.0, 5.0, 6.0]);
    assert!(converted_.log.notes[0].contains("1 samples left out"), "{:?}", converted_.log.notes);
    let coarse = self::found("t [ms],x\n0,1\n0,2\n1,3\n1,4\n").unwrap();
    plan = Plan { spread: true, ..all(&coarse) };
    assert_eq!(seconds(signal(&converted(&coarse, &plan).unwrap(), "x")), [0.0, 0.0005, 0.001, 0.0015]);
}

#[test]
fn two_runs_in_one_file_are_not_mixed() {
    let mut text = String::from("t,x\n");
    for run in 0..2 {
        for row in 0..100 {
            text += &format!("{},{}\n", f64::from(row) * 0.01, run * 100 + row);
        }
    }
    let found = found(&text).unwrap();
    let mut plan = all(&found);
    says(converted(&found, &plan), &["goes back from 0.99 s to 0 s at row 101", "--rows 1:100 or 101:200"]);
    plan.rows = Some((101, 200));
    assert_eq!(signal(&converted(&found, &plan).unwrap(), "x").values[0], 100.0);
}

#[test]
fn what_cannot_be_read_says_where_and_what_to_do() {
    says(
        found("t,x\n0,1\n1,2\n2,oops\n3,4\n"),
        &["log.csv:4: column `x`: `oops` is not a number", "--missing 'oops'"],
    );
    let known = Dialect { missing: vec!["oops".into()], ..Dialect::default() };
    assert!(with("t,x\n0,1\n1,2\n2,oops\n3,4\n", &known).is_ok());
    says(found("t,x\n0,1\n1,2,3\n2,3\n"), &["log.csv:3: the row has 3 cells, the header 2"]);
    says(found(""), &["log.csv is empty"]);
    says(found("hello\nworld\n"), &["no line of it looks like a row of numbers"]);
    says(found("t,mode\n0,a\n1,b\n"), &["no series of numbers", "`mode` holds text, such as `a` in line 2"]);
    says(found(b"\x1f\x8b\x08\x00"), &["compressed by gzip", "gunzip"]);
    says(found(b"SQLite format 3\x00"), &["ROS 2 bag in SQLite", "whole"]);
    says(found(b"\x89HDF\r\n\x1a\n"), &["HDF5", "CSV or Parquet"]);
    says(found([0, 1, 2, 3]), &["not known here"]);
    says(found(b"PAR1 and no more"), &["log.csv", "arquet"]);
    says(found(mcap::MAGIC), &["no series of numbers", "cut off at byte 8"]);
    let found = found("t,pos [furlong]\n0,1\n0.01,2\n").unwrap();
    let mut plan = all(&found);
    plan.choices[0].unit = Some("m".into());
    says(converted(&found, &plan), &["`pos` is in `furlong`", "--scale NAME=FACTOR"]);
    plan.choices[0].scale = 201.168;
    let scaled = converted(&found, &plan).unwrap();
    assert_eq!((signal(&scaled, "pos").values[0], signal(&scaled, "pos").unit.as_str()), (201.168, "m"));
    plan.choices = vec![choice("poss", Role::Command)];
    says(converted(&found, &plan), &["no signal `poss`; did you mean `pos`?"]);
    plan.choices = vec![];
    says(converted(&found, &plan), &["no signal is chosen"]);
}

#[test]
fn a_bag_is_read_by_the_definitions_in_it() {
    let found = open("arm");
    assert_eq!(found.form, "ROS 2 bag (MCAP)");
    let units: Vec<_> = found.series().map(|(_, s)| (s.name.as_str(), s.unit.as_str())).collect();
    for expected in [
        ("joint_states.shoulder.position", ""),
        ("effort_cmd", ""),
        ("gains.0", ""),
        ("cmd_vel.linear.x", "m/s"),
        ("imu.angular_velocity.z", "rad/s"),
        ("ft.wrench.torque.y", "N m"),
        ("odom.pose.pose.position.x", "m"),
    ] {
        assert!(units.contains(&expected), "no {expected:?} in {units:?}");
    }
    assert!(
        !units.iter().any(|(name, _)| name.contains("covariance") && name.contains("camera")),
        "{units:?}"
    );
    assert!(
        found
            .notes
            .iter()
            .any(|note| note.contains("/camera (sensor_msgs/msg/CompressedImage) has no numbers"))
    );
    let role = |name| series(std::slice::from_ref(&found), name).unwrap().role;
    assert_eq!(role("effort_cmd"), Some(Role::Command));
    assert_eq!(role("cmd_vel.angular.z"), Some(Role::Command));
    assert_eq!(role("joint_states.elbow.position"), Some(Role::Measurement));
    assert_eq!(role("imu.orientation_covariance_0"), None);

    let plan = Plan {
        choices: vec![
            choice("effort_cmd", Role::Command),
            choice("joint_states.shoulder.position", Role::Measurement),
            choice("joint_states.elbow.position", Role::Measurement),
        ],
        ..Plan::default()
    };
    let converted = converted(&found, &plan).unwrap();
    assert_eq!(converted.origin, 1_700_000_000_000_000_000);
    let (command, shoulder) =
        (signal(&converted, "effort_cmd"), signal(&converted, "joint_states.shoulder.position"));
    // By its own stamp the state is as old as the command, though it came 2 ms later.
    assert_eq!((command.times.len(), &command.times), (50, &shoulder.times));
    assert_eq!(shoulder.values[10], (6.0_f64 * 0.1).sin());
    let elbow = signal(&converted, "joint_states.elbow.position");
    assert_eq!(
        (elbow.times.len(), elbow.times[1], elbow.values[5]),
        (25, 20_000_000, -(6.0_f64 * 0.1).sin())
    );
    let late = Plan { clocks: vec![(None, "log".into())], ..plan };
    let late = self::converted(&found, &late).unwrap();
    assert_eq!(signal(&late, "joint_states.shoulder.position").times[0], 2_000_000);
}

#[test]
fn a_bag_that_is_cut_off_gives_what_was_whole() {
    let place = tempfile::tempdir().unwrap();
    let bytes = fs::read(data("arm/arm.mcap")).unwrap();
    let path = place.path().join("cut.mcap");
    for length in (8..bytes.len()).step_by(97) {
        fs::write(&path, &bytes[..length]).unwrap();
        match read(&path, &Dialect::default(), &mut |_| {}) {
            Ok(found) => assert!(found.series().count() > 20),
            Err(error) => assert!(error.to_string().contains("cut off"), "{error}"),
        }
    }
    // Damage is an error or a note, whatever the byte.
    for at in (8..bytes.len()).step_by(53) {
        let mut bytes = bytes.clone();
        bytes[at] ^= 0x55;
        fs::write(&path, &bytes).unwrap();
        let _ = read(&path, &Dialect::default(), &mut |_| {});
    }
}

#[test]
fn parquet_files_are_read() {
    let frame = open("frame.parquet");
    let names: Vec<_> = frame.series().map(|(_, s)| (s.name.as_str(), s.unit.as_str())).collect();
    assert_eq!(names, [("u", "V"), ("pos", "deg"), ("n", "")]);
    let plan = Plan {
        choices: vec![choice("u", Role::Command), choice("pos", Role::Measurement)],
        ..Plan::default()
    };
    let converted_ = converted(&frame, &plan).unwrap();
    assert_eq!(converted_.origin, 1_700_000_000_000_000_001);
    let position = signal(&converted_, "pos");
    assert_eq!(
        (position.values.len(), position.times[7], position.values[8]),
        (99, 80_000_000, (9.0_f64 * 0.01).sin())
    );

    let episode = open("episode.parquet");
    let names: Vec<_> = episode.series().map(|(_, s)| (s.name.as_str(), s.role)).collect();
    let (state, action) = (Some(Role::Measurement), Some(Role::Command));
    assert_eq!(
        names,
        [
            ("observation.state_0", state),
            ("observation.state_1", state),
            ("action_0", action),
            ("action_1", None),
            ("frame_index", None)
        ]
    );
    let converted_ = converted(&episode, &Plan::suggested(std::slice::from_ref(&episode))).unwrap();
    assert_eq!(signal(&converted_, "observation.state_1").values[3], -3.0);
    assert!((seconds(signal(&converted_, "action_0"))[99] - 0.99).abs() < 1e-6);
}

#[test]
fn a_bag_without_messages_in_mcap_says_what_to_do() {
    let place: TempDir = tempfile::tempdir().unwrap();
    let open = || read(place.path(), &Dialect::default(), &mut |_| {}).unwrap_err().to_string();
    assert!(open().contains("holds no MCAP or SQLite file"));
    fs::write(place.path().join("bag_0.db3"), b"SQLite format 3\0").unwrap();
    assert!(open().contains("bag_0.db3 cannot be read as a ROS 2 bag in SQLite"));
}

#[test]
fn a_bag_in_sqlite_is_read_as_one_in_mcap() {
    // Both were written by the same program, from the same messages.
    let (database, mcap) = (open("arm.db3"), open("arm"));
    assert_eq!(database.form, "ROS 2 bag (SQLite)");
    assert!(database.groups.len() > 5);
    for (ours, theirs) in database.groups.iter().zip(&mcap.groups) {
        assert!(same(ours, theirs), "{}", ours.name);
    }
    assert_eq!((database.groups.len(), &database.notes), (mcap.groups.len(), &mcap.notes));
}

/// Where a message lacks a number there is a NaN, which equals nothing.
fn same(one: &Group, other: &Group) -> bool {
    format!("{one:?}") == format!("{other:?}")
}

/// The bag `arm.db3` after some SQL, as older and damaged ones are.
fn changed(place: &TempDir, sql: &str) -> PathBuf {
    let path = place.path().join("what? 100 %#.db3");
    fs::copy(data("arm.db3"), &path).unwrap();
    rusqlite::Connection::open(&path).unwrap().execute_batch(sql).unwrap();
    path
}

#[test]
fn bags_without_definitions_are_read_where_their_types_come_with_ros() {
    let place = tempfile::tempdir().unwrap();
    // As ROS 2 Humble writes them, with a journal that is written ahead; and one type that nobody knows.
    let path = changed(
        &place,
        "DROP TABLE message_definitions; DROP TABLE schema; PRAGMA journal_mode = WAL; \
         UPDATE topics SET type = 'my_msgs/msg/Gains' WHERE name = '/gains';",
    );
    let found = read(&path, &Dialect::default(), &mut |_| {}).unwrap();
    let mcap = open("arm");
    let others: Vec<&Group> = mcap.groups.iter().filter(|group| group.name != "/gains").collect();
    assert_eq!((found.groups.len(), others.len() >= 5), (others.len(), true));
    for (ours, theirs) in found.groups.iter().zip(others) {
        assert!(same(ours, theirs), "{}", ours.name);
    }
    assert!(found.groups.iter().all(|group| group.name != "/gains"));
    let note = found.notes.iter().find(|note| note.contains("/gains")).unwrap();
    assert!(note.contains("no definition of this type") && note.contains("rosbags-convert"), "{note}");
    // Nothing is left beside it.
    assert_eq!(place.path().read_dir().unwrap().count(), 1);
}

#[test]
fn a_bag_in_sqlite_that_is_cut_or_is_none_says_so() {
    let place = tempfile::tempdir().unwrap();
    let whole = fs::read(data("arm.db3")).unwrap();
    let path = place.path().join("cut.db3");
    for share in 1..8 {
        fs::write(&path, &whole[..whole.len() * share / 8]).unwrap();
        match read(&path, &Dialect::default(), &mut |_| {}) {
            Ok(found) => {
                assert!(
                    found.notes.iter().any(|note| note.contains("is damaged after")),
                    "{:?}",
                    found.notes
                );
            }
            Err(error) => assert!(error.to_string().contains("cut.db3"), "{error}"),
        }
    }
    let path = changed(&place, "DROP TABLE messages;");
    let error = read(&path, &Dialect::default(), &mut |_| {}).unwrap_err();
    let ForeignError::Database { source, .. } = &error else { panic!("{error}") };
    assert!(source.to_string().contains("messages"), "{source}");
}

proptest! {
    #[test]
    fn any_text_is_a_log_or_an_error(text in "[0-9.,;: \\t\\n\"\\[\\]eETZ#%a()/+-]{0,300}|(t|time_us|x \\[m\\])(,[a-z]{1,3}){1,3}\n([0-9.,\\[\\]\"-]{0,12}\n){0,30}") {
        if let Ok(found) = found(&text) {
            for plan in [all(&found), Plan { rate: Some(10.0), spread: true, ..all(&found) }, Plan { time_unit: Some(TimeUnit::S), ..all(&found) }] {
                if let Ok(converted) = converted(&found, &plan) {
                    let place = tempfile::tempdir().unwrap();
                    // What was converted can be written, and reads as it was meant.
                    write_folder(&place.path().join("log"), &converted).unwrap();
                }
            }
        }
    }

    #[test]
    fn any_bytes_are_a_log_or_an_error(mut bytes in prop::collection::vec(any::<u8>(), 0..200), kind in 0..4_usize) {
        let heads: [&[u8]; 4] = [mcap::MAGIC, b"PAR1", b"\xff\xfe", b"t,x\n"];
        bytes.splice(0..0, heads[kind].iter().copied());
        let _ = found(&bytes);
    }
}
