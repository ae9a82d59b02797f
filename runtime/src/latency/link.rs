//! What the floors are made of: the two ends of a way for messages that carry the time they were sent.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::sync::atomic::Ordering::{Acquire, Release};
use std::time::Duration;

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TryRecvError};
use iceoryx2::prelude::*;

use super::{Carrier, Case, LARGE, LatencyError, Wait};
use crate::channel::futex::{self, SharedPage};
use crate::channel::{Endpoint, Listener, Publisher, Space, Subscriber, Topic, Waker};
use crate::clock::monotonic;
use crate::time::Nanos;

type Ipc = ipc::Service;

/// One end.
pub(super) trait Link {
    /// Sends the time.
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError>;
    /// What has arrived, without waiting.
    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError>;
    /// Sleeps until something may have arrived, at most this long; gives what it found, if it had to look.
    fn sleep(&mut self, patience: Duration) -> Result<Option<Nanos>, LatencyError>;
}

/// How long an answer may take before the other end counts as dead.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Waits for the next message.
pub(super) fn receive(link: &mut dyn Link, wait: Wait) -> Result<Option<Nanos>, LatencyError> {
    let start = monotonic();
    let patience = PATIENCE.as_nanos() as Nanos;
    let mut rounds = 0_u32;
    loop {
        if let Some(stamp) = link.poll()? {
            return Ok(Some(stamp));
        }
        rounds = rounds.wrapping_add(1);
        let spins = match wait {
            Wait::Spin => true,
            Wait::SpinThenBlock => monotonic() - start < wait.spin(),
            Wait::Block => false,
        };
        if spins {
            std::hint::spin_loop();
        } else if let Some(stamp) = link.sleep(PATIENCE)? {
            return Ok(Some(stamp));
        }
        // Reading the clock each time would be part of what is measured.
        if (!spins || rounds.is_multiple_of(4096)) && monotonic() - start > patience {
            return Ok(None);
        }
    }
}

/// Which end: the first one makes what both need.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum End {
    First,
    Second,
}

/// The end of a floor between processes. What it needs of files lies in `space`.
pub(super) fn open(
    case: &Case,
    space: &Space,
    stream: &UnixStream,
    end: End,
) -> Result<Box<dyn Link>, LatencyError> {
    Ok(match case.carrier {
        Carrier::UnixSocket => Box::new(Socket::new(case, stream)?),
        Carrier::Iceoryx2 => Box::new(Iceoryx2::new(case, space, end)?),
        Carrier::Channel => Box::new(Channel::new(case, space, end)?),
        // Graphs and threads have no second process here; a word of memory carries anything.
        _ => Box::new(Word::new(space, end)?),
    })
}

/// Words of a message.
fn words(case: &Case) -> usize {
    (case.payload / 8).max(1)
}

/// Fills a message that lies in place, as the runtime does with its numbers; of a large one, which is data, only the first word.
fn fill(message: &mut [u64], stamp: Nanos) {
    let filled = if message.len() * 8 < LARGE { message.len() } else { 1 };
    message[..filled].fill(stamp as u64);
}

/// Takes a message out of its place, in the same way; gives its stamp.
fn take_out(message: &[u64], taken: &mut [u64]) -> Option<Nanos> {
    if message.len() == taken.len() && message.len() * 8 < LARGE {
        taken.copy_from_slice(message);
        // Not left out as a copy at which nobody looks.
        std::hint::black_box(&*taken);
    }
    message.first().map(|stamp| *stamp as Nanos)
}

struct Socket {
    stream: UnixStream,
    buffer: Vec<u8>,
    /// Bytes of the message that have arrived.
    filled: usize,
}

impl Socket {
    fn new(case: &Case, stream: &UnixStream) -> Result<Self, LatencyError> {
        let stream = stream.try_clone().map_err(LatencyError::io("copy a socket"))?;
        stream
            .set_nonblocking(case.wait == Wait::Spin)
            .and_then(|()| stream.set_read_timeout(Some(PATIENCE)))
            .map_err(LatencyError::io("set up a socket"))?;
        Ok(Self { stream, buffer: vec![0; words(case) * 8], filled: 0 })
    }

    fn read(&mut self) -> Result<Option<Nanos>, LatencyError> {
        loop {
            match self.stream.read(&mut self.buffer[self.filled..]) {
                Ok(0) => return Err(LatencyError::io("read a socket")(io::ErrorKind::UnexpectedEof.into())),
                Ok(count) => self.filled += count,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(LatencyError::io("read a socket")(e)),
            }
            if self.filled == self.buffer.len() {
                self.filled = 0;
                let mut stamp = [0; 8];
                stamp.copy_from_slice(&self.buffer[..8]);
                return Ok(Some(Nanos::from_le_bytes(stamp)));
            }
        }
    }
}

