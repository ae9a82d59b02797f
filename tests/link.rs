//! A graph on two machines: two network namespaces with a cable between them, the second one with a monotonic clock that is
//! 5000 s ahead (`unshare --time`), and the faults that a cable, a machine and a stranger can bring.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use command::fail;
use parallax::runtime::launch::{Exit, RunReport};
use parallax::runtime::recording::Recording;
use parallax::runtime::time::to_seconds;

/// What the clock of the second machine shows more, s.
const AHEAD: i64 = 5000;

/// Two machines with a cable between them.
struct Cable {
    names: [String; 2],
    ends: [String; 2],
    folder: tempfile::TempDir,
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
    fn lay() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = |end: char| format!("plx{}{end}{number}", std::process::id());
        let (names, ends) = ([name('a'), name('b')], [name('v'), name('w')]);
        let cable = Self { names, ends, folder: tempfile::tempdir().unwrap() };
        let ([a, b], [v, w]) = (&cable.names, &cable.ends);
        ip(&["netns", "add", a]);
        ip(&["netns", "add", b]);
        ip(&["link", "add", v, "netns", a, "type", "veth", "peer", "name", w, "netns", b]);
        for (name, end, address) in [(a, v, "10.231.7.1/24"), (b, w, "10.231.7.2/24")] {
            ip(&["-n", name, "link", "set", "lo", "up"]);
            ip(&["-n", name, "addr", "add", address, "dev", end]);
            ip(&["-n", name, "link", "set", end, "up"]);
        }
        fs::write(cable.path("graph.toml"), graph()).unwrap();
        for machine in ["desk", "plant"] {
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
        let place = usize::from(machine == "plant");
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.names[place]]);
        if machine == "plant" {
            command.args(["unshare", "--time", "--fork", "--kill-child"]);
            command.args([format!("--monotonic={AHEAD}"), format!("--boottime={AHEAD}")]);
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
        ip(&["-n", &self.names[0], "link", "set", &self.ends[0], state]);
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
