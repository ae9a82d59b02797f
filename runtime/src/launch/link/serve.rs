//! The process that carries messages between this machine and the others.
//!
//! Messages go through iceoryx2's own link: its core, its tunnel, and its carrier over zenoh. What the machines have to know of
//! each other beside that (clocks, signs of life, how far they are) goes through the same zenoh session.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use iceoryx2_integrations_zenoh_link_carrier::ZenohCarrier;
use iceoryx2_link::Link;
use iceoryx2_link_tunnel::Tunnel;
use zenoh::Wait;
use zenoh::qos::Priority;
use zenoh::sample::Locality;

use super::carrier::{Books, Counted, MESSAGES, RECORDS};
use super::clock::{Estimate, Offsets};
use super::hosts::{Placement, secret};
use super::mirror::Mirror;
use super::page::{ClockPage, Standing};
use super::wire::{Stage, State, Terms, Tick};
use super::{News, WAKE, Word};
use crate::channel::{Endpoint, Space, Waker};
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::control::{Answer, Line, Order};
use crate::launch::plan::{self, Settings};
use crate::launch::report::Exit;
use crate::launch::vitals::Vitals;
use crate::random::fnv1a;
use crate::recording::ClockReading;
use crate::time::Nanos;

/// How long the link sleeps when nothing comes: records wait for so long.
const NAP: Duration = Duration::from_millis(2);
/// How often a machine says how far it is, and what its nodes do.
const STATE: Duration = Duration::from_millis(100);
/// How often it says all of that, and not what has changed.
const ALL: Duration = Duration::from_secs(2);
/// How often the clocks are compared: at first, and later.
const TICKS: (Duration, Duration) = (Duration::from_millis(10), Duration::from_millis(100));
/// Exchanges with each machine before the run begins.
const EXCHANGES: u64 = 30;
/// How often what the clocks say is passed on.
const CLOCKS: Duration = Duration::from_millis(500);
/// How often channels that appeared or went are looked for.
const DISCOVER: Duration = Duration::from_millis(250);
/// Telegrams of one machine that wait for the link at most.
const WAITING: usize = 256;
/// At the end: how long the others are waited for, and how long the link stays after all are over.
const ENDING: (Duration, Duration) = (Duration::from_secs(10), Duration::from_millis(300));

/// What has come from one other machine.
#[derive(Default)]
struct Heard {
    state: Option<State>,
    /// When anything came last, on the monotonic clock.
    at: Nanos,
    offsets: Offsets,
    telegrams: Vec<Vec<u8>>,
}

/// What zenoh's threads write and the link reads.
type Ear = Arc<Vec<Mutex<Heard>>>;

fn lock(heard: &Mutex<Heard>) -> std::sync::MutexGuard<'_, Heard> {
    // What a thread left that panicked is still what it heard.
    heard.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Carries messages until the launcher says that the run is over, or is gone.
pub(in crate::launch) fn serve(
    graph: &Graph,
    settings: &Settings,
    space: &Space,
    stream: std::os::unix::net::UnixStream,
) {
    let mut line = Line::new(stream);
    let worked = match &settings.placement {
        Some(placement) => work(graph, settings, placement, space, &mut line),
        None => Err("the run is on one machine".into()),
    };
    if let Err(reason) = worked {
        line.send(&Answer::Failed { reason });
    }
    // Ports are open until all nodes have ended.
    while !line.closed() {
        let _ = line.receive::<Order>(1000);
    }
}

