//! Starts, synchronises, watches and stops the nodes of one run.

use std::collections::BTreeMap;
use std::time::{SystemTime, UNIX_EPOCH};

use super::about::{About, RunPage};
use super::crew::{Crew, Site};
use super::error::RunError;
use super::link::{Begin, Bridge, Placement, TIME_OVER, Turn};
use super::plan::{self, RUN_FILE, RecordingPlan, RunFile, Settings};
use super::priority::Raised;
use super::recorder::Recorder;
use super::report::{End, LinkReport, NodeReport, RecordingReport, RunReport};
use super::settings::{NodeSettings, Policy, Refused, RunAs};

use super::signals::Signals;
use super::vitals::Vitals;
use super::worker::{Program, Worker};
use super::{Progress, RunOptions, Warner, cores, worker_main};
use crate::channel::{Endpoint, Service, Space};
use crate::clock::{WallClock, monotonic};
use crate::graph::{Graph, GraphSpec};
use crate::recording::{Access, Clock, RecordingError};
use crate::registry::Registry;
use crate::time::Nanos;

/// Between the order to start and the common start: time for the order to reach every node.
const LEAD: Nanos = 20_000_000;
/// The same where the order has to reach other machines.
const FAR_LEAD: Nanos = 500_000_000;

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
    let mut warnings = Warnings { tell: options.warn.take(), list: Vec::new() };
    let placement = options.launch.place(&graph, options.host.as_deref())?;
    if let Some(placement) = &placement {
        check_recorder(placement, options.recording.is_some())?;
        watch_only(placement, &mut nodes);
    }
    let here = |node: usize| placement.as_ref().is_none_or(|placement| placement.is_here(node));
    let (worth_knowing, refused) = cores::assign(&graph, &mut nodes, here, options.spread)?;
    warnings.extend(worth_knowing);
    heed(refused, options.launch.refused, &mut warnings)?;
    check_private(&graph, &nodes, &options)?;
    check_programs(&graph, &nodes, here, &options)?;
    let space = Space::create()?;
    let settings = Settings {
        seed: options.seed,
        duration: options.duration,
        recording: match &placement {
            Some(placement) => placement.recorder.is_some(),
            None => options.recording.is_some(),
        },
        recorder: recording_plan(&options)?,
        nodes,
        placement,
    };
    space.reserve(plan::memory(&graph, &settings))?;
    let file = RunFile { graph: graph.spec().clone(), settings: settings.clone() };
    let file = serde_json::to_vec(&file).map_err(|e| crate::channel::ChannelError::Io {
        what: "cannot describe the run in",
        path: space.path().join(RUN_FILE),
        source: e.into(),
    })?;
    space.write(RUN_FILE, &file)?;

    // Everything is declared in the order in which it must not end: the space last, the nodes first.
    let endpoint = Endpoint::new(&space)?;
    let _services = create(&graph, &endpoint, &settings)?;
    let recorder = match &options.recording {
        Some(path) => {
            Some(Recorder::start(&graph, &settings, &space, path, &options.node_command, &options)?)
        }
        None => None,
    };
    let vitals = graph.nodes().iter().map(|node| Vitals::open(space.path(), &node.name, node.inputs.len()));
    let vitals = vitals.collect::<Result<Vec<_>, _>>()?;
    let page = RunPage::create(&space)?;
    About::new(&graph, &settings).write(&space)?;
    let hiring = Hiring {
        command: std::mem::take(&mut options.node_command),
        private: std::mem::take(&mut options.private),
        programs: std::mem::take(&mut options.programs),
    };
    let hire = |node, stop_only| hire(&graph, &settings, &space, &hiring, node, stop_only);
    let bridge = match &settings.placement {
        Some(placement) => Some(Bridge::start(&space, placement, &hiring.command)?),
        None => None,
    };
    let site = Site { graph: &graph, settings: &settings, space: &space, endpoint: &endpoint, hire: &hire };
    let mut crew = Crew::start(site, vitals, recorder, bridge, &mut options)?;
    crew.journal.warn = warnings.tell.take();
    let mut stopped = || {
        // When the run begins is not known yet: not before so much later.
        let progress = Progress { elapsed: -LEAD, duration: options.duration };
        let wanted = options.progress.as_mut().is_none_or(|told| told(progress));
        !wanted || signals.as_ref().is_some_and(Signals::raised)
    };
    let refused = crew.handshake(&mut stopped)?;
    warnings.tell = crew.journal.warn.take();
    heed(refused, options.launch.refused, &mut warnings)?;
    // Every port exists now.
    space.commit()?;
    let _raised = Raised::current(settings.nodes.iter().any(|node| node.policy != Policy::Other));

    let begin = match &mut crew.bridge {
        None => Begin { epoch: WallClock::starting_in(LEAD).epoch(), again: false },
        Some(bridge) => {
            let mut tell = |text: &str| {
                if let (Some(tell), false) = (&mut warnings.tell, text.is_empty()) {
                    tell(text);
                }
                !signals.as_ref().is_some_and(Signals::raised)
            };
            bridge.begin(|| WallClock::starting_in(FAR_LEAD).epoch(), &mut tell)?
        }
    };
    let clock = WallClock::with_epoch(begin.epoch);
    crew.journal.warn = warnings.tell.take();
    if let Some(recorder) = &mut crew.recorder {
        recorder.begin(describe_clock(clock, options.seed), begin.again);
    }
    crew.begin(begin);
    page.running(clock.epoch());
    let end = crew.watch(clock, &mut options, signals.as_ref());
    page.stopping(&end, &graph);
    let duration = match (&end, options.duration) {
        (End::Duration, Some(duration)) => duration,
        _ => clock.now().max(0),
    };
    crew.stop(clock);
    let shared_memory = used(&space);
    let link = pass_on(&mut crew, &end);
    warnings.tell = crew.journal.warn.take();
    warnings.list.append(&mut crew.journal.said);
    let recorder = crew.recorder.take();
    let recording = recorder.map(|recorder| recorder.finish(&graph, duration, &endpoint));
    let (nodes, journal) = crew.dismiss(clock);
    page.over();
    warnings.extend(recording.iter().flat_map(RecordingReport::warnings));
    warnings.extend(nodes.iter().filter(|node| node.steps == 0).map(never_stepped));
    Ok(RunReport {
        graph: graph.spec().name.clone(),
        end,
        duration,
        startup: clock.epoch() - called,
        shared_memory,
        nodes,
        events: journal.events,
        events_omitted: journal.omitted,
        link,
        recording,
        warnings: warnings.list,
    })
}

