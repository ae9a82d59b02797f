//! Seconds that a diagnosis takes, stage by stage.
//!
//! `cargo bench -p parallax-gap --bench engine` diagnoses twenty synthetic seconds of a pendulum with dry friction;
//! `… -- SYSTEM.toml FOLDER` diagnoses a log of your own.

#![allow(clippy::expect_used, reason = "a bench fails by panicking")]

#[path = "../tests/support/mod.rs"]
mod support;

use std::path::Path;
use std::sync::Mutex;
use std::time::Instant;

use parallax_gap::diagnosis::{Diagnosis, DiagnosisError, Options, diagnose, diagnose_experiment};
use parallax_model::system::System;
use parallax_runtime::import::{self, read_system_text};
use support::{Hidden, SYSTEM, record};

fn main() {
    let given: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let begin = Instant::now();
    let marks: Mutex<Vec<(f64, f64, String)>> = Mutex::new(Vec::new());
    let watch = |share: f64, what: &str| {
        let mut marks = marks.lock().expect("no thread has panicked");
        marks.push((begin.elapsed().as_secs_f64(), share, what.to_owned()));
    };
    let found: Result<Diagnosis, DiagnosisError> = match &given[..] {
        [system, folder] => {
            let (_, system) = read_system_text(Path::new(system)).expect("a system");
            let log = import::folder(Path::new(folder)).expect("a log");
            diagnose(&system, &log, &Options::default(), &watch)
        }
        _ => {
            let equations =
                System::parse(SYSTEM, "pendulum.toml").expect("valid").equations().expect("complete");
            let hidden = Hidden { forward: 0.03, backward: 0.03, ..Hidden::default() };
            let experiment = record(hidden, 7, 20.0);
            diagnose_experiment(equations, experiment, "pendulum", &Options::default(), &watch)
        }
    };
    let total = begin.elapsed().as_secs_f64();
    let marks = marks.into_inner().expect("no thread has panicked");
    println!("{:>8} {:>6}  done", "s", "share");
    let mut last = 0.0;
    for (at, share, what) in &marks {
        if at - last > 0.01 * total {
            println!("{at:>8.3} {:>5.0}%  {what}", 100.0 * share);
        }
        last = *at;
    }
    println!("{total:>8.3}   100%  all, on {} threads", rayon::current_num_threads());
    let report = found.expect("a diagnosis").report;
    for answer in report.which.iter().take(3) {
        let names: Vec<String> = answer.effects.iter().map(|e| format!("{}@{}", e.name, e.place)).collect();
        println!("{:.4} {}", answer.probability, names.join(" + "));
    }
}
