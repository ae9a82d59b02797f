//! The launcher's door: a socket in the run's directory at which the run's owner may ask for something while it runs.
//!
//! One JSON object a line, as on the lines to the nodes. The launcher passes a wish on to its node and the answer back; a
//! caller that is slow, silent or gone holds nobody up.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::control::Line;
use super::desk::{By, Told, Wish};
use super::live::{LiveError, find};
use crate::channel::{ChannelError, Space};
use crate::tuning::{Assignment, TuningError};

/// The socket in the run's directory.
const SOCKET: &str = "door-of-run.socket";
/// Callers at a time; the others wait outside.
const CALLERS: usize = 64;
/// How long an answer may take to be written: it fits into the socket unless the caller does not read.
const WRITING: Duration = Duration::from_millis(50);

/// What a caller asks for.
#[derive(Debug, Serialize, Deserialize)]
struct Call {
    node: String,
    wish: Wish,
}

/// What it is told.
type Reply = Result<Told, String>;

/// The launcher's side.
#[derive(Debug)]
pub(super) struct Door {
    listener: UnixListener,
    callers: Vec<Caller>,
    next: u64,
    /// What has been asked of which node, by its number, and is not answered yet: whoever asked may be gone meanwhile.
    asked: BTreeMap<(usize, u64), Wish>,
    /// By node: what has been set in it so far, to be set again after a restart.
    kept: Vec<Vec<Assignment>>,
}

#[derive(Debug)]
struct Caller {
    line: Line,
    by: By,
    /// The node and the number of what is under way.
    pending: Option<(usize, u64)>,
}

/// Something to be passed on to a node.
#[derive(Debug)]
pub(super) struct Passed {
    pub(super) node: usize,
    pub(super) id: u64,
    pub(super) by: By,
    pub(super) wish: Wish,
}

impl Door {
    pub(super) fn open(space: &Space, nodes: usize) -> Result<Self, ChannelError> {
        let path = space.path().join(SOCKET);
        let make = || {
            let listener = UnixListener::bind(&path)?;
            std::fs::set_permissions(&path, PermissionsExt::from_mode(0o600))?;
            listener.set_nonblocking(true)?;
            Ok(listener)
        };
        let io = |source| ChannelError::Io { what: "cannot make the socket", path: path.clone(), source };
        let listener = make().map_err(io)?;
        let (callers, asked) = (Vec::new(), BTreeMap::new());
        Ok(Self { listener, callers, next: 1, asked, kept: vec![Vec::new(); nodes] })
    }

    /// What to wait for.
    pub(super) fn descriptors(&self) -> impl Iterator<Item = RawFd> {
        let listener = (self.callers.len() < CALLERS).then(|| self.listener.as_raw_fd());
        listener.into_iter().chain(self.callers.iter().map(|caller| caller.line.fd()))
    }

    /// Lets callers in and hears them; gives what is to be passed on. `find` gives a node's place, or why it cannot be asked.
    pub(super) fn hear(&mut self, find: impl Fn(&str) -> Result<usize, String>) -> Vec<Passed> {
        while self.callers.len() < CALLERS
            && let Ok((stream, _)) = self.listener.accept()
        {
            self.callers.extend(Caller::let_in(stream));
        }
        let mut passed = Vec::new();
        for caller in &mut self.callers {
            let calls = caller.line.receive::<Call>(0).unwrap_or_else(|error| {
                caller.reply(&Err(format!("this is no wish: {error}")));
                caller.line.hang_up();
                Vec::new()
            });
            for Call { node, wish } in calls {
                if caller.pending.is_some() {
                    caller.reply(&Err("one wish at a time".into()));
                    caller.line.hang_up();
                    break;
                }
                match find(&node) {
                    Ok(node) => {
                        let id = self.next;
                        self.next += 1;
                        caller.pending = Some((node, id));
                        self.asked.insert((node, id), wish.clone());
                        passed.push(Passed { node, id, by: caller.by, wish });
                    }
                    Err(reason) => caller.reply(&Err(reason)),
                }
            }
        }
        self.callers.retain(|caller| !caller.line.closed());
        passed
    }

