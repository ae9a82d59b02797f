//! A graph on several machines: network namespaces with cables between them, all but the first with a monotonic clock that is
//! thousands of seconds ahead (`unshare --time`), and the faults that a cable, a machine and a stranger can bring.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use command::fail;
use parallax::runtime::graph::{ConnectionSpec, NodeSpec};
use parallax::runtime::launch::{Exit, RunReport};
use parallax::runtime::recording::{Fault, FaultKind, Recording};
use parallax::runtime::time::to_seconds;

/// What the clock of the second machine shows more, s.
const AHEAD: i64 = 5000;

/// The machines, in the order of their addresses. The first one's clock is that of these tests.
const MACHINES: [&str; 3] = ["desk", "plant", "arm"];

/// Machines with a cable between each two of them.
struct Cable {
    names: Vec<String>,
    folder: tempfile::TempDir,
}

/// The address of a machine.
fn address(machine: usize) -> String {
    format!("10.231.7.{}", machine + 1)
}

fn ip(arguments: &[&str]) {
    let output = Command::new("ip").args(arguments).output();
    let refused = match &output {
        Ok(output) if output.status.success() => return,
        Ok(output) => String::from_utf8_lossy(&output.stderr).into_owned(),
        Err(error) => error.to_string(),
    };
    panic!(
        "`ip {}`: {refused}\nThis test makes network namespaces: it has to run as root, in a container with the capabilities \
         NET_ADMIN and SYS_ADMIN (docker run --privileged), and with iproute2 and util-linux installed",
        arguments.join(" ")
    );
}

impl Cable {
    /// Between two machines.
    fn lay() -> Self {
        Self::between(2)
    }

    fn between(machines: usize) -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = |machine: usize| format!("plx{}-{number}-{machine}", std::process::id());
        let cable = Self { names: (0..machines).map(name).collect(), folder: tempfile::tempdir().unwrap() };
        for name in &cable.names {
            ip(&["netns", "add", name]);
            ip(&["-n", name, "link", "set", "lo", "up"]);
        }
        for (a, b) in (0..machines).flat_map(|b| (0..b).map(move |a| (a, b))) {
            let (here, there) = (&cable.names[a], &cable.names[b]);
            let (to_b, to_a) = (format!("to{b}"), format!("to{a}"));
            ip(&["link", "add", &to_b, "netns", here, "type", "veth", "peer", "name", &to_a, "netns", there]);
            for (name, end, own, other) in [(here, &to_b, a, b), (there, &to_a, b, a)] {
                ip(&["-n", name, "addr", "add", &address(own), "peer", &address(other), "dev", end]);
                ip(&["-n", name, "link", "set", end, "up"]);
            }
        }
        fs::write(cable.path("graph.toml"), graph()).unwrap();
        for machine in &MACHINES[..machines] {
            fs::create_dir(cable.path(machine)).unwrap();
            cable.secret(machine, "a word that nobody guesses");
            cable.settings(machine, "");
        }
        cable
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn secret(&self, machine: &str, word: &str) {
        let path = self.path(machine).join("link.secret");
        fs::write(&path, word).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    }

    fn settings(&self, machine: &str, link: &str) {
        fs::write(self.path(machine).join("launch.toml"), settings(link)).unwrap();
    }

    /// Starts the run on a machine.
    fn start(&self, machine: &str, more: &[&str]) -> Run {
        let place = MACHINES.iter().position(|name| *name == machine).unwrap();
        self.start_with_clock(machine, place as i64 * AHEAD, more)
    }

