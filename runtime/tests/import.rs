//! Folders of logs, good and bad.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;

use parallax_runtime::import;
use parallax_runtime::recording::log::{Log, Role};
use tempfile::TempDir;

const MANIFEST: &str = r#"format = 1
title = "a cart"
license = "CC0"

[constants]
mass = 0.49
kp = 100

[[signal]]
name = "push"
role = "command"
unit = "N"
file = "log.csv"
time = "t"
value = "u"

[[signal]]
name = "position"
role = "measurement"
unit = "m"
file = "log.csv"
time = "t"
value = "x"

[[signal]]
name = "battery"
role = "context"
file = "slow.csv"
time = "time"
value = "volts"
"#;
const LOG: &str = "t,u,x\n0,1,0.5\n0.001,-1.5e-3,0.25\n5e-3, 2 ,.125\n";
const SLOW: &str = "time,volts\n0.5,12\n";

fn folder(manifest: &str, log: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("recording.toml"), manifest).unwrap();
    fs::write(folder.path().join("log.csv"), log).unwrap();
    fs::write(folder.path().join("slow.csv"), SLOW).unwrap();
    folder
}

fn load(manifest: &str, log: &str) -> Result<Log, String> {
    import::folder(folder(manifest, log).path()).map_err(|error| error.to_string())
}

#[track_caller]
fn check(result: Result<Log, String>, expected: &[&str]) {
    let message = result.expect_err("the folder was accepted");
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[track_caller]
fn check_manifest(from: &str, to: &str, expected: &[&str]) {
    assert!(MANIFEST.contains(from));
    check(load(&MANIFEST.replacen(from, to, 1), LOG), expected);
}

#[track_caller]
fn check_log(from: &str, to: &str, expected: &[&str]) {
    assert!(LOG.contains(from));
    check(load(MANIFEST, &LOG.replacen(from, to, 1)), expected);
}

#[test]
fn a_folder_becomes_a_log() {
    let log = load(MANIFEST, LOG).unwrap();
    assert_eq!((log.title.as_str(), log.license.as_str()), ("a cart", "CC0"));
    assert_eq!(log.constants, [("kp".into(), 100.0), ("mass".into(), 0.49)]);
    let names: Vec<_> = log.signals.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["push", "position", "battery"]);
    let push = log.signal("push").unwrap();
    assert_eq!((push.role, push.unit.as_str()), (Role::Command, "N"));
    assert_eq!(push.times, [0, 1_000_000, 5_000_000]);
    assert_eq!(push.values, [1.0, -0.0015, 2.0]);
    assert!(push.source.file.ends_with("log.csv") && push.source.column == "u");
    assert_eq!(log.signal("position").unwrap().values, [0.5, 0.25, 0.125]);
    assert_eq!(log.signal("battery").unwrap().times, [500_000_000]);
}

#[test]
fn what_is_not_there() {
    let message = |path: &Path| import::folder(path).unwrap_err().to_string();
    let empty = tempfile::tempdir().unwrap();
    assert!(message(&empty.path().join("nowhere")).contains("nowhere does not exist"));
    assert!(message(empty.path()).contains("has no recording.toml; write one"));
    let file = empty.path().join("log.csv");
    fs::write(&file, LOG).unwrap();
    assert!(message(&file).contains("is not a folder"));
    check_manifest(
        "slow.csv",
        "gone.csv",
        &["recording.toml:26: signal `battery` is in the file `gone.csv`, which does not exist"],
    );
}

#[test]
fn manifests_that_cannot_be_understood() {
    check(load("", LOG), &["recording.toml is empty"]);
    check_manifest("format = 1\n", "", &["`format` is missing; write `format = 1`"]);
    check_manifest("format = 1", "format = 3", &["recording.toml:1: format 3 is not supported"]);
    check_manifest("[constants]", "[constants", &["recording.toml:5:"]);
    check_manifest("title", "titel", &["recording.toml:2: unknown field `titel`, expected one of"]);
    check_manifest("unit = \"N\"", "units = \"N\"", &["recording.toml:12: unknown field `units`"]);
    check_manifest("value = \"u\"\n", "", &["recording.toml:9: missing field `value`"]);
    check_manifest(
        "role = \"command\"",
        "role = \"comand\"",
        &["recording.toml:11: signal `push`: unknown role `comand`; did you mean `command`?"],
    );
    check_manifest(
        "\"position\"",
        "\"push\"",
        &["recording.toml:18: the signal `push` is already defined at line 10"],
    );
    check_manifest("\"position\"", "\"\"", &["recording.toml:18: a signal's name is empty"]);
    check_manifest("0.49", "\"heavy\"", &["recording.toml:6: the constant `mass` must be a finite number"]);
    check_manifest("0.49", "nan", &["the constant `mass` must be a finite number"]);
    check(load("format = 1", LOG), &["names no signals; add a [[signal]]"]);
}

