//! What a node process, or a node thread, does: it takes orders from its launcher and runs its node.

use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use super::control::{Answer, Line, Order};
use super::error::RunError;
use super::plan::{RUN_FILE, RunFile, Settings};
use super::report::Exit;
use super::settings::{NodeSettings, Policy};
use super::stepper::{Orders, StepError, Stepper};
use crate::channel::{Endpoint, Space};
use crate::clock::WallClock;
use crate::graph::Graph;
use crate::registry::Registry;

/// The hidden subcommand under which a program runs one of its own nodes.
pub const NODE_COMMAND: &str = "__node";

/// Runs one node: the body of the hidden subcommand [`NODE_COMMAND`].
///
/// `arguments` are those after the subcommand. The launcher is at standard input; a node that is started by
/// hand says so and ends.
///
/// ```no_run
/// # use parallax_runtime::{launch, registry::Registry};
/// # fn registry() -> Registry { Registry::new() }
/// let mut arguments = std::env::args().skip(1);
/// if arguments.next().as_deref() == Some(launch::NODE_COMMAND) {
///     std::process::exit(i32::from(launch::node_main(arguments, &registry()) != std::process::ExitCode::SUCCESS));
/// }
/// ```
pub fn node_main(arguments: impl Iterator<Item = String>, registry: &Registry) -> ExitCode {
    match prepare(arguments, registry) {
        Ok((graph, index, settings, run, stream)) => {
            if serve(&graph, index, &settings, &run, stream) {
                ExitCode::SUCCESS
            } else {
                ExitCode::FAILURE
            }
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

type Prepared = (Graph, usize, Settings, PathBuf, UnixStream);

fn prepare(arguments: impl Iterator<Item = String>, registry: &Registry) -> Result<Prepared, RunError> {
    let refuse = |reason: String| RunError::NotLaunched { reason };
    let arguments: Vec<String> = arguments.collect();
    let [flag_run, run, flag_node, node] = &arguments[..] else {
        return Err(refuse(format!("expected --run-dir DIR --node NAME, got {arguments:?}")));
    };
    if flag_run != "--run-dir" || flag_node != "--node" {
        return Err(refuse(format!("expected --run-dir DIR --node NAME, got {arguments:?}")));
    }
    let stream = launcher().map_err(|e| refuse(format!("standard input is not its line: {e}")))?;
    die_with_launcher();
    let run = PathBuf::from(run);
    let file = Space::attach(&run)?.read(RUN_FILE)?;
    let RunFile { graph, settings } = serde_json::from_slice(&file).map_err(|e| refuse(e.to_string()))?;
    let graph = graph.validate(registry)?;
    let index = graph.index(node).ok_or_else(|| refuse(format!("the graph has no node {node}")))?;
    name_process(node);
    Ok((graph, index, settings, run, stream))
}

/// Takes the line to the launcher away from standard input, so that no process that the node starts holds it.
fn launcher() -> io::Result<UnixStream> {
    let line = duplicate(io::stdin().as_raw_fd())?;
    let stream = UnixStream::from(line);
    // Fails for anything that is not a connected socket.
    stream.peer_addr()?;
    let nothing = std::fs::File::open("/dev/null")?;
    // SAFETY: both descriptors are open; the call replaces standard input, which nobody reads from here on.
    if unsafe { libc::dup2(nothing.as_raw_fd(), 0) } < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(stream)
}

/// A copy of a descriptor that is closed in processes that this one starts.
fn duplicate(fd: i32) -> io::Result<OwnedFd> {
    // SAFETY: the call takes integers only; a descriptor that is not open makes it fail.
    let copy = unsafe { libc::fcntl(fd, libc::F_DUPFD_CLOEXEC, 3) };
    if copy < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: `copy` was just made and nobody else owns it.
    Ok(unsafe { OwnedFd::from_raw_fd(copy) })
}

/// Asks the system to end this process when its launcher dies. The closing line is noticed anyway; this is for
/// a node that hangs in its step.
fn die_with_launcher() {
    // SAFETY: the call takes integers only and changes nothing but this process's own setting.
    unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
}

/// Shows the node's name in the system's list of processes.
fn name_process(node: &str) {
    let name: Vec<u8> = node.bytes().take(15).chain([0]).collect();
    // SAFETY: `name` is zero-terminated, at most 16 bytes long, and outlives the call.
    unsafe { libc::prctl(libc::PR_SET_NAME, name.as_ptr()) };
}

/// Lets sleeps end within a microsecond of their time, not within the 50 that the system allows itself.
fn sleep_exactly() {
    // SAFETY: the call takes integers only and changes nothing but this thread's own setting.
    unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, 1) };
}

/// Puts this thread on its core; gives what was refused.
fn pin(node: &str, settings: &NodeSettings) -> Option<String> {
    let core = settings.core?;
    // The launcher asked which cores exist; one may have been taken away since then.
    let done = core_affinity::set_for_current(core_affinity::CoreId { id: core });
    (!done)
        .then(|| format!("node {node} was to run on core {core}, which the system refuses; it runs on any"))
}

/// Gives this thread its scheduling policy, and keeps its memory; gives what was refused.
fn schedule(node: &str, settings: &NodeSettings) -> Vec<String> {
    let mut refused = Vec::new();
    let policy = match settings.policy {
        Policy::Other => None,
        Policy::Fifo => Some((libc::SCHED_FIFO, "SCHED_FIFO")),
        Policy::Rr => Some((libc::SCHED_RR, "SCHED_RR")),
    };
    if let Some((policy, name)) = policy {
        let parameters = libc::sched_param { sched_priority: settings.priority.into() };
        // SAFETY: `parameters` is a valid sched_param that outlives the call; 0 is the calling thread. Threads that this
        // one starts are ordinary again.
        if unsafe { libc::sched_setscheduler(0, policy | libc::SCHED_RESET_ON_FORK, &parameters) } != 0 {
            let error = io::Error::last_os_error();
            refused.push(format!(
                "node {node} runs like any program, not under {name} with priority {}: {error}; give this user an \
                 rtprio limit (/etc/security/limits.conf) or the program CAP_SYS_NICE",
                settings.priority
            ));
        }
    }
    // SAFETY: the call takes an integer and changes nothing but where this process's memory may lie.
    if settings.lock_memory && unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } != 0 {
        let error = io::Error::last_os_error();
        refused.push(format!(
            "the memory of node {node} may be paged out: {error}; give this user a memlock limit \
             (/etc/security/limits.conf) or the program CAP_IPC_LOCK"
        ));
    }
    refused
}

