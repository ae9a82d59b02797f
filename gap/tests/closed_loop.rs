//! The closed-loop score against machines of an independent simulation: what the task costs there is what the corrected
//! system predicts, and not what the nominal one does.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::VecDeque;

use parallax_gap::closed_loop::{ClosedLoop, ClosedLoopError, Controlled, Corrections, prepare};
use parallax_gap::report::Interval;
use parallax_model::system::{EffectEntry, System, Task};
use parallax_nodes::pendulum::{self, hidden::HiddenEffect};
use parallax_runtime::recording::log::{Log, Role, Signal};
use parallax_runtime::registry::Registry;
use parallax_sim::Executor;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SYSTEM: &str = r#"
format = 1
name = "carriage"
[parameters]
m = { value = 2.0, unit = "kg" }
b = { value = 1.5, unit = "N s/m" }
[inputs]
force = { signal = "force" }
[state]
q = { derivative = "v" }
v = { derivative = "(force - b*v)/m" }
[outputs]
position = { value = "q", unit = "m" }
[joints]
rail = { position = "q", velocity = "v", inertia = "m", drive = "force" }
"#;

const TASK: &str = r#"
format = 1
name = "follow the course"
[task]
cost = "error^2"
unit = "m^2"
horizon = 2.0
[let]
error = "course - position"
speed = "(position - last)/0.01"
[state]
last = { next = "position", initial = "position" }
[outputs]
force = { value = "clamp(60*error - 14*speed, -40, 40)" }
"#;

/// A carriage that a controller at 100 Hz moves after steps, integrated by steps of 0.1 ms (semi-implicit Euler).
#[derive(Clone, Copy)]
struct Carriage {
    /// How late a command acts (s).
    delay: f64,
    /// Viscous friction beyond the 1.5 N s/m that the nominal system knows.
    viscous: f64,
    /// Gains of the controller (N/m, N s/m), and how old a position is that it knows (steps).
    gains: (f64, f64),
    old: usize,
    limit: f64,
}

const FOLLOWER: Carriage = Carriage { delay: 0.0, viscous: 0.0, gains: (60.0, 14.0), old: 0, limit: 40.0 };

impl Carriage {
    fn record(self, seed: u64, duration: f64) -> Log {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut noise = || 5e-4 * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0);
        let (mut q, mut v, mut acts) = (0.0, 0.0, 0.0);
        let mut queue: VecDeque<(f64, f64)> = VecDeque::new();
        let (mut times, mut forces, mut positions, mut courses) = (vec![], vec![], vec![], vec![]);
        for k in 0..(duration * 1e4) as usize {
            let t = k as f64 * 1e-4;
            if k % 100 == 0 {
                let course = 0.2 * (1.3 * t).sin().signum() + 0.1 * (5.1 * t).sin();
                positions.push(q + noise());
                let seen = |back: usize| positions[(positions.len() - 1).saturating_sub(back)];
                let speed = (seen(self.old) - seen(self.old + 1)) / 0.01;
                let force: f64 = self.gains.0 * (course - seen(self.old)) - self.gains.1 * speed;
                let force = force.clamp(-self.limit, self.limit);
                queue.push_back((t + self.delay, force));
                times.push(k as i64 * 100_000);
                forces.push(force);
                courses.push(course);
            }
            while queue.front().is_some_and(|(due, _)| *due <= t + 1e-9) {
                acts = queue.pop_front().unwrap().1;
            }
            v += 1e-4 * (acts - (1.5 + self.viscous) * v) / 2.0;
            q += 1e-4 * v;
        }
        let signals = vec![
            Signal::new("force", Role::Command, "N", times.clone(), forces),
            Signal::new("position", Role::Measurement, "m", times.clone(), positions),
            Signal::new("course", Role::Reference, "m", times, courses),
        ];
        Log { title: "carriage".into(), signals, ..Log::default() }
    }
}

fn effect(name: &str, place: &str, parameter: &str, value: f64) -> EffectEntry {
    EffectEntry {
        name: name.into(),
        place: place.into(),
        parameters: vec![(parameter.into(), value)],
        smoothing: None,
        line: 0,
    }
}

fn scored(task: &str, log: Log, effects: &[EffectEntry]) -> ClosedLoop {
    let (task, system) = (Task::parse(task, "task.toml").unwrap(), System::parse(SYSTEM, "s.toml").unwrap());
    let prepared = prepare(&task, &system, &[log], None, None).unwrap();
    prepared.scores(Corrections { effects, ..Corrections::default() }, 1).unwrap()
}

fn holds(interval: &Interval, value: f64) -> bool {
    interval.low <= value && value <= interval.high
}