#[test]
fn columns_that_are_not_there() {
    check_log(
        "t,u,x",
        "t,u,y",
        &["log.csv has no column `x`, which signal `position`", "recording.toml:18", "it has: t, u, y"],
    );
    check_log("t,u,x", "time,u,x", &["has no column `t`"]);
    check_log("t,u,x", "t,x,x", &["has no column `u`"]);
    check_log("t,u,x", "t,u,u", &["log.csv:1: the column `u` appears twice"]);
    check(load(MANIFEST, &LOG.replace(',', ";")), &["separate the columns by commas"]);
    check(
        load(MANIFEST, LOG.trim_start_matches("t,u,x\n")),
        &["the first line must hold the columns' names"],
    );
}

#[test]
fn rows_that_cannot_be_read() {
    check(load(MANIFEST, ""), &["log.csv is empty; it should have a header"]);
    check(load(MANIFEST, "t,u,x\n"), &["log.csv has a header but no data"]);
    check_log("0.25", "a quarter", &["log.csv:3: column `x`: `a quarter` is not a number"]);
    check_log("0.25", "", &["log.csv:3: column `x`: an empty cell is not a number"]);
    check_log("0.25", "NaN", &["log.csv:3: column `x`: `NaN` is not finite"]);
    check_log("0.25", "-inf", &["log.csv:3: column `x`: `-inf` is not finite"]);
    check_log("0.001", "nan", &["log.csv:3: column `t`: `nan` is not finite"]);
    check_log("0.001", "1e12", &["log.csv:3: column `t`: the time `1e12` is out of range"]);
    check_log("0.001", "noon", &["log.csv:3: column `t`: `noon` is not a number"]);
    check_log(
        "\n5e-3",
        "\n0.0005",
        &["log.csv:4: column `t`: time runs backwards, from 0.001 s to 0.0005 s"],
    );
    check_log("\n5e-3", "\n0.001", &["log.csv:4: column `t`: the time 0.001 s repeats"]);
    check_log(", 2 ,.125", ", 2", &["log.csv:4: the row has 2 cells, the header 3"]);
}

#[test]
fn a_column_that_no_signal_uses_may_hold_anything() {
    let log = "t,u,note,x\n0,1,\"started, late\",0.5\n1,2,,0.25\n";
    assert_eq!(load(MANIFEST, log).unwrap().signal("position").unwrap().values, [0.5, 0.25]);
}

#[test]
fn a_byte_order_mark_and_windows_line_ends_are_no_trouble() {
    let log = format!("\u{feff}{}", LOG.replace('\n', "\r\n"));
    assert_eq!(load(MANIFEST, &log).unwrap().signal("position").unwrap().values, [0.5, 0.25, 0.125]);
}

#[test]
fn a_million_rows_load_quickly() {
    use std::fmt::Write;
    let mut log = String::from("t,u,x\n");
    for row in 0..1_000_000 {
        writeln!(log, "{}.{:06},{}.25,-0.{row:07}", row / 1000, row % 1000 * 1000, row % 7).unwrap();
    }
    let folder = folder(MANIFEST, &log);
    let start = std::time::Instant::now();
    let log = import::folder(folder.path()).unwrap();
    let elapsed = start.elapsed();
    assert_eq!(log.signal("push").unwrap().times.len(), 1_000_000);
    assert_eq!(log.signal("push").unwrap().times[999_999], 999_999_000_000);
    // A second on an idle machine; the margin is for a busy one.
    assert!(elapsed.as_secs() < 10, "{elapsed:?}");
    println!("a million rows in {elapsed:?}");
}

#[test]
fn systems_are_read_from_a_file_or_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("system.toml");
    assert!(import::read_system(&path).unwrap_err().to_string().contains("system.toml does not exist"));
    fs::write(&path, "format = 1\nname = \"s\"\n[outputs]\ny = { value = \"time\" }\n").unwrap();
    assert_eq!(import::read_system(&path).unwrap().name, "s");
    assert_eq!(import::read_system(folder.path()).unwrap().name, "s");
    fs::write(&path, "format = 1\nname = \"s\"\n[outputs]\ny = { value = \"time +\" }\n").unwrap();
    assert!(import::read_system(&path).unwrap_err().to_string().contains("system.toml:4:"));
}

#[test]
fn real_recordings_load_and_fit_their_systems() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let Ok(machines) = fs::read_dir(&data) else {
        println!("not run: {} does not exist", data.display());
        return;
    };
    let mut loaded = 0;
    for machine in machines {
        let machine = machine.unwrap().path();
        let system = import::read_system(&machine).ok();
        for entry in fs::read_dir(&machine).into_iter().flatten() {
            let path = entry.unwrap().path();
            if !path.join(import::MANIFEST).exists() {
                continue;
            }
            let log = import::folder(&path).unwrap();
            assert!(log.span().unwrap().1 > 1_000_000_000, "{}", path.display());
            if let Some(system) = &system {
                let recorded: Vec<_> =
                    log.signals.iter().map(|s| (s.name.as_str(), s.unit.as_str())).collect();
                system.check_signals(&recorded).unwrap();
                system.with_constants(&log.constants).unwrap().equations().unwrap();
            }
            loaded += 1;
        }
    }
    assert!(loaded >= 20, "only {loaded} recordings in {}", data.display());
}
