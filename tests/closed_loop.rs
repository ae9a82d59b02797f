//! The closed-loop score at the command line: a task file beside a recording. The machine is simulated by code of its own.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::collections::VecDeque;
use std::fs;
use std::path::Path;

use command::ends;
use parallax::gap::closed_loop::{Controlled, LoopScore};
use parallax::gap::report::Report;
use tempfile::TempDir;

const SYSTEM: &str = r#"
format = 1
name = "axis"
[parameters]
M = { value = 2.1, unit = "kg", calibrate = [1.0, 4.0] }
b = { value = 3.8, unit = "N s/m", calibrate = [0.5, 20.0] }
[inputs]
u = { signal = "force" }
[state]
q = { derivative = "v", initial = "position" }
v = { derivative = "(u - b*v)/M" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
axis = { position = "q", velocity = "v", inertia = "M", drive = "u" }
"#;

const TASK: &str = r#"
format = 1
name = "follow the course"
[task]
cost = "(course - position)^2"
unit = "m^2"
horizon = 2.0
[state]
last = { next = "position", initial = "position" }
[outputs]
u = { value = "90*(course - position) - 8*(position - last)/0.01" }
"#;

/// An axis whose amplifier acts 40 ms late, under the task's controller.
fn record(folder: &Path, duration: f64) {
    let (h, mut q, mut v, mut acts, mut last) = (1e-4, 0.0_f64, 0.0_f64, 0.0, None);
    let mut queue = VecDeque::new();
    let mut rows = String::from("t,u,x,c\n");
    let mut noise = 7_u32;
    for step in 0..(duration / h).round() as usize {
        let t = step as f64 * h;
        if step % 100 == 0 {
            let mut sum = -6.0;
            for _ in 0..12 {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                sum += f64::from(noise) / f64::from(u32::MAX);
            }
            let seen = q + 2e-4 * sum;
            let course = 0.1 * (0.9 * t).sin().signum() + 0.05 * (4.3 * t).sin();
            let force = 90.0 * (course - seen) - 8.0 * (seen - last.unwrap_or(seen)) / 0.01;
            last = Some(seen);
            queue.push_back((t + 0.04, force));
            rows += &format!("{t:.4},{force:.9},{seen:.9},{course:.9}\n");
        }
        while queue.front().is_some_and(|(due, _)| *due <= t + 1e-9) {
            acts = queue.pop_front().map_or(acts, |(_, force)| force);
        }
        v += h * (acts - 4.0 * v) / 2.0;
        q += h * v;
    }
    fs::create_dir(folder.join("log")).unwrap();
    fs::write(folder.join("log/log.csv"), rows).unwrap();
    let mut manifest = String::from("format = 1\ntitle = \"axis\"\n");
    for (name, role, unit, value) in [
        ("force", "command", "N", "u"),
        ("position", "measurement", "m", "x"),
        ("course", "reference", "m", "c"),
    ] {
        manifest += &format!(
            "[[signal]]\nname = \"{name}\"\nrole = \"{role}\"\nunit = \"{unit}\"\nfile = \"log.csv\"\ntime = \"t\"\nvalue = \"{value}\"\n"
        );
    }
    fs::write(folder.join("log/recording.toml"), manifest).unwrap();
    fs::write(folder.join("system.toml"), SYSTEM).unwrap();
    fs::write(folder.join("task.toml"), TASK).unwrap();
}

const DIAGNOSE: [&str; 8] =
    ["diagnose", "--system", "system.toml", "log", "--out", "out", "--only", "delay@input:u"];

fn report(folder: &Path) -> Report {
    serde_json::from_str(&fs::read_to_string(folder.join("out/report.json")).unwrap()).unwrap()
}

#[test]
fn the_report_says_what_the_task_costs_with_and_without_the_effect() {
    let folder = TempDir::new().unwrap();
    record(folder.path(), 20.0);
    let (answer, _) = ends(folder.path(), 0, &[&DIAGNOSE[..], &["--task", "task.toml"]].concat());
    assert!(
        answer.contains("closed loop") && answer.contains("the effect matters for this task"),
        "{answer}"
    );
    let scores = report(folder.path()).closed_loop.unwrap();
    let (recorded, with) = (scores.recorded.value, scores.with_effect.unwrap());
    let without = scores.refitted.difference.unwrap();
    assert!(without.value < -0.03 * recorded, "{without:?} of {recorded}: {answer}");
    assert!(with.difference.unwrap().value.abs() < 0.01 * recorded);
    assert!(scores.miss.unwrap() < 1e-3);
    let page = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(page.contains("In closed loop"));

    ends(folder.path(), 0, &DIAGNOSE);
    let text = fs::read_to_string(folder.path().join("out/report.json")).unwrap();
    assert!(text.contains("\"closed_loop\": null"), "{text}");
}

#[test]
fn a_task_that_cannot_be_scored_is_refused_before_anything_is_diagnosed() {
    let folder = TempDir::new().unwrap();
    record(folder.path(), 6.0);
    let refused = |from: &str, to: &str, expected: &[&str]| {
        assert!(TASK.contains(from), "the task has no `{from}`");
        fs::write(folder.path().join("task.toml"), TASK.replacen(from, to, 1)).unwrap();
        let (_, errors) = ends(folder.path(), 2, &[&DIAGNOSE[..], &["--task", "task.toml"]].concat());
        for part in expected {
            assert!(errors.contains(part), "no `{part}` in: {errors}");
        }
        assert!(!folder.path().join("out/report.json").exists());
    };
    refused("course - position", "corse - position", &["task.toml:5", "`corse`", "did you mean `course`?"]);
    refused(
        "u = {",
        "torque = {",
        &["task.toml:11", "`torque`", "no input of the system `axis` (it has: u)"],
    );
    refused(
        "\"(course - position)^2\"",
        "\"log(position - 5)\"",
        &["task.toml:5", "is NaN at 0 s", "position = "],
    );
    refused("horizon = 2.0", "horizon = 60.0", &["task.toml", "0 to 60 s", "ends at 5.99 s"]);
    refused(
        "[outputs]\nu = { value = \"90*(course - position) - 8*(position - last)/0.01\" }",
        "",
        &["[outputs]", "Parallax graph"],
    );
    refused("[task]", "[tsk]", &["task.toml:4", "did you mean `task`?"]);
    let (_, errors) = ends(folder.path(), 2, &[&DIAGNOSE[..], &["--task", "nowhere.toml"]].concat());
    assert!(errors.contains("nowhere.toml"), "{errors}");
}

#[test]
fn a_recorded_graph_closes_the_loop_around_its_plant() {
    let folder = TempDir::new().unwrap();
    ends(folder.path(), 0, &["sim", "pendulum", "--duration", "8", "--seed", "1", "--out", "run.mcap"]);
    let task = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/tasks/pendulum.toml");
    let task = task.to_str().unwrap();
    let arguments = ["diagnose", "run.mcap", "--task", task, "--out", "out", "--only", "viscous"];
    ends(folder.path(), 0, &arguments);
    let scores = report(folder.path()).closed_loop.unwrap();
    assert_eq!((scores.controller, scores.episodes), (Controlled::Graph, 1));
    // Nothing is hidden: calibration alone predicts the score, within what delays and noise make of it.
    assert!(scores.refitted.agrees, "{scores:?}");
}

/// Real recordings, which are not part of the repository: the controller is the one that its authors publish.
#[test]
fn a_stiff_loop_rejects_the_friction_of_a_real_axis() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let data = here.join("../shared/data/emps");
    if !data.exists() {
        println!("not run: {} does not exist", data.display());
        return;
    }
    let folder = TempDir::new().unwrap();
    let text = |path: std::path::PathBuf| path.to_str().unwrap().to_owned();
    let (system, log) = (text(data.join("system.toml")), text(data.join("estimation")));
    let task = text(here.join("examples/tasks/emps.toml"));
    let arguments =
        ["diagnose", "--system", &system, &log, "--task", &task, "--out", "out", "--only", "coulomb"];
    ends(folder.path(), 0, &arguments);
    let scores = report(folder.path()).closed_loop.unwrap();
    assert!(scores.miss.unwrap() < 0.05, "the controller is the one that ran: {:?}", scores.miss);
    let away = |row: &LoopScore| row.difference.as_ref().unwrap().value.abs() / scores.recorded.value;
    let with = away(scores.with_effect.as_ref().unwrap());
    assert!(with < 0.005 && with < away(&scores.refitted) && away(&scores.refitted) < 0.02, "{scores:?}");
}