#[test]
fn a_late_command_raises_the_cost_and_only_the_corrected_system_says_so() {
    let log = Carriage { delay: 0.06, ..FOLLOWER }.record(1, 20.0);
    let found = scored(TASK, log, &[effect("delay", "input:force", "delay", 0.06)]);
    assert_eq!((found.controller, found.episodes, found.horizon_s), (Controlled::Policy, 10, 2.0));
    assert!(found.miss.unwrap() < 1e-6, "the controller is the one that ran: {:?}", found.miss);
    let recorded = found.recorded.value;
    assert!(found.recorded.low < recorded && recorded < found.recorded.high);
    let (nominal, with) = (&found.nominal, found.with_effect.as_ref().unwrap());
    assert_eq!(found.nominal, found.refitted);
    let difference = nominal.difference.as_ref().unwrap();
    assert!(!nominal.agrees && difference.high < -0.05 * recorded, "{difference:?} of {recorded}");
    assert!(with.agrees && holds(with.score.as_ref().unwrap(), recorded), "{with:?} for {recorded}");
    assert!(with.difference.as_ref().unwrap().value.abs() < 0.01 * recorded, "{with:?} for {recorded}");
    assert!(found.closed.as_ref().unwrap().value > 0.9, "{:?}", found.closed);
    // Plots show the first episode.
    assert_eq!(found.episode[0].output, "position");
    assert!(found.episode[0].stamp.iter().all(|t| (0.0..2.0).contains(t)));
}

#[test]
fn a_late_sensor_closes_the_loop_as_a_late_command_does() {
    // With one sensor the two are the same loop, and the same readings.
    let log = Carriage { delay: 0.06, ..FOLLOWER }.record(1, 20.0);
    let found = scored(TASK, log, &[effect("delay", "output:position", "delay", 0.06)]);
    let with = found.with_effect.as_ref().unwrap();
    assert!(with.agrees && with.lost == 0, "{with:?}");
    assert!(with.difference.as_ref().unwrap().value.abs() < 0.01 * found.recorded.value, "{with:?}");
}

#[test]
fn where_nothing_is_wrong_the_nominal_system_predicts_the_recorded_score() {
    let found = scored(TASK, FOLLOWER.record(2, 20.0), &[]);
    let difference = found.nominal.difference.as_ref().unwrap();
    assert!(difference.value.abs() < 0.01 * found.recorded.value, "{difference:?} of {:?}", found.recorded);
    assert!(found.with_effect.is_none() && found.closed.is_none());
}

#[test]
fn an_unstable_loop_is_said_to_be_one() {
    // Friction alone keeps this loop from swinging up: the controller acts on old positions, without damping.
    let rough = Carriage { viscous: 8.0, gains: (60.0, 0.0), old: 10, limit: f64::INFINITY, ..FOLLOWER };
    let task = r#"
format = 1
name = "hold"
[task]
cost = "(position - course)^2"
[policy]
latency = 0.1
[let]
goal = "0.2*sign(sin(1.3*time)) + 0.1*sin(5.1*time)"
[outputs]
force = { value = "60*(goal - position)" }
"#;
    let found = scored(task, rough.record(3, 15.0), &[effect("viscous", "joint:rail", "coefficient", 8.0)]);
    let nominal = &found.nominal;
    assert_eq!((nominal.lost, nominal.of), (20, 20), "{nominal:?}");
    assert!(nominal.score.is_none() && nominal.difference.is_none() && !nominal.agrees);
    let with = found.with_effect.as_ref().unwrap();
    assert_eq!(with.lost, 0);
    assert!(with.difference.as_ref().unwrap().value.abs() < 0.05 * found.recorded.value, "{with:?}");
    let json = serde_json::to_value(&found).unwrap();
    assert!(json["nominal"]["score"].is_null() && json["with_effect"]["score"]["value"].is_f64());
    assert_eq!(serde_json::from_value::<ClosedLoop>(json).unwrap().nominal, found.nominal);
}

#[test]
fn the_same_seed_gives_the_same_scores_on_any_number_of_threads() {
    let delay = [effect("delay", "input:force", "delay", 0.06)];
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scored(TASK, Carriage { delay: 0.06, ..FOLLOWER }.record(1, 6.0), &delay))
    };
    assert_eq!(on(1), on(8));
}

#[test]
fn a_controller_that_did_not_run_is_noticed() {
    let found = scored(&TASK.replace("60*error", "90*error"), FOLLOWER.record(2, 10.0), &[]);
    assert!(found.miss.unwrap() > 0.2, "{:?}", found.miss);
}