/// Where the recording goes, as a process that may run elsewhere has to know it.
fn recording_plan(options: &RunOptions) -> Result<Option<RecordingPlan>, RunError> {
    let Some(path) = &options.recording else { return Ok(None) };
    let create = |source| RecordingError::Io { path: path.clone(), what: "find the folder of", source };
    let absolute = std::path::absolute(path).map_err(create)?;
    let access = options.launch.group.as_ref().map_or(Ok(Access::Owner), |group| {
        Access::group(group).map_err(|source| RunError::Group { group: group.clone(), source })
    })?;
    Ok(Some(RecordingPlan { path: absolute, rotate: options.rotate, access, packing: options.packing }))
}

/// Says why a node made no step, as far as that is known.
fn never_stepped(node: &NodeReport) -> String {
    let silent: Vec<&str> =
        node.inputs.iter().filter(|input| input.sent == 0).map(|input| input.from.as_str()).collect();
    let why = match &silent[..] {
        [] => "its first step did not end, or the run was too short for it".into(),
        senders => format!("nothing came from {}", senders.join(", ")),
    };
    format!("node {} made no step: {why}", node.node)
}

/// What is worth knowing, told as soon as it is known, and kept for the report.
struct Warnings {
    tell: Option<Warner>,
    list: Vec<String>,
}

impl Warnings {
    fn extend(&mut self, warnings: impl IntoIterator<Item = String>) {
        for warning in warnings {
            if let Some(tell) = &mut self.tell {
                tell(&warning);
            }
            self.list.push(warning);
        }
    }
}

