//! The process that carries messages between this machine and the others.
//!
//! Messages go through iceoryx2's own link: its core, its tunnel, and its carrier over zenoh. What the machines have to know of
//! each other beside that (clocks, signs of life, how far they are) goes through the same zenoh session.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;
use iceoryx2_integrations_zenoh_link_carrier::ZenohCarrier;
use iceoryx2_link::Link;
use iceoryx2_link_tunnel::Tunnel;

use super::carrier::{Books, Counted, MESSAGES, RECORDS, Wares};
use super::hosts::Placement;
use super::mirror::Mirror;
use super::page::ClockPage;
use super::post::{Due, Peer, Post};
use super::session::{Ear, listen, lock, open};
use super::wire::{Stage, State, Terms};
use super::{News, WAKE, Word};
use crate::channel::{Endpoint, Space, Waker};
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::control::{Answer, Line, Order};
use crate::launch::plan::{self, Settings};
use crate::launch::vitals::Vitals;

/// How long the link sleeps when nothing comes: records wait for so long.
const NAP: Duration = Duration::from_millis(2);
/// How often channels that appeared or went are looked for.
const DISCOVER: Duration = Duration::from_millis(250);
/// At the end: how long the others are waited for, and how long the link stays after all are over.
const ENDING: (Duration, Duration) = (Duration::from_secs(10), Duration::from_millis(300));

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
    let mut wares = Vec::new();
    let mut nodes = Vec::new();
    for node in 0..graph.nodes().len() {
        if placement.crosses(graph, node) {
            let every = placement.ways[node].every;
            wares.push(Wares { topic: plan::output(graph, node), number: MESSAGES, every });
            nodes.push(Some(node));
        }
        if placement.records_cross(node) {
            wares.push(Wares { topic: plan::records(graph, node), number: RECORDS, every: 1 });
            nodes.push(None);
        }
    }
    let names: Vec<String> = wares.iter().map(|wares| wares.topic.name.clone()).collect();
    let books = Books::new(wares);
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
            faults: Vec::new(),
            forgotten: 0,
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
                Order::Link { word: Word::Fault { fault } } => post.state.add_fault(fault),
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
        post.turn(line, &books)?;
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
