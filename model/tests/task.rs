//! Task files: what they say, and each way to get one wrong has a message with file, line and remedy.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::system::{Point, Task};

const GOOD: &str = r#"format = 1
name = "hold"

[task]
cost = "error^2 + small*u^2"
terminal = "10*error^2"
unit = "m^2"
from = 1.0
to = 9.0
horizon = 2.0

[policy]
rate = 50.0
latency = 0.004

[parameters]
small = { value = 0.01 }

[inputs]
goal = { signal = "target" }

[let]
error = "goal - position"

[state]
sum = { derivative = "error", initial = 0.0 }
last = { next = "position", initial = "position" }

[outputs]
u = { value = "3*error + sum - 2*(position - last)" }
"#;

fn message(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "the good task has no `{from}`");
    let parsed = |text: &str| {
        let task = Task::parse(text, "t.toml")?;
        let signal = |name: &str| ["position", "u"].contains(&name).then(|| name.to_owned());
        task.bind(&["position", "u"], signal).map(|_| ())
    };
    parsed(GOOD).unwrap();
    match parsed(&GOOD.replacen(from, to, 1)) {
        Ok(()) => panic!("`{to}` in place of `{from}` was accepted"),
        Err(error) => error.to_string(),
    }
}

#[track_caller]
fn check(from: &str, to: &str, expected: &[&str]) {
    let message = message(from, to);
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn a_task_is_bound_to_the_machine_it_is_given() {
    let task = Task::parse(GOOD, "t.toml").unwrap();
    assert_eq!((task.from, task.to, task.horizon, task.unit.as_str()), (1.0, Some(9.0), Some(2.0), "m^2"));
    assert_eq!((task.policy.rate, task.policy.latency), (Some(50.0), 0.004));
    let bound = task.bind(&[], |name| Some(format!("machine.{name}"))).unwrap();
    let inputs = &bound.controller.system().inputs;
    let names: Vec<(&str, &str)> = inputs.iter().map(|i| (i.name.as_str(), i.signal.as_str())).collect();
    let signals = [("goal", "target"), ("position", "machine.position"), ("u", "machine.u")];
    assert_eq!(names[..bound.signals], signals);
    assert_eq!(names[bound.signals..], [("last", "last")]);
    // Goal 1, position 0.4, command 2; the sum is 0.5 and the position before was 0.3.
    let point = Point { parameters: &[0.01], states: &[0.5], inputs: &[1.0, 0.4, 2.0, 0.3], time: 0.0 };
    let outputs = bound.controller.values(&point, &[]).outputs;
    assert!((outputs[0] - (3.0 * 0.6 + 0.5 - 0.2)).abs() < 1e-12, "{outputs:?}");
    assert_eq!(outputs[1], 0.4);
    let point = Point { states: &[], inputs: &point.inputs[..3], ..point };
    let costs = bound.cost.values(&point, &[]).outputs;
    assert!((costs[0] - (0.36 + 0.04)).abs() < 1e-12 && (costs[1] - 3.6).abs() < 1e-12, "{costs:?}");
}

#[test]
fn a_task_without_a_controller_has_a_cost_alone() {
    let text = "format = 1\nname = \"hold\"\n[task]\ncost = \"angle^2\"\n";
    let task = Task::parse(text, "t.toml").unwrap();
    assert!(!task.has_policy() && task.horizon.is_none() && task.to.is_none() && task.from == 0.0);
}

#[test]
fn names() {
    check("\"error^2 + small*u^2\"", "\"erorr^2\"", &["t.toml:5", "`cost`", "unknown name `erorr`"]);
    check("\"error^2 + small*u^2\"", "\"sum^2\"", &["t.toml:5", "`sum`", "a state of the controller"]);
    check(
        "goal - position",
        "goal - place",
        &["t.toml:23", "unknown name `place`", "output, an input or a signal"],
    );
    check("3*error + sum", "3*error + som", &["t.toml:30", "unknown name `som`"]);
    check("small = {", "error = {", &["t.toml:23", "`error` is already a parameter (line 17)"]);
}

#[test]
fn tables_and_values() {
    check("[task]", "[tusk]", &["t.toml:4", "`tusk`", "did you mean `task`?"]);
    check("cost = \"error^2 + small*u^2\"\n", "", &["t.toml:4", "`cost`", "\"angle^2\""]);
    check("horizon = 2.0", "horizon = 0.0", &["t.toml:10", "`horizon`", "0 is not above zero"]);
    check("to = 9.0", "to = 0.5", &["t.toml:9", "ends at 0.5 s and begins at 1 s"]);
    check("from = 1.0", "from = -1.0", &["t.toml:8", "before the recording's first stamp"]);
    check("latency = 0.004", "latency = -0.004", &["t.toml:14", "-0.004 is below zero"]);
    check("latency = 0.004", "delay = 0.004", &["t.toml:14", "`delay`", "rate, latency"]);
    check(
        "next = \"position\",",
        "next = \"position\", derivative = \"0\",",
        &["t.toml:27", "`derivative` already"],
    );
    check(
        "[outputs]\nu = { value = \"3*error + sum - 2*(position - last)\" }\n",
        "",
        &["t.toml:12", "[policy]", "[outputs]"],
    );
    check(
        "{ signal = \"target\" }",
        "{ signal = \"target\", supply = 3 }",
        &["t.toml:20", "`supply`", "signal"],
    );
    check(
        "small = { value = 0.01 }",
        "small = { value = 0.01, calibrate = [0.0, 1.0] }",
        &["t.toml:17", "`calibrate`"],
    );
    check("cost = \"error^2", "cost = \"error^^2", &["t.toml:5", "cost"]);
}
