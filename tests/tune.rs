//! Parameters and state of nodes that run: set, read and reset from outside, recorded, and replayed to the bit.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod live;

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;

use live::{eventually, parallax, start, under_way};
use parallax::runtime::launch::{End, Told};
use parallax::runtime::recording::{Change, ChangeKind, Recording};
use serde_json::Value;

/// What a command says that does what it is asked.
fn told(arguments: &[&str]) -> Told {
    let output = parallax(arguments).arg("--json").output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {text}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// What a command says that refuses.
fn refused(arguments: &[&str]) -> String {
    let output = parallax(arguments).output().unwrap();
    assert_eq!((output.status.code(), &*output.stdout), (Some(2), &b""[..]), "{arguments:?}");
    String::from_utf8(output.stderr).unwrap()
}

fn value(told: &Told, name: &str) -> f64 {
    told.parameters.iter().find(|(parameter, _)| parameter.name == name).unwrap().1
}

/// Whether each node's steps give the recorded bits, changes included.
fn replays_exactly(path: &Path) {
    let output = parallax(&["replay", path.to_str().unwrap(), "--json"]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{text}");
    assert_eq!(serde_json::from_str::<Value>(&text).unwrap()["exact"], true);
}

fn set(change: &Change) -> (&str, f64, f64) {
    match &change.kind {
        ChangeKind::Set { parameter, old, new, .. } => (parameter, *old, *new),
        ChangeKind::Reset => panic!("{change}"),
    }
}

#[test]
fn what_is_set_is_recorded_and_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let (run, name) = start("pendulum", &["--out", path.to_str().unwrap()]);
    under_way(&name);
    assert_eq!(value(&told(&["get", &name, "motor"]), "rated"), 4.0);
    let motor = told(&["set", &name, "motor.rated=0.25 V"]);
    assert_eq!(set(&motor.changes[0]), ("rated", 4.0, 0.25));
    let agent = told(&["set", &name, "agent.limit=3", "agent.excitation=1e-1V"]);
    let both: Vec<_> = agent.changes.iter().map(set).collect();
    assert_eq!(both, [("limit", 4.0, 3.0), ("excitation", 2.4, 0.1)]);
    assert_eq!(agent.changes[0].step, agent.changes[1].step, "before the same step");

    for (wrong, says) in [
        ("motor.rated=0", "above 0"),
        ("motor.rated=nan", "must be finite"),
        ("motor.rated=2 A", "in V, not in A"),
        ("motor.ratd=2", "did you mean `rated`"),
        ("mtor.rated=2", "did you mean `motor`"),
        ("camera.rated=2", "no parameters that can be set"),
        ("motor", "NODE.PARAMETER=VALUE"),
    ] {
        let text = refused(&["set", &name, wrong]);
        assert!(text.contains(says), "{wrong}: {text}");
    }
    // Together or not at all.
    refused(&["set", &name, "agent.limit=2", "agent.excitation=-1"]);
    assert!(refused(&["set", &name, "agent.limit=2", "motor.rated=3"]).contains("two nodes"));
    assert!(refused(&["reset", &name, "motor"]).contains("no state"));
    assert_eq!(value(&told(&["get", &name, "agent"]), "limit"), 3.0);

    // Somebody who speaks another language, too much, or not at all holds nobody up.
    let run_path = under_way(&name).path().to_owned();
    let door = run_path.join("door-of-run.socket");
    let _silent = UnixStream::connect(&door).unwrap();
    let mut garbage = UnixStream::connect(&door).unwrap();
    garbage.write_all(b"\xff\x00{}[[[[\n").unwrap();
    let mut answer = String::new();
    garbage.read_to_string(&mut answer).unwrap();
    assert!(answer.contains("no wish"), "{answer}");
    let mut endless = UnixStream::connect(&door).unwrap();
    while endless.write_all(&[b'x'; 65536]).is_ok() {}
    let last = told(&["set", &name, "motor.rated=0.5"]);
    eventually("the next steps", || (told(&["get", &name, "motor"]).step > last.step + 5).then_some(()));
    run.interrupt();
    let report = run.finish();
    assert_eq!(report.end, End::Signal);

    let recording = Recording::read(&path).unwrap();
    let expected: Vec<Change> = [motor.changes, agent.changes, last.changes].concat();
    assert_eq!(recording.changes, expected);
    let user =
        String::from_utf8(std::process::Command::new("id").arg("-u").output().unwrap().stdout).unwrap();
    assert!(expected[0].by.contains("process ") && !user.trim().is_empty(), "{:?}", expected[0]);
    // It took effect at that step: what the motor passes on is within the limit from there on, and was not before.
    let motor = recording.node("motor").unwrap();
    let largest = |steps: std::ops::Range<u64>| {
        let messages = motor.messages.iter().filter(|message| steps.contains(&message.seq));
        messages.map(|message| message.payload[0].abs()).fold(0.0, f64::max)
    };
    let (first, second) = (expected[0].step, expected[3].step);
    assert!(largest(first..second) <= 0.25 && largest(second..u64::MAX) <= 0.5);
    assert!(largest(0..first) > 0.5, "the limit made a difference");
    replays_exactly(&path);

    // A recording without its changes is not the same run.
    let mut forgotten = recording.clone();
    forgotten.changes.clear();
    let other = folder.path().join("forgotten.mcap");
    parallax::runtime::recording::write(&other, &forgotten).unwrap();
    let replay = parallax(&["replay", other.to_str().unwrap()]).output().unwrap();
    assert_eq!(replay.status.code(), Some(1));

    // Under the simulated clock, the same changes before the same steps; one seed gives the same bytes.
    let simulated = |name: &str, changes: &Path| {
        let out = folder.path().join(name);
        let (out_text, changes) = (out.to_str().unwrap().to_owned(), changes.to_str().unwrap());
        let arguments =
            ["sim", "pendulum-simulated", "--duration", "30", "--changes", changes, "--out", &out_text];
        let output = parallax(&arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        out
    };
    let (one, two) = (simulated("one.mcap", &path), simulated("two.mcap", &path));
    assert_eq!(std::fs::read(&one).unwrap(), std::fs::read(&two).unwrap());
    let again = Recording::read(&one).unwrap().changes;
    let key = |change: &Change| (change.node.clone(), change.step, set(change).2.to_bits());
    let sorted = |changes: &[Change]| {
        let mut keys: Vec<_> = changes.iter().map(key).collect();
        keys.sort();
        keys
    };
    assert_eq!(sorted(&again), sorted(&expected));
    replays_exactly(&one);
    let planned = simulated("three.mcap", &one);
    replays_exactly(&planned);
    assert_eq!(sorted(&Recording::read(&planned).unwrap().changes), sorted(&expected));
}

#[test]
fn a_plan_is_made_under_the_simulated_clock() {
    let folder = tempfile::tempdir().unwrap();
    let (plan, out) = (folder.path().join("plan.toml"), folder.path().join("sim.mcap"));
    let sim = |text: &str| {
        std::fs::write(&plan, text).unwrap();
        let (plan, out) = (plan.to_str().unwrap(), out.to_str().unwrap());
        let arguments = ["sim", "quadrotor-simulated", "--duration", "5", "--changes", plan, "--out", out];
        parallax(&arguments).output().unwrap()
    };
    let output = sim("[[change]]\nnode = \"agent\"\ntime = 2.0\nset = { height = 2.0, radius = 0.5 }\n\
                      [[change]]\nnode = \"pid\"\nstep = 100\nreset = true\nset = { integral = 0.0 }\n\
                      [[change]]\nnode = \"pid\"\nstep = 1000000\nreset = true\n");
    let warnings = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && warnings.contains("1 changes are planned for steps"), "{warnings}");
    let recording = Recording::read(&out).unwrap();
    let made: Vec<(&str, u64)> = recording.changes.iter().map(|c| (&*c.node, c.step)).collect();
    assert_eq!(made.iter().filter(|(node, step)| *node == "pid" && *step == 100).count(), 2, "{made:?}");
    let agent = recording.node("agent").unwrap();
    let first = recording.changes.iter().find(|change| change.node == "agent").unwrap();
    let step = agent.steps.iter().find(|step| step.start >= 2_000_000_000).unwrap();
    assert_eq!((first.step, first.time), (step.seq, step.start));
    let height = agent.layout.leaf("height").unwrap();
    for message in &agent.messages {
        assert_eq!(message.payload[height], if message.seq < first.step { 1.0 } else { 2.0 });
    }
    replays_exactly(&out);
    for (wrong, says) in [
        ("[[change]]\nnode = \"agent\"\ntime = 1.0\nset = { heigth = 2.0 }\n", "did you mean `height`"),
        ("[[change]]\nnode = \"agnt\"\ntime = 1.0\nset = { height = 2.0 }\n", "agnt"),
        ("[[change]]\nnode = \"agent\"\nset = { height = 2.0 }\n", "either `step` or `time`"),
        ("[[change]]\nnode = \"agent\"\nstep = 1\n", "changes nothing"),
        ("[[change]]\nnode = \"agent\"\nstop = 1\n", "line 3"),
    ] {
        let output = sim(wrong);
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && text.contains(says), "{wrong}: {text}");
    }
}

