//! What a node process, or a node thread, does: it takes orders from its launcher and runs its node.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::control::{Answer, Line, Order, readable};
use super::cores::{allow, pin};
use super::desk::{Face, Front};
use super::error::RunError;
#[cfg(feature = "link")]
use super::link;
use super::orders::Orders;
use super::plan::{self, RUN_FILE, RunFile, Settings};
use super::priority::{Raised, schedule};
use super::record;
use super::report::Exit;
use super::settings::Policy;
use super::stepper::{StepError, Stepper, panicked};
use crate::channel::{Endpoint, Space, Waker, clean_stale};
use crate::clock::WallClock;
use crate::graph::Graph;
use crate::node::Stopping;
use crate::registry::Registry;

/// The last argument of a process that stops its node and does nothing else.
pub(super) const STOP_ONLY: &str = "--stop";
/// Milliseconds between two looks whether a wish has come back from the node.
const BACK: i32 = 2;
/// So many looks a node may take to end when its launcher is gone: a second. Counted, not timed, so that a machine that was
/// asleep, or kept this process from running, is not taken for a node that hangs.
const GRACE: u32 = 200;
/// So many looks at most whether the others of the run are gone, too: two seconds.
const LEAVING: u32 = 400;
/// Between two such looks.
const LOOK: Duration = Duration::from_millis(5);

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
    let (graph, index, settings, space, stream, stop_only) = match prepare(arguments, registry) {
        #[cfg(feature = "link")]
        Ok(Prepared { graph, settings, space, stream, role: Role::Link, .. }) => {
            link::serve(&graph, &settings, &space, stream);
            return ExitCode::SUCCESS;
        }
        Ok(Prepared { graph, settings, space, stream, role: Role::Recorder, .. }) => {
            record::bear_full_files();
            if record::serve(&graph, &settings, &space, stream) == record::End::LauncherGone {
                leave(&space);
            }
            return ExitCode::SUCCESS;
        }
        Ok(Prepared { graph, role: Role::Node(index), settings, space, stream, stop_only }) => {
            (graph, index, settings, space, stream, stop_only)
        }
        Err(error) => {
            complain(&error.to_string());
            return ExitCode::FAILURE;
        }
    };
    let in_order = if stop_only {
        stop_after_crash(&graph, index, &settings)
    } else {
        match serve(&graph, index, &settings, space.path(), stream, Some(&space)) {
            Served::InOrder => true,
            Served::Failed => false,
            Served::LauncherGone => {
                leave(&space);
                false
            }
        }
    };
    if in_order { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Says something on standard error, of which nobody need be left who reads it.
fn complain(text: &str) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// The launcher is gone: whoever of its nodes is the last removes what the run had in shared memory.
fn leave(space: &Space) {
    space.leave();
    // The kernel closes what a dying process holds one by one: the line to the launcher closes a while before its lock is
    // free, and a node may well have ended in between.
    for _ in 0..LEAVING {
        // What cannot be removed at all is removed by the next run.
        let _ = clean_stale();
        if !space.path().exists() {
            return;
        }
        std::thread::sleep(LOOK);
    }
}

/// Builds a node for nothing but to stop it.
fn stop_after_crash(graph: &Graph, index: usize, settings: &Settings) -> bool {
    match graph.build(index, settings.seed) {
        Ok(mut node) => {
            node.stop(Stopping::AfterCrash);
            true
        }
        Err(error) => {
            complain(&error.to_string());
            false
        }
    }
}

/// What a node process knows before it does anything.
struct Prepared {
    graph: Graph,
    role: Role,
    settings: Settings,
    space: Space,
    stream: UnixStream,
    stop_only: bool,
}

/// What a process of a run does.
enum Role {
    /// It runs the node with this place in the graph.
    Node(usize),
    Recorder,
    /// It is the link to other machines.
    #[cfg(feature = "link")]
    Link,
}

fn prepare(arguments: impl Iterator<Item = String>, registry: &Registry) -> Result<Prepared, RunError> {
    let refuse = |reason: String| RunError::NotLaunched { reason };
    let arguments: Vec<String> = arguments.collect();
    let stop_only = arguments.last().is_some_and(|last| last == STOP_ONLY);
    let named = &arguments[..arguments.len() - usize::from(stop_only)];
    let (run, node) = match named {
        [flag_run, run, flag_node, node] if flag_run == "--run-dir" && flag_node == "--node" => (run, node),
        _ => return Err(refuse(format!("expected --run-dir DIR --node NAME, got {arguments:?}"))),
    };
    let stream = launcher().map_err(|e| refuse(format!("standard input is not its line: {e}")))?;
    awake_without_launcher();
    wait_for_the_launcher_to_say();
    let space = Space::attach(Path::new(run))?;
    let file = space.read(RUN_FILE)?;
    let RunFile { graph, settings } = serde_json::from_slice(&file).map_err(|e| refuse(e.to_string()))?;
    let graph = graph.validate(registry)?;
    let role = match graph.index(node) {
        Some(index) => Role::Node(index),
        None if node == record::NAME => Role::Recorder,
        #[cfg(feature = "link")]
        None if node == link::NAME => Role::Link,
        None => return Err(refuse(format!("the graph has no node {node}"))),
    };
    name_process(node);
    Ok(Prepared { graph, role, settings, space, stream, stop_only })
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

/// Asks the system to let this process go on when its launcher dies, if somebody has stopped it: the closing line is
/// noticed then as by any other node, and nobody else would let it go on.
fn awake_without_launcher() {
    // SAFETY: the call takes integers only and changes nothing but this process's own setting.
    unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGCONT) };
}