/// What the system refused becomes a warning, or the end, as was asked.
fn heed(refused: Vec<String>, then: Refused, warnings: &mut Warnings) -> Result<(), RunError> {
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

/// One machine records, and that one has to be told where to.
fn check_recorder(placement: &Placement, recording: bool) -> Result<(), RunError> {
    let problem = match placement.recorder {
        None if recording => "no machine records: name one, recorder = \"NAME\" under [link] of the launch settings, and \
                              give the file there"
            .into(),
        // Another one than that keeps a copy of what its own nodes record.
        Some(_) if placement.records_here() && !recording => {
            "this machine records for all (recorder under [link]): say where to, with --out FILE.mcap or --record".into()
        }
        _ => return Ok(()),
    };
    Err(RunError::RecorderElsewhere { problem })
}

/// What holds here for nodes of other machines: their signs of life are watched, and nothing is done about them.
fn watch_only(placement: &Placement, nodes: &mut [NodeSettings]) {
    for (node, settings) in nodes.iter_mut().enumerate().filter(|(node, _)| !placement.is_here(*node)) {
        debug_assert!(node < placement.of.len());
        *settings = NodeSettings { heartbeat: placement.ways[node].silence, ..NodeSettings::default() };
    }
}

/// Lets the link pass on what is left, and waits for the other machines; gives what became of it.
fn pass_on(crew: &mut Crew<'_>, end: &End) -> Option<LinkReport> {
    let exits = crew.exits();
    let mut bridge = crew.bridge.take()?;
    let why = match end {
        End::Duration => TIME_OVER.into(),
        End::Signal => "somebody stopped it there".into(),
        End::Node { node } => format!("node {node} ended there"),
        End::Host { host, why } => format!("machine {host}: {why}"),
        End::Link { problem } => problem.clone(),
    };
    let Crew { recorder, .. } = crew;
    bridge.finish(why, exits, |turn| match (turn, recorder.as_mut()) {
        (Turn::Clocks(readings), Some(recorder)) => recorder.clocks(readings),
        (Turn::Faults(faults), Some(recorder)) => faults.into_iter().for_each(|fault| recorder.fault(fault)),
        _ => {}
    });
    for (name, exit) in bridge.exits() {
        if let Some(node) = crew.site.graph.index(name).filter(|&node| !crew.site.settings.is_here(node)) {
            crew.members[node].exit = Some(exit.clone());
        }
    }
    let mut report = bridge.dismiss();
    if let End::Link { problem } = end {
        report.problem = Some(problem.clone());
    }
    Some(report)
}

fn check_programs(
    graph: &Graph,
    nodes: &[NodeSettings],
    here: impl Fn(usize) -> bool,
    options: &RunOptions,
) -> Result<(), RunError> {
    let all = graph.nodes().iter().zip(nodes).enumerate();
    for (_, (plan, settings)) in all.filter(|(node, _)| here(*node)) {
        let node = || plan.name.clone();
        match options.programs.get(&plan.name) {
            // A thread is a node that this program itself knows how to build.
            None if plan.kind.is_external() && settings.run_as == RunAs::Process => {
                return Err(RunError::NoProgram { node: node() });
            }
            Some(_) if settings.run_as == RunAs::Thread => {
                return Err(RunError::ProgramNeedsProcess { node: node() });
            }
            _ => {}
        }
    }
    Ok(())
}

/// Creates every channel, so that no node has to wait for another to exist.
fn create(graph: &Graph, endpoint: &Endpoint, settings: &Settings) -> Result<Vec<Service>, RunError> {
    let channels = plan::channels(graph, settings);
    let services = channels.iter().map(|(topic, senders)| endpoint.create_for(topic, *senders));
    Ok(services.collect::<Result<_, _>>()?)
}

/// Starts the process or the thread of a node.
fn hire(
    graph: &Graph,
    settings: &Settings,
    space: &Space,
    options: &Hiring,
    index: usize,
    stop_only: bool,
) -> Result<Worker, RunError> {
    let name = &graph.nodes()[index].name;
    let worker = match settings.nodes[index].run_as {
        RunAs::Process => {
            let none = Default::default();
            let private = options.private.get(name).unwrap_or(&none);
            let program = match options.programs.get(name) {
                None => Program::own(&options.command),
                Some(command) => Program::other(command),
            };
            Worker::process(program, space.path(), name, private, stop_only)
        }
        RunAs::Thread => {
            let (graph, settings, run) = (graph.clone(), settings.clone(), space.path().to_path_buf());
            Worker::thread(name, move |stream| {
                // How it ended is told over the line.
                let _ = worker_main::serve(&graph, index, &settings, &run, stream, None);
            })
        }
    };
    worker.map_err(|source| RunError::Spawn { node: name.clone(), source })
}

/// What it takes to start a node at any time of the run.
struct Hiring {
    command: Vec<String>,
    private: BTreeMap<String, BTreeMap<String, String>>,
    programs: BTreeMap<String, Vec<String>>,
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