fn work(
    graph: &Graph,
    settings: &Settings,
    placement: &Placement,
    space: &Space,
    line: &mut Line,
) -> Result<(), String> {
    let endpoint = Endpoint::new(space).map_err(|e| e.to_string())?;
    let listener = endpoint.listener(WAKE).map_err(|e| e.to_string())?;
    let mut topics = Vec::new();
    let mut nodes = Vec::new();
    for node in 0..graph.nodes().len() {
        if placement.crosses(graph, node) {
            topics.push((plan::output(graph, node), MESSAGES));
            nodes.push(Some(node));
        }
        if placement.records_cross(node) {
            topics.push((plan::records(graph, node), RECORDS));
            nodes.push(None);
        }
    }
    let names: Vec<String> = topics.iter().map(|(topic, _)| topic.name.clone()).collect();
    let books = Books::new(topics);
    let session = open(graph, placement, space)?;
    let carrier =
        ZenohCarrier::open(session.clone()).map_err(|e| format!("the network cannot be used: {e}"))?;
    let config = space.config().map_err(|e| e.to_string())?;
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(|e| format!("shared memory cannot be opened: {e:?}"))?;
    let filter = names.clone();
    let mut link = Link::new(node, Tunnel::new(Counted::new(carrier, Arc::clone(&books)), &config))
        .with_filter(move |name| filter.iter().any(|known| known == name.as_str()));
    let woken = link.listener().map_err(|e| format!("the link cannot be woken: {e}"))?;
    let own = endpoint.waker(WAKE).map_err(|e| e.to_string())?;
    // Nobody waits for this thread: it ends with the process.
    let helper = std::thread::Builder::new().name("link-wake".into());
    let helper = helper.spawn(move || {
        while woken.blocking_wait(|_| {}).is_ok() {
            own.wake();
        }
    });
    helper.map_err(|e| format!("a thread cannot be started: {e}"))?;
    link.discover().map_err(|e| format!("the channels cannot be joined: {e}"))?;
    let ear: Ear = Arc::new(placement.hosts.iter().map(|_| Mutex::default()).collect());
    let _ears = listen(&session, placement, &ear, &books)?;
    let pages = graph.nodes().iter().map(|node| Vitals::open(space.path(), &node.name, node.inputs.len()));
    let pages = pages.collect::<Result<Vec<_>, _>>().map_err(|e| e.to_string())?;
    let clocks = placement.hosts.iter().map(|host| ClockPage::open(space.path(), &host.name));
    let clocks = clocks.collect::<Result<Vec<_>, _>>().map_err(|e| e.to_string())?;
    let mut post = Post {
        graph,
        placement,
        session,
        ear,
        mirror: Mirror::new(graph, placement, pages),
        clocks,
        state: State {
            terms: Terms::of(graph, settings, placement),
            incarnation: (monotonic() as u64) ^ (u64::from(std::process::id()) << 40),
            stage: Stage::Opening,
            exits: BTreeMap::new(),
            clocks: Vec::new(),
        },
        peers: placement.hosts.iter().map(|_| Peer::default()).collect(),
        told_ready: false,
        told_begin: false,
        receipt: Vec::new(),
        why: String::new(),
        due: Due::new(),
    };
    line.send(&Answer::Listening);

    let mut wakers: Vec<Vec<Waker>> = Vec::new();
    let mut trouble = false;
    let (mut over, mut quiet): (Option<Instant>, Option<Instant>) = (None, None);
    let mut moved = 0;
    loop {
        listener.wait(NAP);
        if line.closed() {
            return Ok(());
        }
        for order in line.receive(0).map_err(|e| e.to_string())? {
            match order {
                Order::Link { word: Word::Ready } => {
                    post.state.stage = Stage::Ready;
                    // Every node here listens now.
                    wakers = wake_ups(graph, placement, &endpoint, &nodes)?;
                    post.due.state = Instant::now();
                }
                Order::Link { word: Word::Started { epoch } } => {
                    post.state.stage = Stage::Running { epoch };
                    post.due.state = Instant::now();
                }
                Order::Link { word: Word::Exits { exits } } => post.state.exits = exits,
                Order::Link { word: Word::Over { why, exits } } => {
                    post.state.exits = exits;
                    over = Some(Instant::now());
                    post.why = why;
                }
                _ => {}
            }
        }
        if post.due.discover <= Instant::now() {
            post.due.discover = Instant::now() + DISCOVER;
            if let Err(error) = link.discover() {
                report_once(line, &mut trouble, &format!("channels are not looked for: {error}"));
            }
        }
        if let Err(error) = link.propagate() {
            report_once(line, &mut trouble, &format!("messages are not passed on: {error}"));
        }
        for (channel, wakers) in wakers.iter().enumerate() {
            if books.arrived(channel) {
                wakers.iter().for_each(|waker| _ = waker.wake());
            }
        }
        post.receipts(&books);
        post.turn(line)?;
        let Some(since) = over else { continue };
        if !matches!(post.state.stage, Stage::Over { .. }) {
            // What the nodes left in the channels goes out first.
            let now = books.moved();
            if now == moved && since.elapsed() > 4 * NAP && (books.kept() == 0 || since.elapsed() > ENDING.0)
            {
                post.last_words();
            }
            moved = now;
        } else if post.all_over() || since.elapsed() > ENDING.0 {
            let now = books.moved();
            let still = *quiet.get_or_insert_with(Instant::now);
            if now != moved && since.elapsed() < ENDING.0 {
                (moved, quiet) = (now, None);
            } else if still.elapsed() > ENDING.1 {
                post.hear_pages();
                let exits =
                    post.others().flat_map(|host| lock(&post.ear[host]).state.clone()).flat_map(|s| s.exits);
                let news = News::Finished { crossings: books.crossings(), exits: exits.collect() };
                line.send(&Answer::Link { news });
                return Ok(());
            }
        }
    }
}