/// Has requests to end be the launcher's to follow: whoever ends a service, a session or a machine sends them to every process at once,
/// and a node that died of one would not have stopped its hardware. When the launcher ends, its line says so.
fn wait_for_the_launcher_to_say() {
    for signal in [libc::SIGTERM, libc::SIGINT, libc::SIGHUP] {
        // SAFETY: the call takes integers only, and no handler is installed that could run.
        unsafe { libc::signal(signal, libc::SIG_IGN) };
    }
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

/// How a node's service ended.
pub(super) enum Served {
    InOrder,
    Failed,
    /// It ended because nobody was left to give orders.
    LauncherGone,
}

/// Runs a node by its launcher's orders. `own` is the space of a node that is a process, which has to end whatever its
/// code does when its launcher is gone.
pub(super) fn serve(
    graph: &Graph,
    index: usize,
    settings: &Settings,
    run: &Path,
    stream: UnixStream,
    own: Option<&Space>,
) -> Served {
    let Ok(copy) = stream.try_clone() else { return Served::Failed };
    let (mut orders, mut answers) =
        (Queue { line: Line::new(copy), waiting: VecDeque::new() }, Line::new(stream));
    sleep_exactly();
    let outcome = work(graph, index, settings, run, own, &mut orders, &mut answers);
    // The ports, which the outcome holds, are closed only when all nodes have ended: until then others may
    // still read from them. The launcher says so by closing the line.
    if let Err(reason) = &outcome {
        answers.send(&Answer::Failed { reason: reason.clone() });
    }
    let alone = matches!(&outcome, Ok(Ended { alone: true, .. }));
    while orders.next(1000).is_some() {}
    match outcome {
        _ if alone => Served::LauncherGone,
        Ok(_) => Served::InOrder,
        Err(_) => Served::Failed,
    }
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

/// A node that has ended, with its ports open.
struct Ended {
    _ports: (Stepper, Endpoint),
    /// Whether its launcher was gone by then.
    alone: bool,
}

/// Builds the node, connects it and runs it; gives it back with its ports open.
fn work(
    graph: &Graph,
    index: usize,
    settings: &Settings,
    run: &Path,
    own: Option<&Space>,
    queue: &mut Queue,
    answers: &mut Line,
) -> Result<Ended, String> {
    let name = &graph.nodes()[index].name;
    let wishes = settings.nodes.get(index).ok_or("the launcher says nothing of this node")?;
    // The threads beside the node's may run wherever this one may now.
    let anywhere = core_affinity::get_core_ids().unwrap_or_default();
    let mut refused: Vec<String> = pin(name, wishes).into_iter().collect();
    let space = Space::attach(run).map_err(|e| e.to_string())?;
    let endpoint = Endpoint::new(&space).map_err(|e| e.to_string())?;
    let mut node = graph.build(index, settings.seed).map_err(|e| e.to_string())?;
    let (orders, face) = (Orders::new(graph.nodes().len()), Face::of(&mut *node));
    let mut front = Front::new(name, &face, &orders.desk);
    // The recorder names by it what is set.
    let parameters = serde_json::to_vec(&face.parameters).map_err(|e| e.to_string())?;
    space.replace(&plan::parameters_file(name), &parameters).map_err(|e| e.to_string())?;
    let mut stepper =
        Stepper::open(graph, index, node, settings, &endpoint, run).map_err(|e| e.to_string())?;
    let wake = endpoint.waker(&plan::wake(graph, index)).map_err(|e| e.to_string())?;
    // Last, so that building a node, which may take long, keeps nobody else from running.
    refused.extend(schedule(name, wishes));
    answers.send(&Answer::Opened { refused });
    let clock = loop {
        match queue.next(1000) {
            Some(Some(Order::Connect)) => {
                let (receivers, recorders) =
                    stepper.connect(graph, index, settings, &endpoint).map_err(|e| e.to_string())?;
                space.populate().map_err(|e| format!("cannot see what is mapped: {e}"))?;
                answers.send(&Answer::Connected { receivers, recorders });
            }
            Some(Some(Order::Start { epoch, resume })) => {
                let clock = WallClock::with_epoch(epoch);
                if resume {
                    let (step, shift) = stepper.resume(graph, index, clock).map_err(|e| e.to_string())?;
                    answers.send(&Answer::Resumed { step, shift });
                }
                break clock;
            }
            // What was set before a restart is set again before the first step.
            Some(Some(Order::Tune { id, by, wish })) => {
                front.take(id, by, &wish).iter().for_each(|answer| answers.send(answer));
            }
            // What is for a recorder or the link is for nobody here.
            Some(
                Some(
                    Order::SenderGone { .. }
                    | Order::Record { .. }
                    | Order::Fault { .. }
                    | Order::Clocks { .. }
                    | Order::Link { .. }
                    | Order::Finish { .. },
                )
                | None,
            ) => {}
            Some(Some(Order::Stop)) => {
                let problem = stepper.finish(WallClock::starting_in(0), Stopping::Over);
                answers.send(&Answer::Done { exit: Exit::Clean, problem, ends_run: false });
                return Ok(Ended { _ports: (stepper, endpoint), alone: false });
            }
            None => {
                stepper.finish(WallClock::starting_in(0), Stopping::LauncherGone);
                return Ok(Ended { _ports: (stepper, endpoint), alone: true });
            }
        }
    };
    // Its lock would be that of a living process to whoever looks after what the run left, this one included.
    drop(space);
    let finished = AtomicBool::new(false);
    // A line inside this process that closes when the loop is over: whoever waits for orders waits for that, too, without
    // looking for it now and then on a core that a node may need.
    let (over, closes) = UnixStream::pair().map_err(|e| format!("cannot make a socket: {e}"))?;
    let (exit, problem, ends_run) = std::thread::scope(|scope| {
        // Orders are read beside the loop, which must wait for nothing but its node's inputs.
        scope.spawn(|| {
            // Not on the node's core: a node that polls under a real-time policy would keep this thread from running.
            allow(&anywhere);
            let _raised = Raised::current(wishes.policy != Policy::Other);
            follow(graph, queue, &orders, front, (&finished, &over), &wake, own);
        });
        // However the node ends, the thread beside it must end too.
        let _end = Raise(&finished, closes);
        let result = catch_unwind(AssertUnwindSafe(|| stepper.run(clock, &orders)));
        let failed = |reason: String| (Exit::Failed { reason }, Stopping::Failed);
        let mut ends_run = false;
        let (exit, why) = match result {
            Ok(Ok(())) if orders.launcher_gone.load(Ordering::Relaxed) => {
                (Exit::Clean, Stopping::LauncherGone)
            }
            Ok(Ok(())) => (Exit::Clean, Stopping::Over),
            Ok(Err(StepError::DeadSender { sender })) => (Exit::DeadSender { sender }, Stopping::SenderGone),
            Ok(Err(error)) => {
                ends_run = matches!(error, StepError::Deadline { .. });
                failed(error.to_string())
            }
            Err(panic) => failed(format!("step {} {}", stepper.running(), panicked(&*panic))),
        };
        (exit, stepper.finish(clock, why), ends_run)
    });
    answers.send(&Answer::Done { exit, problem, ends_run });
    let alone = orders.launcher_gone.load(Ordering::Relaxed);
    Ok(Ended { _ports: (stepper, endpoint), alone })
}

/// Sets a flag when it goes out of scope, and closes a line then.
struct Raise<'a>(&'a AtomicBool, #[expect(dead_code, reason = "closed by its drop")] UnixStream);

impl Drop for Raise<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

/// Passes orders on to the running loop until it has finished.
fn follow(
    graph: &Graph,
    queue: &mut Queue,
    orders: &Orders,
    mut front: Front<'_>,
    (finished, over): (&AtomicBool, &UnixStream),
    wake: &Waker,
    own: Option<&Space>,
) {
    while !finished.load(Ordering::Acquire) {
        if queue.waiting.is_empty() {
            let patience = if front.busy() { BACK } else { -1 };
            readable(&[queue.line.fd(), over.as_raw_fd()], patience);
        }
        front.turn().iter().for_each(|answer| queue.line.send(answer));
        match queue.next(0) {
            Some(Some(Order::Stop)) => orders.stop.store(true, Ordering::Relaxed),
            Some(Some(Order::SenderGone { node, next, back })) => {
                if let Some(node) = graph.index(&node) {
                    orders.gone(node, next, back);
                }
            }
            Some(Some(Order::Tune { id, by, wish })) => {
                front.take(id, by, &wish).iter().for_each(|answer| queue.line.send(answer));
                continue;
            }
            Some(_) => continue,
            None => {
                orders.launcher_gone.store(true, Ordering::Relaxed);
                orders.stop.store(true, Ordering::Relaxed);
                wake.wake();
                return end_alone(finished, own);
            }
        }
        wake.wake();
    }
}

/// The launcher is gone. A node that hangs in its step would be left for ever: there is nobody to end it.
fn end_alone(finished: &AtomicBool, own: Option<&Space>) {
    let Some(own) = own else { return };
    for _ in 0..GRACE {
        if finished.load(Ordering::Acquire) {
            return;
        }
        std::thread::sleep(LOOK);
    }
    leave(own);
    complain("a node hangs and its launcher is gone: it ends without having stopped in order");
    // SAFETY: the call takes an integer and does not return.
    unsafe { libc::_exit(1) };
}
