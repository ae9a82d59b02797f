//! `parallax top` on graphs that run: what it says is what the run itself reports, and the terminal is given back.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod live;

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::process::{Child, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};

use live::{eventually, parallax, start, under_way};
use parallax::runtime::launch::{End, LiveError, LiveRun, NodeState, Phase, Snapshot};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcgetattr, tcsetwinsize};

#[test]
fn what_is_shown_is_what_the_run_reports() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run.mcap");
    // Every step of the agent is late.
    let settings = ["--out", out.to_str().unwrap(), "--set", "agent.deadline=0.000001"];
    let (run, name) = start("pendulum", &settings);
    let live = under_way(&name);
    let output = parallax(&["top", &name, "--json", "--interval", "0.5"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let shown: Snapshot = serde_json::from_slice(&output.stdout).unwrap();
    let once = parallax(&["top", "pendulum", "--once", "--interval", "0.1"]).output().unwrap();
    // Other tests run pendulums, too: by that name it may be one of several.
    if once.status.success() {
        let once = String::from_utf8(once.stdout).unwrap();
        assert!(once.contains("camera -> estimator") && once.contains("99 %"), "{once}");
    } else {
        let refusal = String::from_utf8(once.stderr).unwrap();
        assert!(once.status.code() == Some(2) && refusal.contains(&*live.name().id), "{refusal}");
    }
    run.interrupt();
    let before = live.sample();
    eventually("the end", || (live.phase() == Phase::Over).then_some(()));
    let last = live.snapshot(&before, &live.sample());
    let report = run.finish();

    assert_eq!((&*shown.graph, shown.phase, &shown.end), ("pendulum", Phase::Running, &None));
    assert_eq!(shown.launcher.to_string(), name);
    assert!(shown.elapsed > 0 && shown.elapsed < report.duration);
    assert_eq!(shown.nodes.len(), report.nodes.len());
    for ((shown, last), report) in shown.nodes.iter().zip(&last.nodes).zip(&report.nodes) {
        assert_eq!((&shown.node, shown.core), (&report.node, report.core));
        // A node makes no step before its time; how many it makes on a machine that is busy is not ours to say.
        assert!(shown.steps > 5 && shown.steps <= report.steps, "{shown:?}, {report:?}");
        assert!(shown.rate.is_none_or(|rate| rate > 0.0), "{shown:?}");
        let process = shown.process.expect("it lives");
        assert!(process.to_string() != name && shown.thread == Some(process), "each is a process");
        assert!(shown.computation.max <= report.computation.max, "{shown:?}");
        assert!(!matches!(shown.state, NodeState::Gone | NodeState::Starting), "{shown:?}");
        // What is left when all is over is what the launcher counted.
        let counts = (last.steps, last.sent, last.overruns, last.late, last.late_by, last.restarts);
        let reported =
            (report.steps, report.sent, report.overruns, report.late, report.late_by, report.restarts);
        assert_eq!(counts, reported, "{last:?}");
        assert_eq!((last.state.clone(), last.process), (NodeState::Gone, None));
    }
    let agent = shown.nodes.iter().find(|node| node.node == "agent").unwrap();
    assert!(agent.late > 0 && agent.deadline == Some(1000), "{agent:?}");
    for connection in &last.connections {
        let node = report.nodes.iter().find(|node| node.node == connection.to).unwrap();
        let input = node.inputs.iter().find(|input| input.port == connection.port).unwrap();
        let counts = (connection.sent, connection.consumed, connection.superseded, &connection.lost);
        assert_eq!(counts, (input.sent, input.consumed, input.superseded, &input.lost), "{connection:?}");
    }
    for connection in &shown.connections {
        assert!(
            connection.filled <= connection.window as u64 && connection.waiting <= connection.capacity as u64
        );
        assert!(
            connection.filled == 0 || connection.rate == 0.0 || connection.delay.max > 0,
            "{connection:?}"
        );
    }
    assert_eq!(last.end, Some(End::Signal));
    let recorder = shown.recorder.expect("it is recorded");
    assert_eq!((recorder.lost, recorder.files), (0, vec![out]));
}

#[test]
fn a_run_that_is_not_there_is_said() {
    let output = parallax(&["top", "no-such-run", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("no-such-run") || text.contains("no graph of this user is running"), "{text}");
    assert!(matches!(LiveRun::find(Some("no-such-run")), Err(LiveError::None | LiveError::Unknown { .. })));
}

/// A terminal of ours, and what was written to it.
struct Screen {
    master: File,
    slave: OwnedFd,
    written: Arc<Mutex<Vec<u8>>>,
}

impl Screen {
    fn new() -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY;
        let slave = rustix::fs::open(name, flags, rustix::fs::Mode::empty()).unwrap();
        tcsetwinsize(&slave, Winsize { ws_row: 40, ws_col: 180, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
        let written = Arc::new(Mutex::new(Vec::new()));
        let master = File::from(master);
        let (mut reader, kept) = (master.try_clone().unwrap(), written.clone());
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            // It ends when the last end of the terminal is closed.
            while let Ok(count @ 1..) = reader.read(&mut bytes) {
                kept.lock().unwrap().extend_from_slice(&bytes[..count]);
            }
        });
        Self { master, slave, written }
    }

    fn top(&self, run: &str) -> Child {
        let end = || Stdio::from(self.slave.try_clone().unwrap());
        let mut command = parallax(&["top", run, "--interval", "0.2"]);
        command.stdin(end()).stdout(end()).stderr(end()).env("TERM", "xterm").spawn().unwrap()
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.written.lock().unwrap()).into_owned()
    }

    fn shows(&self, text: &str) {
        eventually(text, || self.text().contains(text).then_some(()));
    }

    fn press(&mut self, keys: &[u8]) {
        self.master.write_all(keys).unwrap();
    }

    /// Whether the terminal is as it was before, once this has ended.
    fn given_back(&self, mut top: Child, before: &rustix::termios::Termios) -> ExitStatus {
        let status = eventually("the end of top", || top.try_wait().unwrap());
        let after = tcgetattr(&self.slave).unwrap();
        let modes =
            |t: &rustix::termios::Termios| (t.input_modes, t.output_modes, t.local_modes, t.control_modes);
        assert_eq!(modes(&after), modes(before));
        // The other screen was left, and the cursor is to be seen.
        self.shows("\x1b[?1049l");
        let text = self.text();
        let last = |what: &str| text.rfind(what).unwrap_or_else(|| panic!("no {what:?} in {text:?}"));
        assert!(last("\x1b[?1049l") > last("\x1b[?1049h") && last("\x1b[?25h") > last("\x1b[?25l"));
        status
    }
}