impl Link for Socket {
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError> {
        self.buffer[..8].copy_from_slice(&stamp.to_le_bytes());
        let mut rest = &self.buffer[..];
        while !rest.is_empty() {
            match self.stream.write(rest) {
                Ok(count) => rest = &rest[count..],
                Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {
                    std::hint::spin_loop();
                }
                Err(e) => return Err(LatencyError::io("write to a socket")(e)),
            }
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError> {
        self.read()
    }

    fn sleep(&mut self, _: Duration) -> Result<Option<Nanos>, LatencyError> {
        self.read()
    }
}

struct Iceoryx2 {
    publisher: iceoryx2::port::publisher::Publisher<Ipc, [u64], ()>,
    subscriber: iceoryx2::port::subscriber::Subscriber<Ipc, [u64], ()>,
    notifier: Option<iceoryx2::port::notifier::Notifier<Ipc>>,
    listener: Option<iceoryx2::port::listener::Listener<Ipc>>,
    taken: Box<[u64]>,
    _node: iceoryx2::node::Node<Ipc>,
}

impl Iceoryx2 {
    fn new(case: &Case, space: &Space, end: End) -> Result<Self, LatencyError> {
        let fail = LatencyError::iceoryx2;
        set_log_level(LogLevel::Fatal);
        let node = NodeBuilder::new()
            .config(&space.config()?)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| fail("make a node")(&e))?;
        let name = |name: &str| ServiceName::new(name).map_err(|e| fail("use a name")(&e));
        let data = |service: &str| {
            let builder = node.service_builder(&name(service)?).publish_subscribe::<[u64]>();
            builder.open_or_create().map_err(|e| fail("make a service")(&e))
        };
        let event = |service: &str| {
            let builder = node.service_builder(&name(service)?).event();
            builder.open_or_create().map_err(|e| fail("make an event")(&e))
        };
        let (out, back) = if end == End::First { ("to", "fro") } else { ("fro", "to") };
        let publisher = data(out)?
            .publisher_builder()
            .initial_max_slice_len(words(case))
            .create()
            .map_err(|e| fail("publish")(&e))?;
        let subscriber = data(back)?.subscriber_builder().create().map_err(|e| fail("subscribe")(&e))?;
        let (mut notifier, mut listener) = (None, None);
        if case.wait != Wait::Spin {
            let created = event(&format!("{back} event"))?.listener_builder().create();
            listener = Some(created.map_err(|e| fail("listen")(&e))?);
            let created = event(&format!("{out} event"))?.notifier_builder().create();
            notifier = Some(created.map_err(|e| fail("notify")(&e))?);
        }
        Ok(Self {
            publisher,
            subscriber,
            notifier,
            listener,
            taken: vec![0; words(case)].into(),
            _node: node,
        })
    }
}

impl Link for Iceoryx2 {
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError> {
        let fail = LatencyError::iceoryx2("send");
        let sample = self.publisher.loan_slice_uninit(self.taken.len()).map_err(|e| fail(&e))?;
        // SAFETY: the words lie in a mapped file, whose bytes are always initialised; any bits are a valid u64.
        let mut sample = unsafe { sample.assume_init() };
        fill(sample.payload_mut(), stamp);
        sample.send().map_err(|e| fail(&e))?;
        if let Some(notifier) = &self.notifier {
            notifier.notify().map_err(|e| fail(&e))?;
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError> {
        let sample = self.subscriber.receive().map_err(|e| LatencyError::iceoryx2("receive")(&e))?;
        Ok(sample.and_then(|sample| take_out(sample.payload(), &mut self.taken)))
    }

    fn sleep(&mut self, patience: Duration) -> Result<Option<Nanos>, LatencyError> {
        if let Some(listener) = &self.listener {
            listener.timed_wait(|_| {}, patience).map_err(|e| LatencyError::iceoryx2("wait")(&e))?;
        }
        Ok(None)
    }
}

struct Channel {
    publisher: Publisher,
    subscriber: Subscriber,
    listener: Option<Listener>,
    waker: Option<Waker>,
    taken: Box<[u64]>,
}

impl Channel {
    fn new(case: &Case, space: &Space, end: End) -> Result<Self, LatencyError> {
        let endpoint = Endpoint::new(space)?;
        let topic = |name: &str| Topic {
            name: name.into(),
            layout: 1,
            words: words(case),
            buffer: 2,
            subscribers: 1,
            held: 0,
        };
        let (out, back) = (topic("to"), topic("fro"));
        let blocks = case.wait != Wait::Spin;
        let taken = vec![0; words(case)].into();
        if end == End::First {
            let listener = endpoint.listener("first")?;
            // The second end looks for this one: both are there before it starts.
            endpoint.listener("second")?;
            let publisher = endpoint.create(&out)?.publisher()?;
            let subscriber = endpoint.create(&back)?.subscriber()?;
            let waker = blocks.then(|| endpoint.waker("second")).transpose()?;
            return Ok(Self { publisher, subscriber, listener: Some(listener), waker, taken });
        }
        let listener = Some(endpoint.listener("second")?);
        let subscriber = endpoint.open(&out)?.subscriber()?;
        let publisher = endpoint.open(&back)?.publisher()?;
        let waker = blocks.then(|| endpoint.waker("first")).transpose()?;
        Ok(Self { publisher, subscriber, listener, waker, taken })
    }
}

impl Link for Channel {
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError> {
        let mut loan = self.publisher.loan(self.taken.len())?;
        fill(&mut loan, stamp);
        loan.send()?;
        if let Some(waker) = &self.waker {
            waker.wake();
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError> {
        Ok(self.subscriber.take()?.and_then(|view| take_out(&view, &mut self.taken)))
    }

    fn sleep(&mut self, patience: Duration) -> Result<Option<Nanos>, LatencyError> {
        if let Some(listener) = &self.listener {
            listener.wait(patience);
        }
        Ok(None)
    }
}

/// A word that counts messages and one that holds the time, for each direction.
struct Word {
    page: SharedPage,
    out: usize,
    back: usize,
    seen: u32,
}

impl Word {
    fn new(space: &Space, end: End) -> Result<Self, LatencyError> {
        let page = SharedPage::create(&space.path().join("word")).map_err(LatencyError::io("map a page"))?;
        // A cache line each.
        let (out, back) = if end == End::First { (0, 8) } else { (8, 0) };
        Ok(Self { page, out, back, seen: 0 })
    }
}

impl Link for Word {
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError> {
        self.page.cell(self.out + 1).store(stamp as u64, Release);
        self.page.half(self.out).fetch_add(1, Release);
        if self.page.half(self.out + 2).load(Acquire) != 0 {
            futex::wake(self.page.half(self.out));
        }
        Ok(())
    }

    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError> {
        let count = self.page.half(self.back).load(Acquire);
        if count == self.seen {
            return Ok(None);
        }
        self.seen = count;
        Ok(Some(self.page.cell(self.back + 1).load(Acquire) as Nanos))
    }

    fn sleep(&mut self, patience: Duration) -> Result<Option<Nanos>, LatencyError> {
        // Whoever blocks here never polls: the other end always wakes.
        self.page.half(self.back + 2).store(1, std::sync::atomic::Ordering::SeqCst);
        futex::wait(self.page.half(self.back), self.seen, monotonic() + patience.as_nanos() as Nanos);
        Ok(None)
    }
}

/// One end of a pair of crossbeam channels. The same memory goes to and fro.
pub(super) struct Threads {
    pub(super) out: Sender<Vec<u64>>,
    pub(super) back: Receiver<Vec<u64>>,
    /// The message, while it is at this end.
    pub(super) held: Option<Vec<u64>>,
}

impl Threads {
    /// Both ends.
    pub(super) fn pair(case: &Case) -> (Self, Self) {
        let ((to, at_second), (fro, at_first)) =
            (crossbeam::channel::bounded(2), crossbeam::channel::bounded(2));
        let first = Self { out: to, back: at_first, held: Some(vec![0; words(case)]) };
        (first, Self { out: fro, back: at_second, held: None })
    }

    fn take(&mut self, message: Vec<u64>) -> Option<Nanos> {
        let stamp = message[0] as Nanos;
        self.held = Some(message);
        Some(stamp)
    }

    fn gone() -> LatencyError {
        LatencyError::Silent { carrier: Carrier::Crossbeam.to_string(), seconds: 0 }
    }
}

impl Link for Threads {
    fn send(&mut self, stamp: Nanos) -> Result<(), LatencyError> {
        let mut message = self.held.take().ok_or_else(Self::gone)?;
        message[0] = stamp as u64;
        self.out.send(message).map_err(|_| Self::gone())
    }

    fn poll(&mut self) -> Result<Option<Nanos>, LatencyError> {
        match self.back.try_recv() {
            Ok(message) => Ok(self.take(message)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(Self::gone()),
        }
    }

    fn sleep(&mut self, patience: Duration) -> Result<Option<Nanos>, LatencyError> {
        match self.back.recv_timeout(patience) {
            Ok(message) => Ok(self.take(message)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(Self::gone()),
        }
    }
}