/// Says once that something goes wrong.
fn report_once(line: &mut Line, told: &mut bool, text: &str) {
    if !std::mem::replace(told, true) {
        line.send(&Answer::Link { news: News::Trouble { text: text.into() } });
    }
}

/// By channel: the wake-ups of those here who receive what comes on it.
fn wake_ups(
    graph: &Graph,
    placement: &Placement,
    endpoint: &Endpoint,
    nodes: &[Option<usize>],
) -> Result<Vec<Vec<Waker>>, String> {
    let of = |node: &Option<usize>| {
        let from = node.filter(|&node| !placement.is_here(node));
        let receivers = from.map(|node| plan::receivers(graph, node)).unwrap_or_default();
        let here = receivers.into_iter().filter(|&receiver| placement.is_here(receiver));
        here.map(|receiver| endpoint.waker(&plan::wake(graph, receiver))).collect::<Result<Vec<_>, _>>()
    };
    nodes.iter().map(of).collect::<Result<Vec<_>, _>>().map_err(|e| e.to_string())
}

/// Opens the session: to the machines that are named and to no others, with the secret.
fn open(graph: &Graph, placement: &Placement, space: &Space) -> Result<zenoh::Session, String> {
    let word = secret(&placement.secret)?;
    let dictionary = space.path().join("-link.users");
    // In the run's directory, which nobody else may enter.
    space.write("-link.users", format!("parallax:{word}\n").as_bytes()).map_err(|e| e.to_string())?;
    let endpoint = |host: usize| placement.hosts[host].address.map(|address| format!("tcp/{address}"));
    let listen: Vec<String> = endpoint(placement.me).into_iter().collect();
    let connect: Vec<String> =
        (0..placement.hosts.len()).filter(|&host| host != placement.me).filter_map(endpoint).collect();
    let mut config = zenoh::Config::default();
    let lease = (placement.gone / 1_000_000).max(500).to_string();
    let settings = [
        ("mode", "\"peer\"".to_owned()),
        ("namespace", format!("\"parallax/{:016x}\"", fnv1a(graph.spec().name.as_bytes()))),
        ("listen/endpoints", serde_json::to_string(&listen).unwrap_or_default()),
        ("listen/exit_on_failure", "true".into()),
        ("connect/endpoints", serde_json::to_string(&connect).unwrap_or_default()),
        // It may be started before the others, and goes on trying.
        ("connect/exit_on_failure", "false".into()),
        ("connect/timeout_ms", "-1".into()),
        ("connect/retry", "{ period_init_ms: 100, period_max_ms: 500, period_increase_factor: 1.5 }".into()),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
        ("adminspace/enabled", "false".into()),
        ("transport/link/tx/lease", lease),
        ("transport/auth/usrpwd/user", "\"parallax\"".into()),
        ("transport/auth/usrpwd/password", serde_json::to_string(&word).unwrap_or_default()),
        (
            "transport/auth/usrpwd/dictionary_file",
            serde_json::to_string(&dictionary.display().to_string()).unwrap_or_default(),
        ),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).map_err(|e| format!("zenoh refuses the setting {key}: {e}"))?;
    }
    let session = zenoh::open(config).wait();
    session.map_err(|error| match listen.first() {
        Some(listen) => {
            format!("{listen} cannot be opened: {error}. Is the address this machine's, and the port free?")
        }
        None => format!("the network cannot be used: {error}"),
    })
}

type Ears = Vec<zenoh::pubsub::Subscriber<()>>;

