//! Starts, synchronises, watches and stops the nodes of one run.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use super::control::{Answer, Order, readable};
use super::error::RunError;
use super::plan::{self, RUN_FILE, RunFile, Settings};
use super::recorder::Recorder;
use super::report::{End, Exit, NodeReport, RunReport};
use super::settings::{NodeSettings, Refused, RunAs};
use super::signals::Signals;
use super::worker::Worker;
use super::{Progress, RunOptions, cores, worker_main};
use crate::channel::{Endpoint, Service, Space};
use crate::clock::{WallClock, monotonic};
use crate::graph::{Graph, GraphSpec, OnDeadSender};
use crate::recording::{Clock, Fault, FaultKind};
use crate::registry::Registry;
use crate::time::Nanos;

/// Between the order to start and the common start: time for the order to reach every node.
const LEAD: Nanos = 20_000_000;
/// How long nodes that wait for a dead one may take to stop by themselves before they are told to.
const SETTLING: Duration = Duration::from_millis(300);
/// How often the launcher looks around when nothing happens, in milliseconds.
const TICK: i32 = 50;

/// Runs a graph in real time.
///
/// # Errors
///
/// [`RunError`] when the run could not be made, or its recording not be written. A run that began and lost a
/// node is reported, not an error: see [`RunReport::failure`].
pub fn run(spec: &GraphSpec, registry: &Registry, mut options: RunOptions) -> Result<RunReport, RunError> {
    let called = monotonic();
    let mut spec = spec.clone();
    options.launch.put_into(&mut spec)?;
    let graph = spec.validate(registry)?;
    let mut nodes = options.launch.resolve(&graph, &options.base())?;
    let signals = if options.signals { Some(Signals::watch().map_err(RunError::Signals)?) } else { None };
    let (mut warnings, refused) = cores::assign(&graph, &mut nodes, options.spread)?;
    heed(refused, options.launch.refused, &mut warnings)?;
    check_private(&graph, &nodes, &options)?;
    let space = Space::create()?;
    let memory = plan::memory(&graph, options.recording.is_some());
    space.reserve(memory)?;
    let settings = Settings {
        seed: options.seed,
        duration: options.duration,
        recording: options.recording.is_some(),
        nodes,
    };
    let file = RunFile { graph: graph.spec().clone(), settings: settings.clone() };
    let file = serde_json::to_vec(&file).map_err(|e| crate::channel::ChannelError::Io {
        what: "cannot describe the run in",
        path: space.path().join(RUN_FILE),
        source: e.into(),
    })?;
    space.write(RUN_FILE, &file)?;

    // Everything is declared in the order in which it must not end: the space last, the nodes first.
    let endpoint = Endpoint::new(&space)?;
    let _services = create(&graph, &endpoint, settings.recording)?;
    let recorder = match &options.recording {
        Some(path) => Some(Recorder::start(&graph, &space, path)?),
        None => None,
    };
    let workers = start(&graph, &settings, &space, &options)?;
    let mut crew = Crew { graph: &graph, reports: vec![None; workers.len()], workers, recorder };
    let refused = crew.handshake(&settings, options.patience)?;
    heed(refused, options.launch.refused, &mut warnings)?;

    let clock = WallClock::starting_in(LEAD);
    if let Some(recorder) = &mut crew.recorder {
        recorder.begin(describe_clock(clock, options.seed));
    }
    crew.workers.iter_mut().for_each(|worker| worker.order(&Order::Start { epoch: clock.epoch() }));
    let end = crew.watch(clock, &mut options, signals.as_ref());
    let duration = match (&end, options.duration) {
        (End::Duration, Some(duration)) => duration,
        _ => clock.now().max(0),
    };
    crew.stop(clock, options.patience);
    let shared_memory = used(&space);
    let recorder = crew.recorder.take();
    let records_lost = recorder.map_or(Ok(Vec::new()), |recorder| recorder.finish(duration));
    let nodes = crew.dismiss(options.patience);
    let records_lost = records_lost?;
    for (node, lost) in &records_lost {
        warnings.push(format!(
            "{lost} records of node {node} did not reach the recorder: its recording has holes there"
        ));
    }
    Ok(RunReport {
        graph: graph.spec().name.clone(),
        end,
        duration,
        startup: clock.epoch() - called,
        shared_memory,
        nodes,
        records_lost,
        warnings,
    })
}

