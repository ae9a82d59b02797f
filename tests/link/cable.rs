//! Machines for these tests: network namespaces with cables between them, and runs of a graph on them.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use parallax::runtime::graph::{ConnectionSpec, NodeSpec};
use parallax::runtime::launch::RunReport;

/// What the clock of the second machine shows more, s.
pub(crate) const AHEAD: i64 = 5000;

/// The machines, in the order of their addresses. The first one's clock is that of these tests.
pub(crate) const MACHINES: [&str; 3] = ["desk", "plant", "arm"];

/// In place of an argument: nothing is recorded.
const UNRECORDED: &str = "unrecorded";

/// Machines with a cable between each two of them.
pub(crate) struct Cable {
    pub(crate) names: Vec<String>,
    pub(crate) folder: tempfile::TempDir,
}

/// The address of a machine.
pub(crate) fn address(machine: usize) -> String {
    format!("10.231.7.{}", machine + 1)
}

pub(crate) fn ip(arguments: &[&str]) {
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
    pub(crate) fn lay() -> Self {
        Self::between(2)
    }

    pub(crate) fn between(machines: usize) -> Self {
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

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn secret(&self, machine: &str, word: &str) {
        let path = self.path(machine).join("link.secret");
        fs::write(&path, word).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    }

    pub(crate) fn settings(&self, machine: &str, link: &str) {
        fs::write(self.path(machine).join("launch.toml"), settings(link)).unwrap();
    }

    /// Starts the run on a machine.
    pub(crate) fn start(&self, machine: &str, more: &[&str]) -> Run {
        let place = MACHINES.iter().position(|name| *name == machine).unwrap();
        self.start_with_clock(machine, place as i64 * AHEAD, more)
    }

    /// The same, with a clock that is so far ahead.
    pub(crate) fn start_with_clock(&self, machine: &str, ahead: i64, more: &[&str]) -> Run {
        let place = MACHINES.iter().position(|name| *name == machine).unwrap();
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.names[place]]);
        if ahead != 0 {
            command.args(["unshare", "--time", "--fork", "--kill-child"]);
            command.args([format!("--monotonic={ahead}"), format!("--boottime={ahead}")]);
        }
        command.arg(env!("CARGO_BIN_EXE_parallax")).args(["run", self.path("graph.toml").to_str().unwrap()]);
        command.arg("--launch").arg(self.path(machine).join("launch.toml"));
        command.args(["--host", machine, "--json"]).args(more.iter().filter(|more| **more != UNRECORDED));
        if machine == "desk" && !more.contains(&UNRECORDED) {
            command.arg("--out").arg(self.path("run.mcap"));
        }
        Run(Some(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()))
    }

    /// The same as [`start`](Self::start), on a machine that does not record.
    pub(crate) fn start_unrecorded(&self, machine: &str, more: &[&str]) -> Run {
        self.start(machine, &[more, &[UNRECORDED]].concat())
    }

    pub(crate) fn set_link(&self, state: &str) {
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
pub(crate) struct Run(pub(crate) Option<Child>);

impl Drop for Run {
    fn drop(&mut self) {
        if let Some(mut child) = self.0.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Run {
    pub(crate) fn output(mut self) -> Output {
        self.0.take().unwrap().wait_with_output().unwrap()
    }

    #[track_caller]
    pub(crate) fn report(self) -> (RunReport, Option<i32>, String) {
        let output = self.output();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!errors.contains("panicked"), "{errors}");
        let report =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {errors}"));
        (report, output.status.code(), errors)
    }
}

/// The ready-made pendulum, with a safe output of the agent.
pub(crate) fn graph() -> String {
    let mut spec = parallax::nodes::graph("pendulum").unwrap();
    spec.name = "pendulum-far".into();
    spec.to_toml().unwrap()
}

/// The pendulum that is seen by pictures.
pub(crate) fn seen() -> String {
    let mut spec = parallax::nodes::graph("pendulum").unwrap();
    spec.name = "pendulum-seen".into();
    spec.node_mut("camera").unwrap().kind = "pendulum/camera-map".into();
    spec.nodes.push(NodeSpec::new("film", "pendulum/film", 50.0));
    spec.nodes.push(NodeSpec::new("mark", "pendulum/detector", 50.0));
    spec.connections[0].to = "film".into();
    for (from, to) in [("film", "mark"), ("mark", "camera")] {
        spec.connections.push(ConnectionSpec { blocking: true, ..ConnectionSpec::new(from, to) });
    }
    spec.plant = None;
    spec.to_toml().unwrap()
}

/// [`settings`] of a graph that is [`seen`] by pictures: they are taken on the plant and looked at on the desk.
pub(crate) fn seen_settings(settings: String) -> String {
    let camera = "[node.camera]\n        host = \"plant\"";
    assert!(settings.contains(camera), "{settings}");
    let nodes = "[node.film]\nhost = \"plant\"\n[node.mark]\nhost = \"desk\"\n[node.camera]\nhost = \"desk\"";
    settings.replace(camera, nodes)
}

pub(crate) fn settings(link: &str) -> String {
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
pub(crate) fn adds_up(report: &RunReport, nodes: &[&str]) {
    for node in report.nodes.iter().filter(|node| nodes.contains(&node.node.as_str())) {
        for input in &node.inputs {
            let lost: u64 = input
                .lost
                .iter()
                .filter(|(reason, _)| reason.name() != "malformed")
                .map(|(_, count)| count)
                .sum();
            let sum = input.consumed + input.superseded + input.in_flight + lost + input.held_back;
            assert_eq!(input.sent, sum, "{} -> {}: {input:?}", input.from, node.node);
            assert!(input.sent > 0, "{} -> {}: {input:?}", input.from, node.node);
        }
    }
}

pub(crate) fn until_recorded(path: &Path) {
    let start = Instant::now();
    while fs::metadata(path).map_or(0, |metadata| metadata.len()) < 20_000 {
        assert!(start.elapsed() < Duration::from_secs(60), "nothing is recorded");
        std::thread::sleep(Duration::from_millis(20));
    }
}