/// Takes in what the other machines say.
fn listen(
    session: &zenoh::Session,
    placement: &Placement,
    ear: &Ear,
    books: &Arc<Books>,
) -> Result<Ears, String> {
    let me = placement.my_name().to_owned();
    let names: Arc<Vec<String>> = Arc::new(placement.hosts.iter().map(|host| host.name.clone()).collect());
    let from = move |key: &str, names: &[String]| {
        let name = key.rsplit('/').next()?;
        names.iter().position(|host| host == name)
    };
    let mut ears = Vec::new();
    let ticks = format!("tick/{me}/*");
    {
        let (ear, names, session) = (Arc::clone(ear), Arc::clone(&names), session.clone());
        let tick = move |sample: zenoh::sample::Sample| {
            let now = monotonic();
            let Some(host) = from(sample.key_expr().as_str(), &names) else { return };
            match Tick::read(&sample.payload().to_bytes()) {
                Some(Tick::Question { asked }) => {
                    let answer = Tick::Answer { asked, heard: now, answered: monotonic() };
                    send_tick(&session, &names[host], &me, answer);
                }
                Some(answer) => {
                    let mut heard = lock(&ear[host]);
                    heard.at = now;
                    if let Some(exchange) = answer.exchange(now) {
                        heard.offsets.add(&exchange);
                    }
                }
                None => {}
            }
        };
        ears.push((ticks, Box::new(tick) as Box<dyn Fn(zenoh::sample::Sample) + Send + Sync>));
    }
    {
        let (ear, names) = (Arc::clone(ear), Arc::clone(&names));
        let state = move |sample: zenoh::sample::Sample| {
            let Some(host) = from(sample.key_expr().as_str(), &names) else { return };
            let Ok(state) = serde_json::from_slice::<State>(&sample.payload().to_bytes()) else { return };
            let mut heard = lock(&ear[host]);
            heard.at = monotonic();
            heard.state = Some(state);
        };
        ears.push(("state/*".into(), Box::new(state)));
    }
    {
        let (ear, names) = (Arc::clone(ear), Arc::clone(&names));
        let pages = move |sample: zenoh::sample::Sample| {
            let Some(host) = from(sample.key_expr().as_str(), &names) else { return };
            let mut heard = lock(&ear[host]);
            heard.at = monotonic();
            // A link that is that far behind hears everything again in a moment.
            if heard.telegrams.len() < WAITING {
                heard.telegrams.push(sample.payload().to_bytes().into_owned());
            }
        };
        ears.push(("pages/*".into(), Box::new(pages)));
    }
    {
        let (names, books, recorder) = (Arc::clone(&names), Arc::clone(books), placement.recorder);
        let receipts = move |sample: zenoh::sample::Sample| {
            if from(sample.key_expr().as_str(), &names).is_some_and(|host| Some(host) == recorder) {
                books.acknowledge(&sample.payload().to_bytes());
            }
        };
        ears.push(("receipt/*".into(), Box::new(receipts)));
    }
    let declare = |(key, callback): (String, Box<dyn Fn(zenoh::sample::Sample) + Send + Sync>)| {
        let subscriber = session.declare_subscriber(key).callback(callback).allowed_origin(Locality::Remote);
        subscriber.wait().map_err(|error| format!("the network cannot be listened to: {error}"))
    };
    ears.into_iter().map(declare).collect()
}

/// Sends a question or an answer about clocks. One that does not arrive is one exchange less.
fn send_tick(session: &zenoh::Session, to: &str, from: &str, tick: Tick) {
    let put = session.put(format!("tick/{to}/{from}"), tick.bytes());
    let _ = put.express(true).priority(Priority::RealTime).wait();
}

/// What this machine knows of another one's presence.
#[derive(Debug, Clone, Copy, Default)]
struct Peer {
    /// It has been heard at all.
    known: bool,
    silent: bool,
    gone: bool,
    over: bool,
    /// Which of its runs was heard first.
    incarnation: Option<u64>,
}

/// When what is due next.
struct Due {
    discover: Instant,
    tick: Instant,
    state: Instant,
    all: Instant,
    clocks: Instant,
    waiting: Instant,
}

impl Due {
    fn new() -> Self {
        let now = Instant::now();
        let waiting = now + Duration::from_secs(2);
        Self { discover: now, tick: now, state: now, all: now, clocks: now, waiting }
    }
}

/// What this machine says to the others, and hears from them, beside messages.
struct Post<'a> {
    graph: &'a Graph,
    placement: &'a Placement,
    session: zenoh::Session,
    ear: Ear,
    mirror: Mirror,
    clocks: Vec<ClockPage>,
    state: State,
    peers: Vec<Peer>,
    told_ready: bool,
    told_begin: bool,
    /// Which records had arrived here when that was told last.
    receipt: Vec<u8>,
    why: String,
    due: Due,
}