    /// The same, with a clock that is so far ahead.
    fn start_with_clock(&self, machine: &str, ahead: i64, more: &[&str]) -> Run {
        let place = MACHINES.iter().position(|name| *name == machine).unwrap();
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.names[place]]);
        if ahead != 0 {
            command.args(["unshare", "--time", "--fork", "--kill-child"]);
            command.args([format!("--monotonic={ahead}"), format!("--boottime={ahead}")]);
        }
        command.arg(env!("CARGO_BIN_EXE_parallax")).args(["run", self.path("graph.toml").to_str().unwrap()]);
        command.arg("--launch").arg(self.path(machine).join("launch.toml"));
        command.args(["--host", machine, "--json"]).args(more);
        if machine == "desk" {
            command.arg("--out").arg(self.path("run.mcap"));
        }
        Run(Some(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()))
    }

    fn set_link(&self, state: &str) {
        ip(&["-n", &self.names[0], "link", "set", "to1", state]);
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        for name in &self.names {
            let _ = Command::new("ip").args(["netns", "del", name]).status();
        }
    }
}

/// A run that does not outlive its test.
struct Run(Option<Child>);

impl Drop for Run {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Run {
    fn output(mut self) -> Output {
        self.0.take().unwrap().wait_with_output().unwrap()
    }

    #[track_caller]
    fn report(self) -> (RunReport, Option<i32>, String) {
        let output = self.output();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!errors.contains("panicked"), "{errors}");
        let report =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {errors}"));
        (report, output.status.code(), errors)
    }
}

/// The ready-made pendulum, with a safe output of the agent.
fn graph() -> String {
    let mut spec = parallax::nodes::graph("pendulum").unwrap();
    spec.name = "pendulum-far".into();
    spec.to_toml().unwrap()
}

fn settings(link: &str) -> String {
    format!(
        r#"
        [link]
        secret = "link.secret"
        recorder = "desk"
        {link}

        [host.desk]
        address = "10.231.7.1:7447"
        [host.plant]

        [node.world]
        host = "plant"
        [node.camera]
        host = "plant"
        [node.motor]
        host = "plant"
        [node.estimator]
        host = "desk"
        [node.agent]
        host = "desk"
        safe = {{ voltage = 0.0 }}
        "#
    )
}

/// What became of the messages of every input of the nodes on this machine adds up.
#[track_caller]
fn adds_up(report: &RunReport, nodes: &[&str]) {
    for node in report.nodes.iter().filter(|node| nodes.contains(&node.node.as_str())) {
        for input in &node.inputs {
            let lost: u64 = input
                .lost
                .iter()
                .filter(|(reason, _)| reason.name() != "malformed")
                .map(|(_, count)| count)
                .sum();
            let sum = input.consumed + input.superseded + input.in_flight + lost;
            assert_eq!(input.sent, sum, "{} -> {}: {input:?}", input.from, node.node);
            assert!(input.sent > 0, "{} -> {}: {input:?}", input.from, node.node);
        }
    }
}