#[test]
fn the_screen_shows_the_run_and_is_given_back() {
    let (run, name) = start("pendulum", &[]);
    let _live = under_way(&name);
    for keys in [&b"q"[..], &[3], b" j\x1b[Bkq"] {
        let mut screen = Screen::new();
        let before = tcgetattr(&screen.slave).unwrap();
        let top = screen.top(&name);
        screen.shows("camera -> estimator");
        screen.shows("q quit");
        screen.press(keys);
        assert_eq!(screen.given_back(top, &before).code(), Some(0));
    }

    // A signal is no way to lose a terminal either.
    let screen = Screen::new();
    let before = tcgetattr(&screen.slave).unwrap();
    let top = screen.top(&name);
    screen.shows("camera -> estimator");
    let id = rustix::process::Pid::from_child(&top);
    rustix::process::kill_process(id, rustix::process::Signal::TERM).unwrap();
    assert_eq!(screen.given_back(top, &before).code(), Some(130));

    // The graph ends while somebody looks.
    let screen = Screen::new();
    let before = tcgetattr(&screen.slave).unwrap();
    let top = screen.top(&name);
    screen.shows("camera -> estimator");
    run.interrupt();
    assert_eq!(screen.given_back(top, &before).code(), Some(0));
    screen.shows("somebody stopped it");
    let text = screen.text();
    let after = &text[text.rfind("\x1b[?1049l").unwrap()..];
    assert!(after.contains("has ended after") && after.contains("camera -> estimator"), "{after}");
    assert_eq!(run.finish().end, End::Signal);
}
