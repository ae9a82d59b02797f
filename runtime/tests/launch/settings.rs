//! Launch settings: what they do to the nodes of a run, and what is said about those that cannot be.

use parallax_runtime::launch::{End, LaunchSpec, Mode, RunError, RunOptions, run};

use crate::Test;
use crate::nodes::{Place, graph, place_of, registry};
use crate::runs::options;

pub(crate) const TESTS: &[Test] = &[
    ("settings_reach_every_node", settings_reach_every_node),
    ("threads_and_processes_mix", threads_and_processes_mix),
    ("the_command_line_goes_before_the_file", changes_go_before_the_file),
    ("settings_that_cannot_be_are_named", settings_that_cannot_be_are_named),
    ("what_the_system_refuses_stops_the_run_if_asked", refusals_stop_the_run_if_asked),
    ("a_node_that_polls_shares_no_core", a_node_that_polls_shares_no_core),
    ("a_node_that_polls_under_fifo_can_be_stopped", a_node_that_polls_under_fifo_can_be_stopped),
];

pub(crate) fn launch(text: &str) -> LaunchSpec {
    LaunchSpec::from_toml("launch.toml", text).unwrap()
}

/// The graph whose counter says where it runs, under these settings: what it says, and the warnings.
fn placed(settings: &str) -> (Place, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut graph = graph();
    graph.node_mut("counter").unwrap().kind = "place".into();
    let options = RunOptions { launch: launch(settings), ..options(0.3, &path) };
    let report = run(&graph, &registry(), options).unwrap();
    assert!(report.clean(), "{report:?}");
    (place_of(&path, "counter"), report.warnings)
}

fn settings_reach_every_node() {
    let core = core_affinity::get_core_ids().unwrap().last().unwrap().id;
    let settings = format!(
        "[defaults]\nlock_memory = true\npolicy = \"rr\"\npriority = 7\n[node.counter]\ncore = {core}\npriority = 9\n"
    );
    let (place, warnings) = placed(&settings);
    assert_eq!(place.core, core as f64);
    assert!(place.alone, "pinned to one core");
    let refused = |what: &str| warnings.iter().any(|w| w.contains("counter") && w.contains(what));
    assert!(
        (place.policy, place.priority) == (f64::from(libc::SCHED_RR), 9.0) || refused("SCHED_RR"),
        "{place:?}"
    );
    assert!(place.locked || refused("paged out"), "{place:?} {warnings:?}");
    // Without settings a node is like any program.
    let (place, _) = placed("");
    assert_eq!((place.policy, place.priority, place.locked), (f64::from(libc::SCHED_OTHER), 0.0, false));
}

fn threads_and_processes_mix() {
    let own = f64::from(std::process::id());
    assert_eq!(placed("[node.counter]\nrun_as = \"thread\"\n").0.process, own);
    assert_ne!(placed("[node.adder]\nrun_as = \"thread\"\n").0.process, own);
}

fn changes_go_before_the_file() {
    let mut spec = launch("[defaults]\nrestart = \"always\"\n[node.a]\npriority = 3\npolicy = \"fifo\"\n");
    for change in ["a.priority=5", "defaults.policy=rr", "b.safe={ torque = 0 }", "b.heartbeat=inf"] {
        spec.change(change).unwrap();
    }
    let expected = "[defaults]\nrestart = \"always\"\npolicy = \"rr\"\n[node.a]\npriority = 5\n\
                    [node.b]\nsafe = { torque = 0 }\nheartbeat = inf\n";
    assert_eq!(spec, launch(expected));
    for (change, says) in [
        ("a", "NODE.SETTING=VALUE"),
        ("a.prio=5", "unknown field"),
        ("a.policy=fast", "unknown variant `fast`"),
        ("a.core=-1", "-1"),
    ] {
        let error = spec.change(change).unwrap_err().to_string();
        assert!(error.contains(change) && error.contains(says), "{error}");
    }
}