#[test]
fn a_node_that_comes_back_is_set_again_and_a_state_is_reset() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let settings = ["--out", path.to_str().unwrap(), "--set", "pid.restart=on-failure", "--set"];
    let (run, name) = start("quadrotor-simulated", &[&settings[..], &["pid.restart_delay=0.01"]].concat());
    let live = under_way(&name);
    told(&["set", &name, "pid.proportional=20000", "pid.integral=9000"]);
    let reset = told(&["reset", &name, "pid"]);
    assert_eq!(reset.changes[0].kind, ChangeKind::Reset);
    let read = told(&["get", &name, "pid"]);
    assert_eq!((value(&read, "proportional"), value(&read, "derivative")), (20_000.0, 15_000.0));
    assert!(read.step > reset.step && read.state[0].0 == "integral" && read.state[0].1.is_finite());

    let pid = || {
        let sample = live.sample();
        live.snapshot(&sample, &sample).nodes.into_iter().find(|node| node.node == "pid").unwrap()
    };
    let process = rustix::process::Pid::from_raw(pid().process.unwrap() as i32).unwrap();
    rustix::process::kill_process(process, rustix::process::Signal::KILL).unwrap();
    eventually("the restart", || (pid().restarts == 1).then_some(()));
    let read = eventually("the node", || {
        let output = parallax(&["get", &name, "pid", "--json"]).output().unwrap();
        serde_json::from_slice::<Told>(&output.stdout).ok()
    });
    assert_eq!((value(&read, "proportional"), value(&read, "integral")), (20_000.0, 9_000.0));
    run.interrupt();
    run.finish();
    let recording = Recording::read(&path).unwrap();
    let again: Vec<&Change> = recording.changes.iter().filter(|c| c.by.contains("after a restart")).collect();
    assert_eq!(again.len(), 2, "{:?}", recording.changes);
    assert_eq!(set(again[0]), ("proportional", 25_000.0, 20_000.0));
    replays_exactly(&path);
}