/// Runs a node by its launcher's orders; says whether it ended in order.
pub(super) fn serve(
    graph: &Graph,
    index: usize,
    settings: &Settings,
    run: &Path,
    stream: UnixStream,
) -> bool {
    let Ok(copy) = stream.try_clone() else { return false };
    let (mut orders, mut answers) =
        (Queue { line: Line::new(copy), waiting: VecDeque::new() }, Line::new(stream));
    sleep_exactly();
    let outcome = work(graph, index, settings, run, &mut orders, &mut answers);
    let in_order = outcome.is_ok();
    // The ports, which the outcome holds, are closed only when all nodes have ended: until then others may
    // still read from them. The launcher says so by closing the line.
    if let Err(reason) = &outcome {
        answers.send(&Answer::Failed { reason: reason.clone() });
    }
    while orders.next(1000).is_some() {}
    in_order
}

/// Orders that have arrived and have not been followed yet.
struct Queue {
    line: Line,
    waiting: VecDeque<Order>,
}

impl Queue {
    /// The next order, or `Some(None)` when none came within so many milliseconds; `None` when the launcher is
    /// gone.
    fn next(&mut self, milliseconds: i32) -> Option<Option<Order>> {
        if self.waiting.is_empty() {
            // A line that is no order comes from a launcher of another version, which is as good as none.
            self.waiting.extend(self.line.receive::<Order>(milliseconds).ok()?);
        }
        match self.waiting.pop_front() {
            None if self.line.closed() => None,
            order => Some(order),
        }
    }
}

/// Builds the node, connects it and runs it; gives it back with its ports open.
fn work(
    graph: &Graph,
    index: usize,
    settings: &Settings,
    run: &Path,
    queue: &mut Queue,
    answers: &mut Line,
) -> Result<Option<(Stepper, Endpoint)>, String> {
    let name = &graph.nodes()[index].name;
    let own = settings.nodes.get(index).ok_or("the launcher says nothing of this node")?;
    let mut refused: Vec<String> = pin(name, own).into_iter().collect();
    let space = Space::attach(run).map_err(|e| e.to_string())?;
    let endpoint = Endpoint::new(&space).map_err(|e| e.to_string())?;
    let node = graph.build(index, settings.seed).map_err(|e| e.to_string())?;
    let mut stepper = Stepper::open(graph, index, node, settings, &endpoint).map_err(|e| e.to_string())?;
    // Last, so that building a node, which may take long, keeps nobody else from running.
    refused.extend(schedule(name, own));
    answers.send(&Answer::Opened { refused });
    let clock = loop {
        match queue.next(1000) {
            Some(Some(Order::Connect)) => {
                let (receivers, recorders) =
                    stepper.connect(graph, index, &endpoint).map_err(|e| e.to_string())?;
                answers.send(&Answer::Connected { receivers, recorders });
            }
            Some(Some(Order::Start { epoch })) => break WallClock::with_epoch(epoch),
            Some(Some(Order::SenderDead { .. }) | None) => {}
            Some(Some(Order::Stop)) | None => return Ok(None),
        }
    };
    let (orders, finished) = (Orders::new(graph.nodes().len()), AtomicBool::new(false));
    let result = std::thread::scope(|scope| {
        // Orders are read beside the loop, which must wait for nothing but its node's inputs. This thread
        // inherits the node's core, where it sleeps.
        scope.spawn(|| follow(graph, queue, &orders, &finished));
        // However the loop ends, also by a panic of the node, the thread beside it must end too.
        let _end = Raise(&finished);
        stepper.run(clock, &orders)
    });
    let mut report = stepper.report();
    report.exit = match result {
        Ok(()) => Exit::Clean,
        Err(StepError::DeadSender { sender }) => Exit::DeadSender { sender },
        Err(error) => Exit::Failed { reason: error.to_string() },
    };
    answers.send(&Answer::Done { report: Box::new(report) });
    Ok(Some((stepper, endpoint)))
}

/// Sets a flag when it goes out of scope.
struct Raise<'a>(&'a AtomicBool);

impl Drop for Raise<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

/// Passes orders on to the running loop until it has finished.
fn follow(graph: &Graph, queue: &mut Queue, orders: &Orders, finished: &AtomicBool) {
    while !finished.load(Ordering::Acquire) {
        match queue.next(20) {
            Some(Some(Order::Stop)) | None => {
                orders.stop.store(true, Ordering::Relaxed);
                return;
            }
            Some(Some(Order::SenderDead { node })) => {
                if let Some(node) = graph.index(&node) {
                    orders.dead[node].store(true, Ordering::Relaxed);
                    orders.dead_news.store(true, Ordering::Release);
                }
            }
            Some(_) => {}
        }
    }
}