    /// A node has answered: its caller is told, if it is still there.
    pub(super) fn answered(&mut self, node: usize, id: u64, told: Reply) {
        if let (Ok(_), Some(Wish::Set(assignments))) = (&told, self.asked.remove(&(node, id))) {
            for assignment in assignments {
                let kept = &mut self.kept[node];
                kept.retain(|other| other.parameter != assignment.parameter);
                kept.push(assignment);
            }
        }
        let mut callers = self.callers.iter_mut();
        if let Some(caller) = callers.find(|caller| caller.pending == Some((node, id))) {
            caller.pending = None;
            caller.reply(&told);
        }
    }

    /// A node is gone: what was asked of it will not be answered.
    pub(super) fn gone(&mut self, node: usize, name: &str) {
        self.asked.retain(|(asked, _), _| *asked != node);
        for caller in &mut self.callers {
            if caller.pending.is_some_and(|(asked, _)| asked == node) {
                caller.pending = None;
                caller.reply(&Err(format!("node `{name}` ended before it could answer")));
            }
        }
    }

    /// What is to be set again in a node that was started again.
    pub(super) fn again(&self, node: usize) -> Option<Wish> {
        let kept = &self.kept[node];
        (!kept.is_empty()).then(|| Wish::Set(kept.clone()))
    }
}

impl Caller {
    /// Lets a caller in who is the run's owner; the others find the door closed.
    fn let_in(stream: UnixStream) -> Option<Self> {
        let by = peer(&stream).ok()?;
        // SAFETY: geteuid takes no arguments, cannot fail and touches no memory of ours.
        if by.user != unsafe { libc::geteuid() } {
            return None;
        }
        stream.set_write_timeout(Some(WRITING)).ok()?;
        Some(Self { line: Line::new(stream), by, pending: None })
    }

    fn reply(&mut self, reply: &Reply) {
        self.line.send(reply);
    }
}

/// Who is at the other end, as the system vouches for.
fn peer(stream: &UnixStream) -> io::Result<By> {
    let mut peer = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut length = size_of::<libc::ucred>() as libc::socklen_t;
    // SAFETY: `peer` and `length` are writable, `length` is the size of `peer`, and both outlive the call.
    let done = unsafe {
        libc::getsockopt(
            stream.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_PEERCRED,
            (&raw mut peer).cast(),
            &mut length,
        )
    };
    if done != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(By { user: peer.uid, process: peer.pid.unsigned_abs() })
}

/// Why a running node did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// There is no such run.
    #[error(transparent)]
    Run(#[from] LiveError),
    /// The run's launcher cannot be reached.
    #[error("the launcher of {run} cannot be reached: {source}")]
    Unreachable {
        /// The run.
        run: String,
        /// The system's answer.
        source: io::Error,
    },
    /// It was refused, and nothing was changed.
    #[error("{reason}")]
    Refused {
        /// Why.
        reason: String,
    },
    /// The run ended meanwhile.
    #[error("the run {run} ended before it answered")]
    Ended {
        /// The run.
        run: String,
    },
    /// No answer in time.
    #[error(
        "node `{node}` has made no step for {seconds} s and has not answered; it does what it was asked before its next step"
    )]
    Silent {
        /// The node.
        node: String,
        /// How long it was waited for.
        seconds: f64,
    },
}

/// Sets parameters of a node of a running graph, all before the same step; see [`LiveRun::find`](super::LiveRun::find)
/// for how the run is named.
///
/// ```no_run
/// use parallax_runtime::launch::set_parameters;
/// use parallax_runtime::tuning::Assignment;
/// # fn main() -> Result<(), parallax_runtime::launch::AskError> {
/// let rated = Assignment { parameter: "rated".into(), value: 2.0, unit: Some("V".into()) };
/// let told = set_parameters(Some("pendulum"), "motor", &[rated], std::time::Duration::from_secs(5))?;
/// println!("from step {} on", told.step);
/// # Ok(())
/// # }
/// ```
///
/// # Errors
///
/// [`AskError`]: the run or the node is not there, or refuses; nothing has been changed then.
pub fn set_parameters(
    run: Option<&str>,
    node: &str,
    assignments: &[Assignment],
    patience: Duration,
) -> Result<Told, AskError> {
    if let Some(Assignment { parameter, value, .. }) = assignments.iter().find(|a| !a.value.is_finite()) {
        let range = "finite".into();
        let error =
            TuningError::Range { node: node.into(), parameter: parameter.clone(), value: *value, range };
        return Err(AskError::Refused { reason: error.to_string() });
    }
    ask(run, node, Wish::Set(assignments.to_vec()), patience)
}