/// What the system refused becomes a warning, or the end, as was asked.
fn heed(refused: Vec<String>, then: Refused, warnings: &mut Vec<String>) -> Result<(), RunError> {
    if then == Refused::Stop && !refused.is_empty() {
        return Err(RunError::Refused { refused });
    }
    warnings.extend(refused);
    Ok(())
}

fn check_private(graph: &Graph, nodes: &[NodeSettings], options: &RunOptions) -> Result<(), RunError> {
    for node in options.private.keys() {
        let index = graph.index(node).ok_or_else(|| RunError::PrivateForNobody { node: node.clone() })?;
        if nodes[index].run_as == RunAs::Thread {
            return Err(RunError::PrivateNeedsProcesses { node: node.clone() });
        }
    }
    Ok(())
}

/// Creates every channel, so that no node has to wait for another to exist.
fn create(graph: &Graph, endpoint: &Endpoint, recording: bool) -> Result<Vec<Service>, RunError> {
    let mut services = Vec::new();
    for node in 0..graph.nodes().len() {
        services.push(endpoint.create(&plan::output(graph, node))?);
        if recording {
            services.push(endpoint.create(&plan::records(graph, node))?);
        }
    }
    Ok(services)
}

fn start(
    graph: &Graph,
    settings: &Settings,
    space: &Space,
    options: &RunOptions,
) -> Result<Vec<Worker>, RunError> {
    let none = Default::default();
    let start = |(index, node): (usize, &crate::graph::NodePlan)| {
        let worker = match settings.nodes[index].run_as {
            RunAs::Process => {
                let private = options.private.get(&node.name).unwrap_or(&none);
                Worker::process(&options.node_command, space.path(), &node.name, private)
            }
            RunAs::Thread => {
                let (graph, settings, run) = (graph.clone(), settings.clone(), space.path().to_path_buf());
                Worker::thread(&node.name, move |stream| {
                    worker_main::serve(&graph, index, &settings, &run, stream);
                })
            }
        };
        worker.map_err(|source| RunError::Spawn { node: node.name.clone(), source })
    };
    graph.nodes().iter().enumerate().map(start).collect()
}

fn describe_clock(clock: WallClock, seed: u64) -> Clock {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos() as Nanos);
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    Clock::Wall { start: unix - clock.now(), host: host.trim().into(), seed }
}

/// Bytes that this run occupies in shared memory.
fn used(space: &Space) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let Some(entries) = space.path().ancestors().nth(2).and_then(|path| std::fs::read_dir(path).ok()) else {
        return 0;
    };
    let ours =
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().starts_with(space.prefix()));
    ours.filter_map(|entry| entry.metadata().ok()).map(|metadata| metadata.blocks() * 512).sum()
}

impl Drop for Crew<'_> {
    fn drop(&mut self) {
        // All are told before the first is waited for.
        self.workers.iter_mut().for_each(Worker::hang_up);
    }
}

/// The nodes of a run, and the recorder.
struct Crew<'a> {
    graph: &'a Graph,
    workers: Vec<Worker>,
    recorder: Option<Recorder>,
    /// How each node ended, once it has.
    reports: Vec<Option<NodeReport>>,
}

