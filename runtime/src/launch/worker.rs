//! One running node as the launcher sees it: a process or a thread, and the line to it.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::control::{Answer, Line, Order, readable};
use super::report::Exit;
use super::stepper::panicked;
use super::worker_main::STOP_ONLY;

/// How long a process may take to leave its hardware in a safe state when the launcher leaves.
pub(super) const LEAVING: Duration = Duration::from_millis(500);

/// A running node.
#[derive(Debug)]
pub(super) struct Worker {
    pub(super) node: String,
    pub(super) line: Line,
    body: Body,
    /// How it ended, once that has been found out.
    ended: Option<Exit>,
}

#[derive(Debug)]
enum Body {
    Process(Child),
    Thread(Option<JoinHandle<()>>),
    /// It runs on another machine; somebody here speaks for it.
    Elsewhere,
}

/// What a process runs.
#[derive(Debug)]
pub(super) struct Program(Command);

impl Program {
    /// This program, with these arguments.
    pub(super) fn own(arguments: &[String]) -> Self {
        // Not the path that the program was started by: it may have been rebuilt since, or removed.
        let mut command = Command::new("/proc/self/exe");
        if let Some(name) = std::env::args_os().next() {
            command.arg0(name);
        }
        command.args(arguments);
        Self(command)
    }

    /// Another one: its path and its arguments.
    pub(super) fn other(words: &[String]) -> Self {
        let (path, arguments) =
            words.split_first().map_or(("", &[][..]), |(path, rest)| (path.as_str(), rest));
        let mut command = Command::new(path);
        command.args(arguments);
        Self(command)
    }
}

impl Worker {
    /// Starts a node as a process.
    ///
    /// The run's directory and the node's name are added to the program's arguments. A process that is to stop the node and
    /// do nothing else is told so.
    pub(super) fn process(
        Program(mut process): Program,
        run: &Path,
        node: &str,
        private: &BTreeMap<String, String>,
        stop_only: bool,
    ) -> io::Result<Self> {
        let (here, there) = UnixStream::pair()?;
        let child = process
            .arg("--run-dir")
            .arg(run)
            .arg("--node")
            .arg(node)
            .args(stop_only.then_some(STOP_ONLY))
            .envs(private)
            .stdin(Stdio::from(OwnedFd::from(there)))
            // What a node prints must not get between the lines that a script reads from the launcher.
            .stdout(Stdio::from(io::stderr().as_fd().try_clone_to_owned()?))
            // A Ctrl-C at the terminal goes to the launcher, which stops the nodes in order.
            .process_group(0)
            .spawn()?;
        let line = Line::without_waiting(here)?;
        Ok(Self { node: node.into(), line, body: Body::Process(child), ended: None })
    }

    /// Starts a node as a thread that runs `body` with its end of the line.
    pub(super) fn thread(node: &str, body: impl FnOnce(UnixStream) + Send + 'static) -> io::Result<Self> {
        let (here, there) = UnixStream::pair()?;
        let line = Line::without_waiting(here)?;
        let handle = std::thread::Builder::new().name(node.into()).spawn(move || body(there))?;
        Ok(Self { node: node.into(), line, body: Body::Thread(Some(handle)), ended: None })
    }

    /// A node of another machine, for which somebody speaks at the other end of the line.
    pub(super) fn elsewhere(node: &str, stream: UnixStream) -> Self {
        Self { node: node.into(), line: Line::new(stream), body: Body::Elsewhere, ended: None }
    }

    /// Its process, when it is one.
    pub(super) fn pid(&self) -> Option<u32> {
        match &self.body {
            Body::Process(child) => Some(child.id()),
            Body::Thread(_) | Body::Elsewhere => None,
        }
    }

    pub(super) fn order(&mut self, order: &Order) {
        self.line.send(order);
    }

    /// Lets it go: a node ends when its line is closed.
    pub(super) fn hang_up(&mut self) {
        self.line.hang_up();
    }

    /// What it says, waiting for nothing.
    pub(super) fn answers(&mut self) -> Vec<Answer> {
        // A line that is no answer comes from a process that is not ours: it counts as silence, and the
        // launcher's patience ends the run.
        self.line.receive(0).unwrap_or_default()
    }

    /// Waits until it says something, at most so many milliseconds.
    pub(super) fn wait(&self, milliseconds: i32) {
        if self.line.closed() {
            std::thread::sleep(Duration::from_millis(milliseconds.unsigned_abs().into()));
        } else {
            readable(&[self.line.fd()], milliseconds);
        }
    }

    /// How it died, if it is dead. To be asked when its line is closed, and after its last answers are read.
    pub(super) fn death(&mut self) -> Option<Exit> {
        if self.ended.is_none() {
            self.ended = self.look();
        }
        self.ended.clone()
    }

    fn look(&mut self) -> Option<Exit> {
        match &mut self.body {
            Body::Process(child) => {
                let pid = Some(child.id());
                let status = child.try_wait().ok()??;
                Some(Exit::Died { pid, status: describe(status) })
            }
            Body::Thread(handle) => {
                if handle.as_ref().is_some_and(|handle| !handle.is_finished()) {
                    return None;
                }
                let status = match handle.take().map(JoinHandle::join) {
                    Some(Err(panic)) => panicked(&*panic),
                    _ => "its thread ended".into(),
                };
                Some(Exit::Died { pid: None, status })
            }
            // Nobody here could wait for it.
            Body::Elsewhere => self.line.closed().then_some(Exit::Clean),
        }
    }

    /// Ends its process at once, if it is one: a thread cannot be ended.
    pub(super) fn kill(&mut self) {
        if let Body::Process(child) = &mut self.body {
            // It can only fail when the process has ended.
            let _ = child.kill();
        }
    }

    /// Gives a process so long to end, and ends it then.
    pub(super) fn end_within(&mut self, patience: Duration) {
        if matches!(self.body, Body::Process(_)) && !self.join(patience) {
            self.kill();
        }
    }

    /// Waits for its end, at most this long; says whether it came.
    pub(super) fn join(&mut self, patience: Duration) -> bool {
        let start = Instant::now();
        loop {
            if self.death().is_some() {
                return true;
            }
            if start.elapsed() > patience {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        false
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // However the launcher leaves, no process of the run outlives it.
        self.hang_up();
        match &mut self.body {
            Body::Process(_) => {
                self.join(LEAVING);
                self.kill();
                if let Body::Process(child) = &mut self.body {
                    let _ = child.wait();
                }
            }
            // A thread cannot be killed: one that hangs in its node's code is left behind after a while.
            Body::Thread(_) => {
                self.join(Duration::from_secs(2));
            }
            Body::Elsewhere => {}
        }
    }
}

/// An exit status in words.
fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exit status {code}"),
        (None, Some(signal)) => {
            let name = signal_hook::low_level::signal_name(signal).unwrap_or("unknown");
            let why = if signal == libc::SIGBUS { "; shared memory may be full" } else { "" };
            format!("signal {signal}, {name}{why}")
        }
        (None, None) => "unknown status".into(),
    }
}
