//! Runs a floor: this process sends at a pace, the other one, or another thread, answers.

use std::time::Duration;

use super::link::{self, End, Link, Threads};
use super::peer::{FINISH, Peer, answer};
use super::{Carrier, Case, LatencyError, Options, Pace, Row, place, room, warm_up};
use crate::channel::Space;
use crate::clock::monotonic;
use crate::time::Nanos;

/// Adds a turn's messages to a row; gives what the system refused.
pub(super) fn exchange(
    row: &mut Row,
    options: &Options,
    time: Duration,
) -> Result<Vec<String>, LatencyError> {
    let (case, rate) = (row.case, row.case.rate(options.rate));
    let (options, core) = (options.clone(), |end: usize| case.pinned.then_some(options.cores[end]));
    let (here, there) = (core(0), core(1));
    // A thread of its own: what it is given for the measurement ends with it.
    let measured = std::thread::Builder::new().name("latency".into()).spawn(move || {
        if case.carrier == Carrier::Crossbeam {
            threads(&case, &options, time, here, there)
        } else {
            processes(&case, &options, time, here, there)
        }
    });
    let measured = measured.map_err(LatencyError::io("start a thread"))?.join();
    let lost = || LatencyError::Silent { carrier: case.carrier.to_string(), seconds: 0 };
    let Turn { one_way, round_trip, warnings } = measured.map_err(|_| lost())??;
    let (period, warm_up) = ((1e9 / rate) as Nanos, warm_up((time.as_secs_f64() * rate) as usize));
    row.one_way.extend_paced(one_way.into_iter().skip(warm_up), period);
    row.round_trip.extend_paced(round_trip.into_iter().skip(warm_up), period);
    Ok(warnings)
}

struct Turn {
    one_way: Vec<Nanos>,
    round_trip: Vec<Nanos>,
    warnings: Vec<String>,
}

fn processes(
    case: &Case,
    options: &Options,
    time: Duration,
    here: Option<usize>,
    there: Option<usize>,
) -> Result<Turn, LatencyError> {
    let space = Space::create()?;
    // Two directions, a few messages under way in each, and what lies around them.
    space.reserve((case.payload * 16 + (4 << 20)) as u64)?;
    // The ends of one channel are made in order: first here, then there, and the first one is used when both exist.
    let (mut peer, mut link);
    if case.carrier == Carrier::UnixSocket {
        peer = Peer::start(case, &space, there)?;
        let refused = peer.ready(case.carrier)?;
        link = link::open(case, &space, peer.stream(), End::First)?;
        return drive(&mut *link, case, options, time, here, refused).and_then(|turn| end(turn, peer));
    }
    let (unused, _other) =
        std::os::unix::net::UnixStream::pair().map_err(LatencyError::io("make a socket"))?;
    link = link::open(case, &space, &unused, End::First)?;
    peer = Peer::start(case, &space, there)?;
    let refused = peer.ready(case.carrier)?;
    drive(&mut *link, case, options, time, here, refused).and_then(|turn| end(turn, peer))
}

fn end(mut turn: Turn, peer: Peer) -> Result<Turn, LatencyError> {
    turn.one_way = peer.finish()?;
    Ok(turn)
}

fn threads(
    case: &Case,
    options: &Options,
    time: Duration,
    here: Option<usize>,
    there: Option<usize>,
) -> Result<Turn, LatencyError> {
    let (mut first, mut second) = Threads::pair(case);
    std::thread::scope(|scope| {
        let (fifo, wait) = (case.fifo, case.wait);
        let answering = scope.spawn(move || {
            let refused = place::settle(there, fifo);
            answer(&mut second, wait).map(|taken| (taken, refused))
        });
        let mut turn = drive(&mut first, case, options, time, here, Vec::new())?;
        drop(first);
        let lost = |_| LatencyError::Silent { carrier: case.carrier.to_string(), seconds: 0 };
        let (taken, refused) = answering.join().map_err(lost)??;
        turn.one_way = taken;
        turn.warnings.extend(refused);
        Ok(turn)
    })
}

/// Sends at the pace, and waits for the answer each time.
fn drive(
    link: &mut dyn Link,
    case: &Case,
    options: &Options,
    time: Duration,
    core: Option<usize>,
    mut warnings: Vec<String>,
) -> Result<Turn, LatencyError> {
    warnings.extend(place::settle(core, case.fifo));
    let rate = case.rate(options.rate);
    let mut round_trip = room((time.as_secs_f64() * rate) as usize + 16);
    let mut pace = Pace::new(rate, case.wait, time);
    while pace.wait() {
        let sent = monotonic();
        link.send(sent)?;
        if link::receive(link, case.wait)?.is_none() {
            return Err(LatencyError::Silent {
                carrier: case.carrier.to_string(),
                seconds: link::PATIENCE.as_secs(),
            });
        }
        round_trip.push(monotonic() - sent);
    }
    link.send(FINISH)?;
    Ok(Turn { one_way: Vec::new(), round_trip, warnings })
}