impl Crew<'_> {
    /// Brings all nodes to the point where they wait for the common start; gives what the system refused them.
    fn handshake(&mut self, settings: &Settings, patience: Duration) -> Result<Vec<String>, RunError> {
        let mut said = Vec::new();
        self.await_all(patience, "open its channels", |_, answer| {
            let Answer::Opened { refused } = answer else { return Ok(false) };
            said.extend_from_slice(refused);
            Ok(true)
        })?;
        self.workers.iter_mut().for_each(|worker| worker.order(&Order::Connect));
        let graph = self.graph;
        self.await_all(patience, "connect to its receivers", |node, answer| {
            let Answer::Connected { receivers, recorders } = answer else { return Ok(false) };
            let expected = graph.nodes()[node].outputs.len() + usize::from(settings.recording);
            let got = receivers + recorders;
            if got != expected {
                return Err(RunError::Receivers { node: graph.nodes()[node].name.clone(), got, expected });
            }
            Ok(true)
        })?;
        Ok(said)
    }

    /// Waits until every node has given the answer that `accept` wants.
    fn await_all(
        &mut self,
        patience: Duration,
        what: &'static str,
        mut accept: impl FnMut(usize, &Answer) -> Result<bool, RunError>,
    ) -> Result<(), RunError> {
        let start = Instant::now();
        let mut pending = vec![true; self.workers.len()];
        loop {
            for (node, worker) in self.workers.iter_mut().enumerate() {
                for answer in worker.answers() {
                    if let Answer::Failed { reason } = answer {
                        return Err(RunError::Start {
                            node: worker.node.clone(),
                            exit: Exit::Failed { reason },
                        });
                    }
                    if accept(node, &answer)? {
                        pending[node] = false;
                    }
                }
                if worker.line.closed() {
                    worker.join(Duration::from_millis(100));
                }
                if let Some(exit) = worker.death() {
                    return Err(RunError::Start { node: worker.node.clone(), exit });
                }
            }
            let Some(late) = pending.iter().position(|pending| *pending) else { return Ok(()) };
            if start.elapsed() > patience {
                let (node, seconds) = (self.workers[late].node.clone(), patience.as_secs_f64());
                return Err(RunError::Silent { node, what, seconds });
            }
            self.pause(TICK);
        }
    }

    /// Waits until a node says something or dies, a signal comes, or the time is over.
    fn pause(&self, milliseconds: i32) {
        let lines = self.workers.iter().filter(|worker| !worker.line.closed());
        let lines: Vec<_> = lines.map(|worker| worker.line.fd()).collect();
        readable(&lines, milliseconds);
    }

    /// Watches the running nodes until the run is to end.
    fn watch(&mut self, clock: WallClock, options: &mut RunOptions, signals: Option<&Signals>) -> End {
        loop {
            let now = clock.now();
            let left = options.duration.map_or(Nanos::MAX, |duration| duration - now);
            if let Some(progress) = &mut options.progress
                && !progress(Progress { elapsed: now, duration: options.duration })
            {
                return End::Signal;
            }
            if signals.is_some_and(Signals::raised) {
                return End::Signal;
            }
            if left <= 0 {
                return End::Duration;
            }
            if let Some(node) = self.look(clock, left <= 0)
                && self.needed(node)
            {
                return End::Node { node: self.workers[node].node.clone() };
            }
            if self.recorder.as_ref().is_some_and(Recorder::ended) {
                return End::Recorder;
            }
            if self.reports.iter().all(Option::is_some) {
                return End::Duration;
            }
            self.pause(TICK.min((left / 1_000_000 + 1).min(i64::from(TICK)) as i32));
        }
    }

    /// Takes in what nodes say and who died; gives a node that ended although the run goes on.
    fn look(&mut self, clock: WallClock, over: bool) -> Option<usize> {
        let mut gone = None;
        for node in 0..self.workers.len() {
            if self.reports[node].is_some() {
                continue;
            }
            let worker = &mut self.workers[node];
            let mut report = None;
            for answer in worker.answers() {
                report = match answer {
                    Answer::Done { report } => Some(*report),
                    Answer::Failed { reason } => Some(NodeReport {
                        node: worker.node.clone(),
                        exit: Exit::Failed { reason },
                        ..NodeReport::default()
                    }),
                    _ => report,
                };
            }
            if report.is_none() && worker.line.closed() {
                worker.join(Duration::from_millis(500));
            }
            if report.is_none()
                && let Some(exit) = worker.death()
            {
                report = Some(NodeReport { node: worker.node.clone(), exit, ..NodeReport::default() });
            }
            let Some(report) = report else { continue };
            if report.exit != Exit::Clean && !over {
                gone = gone.or(Some(node));
                self.mourn(node, &report.exit, clock);
            }
            self.reports[node] = Some(report);
        }
        gone
    }

    /// Tells the recording and the receivers that a node is gone.
    fn mourn(&mut self, node: usize, exit: &Exit, clock: WallClock) {
        let name = self.workers[node].node.clone();
        let kind = match exit {
            Exit::Clean => return,
            Exit::Failed { reason } => FaultKind::Failed { message: reason.clone() },
            Exit::DeadSender { sender } => FaultKind::DeadSender { sender: sender.clone() },
            Exit::Died { .. } => FaultKind::Died { message: exit.to_string() },
        };
        if let Some(recorder) = &self.recorder {
            recorder.fault(Fault { node: name.clone(), time: clock.now().max(0), kind });
        }
        for receiver in plan::receivers(self.graph, node) {
            self.workers[receiver].order(&Order::SenderDead { node: name.clone() });
        }
    }

    /// Whether the run cannot go on without a node: it is the supervisor, nobody listens to it, or somebody
    /// who does wants to stop then.
    fn needed(&self, node: usize) -> bool {
        let receivers = plan::receivers(self.graph, node);
        node == self.graph.supervisor()
            || receivers.is_empty()
            || receivers
                .iter()
                .any(|receiver| self.graph.nodes()[*receiver].on_dead_sender == OnDeadSender::Stop)
    }

    /// Lets the nodes that stop by themselves, because one that they wait for is gone, do so and say it.
    fn settle(&mut self, clock: WallClock) {
        let start = Instant::now();
        while (0..self.workers.len()).any(|node| self.stopping(node)) && start.elapsed() < SETTLING {
            self.pause(5);
            self.look(clock, false);
        }
    }

    /// Whether a node is about to stop by itself.
    fn stopping(&self, node: usize) -> bool {
        let plan = &self.graph.nodes()[node];
        let gone = |connection: &usize| {
            let connection = &self.graph.connections()[*connection];
            let report = self.reports[connection.from].as_ref();
            connection.blocking && report.is_some_and(|report| report.exit != Exit::Clean)
        };
        self.reports[node].is_none()
            && plan.on_dead_sender == OnDeadSender::Stop
            && plan.inputs.iter().any(gone)
    }

    /// Stops all nodes and waits until each has said how it fared.
    fn stop(&mut self, clock: WallClock, patience: Duration) {
        self.settle(clock);
        self.workers.iter_mut().for_each(|worker| worker.order(&Order::Stop));
        let start = Instant::now();
        while self.reports.iter().any(Option::is_none) && start.elapsed() < patience {
            self.pause(TICK);
            self.look(clock, true);
        }
    }

    /// Lets all nodes end; gives their reports.
    fn dismiss(mut self, patience: Duration) -> Vec<NodeReport> {
        let (workers, reports) = (std::mem::take(&mut self.workers), std::mem::take(&mut self.reports));
        let dismiss = |(mut worker, report): (Worker, Option<NodeReport>)| {
            worker.hang_up();
            let in_time = worker.join(patience);
            report.unwrap_or_else(|| NodeReport {
                node: worker.node.clone(),
                exit: Exit::Died {
                    pid: worker.pid(),
                    status: if in_time {
                        "ended without a report".into()
                    } else {
                        "did not stop and was killed".into()
                    },
                },
                ..NodeReport::default()
            })
        };
        // All lines are closed before the first wait: nodes end side by side.
        let mut pairs: Vec<_> = workers.into_iter().zip(reports).collect();
        pairs.iter_mut().for_each(|(worker, _)| worker.hang_up());
        pairs.into_iter().map(dismiss).collect()
    }
}