fn until_recorded(path: &Path) {
    let start = Instant::now();
    while fs::metadata(path).map_or(0, |metadata| metadata.len()) < 20_000 {
        assert!(start.elapsed() < Duration::from_secs(60), "nothing is recorded");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_graph_on_two_machines_is_recorded_in_one_file_and_replays() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "3"]);
    let desk = cable.start("desk", &["--duration", "3"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    // Each machine knows of the other's nodes.
    for report in [&desk, &plant] {
        assert!(report.nodes.iter().all(|node| node.steps > 100 && node.exit == Exit::Clean), "{report:#?}");
        let link = report.link.as_ref().unwrap();
        assert_eq!((link.silences, &link.problem), (0, &None), "{link:?}");
        assert!(link.crossings.iter().all(|crossing| crossing.malformed == 0), "{link:?}");
    }
    let link = desk.link.unwrap();
    let camera = link.crossings.iter().find(|crossing| crossing.channel == "camera").unwrap();
    assert!(camera.received > 250, "{camera:?}");

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    assert_eq!(recording.hosts["motor"], "plant");
    assert!(recording.nodes.iter().all(|track| track.steps.len() > 100), "a node is not recorded");
    // The clocks: what the kernel was told is the truth.
    let readings: Vec<_> = recording.clocks.iter().collect();
    assert!(readings.iter().any(|reading| reading.host == "plant" && reading.other == "desk"));
    assert!(readings.iter().filter(|reading| reading.host == "desk").count() > 2, "{readings:?}");
    for reading in readings {
        let truth = if reading.host == "desk" { AHEAD } else { -AHEAD } * 1_000_000_000;
        assert!((reading.offset - truth).abs() <= reading.bound, "{reading:?}");
        assert!(reading.skew.abs() <= reading.skew_bound, "{reading:?}");
        assert!(reading.ahead.abs() < 20_000_000 && reading.bound < 20_000_000, "{reading:?}");
    }
    for (from, to) in [("camera", "estimator"), ("agent", "motor")] {
        let bound = recording.clock_bound(from, to).expect("it crosses");
        let steps = &recording.node(to).unwrap().steps;
        let port = recording.graph.connections.iter().find(|c| c.from == from && c.to == to).unwrap().port();
        let consumed = steps.iter().flat_map(|step| &step.inputs).filter(|input| input.port == port);
        let sender = recording.node(from).unwrap();
        let mut seen = 0;
        for message in consumed.flat_map(|input| &input.consumed) {
            let Some(seq) = message.seq else { continue };
            seen += 1;
            assert!(message.sent <= message.received, "{from} -> {to}: {message:?}");
            // The receiver's statement of when it was sent agrees with the sender's to within what the clocks allow.
            let there = sender.message(seq).unwrap().sent;
            assert!(
                (message.sent - there).abs() < 20_000_000 + bound,
                "{from} -> {to}: {message:?}, {there}"
            );
        }
        assert!(seen > 50, "{from} -> {to}");
    }
    let replay = command::json(cable.folder.path(), &["replay", path.to_str().unwrap(), "--json"]);
    assert_eq!(replay["exact"], true, "{replay}");
    let info = command::succeed(cable.folder.path(), &["info", path.to_str().unwrap()]);
    assert!(
        info.contains("machine plant: camera, motor, world") && info.contains("clock of plant"),
        "{info}"
    );
}

#[test]
fn a_cable_that_is_out_for_a_second_and_garbage_on_the_port_cost_messages_that_are_counted() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "7"]);
    let desk = cable.start("desk", &["--duration", "7"]);
    until_recorded(&cable.path("run.mcap"));
    // Somebody who has no business here. `nc` is not everywhere, and bash is.
    let garbage = "exec 3<>/dev/tcp/10.231.7.1/7447; head -c 100000 /dev/urandom >&3; sleep 0.3";
    let stranger = Command::new("ip")
        .args(["netns", "exec", &cable.names[1], "bash", "-c", garbage])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    cable.set_link("down");
    std::thread::sleep(Duration::from_secs(1));
    cable.set_link("up");
    drop(stranger.wait_with_output());
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    assert!(
        errors.contains("machine plant has been silent") && errors.contains("is heard again"),
        "{errors}"
    );
    assert!(plant_errors.contains("machine desk has been silent"), "{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    // The motor stood on the agent's safe output meanwhile, and went on with commands afterwards.
    let motor = plant.nodes.iter().find(|node| node.node == "motor").unwrap();
    assert!(motor.inputs[0].safe > 0, "{motor:?}");
    assert!(motor.inputs[0].consumed > 150, "{motor:?}");
    let lost = |report: &RunReport| report.nodes.iter().map(|node| node.inputs.clone()).collect::<Vec<_>>();
    let recording = Recording::read(cable.path("run.mcap")).unwrap();
    assert_eq!(recording.truncated, None, "{:?}", lost(&desk));
}