impl Post<'_> {
    /// The other machines.
    fn others(&self) -> impl Iterator<Item = usize> + use<> {
        let me = self.placement.me;
        (0..self.placement.hosts.len()).filter(move |&host| host != me)
    }

    fn name(&self, host: usize) -> String {
        self.placement.hosts[host].name.clone()
    }

    fn epoch(&self) -> Option<Nanos> {
        match self.state.stage {
            Stage::Running { epoch } => Some(epoch),
            _ => None,
        }
    }

    /// Says what is due, and takes in what has come.
    fn turn(&mut self, line: &mut Line) -> Result<(), String> {
        let now = Instant::now();
        if self.due.tick <= now {
            self.due.tick = now + if self.told_ready { TICKS.1 } else { TICKS.0 };
            for host in self.others() {
                let tick = Tick::Question { asked: monotonic() };
                send_tick(&self.session, &self.name(host), self.placement.my_name(), tick);
            }
        }
        if self.due.clocks <= now {
            self.due.clocks = now + CLOCKS;
            self.tell_clocks(line);
        }
        if self.due.state <= now {
            self.due.state = now + STATE;
            let all = self.due.all <= now;
            if all {
                self.due.all = now + ALL;
            }
            self.say(all);
            self.hear_pages();
            self.watch(line)?;
        }
        Ok(())
    }

    /// Says how far this machine is, and what its nodes do.
    fn say(&mut self, all: bool) {
        let Ok(state) = serde_json::to_vec(&self.state) else { return };
        // What does not arrive is said again. Not in the queue of messages, of which each urgent word would take a place.
        let put = self.session.put(format!("state/{}", self.placement.my_name()), state);
        let _ = put.express(true).priority(Priority::InteractiveHigh).wait();
        for telegram in self.mirror.news(all) {
            let put = self.session.put(format!("pages/{}", self.placement.my_name()), telegram);
            let _ = put.priority(Priority::Background).wait();
        }
    }

    /// The nodes have stopped, and what they sent is on the way: says so, with their last signs of life.
    fn last_words(&mut self) {
        self.state.stage = Stage::Over { why: std::mem::take(&mut self.why) };
        self.say(true);
    }

    /// Tells the others which records have arrived here, when that has changed; gives up what the recording machine, which is
    /// heard, has not received for long.
    fn receipts(&mut self, books: &Books) {
        if self.placement.records_here() {
            let receipt = books.receipt();
            if receipt != self.receipt {
                let put = self.session.put(format!("receipt/{}", self.placement.my_name()), receipt.clone());
                let _ = put.express(true).priority(Priority::InteractiveHigh).wait();
                self.receipt = receipt;
            }
        } else if let Some(host) = self.placement.recorder {
            let (now, at) = (monotonic(), lock(&self.ear[host]).at);
            books.forget(now, now.saturating_sub(at) < self.placement.silence);
        }
    }

    fn all_over(&self) -> bool {
        self.others().all(|host| self.peers[host].over || self.peers[host].gone || !self.peers[host].known)
    }

    fn estimate(&self, host: usize) -> Option<Estimate> {
        lock(&self.ear[host]).offsets.estimate(monotonic())
    }

    /// Takes over the signs of life of nodes on other machines.
    fn hear_pages(&self) {
        for host in self.others() {
            let telegrams = std::mem::take(&mut lock(&self.ear[host]).telegrams);
            let Some(estimate) = self.estimate(host) else { continue };
            for telegram in telegrams {
                self.mirror.hear(self.placement, host, estimate.offset, &telegram);
            }
        }
    }

    /// Tells the nodes, the others and the recording how the clocks stand to each other.
    fn tell_clocks(&mut self, line: &mut Line) {
        let Some(epoch) = self.epoch() else { return };
        let mut readings = Vec::new();
        for host in self.others() {
            let Some(estimate) = self.estimate(host) else { continue };
            let theirs = match lock(&self.ear[host]).state.as_ref().map(|state| &state.stage) {
                Some(Stage::Running { epoch }) => *epoch,
                _ => continue,
            };
            // Of the same moment: here `at - epoch`, there `at + offset - theirs`.
            let ahead = estimate.offset.saturating_sub(theirs.saturating_sub(epoch));
            let at = estimate.at - epoch;
            self.clocks[host].write(&Standing { shift: -ahead, at, skew: estimate.skew });
            readings.push(ClockReading {
                host: self.placement.my_name().into(),
                other: self.name(host),
                time: at,
                ahead,
                bound: estimate.bound,
                skew: estimate.skew,
                skew_bound: estimate.skew_bound,
                round_trip: estimate.round_trip,
                offset: estimate.offset,
                exchanges: estimate.exchanges,
            });
        }
        self.state.clocks.clone_from(&readings);
        if self.placement.records_here() {
            // Those that the others have of each other are in their state.
            for host in self.others() {
                let theirs = lock(&self.ear[host]).state.as_ref().map(|state| state.clocks.clone());
                readings.extend(theirs.unwrap_or_default());
            }
        }
        if !readings.is_empty() {
            line.send(&Answer::Link { news: News::Clocks { readings } });
        }
    }

    /// What the others' states mean for this machine.
    fn watch(&mut self, line: &mut Line) -> Result<(), String> {
        let mut say = |news: News| line.send(&Answer::Link { news });
        let mut waits_for = Vec::new();
        for host in self.others() {
            let (state, at, exchanges) = {
                let heard = lock(&self.ear[host]);
                (heard.state.clone(), heard.at, heard.offsets.exchanges())
            };
            let name = self.name(host);
            let Some(state) = state else {
                waits_for.push(format!("{name}, which has not answered"));
                continue;
            };
            if let Some(problem) = self.state.terms.disagreement(&state.terms) {
                return Err(format!("machine {name} {problem}"));
            }
            let silent_for = monotonic().saturating_sub(at);
            let peer = &mut self.peers[host];
            peer.known = true;
            if silent_for > self.placement.silence && !peer.silent {
                peer.silent = true;
                say(News::Silent { host: name.clone(), silent: silent_for });
            } else if silent_for <= self.placement.silence && peer.silent {
                (peer.silent, peer.gone) = (false, false);
                say(News::Back { host: name.clone() });
            }
            if silent_for > self.placement.gone && !peer.gone {
                peer.gone = true;
                say(News::Gone { host: name.clone(), silent: silent_for });
            }
            let first = *peer.incarnation.get_or_insert(state.incarnation);
            if first != state.incarnation && !matches!(self.state.stage, Stage::Running { .. }) {
                peer.incarnation = Some(state.incarnation);
            } else if first != state.incarnation {
                // It knows nothing of what was before; its nodes would count from 0 again.
                if !std::mem::replace(&mut peer.over, true) {
                    say(News::Over { host: name, why: "it was started again while the run went on".into() });
                }
                continue;
            }
            match &state.stage {
                Stage::Opening => waits_for.push(format!("{name}, whose nodes come up")),
                _ if exchanges < EXCHANGES => waits_for.push(format!("the clock of {name}")),
                Stage::Ready => {}
                Stage::Running { epoch } => {
                    if host == self.placement.lead
                        && !self.told_begin
                        && self.state.stage == Stage::Ready
                        && let Some(estimate) = lock(&self.ear[host]).offsets.estimate(monotonic())
                    {
                        self.told_begin = true;
                        say(News::Begin { epoch: epoch.saturating_sub(estimate.offset) });
                    }
                }
                Stage::Over { why } if !peer.over => {
                    peer.over = true;
                    say(News::Over { host: name.clone(), why: why.clone() });
                }
                Stage::Over { .. } => {}
            }
            let exits: BTreeMap<String, Exit> =
                state.exits.into_iter().filter(|(_, exit)| *exit != Exit::Clean).collect();
            let of_host =
                |node: &str| self.graph.index(node).is_some_and(|node| self.placement.of[node] == host);
            let exits: BTreeMap<_, _> = exits.into_iter().filter(|(node, _)| of_host(node)).collect();
            if !exits.is_empty() {
                say(News::Exits { host: name, exits });
            }
        }
        if self.state.stage == Stage::Ready && waits_for.is_empty() && !self.told_ready {
            self.told_ready = true;
            say(News::AllReady);
        }
        if !self.told_ready && !waits_for.is_empty() && self.due.waiting <= Instant::now() {
            self.due.waiting = Instant::now() + Duration::from_secs(5);
            say(News::Waits { waits_for });
        }
        Ok(())
    }
}
