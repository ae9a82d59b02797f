//! The network between the machines: who gets in, and what is heard of the others beside messages.

use std::sync::{Arc, Mutex, PoisonError};

use iceoryx2::prelude::*;
use iceoryx2::service::Service;
use iceoryx2::service::messaging_pattern::MessagingPattern;
use iceoryx2::service::service_hash::ServiceHash;
use zenoh::Wait;
use zenoh::qos::Priority;
use zenoh::sample::Locality;

use super::LinkPriority;
use super::carrier::Books;
use super::clock::Offsets;
use super::hosts::{Placement, secret};
use super::wire::{State, Tick};
use crate::channel::Space;
use crate::clock::monotonic;
use crate::graph::Graph;
use crate::launch::plan;
use crate::random::fnv1a;
use crate::time::Nanos;

/// Bytes that wait in the kernel to leave, which it doubles: what is there no priority can overtake. Five milliseconds at 100 Mbit/s.
const KERNEL: usize = 32_000;
/// Telegrams of one machine that wait for the link at most.
const WAITING: usize = 256;

/// What has come from one other machine.
#[derive(Default)]
pub(super) struct Heard {
    pub(super) state: Option<State>,
    /// When anything came last, on the monotonic clock.
    pub(super) at: Nanos,
    pub(super) offsets: Offsets,
    pub(super) telegrams: Vec<Vec<u8>>,
    /// What it knows of this machine's nodes, which have run before.
    pub(super) memory: Option<Vec<u8>>,
}

/// What zenoh's threads write and the link reads.
pub(super) type Ear = Arc<Vec<Mutex<Heard>>>;

pub(super) fn lock(heard: &Mutex<Heard>) -> std::sync::MutexGuard<'_, Heard> {
    // What a thread left that panicked is still what it heard.
    heard.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Opens the session: to the machines that are named and to no others, with the secret.
pub(super) fn open(graph: &Graph, placement: &Placement, space: &Space) -> Result<zenoh::Session, String> {
    let word = secret(&placement.secret)?;
    let dictionary = space.path().join("-link.users");
    // In the run's directory, which nobody else may enter.
    space.write("-link.users", format!("parallax:{word}\n").as_bytes()).map_err(|e| e.to_string())?;
    let endpoint = |host: usize| {
        placement.hosts[host].address.map(|address| format!("tcp/{address}#so_sndbuf={KERNEL}"))
    };
    let listen: Vec<String> = endpoint(placement.me).into_iter().collect();
    let connect: Vec<String> =
        (0..placement.hosts.len()).filter(|&host| host != placement.me).filter_map(endpoint).collect();
    let mut config = zenoh::Config::default();
    let lease = (placement.gone / 1_000_000).max(500).to_string();
    let qos = serde_json::to_string(&publications(graph, placement)?).unwrap_or_default();
    let settings = [
        ("qos/publication", qos),
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
    session.map_err(|error| match placement.hosts[placement.me].address {
        Some(listen) => {
            format!(
                "tcp/{listen} cannot be opened: {error}. Is the address this machine's, and the port free?"
            )
        }
        None => format!("the network cannot be used: {error}"),
    })
}

/// The priorities of all channels that cross, as zenoh's configuration has them.
fn publications(graph: &Graph, placement: &Placement) -> Result<Vec<serde_json::Value>, String> {
    let key = |topic: &str| {
        let name =
            ServiceName::new(topic).map_err(|e| format!("the channel {topic} cannot be named: {e:?}"))?;
        let hash = ServiceHash::new::<<ipc::Service as Service>::ServiceNameHasher>(
            &name,
            MessagingPattern::PublishSubscribe,
        );
        // The last part is the fingerprint of the service's description.
        Ok::<_, String>(format!("iox2/v1/channel/{}/*", hash.as_str()))
    };
    let mut publications = Vec::new();
    // None is express: each of these takes a whole one of the few places in its queue, and the rest would be dropped.
    let mut add = |topic: &str, priority: &str| {
        let config = serde_json::json!({ "priority": priority });
        publications.push(serde_json::json!({ "key_exprs": [key(topic)?], "config": config }));
        Ok::<_, String>(())
    };
    for node in 0..graph.nodes().len() {
        if placement.crosses(graph, node) {
            let priority = match placement.ways[node].priority {
                LinkPriority::Low => "data_low",
                LinkPriority::Normal => "data",
                LinkPriority::High => "interactive_low",
            };
            add(&plan::output(graph, node).name, priority)?;
        }
        if placement.records_cross(node) {
            add(&plan::records(graph, node).name, "background")?;
        }
    }
    Ok(publications)
}

pub(super) type Ears = Vec<zenoh::pubsub::Subscriber<()>>;

/// Takes in what the other machines say.
pub(super) fn listen(
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
            if heard.state.as_ref().is_some_and(|before| before.incarnation != state.incarnation) {
                // It was started again, and its clock may be another one.
                *heard = Heard::default();
            }
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
        let (ear, names) = (Arc::clone(ear), Arc::clone(&names));
        let memory = move |sample: zenoh::sample::Sample| {
            let Some(host) = from(sample.key_expr().as_str(), &names) else { return };
            lock(&ear[host]).memory = Some(sample.payload().to_bytes().into_owned());
        };
        ears.push((format!("memory/{}/*", placement.my_name()), Box::new(memory)));
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
pub(super) fn send_tick(session: &zenoh::Session, to: &str, from: &str, tick: Tick) {
    let put = session.put(format!("tick/{to}/{from}"), tick.bytes());
    let _ = put.express(true).priority(Priority::RealTime).wait();
}