#[test]
fn a_machine_that_is_gone_ends_the_run_and_the_recording_is_kept() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0");
    }
    let mut plant = cable.start("plant", &["--duration", "60"]);
    let desk = cable.start("desk", &["--duration", "60"]);
    until_recorded(&cable.path("run.mcap"));
    // With the cable out, nothing can be said any more.
    cable.set_link("down");
    drop(plant.0.as_mut().unwrap().kill());
    let (desk, code, errors) = desk.report();
    assert_eq!(code, Some(3), "{errors}");
    assert!(errors.contains("error: machine plant: it has been silent for"), "{errors}");
    assert!(desk.nodes.iter().any(|node| node.node == "agent" && node.exit == Exit::Clean), "{desk:#?}");
    let recording = Recording::read(cable.path("run.mcap")).unwrap();
    assert!(recording.truncated.is_none() && recording.node("motor").unwrap().steps.len() > 10);
    assert!(to_seconds(recording.duration) < 50.0);
}

#[test]
fn a_link_that_is_killed_ends_the_run_on_both_machines() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "60"]);
    let desk = cable.start("desk", &["--duration", "60"]);
    until_recorded(&cable.path("run.mcap"));
    let launcher = desk.0.as_ref().unwrap().id();
    let children = fs::read_to_string(format!("/proc/{launcher}/task/{launcher}/children")).unwrap();
    let is_link = |pid: &&str| {
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.contains("@link")
    };
    let link = children.split_whitespace().find(is_link).expect("the link is a process of its own");
    assert!(Command::new("kill").args(["-KILL", link]).status().unwrap().success());
    let ((_, code, errors), (_, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(3), Some(3)), "{errors}\n{plant_errors}");
    assert!(errors.contains("the link to the other machines ended: process"), "{errors}");
    assert!(plant_errors.contains("machine desk: it has been silent"), "{plant_errors}");
}

/// A machine loses its power: nothing of it is left, and its clock begins anew.
fn cut(run: &mut Run) {
    let process = run.0.as_mut().unwrap();
    process.kill().unwrap();
    process.wait().unwrap();
    // Its nodes end by themselves: they have lost their launcher.
    std::thread::sleep(Duration::from_secs(2));
}

fn restarted(recording: &Recording, node: &str) -> bool {
    let of = |fault: &&Fault| fault.node == node && matches!(fault.kind, FaultKind::Restarted { .. });
    recording.faults.iter().find(of).is_some()
}