/// Puts the state of a node of a running graph back to what it was before its first step.
///
/// # Errors
///
/// As [`set_parameters`].
pub fn reset_state(run: Option<&str>, node: &str, patience: Duration) -> Result<Told, AskError> {
    ask(run, node, Wish::Reset, patience)
}

/// The parameters of a node of a running graph that may be set, with their values, and its state, both before the same step.
///
/// # Errors
///
/// As [`set_parameters`].
pub fn read_node(run: Option<&str>, node: &str, patience: Duration) -> Result<Told, AskError> {
    ask(run, node, Wish::Read, patience)
}

fn ask(run: Option<&str>, node: &str, wish: Wish, patience: Duration) -> Result<Told, AskError> {
    let found = find(run)?;
    let run = || found.name.id.clone();
    let stream = connect(&found.path).map_err(|source| AskError::Unreachable { run: run(), source })?;
    let mut line = Line::new(stream);
    line.send(&Call { node: node.into(), wish });
    let start = Instant::now();
    loop {
        let left = patience.saturating_sub(start.elapsed());
        let replies = line.receive::<Reply>(left.as_millis().min(100) as i32);
        let replies = replies.map_err(|error| AskError::Unreachable { run: run(), source: error.into() })?;
        if let Some(reply) = replies.into_iter().next() {
            return reply.map_err(|reason| AskError::Refused { reason });
        }
        if line.closed() {
            return Err(AskError::Ended { run: run() });
        }
        if left.is_zero() {
            return Err(AskError::Silent { node: node.into(), seconds: patience.as_secs_f64() });
        }
    }
}

fn connect(run: &Path) -> io::Result<UnixStream> {
    UnixStream::connect(run.join(SOCKET))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_set_is_set_again_even_if_nobody_waited_for_the_answer() {
        let folder = tempfile::tempdir().unwrap();
        let listener = UnixListener::bind(folder.path().join(SOCKET)).unwrap();
        listener.set_nonblocking(true).unwrap();
        let (callers, asked) = (Vec::new(), BTreeMap::new());
        let mut door = Door { listener, callers, next: 1, asked, kept: vec![Vec::new()] };
        let rated = Assignment { parameter: "rated".into(), value: 2.0, unit: None };
        let ask = |door: &mut Door, value: f64| {
            let mut line = Line::new(connect(folder.path()).unwrap());
            let wish = Wish::Set(vec![Assignment { value, ..rated.clone() }]);
            line.send(&Call { node: "motor".into(), wish });
            // The launcher hears of it, and then the caller has lost patience.
            door.hear(|_| Ok(0)).into_iter().chain(door.hear(|_| Ok(0))).next().unwrap().id
        };
        let told = || Ok(Told { step: 7, ..Told::default() });
        let id = ask(&mut door, 2.0);
        assert!(door.hear(|_| Ok(0)).is_empty() && door.callers.is_empty());
        door.answered(0, id, told());
        let Some(Wish::Set(again)) = door.again(0) else { panic!("it was set") };
        assert_eq!(again, [Assignment { value: 2.0, ..rated.clone() }]);
        // What a node ended with unanswered was not set.
        let id = ask(&mut door, 3.0);
        door.gone(0, "motor");
        door.answered(0, id, told());
        let Some(Wish::Set(again)) = door.again(0) else { panic!("it was set") };
        assert_eq!(again, [Assignment { value: 2.0, ..rated }]);
    }
}