fn settings_that_cannot_be_are_named() {
    let refuse = |text: &str, parts: &[&str]| {
        let says = match LaunchSpec::from_toml("robot/launch.toml", text) {
            Err(error) => error.to_string(),
            Ok(launch) => {
                let error =
                    run(&graph(), &registry(), RunOptions { launch, ..RunOptions::default() }).unwrap_err();
                assert!(matches!(error, RunError::Settings(_) | RunError::Graph(_)), "{error}");
                error.to_string()
            }
        };
        parts.iter().for_each(|part| assert!(says.contains(part), "{text}: {says}"));
    };
    let file = "robot/launch.toml";
    refuse("[defaults]\npolcy = \"fifo\"\n", &[file, "polcy", "line 2"]);
    refuse("[node.counter]\npolicy = \"fast\"\n", &[file, "fast", "fifo", "line 2"]);
    refuse("[node.conter]\ncore = 0\n", &[file, "node.conter", "did you mean `counter`?"]);
    refuse("[node.counter]\npriority = 7\n", &[file, "node.counter", "priority", "policy = \"other\""]);
    refuse("[node.counter]\npolicy = \"fifo\"\npriority = 100\n", &["node.counter", "priority", "1 and 99"]);
    refuse("[node.counter]\ncore = 5000\n", &["node.counter", "core", "5000"]);
    refuse("[defaults]\ncore = 0\n", &["[defaults] core", "one node"]);
    refuse("[node.counter]\nwait = \"block\"\nspin = 0.1\n", &["node.counter", "spin", "spin-then-block"]);
    refuse("[node.counter]\ndeadline = -1\n", &["node.counter", "deadline"]);
    refuse(
        "[node.counter]\non_deadline = \"stop\"\n",
        &["node.counter", "on_deadline", "deadline = SECONDS"],
    );
    refuse("[node.counter]\ndeadline = 1\non_deadline = \"safe\"\n", &["on_deadline", "safe output"]);
    refuse("[node.counter]\nrestart_limit = 2\n", &["node.counter", "restart_limit", "on-failure"]);
    refuse("[node.counter]\non_hang = \"restart\"\n", &["node.counter", "on_hang", "on-failure"]);
    refuse(
        "[node.counter]\non_hang = \"restart\"\nrestart = \"always\"\nrun_as = \"thread\"\n",
        &["node.counter", "on_hang", "process"],
    );
    refuse("[node.counter]\nheartbeat = 0.001\n", &["node.counter", "heartbeat", "0.05"]);
    refuse("[node.counter]\nsafe = { valu = 1 }\n", &["counter", "valu", "did you mean `value`?"]);
    refuse("[node.counter]\nsafe = {}\n", &["counter", "`value`", "hold"]);
    refuse("[node.counter]\nsafe = { value = nan }\n", &["counter", "`value`", "finite"]);
    refuse("[node.counter]\nsafe = { value = \"stay\" }\n", &[file, "stay", "hold"]);
}

fn refusals_stop_the_run_if_asked() {
    // A core that this machine lacks, and that another may have.
    let missing = core_affinity::get_core_ids().unwrap().iter().map(|core| core.id).max().unwrap() + 1;
    let settings = format!("[node.counter]\ncore = {missing}\n");
    let (_, warnings) = placed(&settings);
    let says = |text: &str| text.contains("counter") && text.contains(&format!("core {missing}"));
    assert!(warnings.iter().any(|warning| says(warning)), "{warnings:?}");
    let options =
        RunOptions { launch: launch(&format!("refused = \"stop\"\n{settings}")), ..RunOptions::default() };
    let error = run(&graph(), &registry(), options).unwrap_err();
    assert!(matches!(&error, RunError::Refused { refused } if refused.len() == 1), "{error}");
    assert!(says(&error.to_string()) && error.to_string().contains("refused"), "{error}");
}

fn a_node_that_polls_shares_no_core() {
    let core = core_affinity::get_core_ids().unwrap()[0].id;
    let settings = format!("[node.counter]\nwait = \"spin\"\ncore = {core}\n[node.adder]\ncore = {core}\n");
    for mode in [Mode::Processes, Mode::Threads] {
        let options = RunOptions {
            duration: Some(100_000_000),
            launch: launch(&settings),
            mode,
            ..RunOptions::default()
        };
        let report = run(&graph(), &registry(), options).unwrap();
        let says =
            |warning: &&String| warning.contains("counter was to poll always") && warning.contains("adder");
        assert!(report.warnings.iter().any(|warning| says(&warning)), "{:?}", report.warnings);
    }
}

fn a_node_that_polls_under_fifo_can_be_stopped() {
    let settings = "[node.counter]\nwait = \"spin\"\npolicy = \"fifo\"\npriority = 50\n";
    for mode in [Mode::Processes, Mode::Threads] {
        let stop = |progress: parallax_runtime::launch::Progress| progress.elapsed < 200_000_000;
        let options = RunOptions {
            launch: launch(settings),
            mode,
            progress: Some(Box::new(stop)),
            ..RunOptions::default()
        };
        let report = run(&graph(), &registry(), options).unwrap();
        assert_eq!(report.end, End::Signal);
        assert!(report.clean() && report.nodes[0].steps > 20, "{report:#?}");
    }
}