#[test]
fn a_machine_that_is_started_again_takes_part_again() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0\n        on_gone = \"continue\"");
    }
    let mut first = cable.start("plant", &["--duration", "14"]);
    let desk = cable.start("desk", &["--duration", "14"]);
    until_recorded(&cable.path("run.mcap"));
    cut(&mut first);
    let plant = cable.start_with_clock("plant", AHEAD + 777, &["--duration", "14"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    for said in ["machine plant has been silent", "machine plant is gone", "machine plant was started again"]
    {
        assert!(errors.contains(said), "{said}: {errors}");
    }
    assert_eq!(desk.link.as_ref().unwrap().rejoined, 1);
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    for name in ["world", "camera", "motor"] {
        assert!(restarted(&recording, name), "{name}: {:?}", recording.faults);
        let steps = &recording.node(name).unwrap().steps;
        // One clock and one count before and after: no number is used twice, and the grid is kept.
        assert!(steps.windows(2).all(|pair| pair[0].seq < pair[1].seq && pair[0].start < pair[1].start));
        let (gap, before) =
            steps.windows(2).map(|pair| (pair[1].due - pair[0].due, pair[0].due)).max().unwrap();
        assert!(gap > 2_000_000_000, "{name}: {gap}");
        let after = steps.iter().filter(|step| step.due > before);
        assert!(after.clone().count() > 50, "{name}");
        let mut late: Vec<_> = after.map(|step| step.start - step.due).collect();
        late.sort_unstable();
        assert!(late[late.len() / 2] < 100_000_000, "{name}: {late:?}");
    }
    // What the plant had recorded and not yet sent when it lost its power is missing: of the steps about that moment the schedule cannot
    // be told whole, and what they gave can.
    let replay =
        Command::new(env!("CARGO_BIN_EXE_parallax")).arg("replay").arg(&path).arg("--json").output().unwrap();
    let replay: serde_json::Value = serde_json::from_slice(&replay.stdout).unwrap();
    for node in replay["nodes"].as_array().unwrap() {
        assert_eq!(node["differing"], 0, "{node}");
    }
}

#[test]
fn the_machine_that_records_goes_on_in_another_file() {
    let cable = Cable::lay();
    for machine in ["desk", "plant"] {
        cable.settings(machine, "gone = 1.0\n        on_gone = \"continue\"");
    }
    let plant = cable.start("plant", &["--duration", "14"]);
    let mut first = cable.start("desk", &["--duration", "14"]);
    until_recorded(&cable.path("run.mcap"));
    cut(&mut first);
    let desk = cable.start("desk", &["--duration", "14"]);
    let ((desk, code, errors), (plant, plant_code, plant_errors)) = (desk.report(), plant.report());
    assert_eq!((code, plant_code), (Some(0), Some(0)), "{errors}\n{plant_errors}");
    adds_up(&desk, &["estimator", "agent"]);
    adds_up(&plant, &["world", "camera", "motor"]);
    let parts = ["run.mcap", "run.1.mcap"].map(|name| Recording::read(cable.path(name)).unwrap());
    let [before, after] = parts.each_ref().map(|part| &part.node("agent").unwrap().steps);
    assert!(before.len() > 10 && after.len() > 10, "{} {}", before.len(), after.len());
    assert!(after[0].seq > before[before.len() - 1].seq && after[0].start > before[before.len() - 1].start);
    assert!(restarted(&parts[1], "agent") && !restarted(&parts[1], "motor"), "{:?}", parts[1].faults);
}

#[test]
fn pictures_cross_between_three_machines() {
    let cable = Cable::between(3);
    let mut spec = parallax::nodes::graph("pendulum").unwrap();
    spec.name = "pendulum-seen".into();
    spec.node_mut("camera").unwrap().kind = "pendulum/detector".into();
    spec.nodes.push(NodeSpec::new("film", "pendulum/film", 50.0));
    spec.connections[0].to = "film".into();
    spec.connections.push(ConnectionSpec { blocking: true, ..ConnectionSpec::new("film", "camera") });
    spec.plant = None;
    fs::write(cable.path("graph.toml"), spec.to_toml().unwrap()).unwrap();
    let settings =
        settings("").replace("[host.plant]", "[host.plant]\n[host.arm]\naddress = \"10.231.7.3:7447\"");
    let motor = "[node.motor]\n        host = \"plant\"";
    assert!(settings.contains(motor));
    let camera = "[node.camera]\n        host = \"plant\"";
    let settings = settings
        .replace(motor, "[node.motor]\nhost = \"arm\"")
        .replace(camera, "[node.camera]\nhost = \"desk\"\n[node.film]\nhost = \"plant\"");
    for machine in MACHINES {
        fs::write(cable.path(machine).join("launch.toml"), &settings).unwrap();
    }
    let runs = MACHINES.map(|machine| cable.start(machine, &["--duration", "4"]));
    let reports = runs.map(Run::report);
    for (report, code, errors) in &reports {
        assert_eq!(*code, Some(0), "{errors}");
        assert!(report.nodes.iter().all(|node| node.steps > 50 && node.exit == Exit::Clean), "{report:#?}");
        // Every machine knows the clocks of both others.
        assert_eq!(report.link.as_ref().unwrap().clocks.len(), 2, "{:?}", report.link);
    }
    let [(desk, ..), (plant, ..), (arm, ..)] = &reports;
    adds_up(desk, &["camera", "estimator", "agent"]);
    adds_up(plant, &["world", "film"]);
    adds_up(arm, &["motor"]);

    let path = cable.path("run.mcap");
    let recording = Recording::read(&path).unwrap();
    assert_eq!(["film", "motor", "agent"].map(|node| &*recording.hosts[node]), ["plant", "arm", "desk"]);
    let film = recording.node("film").unwrap();
    assert!(
        film.messages.len() > 100 && film.messages.iter().all(|message| message.data.len() == 120 * 90 * 3)
    );
    // Those that the detector saw on the desk are those that the film took on the plant: seen again, they give the same.
    let seen = recording.node("camera").unwrap();
    assert!(seen.steps.len() > 100 && seen.messages.iter().any(|message| message.payload[0] != 0.0));
    let replay = command::json(cable.folder.path(), &["replay", path.to_str().unwrap(), "--json"]);
    assert_eq!(replay["exact"], true, "{replay}");
}

#[test]
fn whoever_has_another_secret_stays_outside() {
    let cable = Cable::lay();
    cable.secret("plant", "another word, well guessed");
    for machine in ["desk", "plant"] {
        cable.settings(machine, "patience = 3.0");
    }
    let plant = cable.start("plant", &["--duration", "2"]);
    let desk = cable.start("desk", &["--duration", "2"]);
    for output in [desk.output(), plant.output()] {
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(3), "{errors}");
        assert!(errors.contains("which has not answered") && errors.contains("secret the same"), "{errors}");
    }
    assert!(!cable.path("run.mcap").exists(), "a run that never began left a recording");
}