/// A recorded pendulum that its agent balances; its world acts on commands late by what `effect` says.
#[test]
fn a_recorded_graph_closes_its_own_loop() {
    let delay = 0.02;
    let mut spec = pendulum::graph();
    let agent = spec.node_mut("agent").unwrap();
    agent.parameters.insert("balance_only".into(), true.into());
    let registry = pendulum::kinds(Registry::new(), HiddenEffect::Delay { delay });
    let graph = spec.validate(&registry).unwrap();
    let recording = Executor::new(graph, 5).record(10_000_000_000).unwrap();
    let task = "format = 1\nname = \"upright\"\n[task]\ncost = \"1 - cos(angle)\"\nfrom = 2.0\n";
    let task = Task::parse(task, "task.toml").unwrap();
    let system = System::parse(pendulum::SYSTEM, "system.toml").unwrap();
    let logs = [recording.log()];
    let prepared = prepare(&task, &system, &logs, Some((&recording, &registry)), None).unwrap();
    // What the world is made of, apart from the effect.
    let constants = [("J".to_owned(), 1.62e-4), ("K".to_owned(), 0.0337)];
    let effects = [effect("delay", "input:voltage", "delay", delay)];
    let corrections = Corrections { refitted: &constants, calibrated: &constants, effects: &effects };
    let found = prepared.scores(corrections, 1).unwrap();
    assert_eq!((found.controller, found.episodes, found.miss), (Controlled::Graph, 1, None));
    let (without, with) = (&found.refitted, found.with_effect.as_ref().unwrap());
    assert!(!without.agrees, "{without:?} for {:?}", found.recorded);
    assert!(with.agrees, "{with:?} for {:?}", found.recorded);
}

#[test]
fn a_graph_whose_sensor_says_more_than_the_system_is_refused() {
    let registry = pendulum::kinds(Registry::new(), HiddenEffect::None);
    let graph = pendulum::graph().validate(&registry).unwrap();
    let recording = Executor::new(graph, 5).record(3_000_000_000).unwrap();
    let task = "format = 1\nname = \"upright\"\n[task]\ncost = \"angle^2\"\n";
    let task = Task::parse(task, "task.toml").unwrap();
    let logs = [recording.log()];
    let refused = |from: &str, to: &str| {
        let system = System::parse(&pendulum::SYSTEM.replace(from, to), "system.toml").unwrap();
        match prepare(&task, &system, &logs, Some((&recording, &registry)), None) {
            Ok(_) => panic!("the system was accepted"),
            Err(error) => error.to_string(),
        }
    };
    let message = refused("camera.angle", "estimator.angle");
    assert!(
        message.contains("node `estimator` sends `speed`") && message.contains("estimator.speed"),
        "{message}"
    );
    let mean = refused("signal = \"motor.voltage\"", "mean_of = [\"motor.voltage\", \"agent.voltage\"]");
    assert!(mean.contains("`voltage`") && mean.contains("motor.voltage and agent.voltage"), "{mean}");
}

fn refused(task: &str) -> ClosedLoopError {
    let system = System::parse(SYSTEM, "s.toml").unwrap();
    let task = Task::parse(task, "task.toml").unwrap();
    let Err(error) = prepare(&task, &system, &[FOLLOWER.record(1, 5.0)], None, None) else {
        panic!("the task was accepted")
    };
    error
}

#[track_caller]
fn check(from: &str, to: &str, expected: &[&str]) {
    assert!(TASK.contains(from), "the task has no `{from}`");
    let message = refused(&TASK.replacen(from, to, 1)).to_string();
    for part in expected {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn tasks_that_do_not_fit_their_machine_are_refused_with_the_place_and_a_remedy() {
    check(
        "\"error^2\"",
        "\"(course - positon)^2\"",
        &["task.toml:5", "unknown name `positon`", "did you mean `position`"],
    );
    check("\"error^2\"", "\"last^2\"", &["task.toml:5", "`last`", "state of the controller"]);
    check(
        "force = { value",
        "push = { value",
        &["task.toml:14", "`push`", "no input of the system `carriage`", "force"],
    );
    check(
        "\"error^2\"",
        "\"log(error)\"",
        &["task.toml:5", "the cost of the recording `carriage` is NaN", "position = "],
    );
    check("horizon = 2.0", "horizon = 9.0", &["task.toml", "0 to 9 s", "ends at 4.99 s"]);
    check("horizon = 2.0", "from = 7.0", &["7 to", "ends at 4.99 s"]);
    check("initial = \"position\" }", "}", &["task.toml:12", "`last`", "initial = 0.0"]);
    check(
        "[let]",
        "[inputs]\ngoal = { signal = \"gaol\" }\n[let]",
        &["task.toml:9", "`goal`", "no signal `gaol`"],
    );
    let message =
        refused(&TASK[..TASK.find("[state]").unwrap()].replace("speed = \"(position - last)/0.01\"", ""))
            .to_string();
    assert!(message.contains("task.toml") && message.contains("[outputs]"), "{message}");
}
