//! `parallax latency` as its users run it: real nodes and floors, all cases measured, the numbers sane. How small the
//! numbers are is for the command to say, not for a test.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod command;

use command::{fail, parallax};
use serde_json::Value;

#[test]
fn every_case_is_measured_beside_its_floor() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = [
        "latency",
        "--seconds",
        "0.2",
        "--rounds",
        "2",
        "--rate",
        "500",
        "--payload",
        "64,8192",
        "--wait",
        "block",
        "--plot",
        "delays.svg",
        "--json",
    ];
    let output = parallax(folder.path(), &arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    // Whether the aims are reached depends on what else the machine does.
    assert!(matches!(output.status.code(), Some(0 | 1)), "{errors}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = answer["report"]["rows"].as_array().unwrap();
    let count = |carrier: &str| rows.iter().filter(|row| row["carrier"] == carrier).count();
    for carrier in ["graph", "recorded-graph", "channel", "iceoryx2", "futex", "crossbeam", "unix-socket"] {
        assert!(count(carrier) > 0, "{carrier} is missing");
    }
    assert_eq!(count("channel"), 2, "both sizes");
    for row in rows {
        for way in ["one_way", "round_trip"] {
            let delays = &row[way];
            assert!(delays["count"].as_u64().unwrap() > 20, "{row}");
            let p50 = delays["p50_ns"].as_u64().unwrap();
            assert!((20..10_000_000_000).contains(&p50), "{row}");
        }
    }
    let report = &answer["report"];
    for what in ["step", "step_unrecorded", "lateness", "bare_lateness"] {
        assert!(report[what]["count"].as_u64().unwrap() > 50, "{what}");
    }
    let aims = answer["aims"].as_array().unwrap();
    assert!(aims.len() >= 5, "{aims:?}");
    assert!(aims.iter().all(|aim| aim["limit_ns"].as_f64().unwrap() > 0.0));
    let picture = std::fs::read_to_string(folder.path().join("delays.svg")).unwrap();
    assert!(roxmltree::Document::parse(&picture).is_ok() && picture.contains("raw iceoryx2"));
}

#[test]
fn what_cannot_be_measured_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    fail(&folder, &["latency", "--payload", "63"], 2, &["63", "multiple of 8"]);
    fail(&folder, &["latency", "--cores", "0,100000"], 2, &["100000", "may run on"]);
    fail(&folder, &["latency", "--seconds", "0"], 2, &["--seconds"]);
    // Its processes are not started by hand.
    fail(&folder, &["__latency-peer", "nowhere"], 1, &["started"]);
}

#[test]
fn the_doctor_ends_as_its_answer_is() {
    let folder = tempfile::tempdir().unwrap();
    let output = parallax(folder.path(), &["doctor", "--seconds", "0.1", "--json"]);
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let findings = answer["findings"].as_array().unwrap();
    let change = findings.iter().any(|finding| finding["verdict"] == "change");
    assert_eq!(output.status.code(), Some(i32::from(change)), "{findings:?}");
    assert!(
        findings.iter().filter(|finding| finding["verdict"] == "change").all(|f| f["command"].is_string())
    );
    assert!(answer["wake_ups"]["count"].as_u64().unwrap() > 10);
    fail(&folder, &["doctor", "--root", "nowhere"], 2, &["nowhere"]);
}