#[test]
fn machines_that_run_different_graphs_say_so() {
    let cable = Cable::lay();
    let plant = cable.start("plant", &["--duration", "2", "--node", "agent.rate=25"]);
    let desk = cable.start("desk", &["--duration", "2"]);
    let (desk, plant) = (desk.output(), plant.output());
    let both = [&desk, &plant].map(|output| String::from_utf8_lossy(&output.stderr).into_owned());
    assert_eq!((desk.status.code(), plant.status.code()), (Some(3), Some(3)), "{both:?}");
    assert!(both.iter().any(|errors| errors.contains("runs another graph")), "{both:?}");
}

#[test]
fn settings_that_cannot_be_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let write = |text: &str| fs::write(folder.path().join("launch.toml"), text).unwrap();
    fs::write(folder.path().join("graph.toml"), graph()).unwrap();
    let secret = folder.path().join("link.secret");
    fs::write(&secret, "a word that nobody guesses").unwrap();
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o600)).unwrap();
    let run = |more: &[&str]| {
        let all = [&["run", "graph.toml", "--duration", "1"], more].concat();
        all.into_iter().map(str::to_owned).collect::<Vec<String>>()
    };
    let refuse = |more: &[&str], expected: &[&str]| {
        let arguments = run(more);
        fail(folder.path(), &arguments.iter().map(String::as_str).collect::<Vec<_>>(), 2, expected);
    };
    write(&settings(""));
    refuse(&[], &["launch.toml", "--host NAME, one of desk, plant"]);
    refuse(&["--host", "dsk"], &["there is no machine `dsk`", "did you mean `desk`?"]);
    refuse(&["--host", "desk"], &["this machine records", "--out"]);
    refuse(&["--host", "plant", "--out", "x.mcap"], &["machine desk records for all"]);
    write(&settings("gone = 0.1"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[link] gone", "at least 0.2 s"]);
    write(&settings("").replace("10.231.7.1:7447", "0.0.0.0:7447"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[host.desk] address", "every network"]);
    write(&settings("").replace("address = \"10.231.7.1:7447\"", ""));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["address", "has to wait for the other"]);
    write(&settings("").replace("host = \"desk\"\n        safe", "safe"));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[node.agent] host", "is missing"]);
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o644)).unwrap();
    write(&settings(""));
    refuse(&["--host", "desk", "--out", "x.mcap"], &["[link] secret", "chmod 600"]);
    fs::write(&secret, "short").unwrap();
    fs::set_permissions(&secret, fs::Permissions::from_mode(0o600)).unwrap();
    refuse(&["--host", "desk", "--out", "x.mcap"], &["at least 16"]);
}
