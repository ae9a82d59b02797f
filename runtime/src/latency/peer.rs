//! The second process of a floor: it answers every message at once and remembers how long each was under way.

use std::io::{self, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};

use super::link::{self, End, Link, PATIENCE};
use super::{Case, LatencyError, Wait, place, room};
use crate::channel::Space;
use crate::clock::monotonic;
use crate::time::Nanos;

/// The hidden subcommand under which a program is the second process of a floor.
pub const PEER_COMMAND: &str = "__latency-peer";

/// What is sent instead of a time when the measurement is over.
pub(super) const FINISH: Nanos = Nanos::MIN;

/// Answers until the finish; gives how long each message was under way.
pub(super) fn answer(link: &mut dyn Link, wait: Wait) -> Result<Vec<Nanos>, LatencyError> {
    let mut taken = room(1 << 20);
    while let Some(stamp) = link::receive(link, wait)? {
        let now = monotonic();
        if stamp == FINISH {
            break;
        }
        taken.push(now - stamp);
        link.send(now)?;
    }
    Ok(taken)
}

/// The second process, from the first one's side.
pub(super) struct Peer {
    child: Child,
    stream: UnixStream,
}

impl Peer {
    /// Starts it; it can be talked to when this returns, over the stream that `link` is given.
    pub(super) fn start(case: &Case, space: &Space, core: Option<usize>) -> Result<Self, LatencyError> {
        let io = LatencyError::io("start the other process");
        let (here, there) = UnixStream::pair().map_err(&io)?;
        let case = serde_json::to_string(case).map_err(|e| io(e.into()))?;
        let mut command = Command::new("/proc/self/exe");
        command
            .arg(PEER_COMMAND)
            .arg(space.path())
            .arg(case)
            .arg(core.map_or_else(String::new, |core| core.to_string()))
            .stdin(Stdio::from(OwnedFd::from(there)))
            .stdout(Stdio::from(io::stderr().as_fd().try_clone_to_owned().map_err(&io)?))
            .process_group(0);
        Ok(Self { child: command.spawn().map_err(&io)?, stream: here })
    }

    pub(super) fn stream(&self) -> &UnixStream {
        &self.stream
    }

    /// Waits until it is ready; gives what it was refused.
    pub(super) fn ready(&mut self, carrier: super::Carrier) -> Result<Vec<String>, LatencyError> {
        let silent = |_| LatencyError::Silent { carrier: carrier.to_string(), seconds: PATIENCE.as_secs() };
        self.stream.set_read_timeout(Some(PATIENCE)).map_err(LatencyError::io("set up a socket"))?;
        Ok(match read_number(&mut self.stream).map_err(silent)? {
            0 => Vec::new(),
            _ => vec!["the other process of a floor could not have its core or its priority".into()],
        })
    }

    /// What it measured, once it has got the finish.
    pub(super) fn finish(mut self) -> Result<Vec<Nanos>, LatencyError> {
        let io = LatencyError::io("read what the other process measured");
        self.stream.set_nonblocking(false).map_err(&io)?;
        let count = read_number(&mut self.stream).map_err(&io)?;
        let taken: io::Result<Vec<Nanos>> = (0..count).map(|_| read_number(&mut self.stream)).collect();
        taken.map_err(&io)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It has nothing left to do; after an error it may hang in a wait.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn read_number(stream: &mut UnixStream) -> io::Result<Nanos> {
    let mut bytes = [0; 8];
    stream.read_exact(&mut bytes)?;
    Ok(Nanos::from_le_bytes(bytes))
}

/// The body of the hidden subcommand [`PEER_COMMAND`]; `arguments` are those after it.
pub fn peer_main(arguments: impl Iterator<Item = String>) -> ExitCode {
    let arguments: Vec<String> = arguments.collect();
    match serve(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn serve(arguments: &[String]) -> Result<(), LatencyError> {
    let refuse = || LatencyError::io("be started by hand")(io::ErrorKind::InvalidInput.into());
    let [run, case, core] = arguments else { return Err(refuse()) };
    let case: Case = serde_json::from_str(case).map_err(|_| refuse())?;
    // SAFETY: the call takes integers only; this process dies with the one that measures.
    unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
    let stdin = io::stdin().as_fd().try_clone_to_owned().map_err(|_| refuse())?;
    let mut stream = UnixStream::from(stdin);
    let space = Space::attach(Path::new(run))?;
    let mut link = link::open(&case, &space, &stream, End::Second)?;
    let refused = place::settle(core.parse().ok(), case.fifo);
    let io = LatencyError::io("answer");
    stream.set_nonblocking(false).map_err(&io)?;
    stream.write_all(&(refused.len() as Nanos).to_le_bytes()).map_err(&io)?;
    stream.set_nonblocking(case.wait == Wait::Spin).map_err(&io)?;
    let taken = answer(&mut *link, case.wait)?;
    stream.set_nonblocking(false).map_err(&io)?;
    let numbers = std::iter::once(taken.len() as Nanos).chain(taken);
    let bytes: Vec<u8> = numbers.flat_map(Nanos::to_le_bytes).collect();
    stream.write_all(&bytes).map_err(&io)
}
