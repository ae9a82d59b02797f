//! Ctrl-C during a diagnosis: what was weighed is reported, nothing is reported of nothing, and a second one ends at once.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::time::Duration;

use command::counts;
use serde_json::Value;
use tempfile::TempDir;

fn program(folder: &TempDir) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_parallax"));
    command.current_dir(folder.path()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// A folder with `run.mcap`, ten seconds of the pendulum.
fn recorded() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["sim", "pendulum", "--duration", "10", "--seed", "3", "--out", "run.mcap"];
    let output = program(&folder).args(arguments).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    folder
}

fn interrupt(process: &Child) {
    assert!(Command::new("kill").args(["-INT", &process.id().to_string()]).status().unwrap().success());
}

/// A process that says what it does, and its standard error.
struct Watched(Child, BufReader<ChildStderr>);

impl Watched {
    fn start(folder: &TempDir, arguments: &[&str]) -> Self {
        let mut process = program(folder).arg("--verbose").args(arguments).spawn().unwrap();
        let errors = BufReader::new(process.stderr.take().unwrap());
        Watched(process, errors)
    }

    /// Waits until a line holds `what`.
    fn until(&mut self, what: &str) {
        let mut line = String::new();
        while !line.contains(what) {
            line.clear();
            assert!(self.1.read_line(&mut line).unwrap() > 0, "it ended before it said `{what}`");
        }
    }

    /// Its end, with what is left of its standard error.
    fn end(self) -> Output {
        let Watched(process, mut errors) = self;
        let mut rest = Vec::new();
        errors.read_to_end(&mut rest).unwrap();
        Output { stderr: rest, ..process.wait_with_output().unwrap() }
    }
}

const DIAGNOSE: [&str; 5] = ["diagnose", "run.mcap", "--out", "found", "--json"];

fn exists(folder: &TempDir, name: &str) -> bool {
    Path::new(folder.path()).join(name).exists()
}

#[test]
fn what_was_weighed_before_ctrl_c_is_reported() {
    let folder = recorded();
    let mut process = Watched::start(&folder, &DIAGNOSE);
    // The first effect has been weighed.
    process.until("@");
    interrupt(&process.0);
    let output = process.end();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let not_tried = report["interrupted"]["not_tried"].as_array().unwrap();
    assert!(not_tried.contains(&"an unknown cause".into()), "{not_tried:?}");
    let weighed = report["which"].as_array().unwrap();
    assert!(weighed.iter().any(|answer| !answer["effects"].as_array().unwrap().is_empty()), "{weighed:?}");
    for answer in weighed {
        let class = answer["class"].as_array().unwrap();
        assert!(!class.iter().any(|label| not_tried.contains(label)), "{class:?} was tried after all");
    }
    let named: f64 = weighed.iter().map(|answer| answer["probability"].as_f64().unwrap()).sum();
    let total = named + report["unexplained"]["probability"].as_f64().unwrap();
    assert!((total - 1.0).abs() < 1e-6, "{total}");
    assert!(report["summary"].as_str().unwrap().starts_with("Interrupted before everything was tried."));
    let page = std::fs::read_to_string(folder.path().join("found/report.html")).unwrap();
    assert!(
        page.contains("This diagnosis was interrupted.") && page.contains(not_tried[0].as_str().unwrap())
    );
}

#[test]
fn before_any_effect_is_weighed_there_is_nothing_to_report() {
    let folder = recorded();
    let mut process = Watched::start(&folder, &DIAGNOSE);
    process.until("nominal model");
    interrupt(&process.0);
    let output = process.end();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{errors}");
    assert!(errors.contains("interrupted before any effect was weighed"), "{errors}");
    assert!(output.stdout.is_empty() && !exists(&folder, "found/report.json"));
}

#[test]
fn a_second_ctrl_c_ends_at_once() {
    let folder = recorded();
    let mut process = Watched::start(&folder, &DIAGNOSE);
    process.until("@");
    // Two that come while the process does not run are one: it is asked until it ends.
    while process.0.try_wait().unwrap().is_none() {
        interrupt(&process.0);
        std::thread::sleep(Duration::from_millis(5));
    }
    let output = process.end();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert!(output.stdout.is_empty() && !exists(&folder, "found/report.json"));
}

#[test]
fn an_interrupted_benchmark_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let run = |more: &[&str]| {
        let counts = counts(&[("singles", 2)]);
        let all = ["withheld", "--dev-seed", "7", "--out", "run", "--separate", "0", "--json"].into_iter();
        all.chain(counts.iter().map(String::as_str))
            .chain(more.iter().copied())
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let arguments = run(&[]);
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let mut process = Watched::start(&folder, &arguments);
    process.until("answers sealed");
    interrupt(&process.0);
    let output = process.end();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert!(said.contains("of 2 cases are in") && said.contains("--resume"), "{said}");

    let output = program(&folder).args(run(&["--resume"])).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let scores: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(scores["sets"]["single"], 2);
}
