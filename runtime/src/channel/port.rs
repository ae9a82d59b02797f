//! Publishers and subscribers: the thin layer over iceoryx2.

use std::cell::Cell;
use std::fmt::Debug;
use std::mem::ManuallyDrop;
use std::ops::{Deref, DerefMut};
use std::path::PathBuf;
use std::ptr::NonNull;
use std::thread::ThreadId;

use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::{ChannelError, LOANED, Listener, Space, Topic, Waker};

type Ipc = ipc::Service;

/// Attribute of a service under which the layout's hash stands.
const LAYOUT: &str = "parallax.layout";

/// One process's, or one thread's, access to a run's channels.
#[derive(Debug)]
pub struct Endpoint {
    node: iceoryx2::node::Node<Ipc>,
    /// The run's directory, where the wake-ups lie.
    run: PathBuf,
}

/// A channel that exists: opened or created.
#[derive(Debug)]
pub struct Service {
    factory: PortFactory<Ipc, [u64], ()>,
    topic: Topic,
}

/// The sending end of a channel.
#[derive(Debug)]
pub struct Publisher {
    /// The place of the next message, taken while there was time.
    ready: Ready,
    port: iceoryx2::port::publisher::Publisher<Ipc, [u64], ()>,
    factory: PortFactory<Ipc, [u64], ()>,
    topic: Topic,
}

/// The receiving end of a channel.
#[derive(Debug)]
pub struct Subscriber {
    /// The last message that was looked at. Its place is given back when the next one is looked for, and not before what it
    /// led to has been done.
    last: Last,
    port: iceoryx2::port::subscriber::Subscriber<Ipc, [u64], ()>,
    topic: Topic,
    /// The thread that it was made in, and stays in.
    thread: ThreadId,
}

/// A message that is not begun yet.
#[derive(Default)]
struct Ready(Cell<Option<iceoryx2::sample_mut::SampleMut<Ipc, [u64], ()>>>);

impl Debug for Ready {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Ready")
    }
}

/// A message that was looked at.
#[derive(Default)]
struct Last(Cell<Option<iceoryx2::sample::Sample<Ipc, [u64], ()>>>);

impl Debug for Last {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Last")
    }
}

/// Words of a message that is small enough to be written to ahead of its time.
const SMALL: usize = 512;

/// A message being written, in the place in shared memory from which it is read.
#[derive(Debug)]
pub struct Loan<'a> {
    sample: iceoryx2::sample_mut::SampleMut<Ipc, [u64], ()>,
    topic: &'a Topic,
}

/// A message in the place where its sender wrote it. It stays as it is until the view is dropped, by the thread that took
/// it: one that another thread drops keeps its place.
#[derive(Debug)]
pub struct View {
    sample: ManuallyDrop<iceoryx2::sample::Sample<Ipc, [u64], ()>>,
    /// The message that the sample holds.
    words: NonNull<[u64]>,
    /// The thread that took it, which the subscriber cannot leave.
    thread: ThreadId,
}

// SAFETY: what keeps a sample from being sent is the count that it shares with its subscriber without synchronisation.
// The sample is touched by `drop` only, and only on the thread that took it, where the subscriber is, too. Everything else
// reads the words of the message, which nobody writes while the sample is there.
unsafe impl Send for View {}
// SAFETY: as above; a shared view gives nothing but the message to read.
unsafe impl Sync for View {}

impl Drop for View {
    fn drop(&mut self) {
        if std::thread::current().id() == self.thread {
            // SAFETY: this is the only place that drops it, once, and nothing uses it afterwards.
            unsafe { ManuallyDrop::drop(&mut self.sample) };
        }
    }
}

/// The words of a message. How many there are stands beside them in shared memory, where whoever sends can write: a number
/// that cannot be right is taken for none.
fn words(sample: &iceoryx2::sample::Sample<Ipc, [u64], ()>, limit: usize) -> &[u64] {
    if sample.header().number_of_elements() > limit as u64 {
        return &[];
    }
    let words = sample.payload();
    // The number was read once more for this.
    if words.len() > limit { &[] } else { words }
}

/// Bytes of a cache line.
const LINE: usize = 64;
/// Cache lines of a message that are asked for ahead: what stands before its data is seldom longer.
const LINES: usize = 4;

/// Asks for the first lines of a message, so that they come from the sender's core while something else is done.
fn fetch(sample: &iceoryx2::sample::Sample<Ipc, [u64], ()>, limit: usize) {
    // The number of words is not looked at: it lies in the message, and has to be waited for.
    let start = std::ptr::from_ref(sample.header()).cast::<i8>();
    let length = size_of_val(sample.header()) + limit * size_of::<u64>();
    for line in 0..length.div_ceil(LINE).min(LINES) {
        prefetch(start.wrapping_add(line * LINE));
    }
    // One that does not begin with a line ends in one more.
    prefetch(start.wrapping_add(length.min(LINES * LINE) - 1));
}

#[cfg(target_arch = "x86_64")]
fn prefetch(address: *const i8) {
    use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
    // SAFETY: a hint to the processor, which touches no memory as the program sees it and faults at no address. The
    // instruction belongs to SSE, which every x86-64 processor has.
    unsafe { _mm_prefetch::<_MM_HINT_T0>(address) };
}

#[cfg(not(target_arch = "x86_64"))]
fn prefetch(_: *const i8) {}

/// A transport error with the channel's name and what was tried.
fn failed(topic: &str, what: &'static str) -> impl Fn(&dyn Debug) -> ChannelError {
    move |detail| ChannelError::Transport { topic: topic.into(), what, detail: format!("{detail:?}") }
}

fn service_name(topic: &str) -> Result<ServiceName, ChannelError> {
    ServiceName::new(topic).map_err(|e| failed(topic, "use the name")(&e))
}

impl Endpoint {
    /// Opens this process's access to a space.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`] when iceoryx2 cannot work in the space.
    pub fn new(space: &Space) -> Result<Self, ChannelError> {
        // Every failure comes back as an error value and is reported once, by whoever handles it.
        set_log_level(LogLevel::Fatal);
        let config = space.config()?;
        let node = NodeBuilder::new()
            .config(&config)
            // The launcher decides what a signal means, not the transport.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| failed("(all)", "open shared memory")(&e))?;
        Ok(Self { node, run: space.path().into() })
    }

    /// Creates a channel. It exists while somebody holds the service or a port of it.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`] when it exists already, or cannot be made.
    pub fn create(&self, topic: &Topic) -> Result<Service, ChannelError> {
        self.create_for(topic, 1)
    }

    /// As [`create`](Self::create), for so many publishers: one, and the link to other machines where the channel crosses.
    pub(crate) fn create_for(&self, topic: &Topic, publishers: usize) -> Result<Service, ChannelError> {
        let fail = failed(&topic.name, "create the channel");
        let (key, value) = attribute(topic)?;
        let attributes = AttributeSpecifier::new().define(&key, &value).map_err(|e| fail(&e))?;
        let factory = self
            .node
            .service_builder(&service_name(&topic.name)?)
            .publish_subscribe::<[u64]>()
            .max_publishers(publishers)
            .max_subscribers(topic.subscribers.max(1))
            .max_nodes(topic.subscribers + 1 + publishers)
            .subscriber_max_buffer_size(topic.buffer.max(1))
            .subscriber_max_borrowed_samples(topic.borrowed())
            .history_size(0)
            // The newest message is worth more than the oldest: a receiver that falls behind loses the oldest,
            // and counts the gap in the sequence numbers.
            .enable_safe_overflow(true)
            .create_with_attributes(&attributes)
            .map_err(|e| fail(&e))?;
        Ok(Service { factory, topic: topic.clone() })
    }

    /// Opens a channel that another endpoint created.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Layout`] when it was created with another layout, else [`ChannelError::Transport`].
    pub fn open(&self, topic: &Topic) -> Result<Service, ChannelError> {
        let fail = failed(&topic.name, "open the channel");
        let (key, value) = attribute(topic)?;
        let attributes = AttributeVerifier::new().require(&key, &value).map_err(|e| fail(&e))?;
        let opened = self
            .node
            .service_builder(&service_name(&topic.name)?)
            .publish_subscribe::<[u64]>()
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(topic.buffer.max(1))
            .open_with_attributes(&attributes);
        match opened {
            Ok(factory) => Ok(Service { factory, topic: topic.clone() }),
            Err(PublishSubscribeOpenError::IncompatibleAttributes) => {
                Err(ChannelError::Layout { topic: topic.name.clone(), expected: topic.layout })
            }
            Err(e) => Err(fail(&e)),
        }
    }

    /// Removes what participants left behind that have died. Until then their ports count as there: nobody can take their
    /// place. Gives the number of those that were removed.
    pub fn remove_dead(&self) -> u64 {
        self.node.blocking_cleanup_dead_nodes(std::time::Duration::from_millis(200)).cleanups
    }

    /// The listener `name`: what every waker of that name wakes. A name has one listener at a time.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`] when it cannot be put into the run's directory.
    pub fn listener(&self, name: &str) -> Result<Listener, ChannelError> {
        Listener::create(&self.run, name)
    }

    /// A waker of the listener `name`, which must exist.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Io`] when there is no such listener.
    pub fn waker(&self, name: &str) -> Result<Waker, ChannelError> {
        Waker::open(&self.run, name)
    }
}

fn attribute(topic: &Topic) -> Result<(AttributeKey, AttributeValue), ChannelError> {
    let fail = failed(&topic.name, "describe the layout");
    Ok((
        AttributeKey::new(LAYOUT.as_bytes()).map_err(|e| fail(&e))?,
        AttributeValue::new(format!("{:016x}/{}", topic.layout, topic.words).as_bytes())
            .map_err(|e| fail(&e))?,
    ))
}

impl Service {
    /// The sending end; a channel has one.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn publisher(self) -> Result<Publisher, ChannelError> {
        let port = self
            .factory
            .publisher_builder()
            .initial_max_slice_len(self.topic.words)
            .max_loaned_samples(LOANED)
            // "Retry" would poll with sleeps of up to 10 ms inside a step.
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|e| failed(&self.topic.name, "publish")(&e))?;
        Ok(Publisher { ready: Ready::default(), port, factory: self.factory, topic: self.topic })
    }

    /// A receiving end.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn subscriber(&self) -> Result<Subscriber, ChannelError> {
        let port = self
            .factory
            .subscriber_builder()
            .buffer_size(self.topic.buffer.max(1))
            .create()
            .map_err(|e| failed(&self.topic.name, "subscribe")(&e))?;
        let thread = std::thread::current().id();
        Ok(Subscriber { last: Last::default(), port, topic: self.topic.clone(), thread })
    }
}

impl Publisher {
    /// Sends a message of `words` words, the i-th of which is `word(i)`; gives the number of subscribers
    /// that it was put before.
    ///
    /// # Errors
    ///
    /// [`ChannelError::TooLong`], or [`ChannelError::Transport`].
    pub fn send(&self, words: usize, mut word: impl FnMut(usize) -> u64) -> Result<usize, ChannelError> {
        self.send_filled(words, |place| {
            place.iter_mut().enumerate().for_each(|(index, place)| *place = word(index));
        })
    }

    /// As [`send`](Self::send), with a message that `fill` writes whole.
    ///
    /// # Errors
    ///
    /// [`ChannelError::TooLong`], or [`ChannelError::Transport`].
    pub(crate) fn send_filled(
        &self,
        words: usize,
        fill: impl FnOnce(&mut [u64]),
    ) -> Result<usize, ChannelError> {
        let mut sample = self.place(words, "send")?;
        fill(sample.payload_mut());
        sample.send().map_err(|e| failed(&self.topic.name, "send")(&e))
    }

    /// Takes the place of the next message, of the greatest length, now that there is time: to take it back from a receiver
    /// on another core, and to get its memory into this core's cache, costs as much as to send it. What cannot be done now
    /// is done, or fails, when the message is sent.
    pub(crate) fn prepare(&self) {
        if let Some(ready) = self.ready.0.take() {
            return self.ready.0.set(Some(ready));
        }
        let Ok(mut sample) = self.place(self.topic.words, "prepare") else { return };
        if self.topic.words <= SMALL {
            sample.payload_mut().fill(0);
        }
        self.ready.0.set(Some(sample));
    }

    fn place(
        &self,
        words: usize,
        what: &'static str,
    ) -> Result<iceoryx2::sample_mut::SampleMut<Ipc, [u64], ()>, ChannelError> {
        self.check(words)?;
        match self.ready.0.take() {
            Some(ready) if ready.payload().len() == words => return Ok(ready),
            // One that does not fit is given back: only one may be taken at a time.
            other => drop(other),
        }
        let sample = self.port.loan_slice_uninit(words).map_err(|e| failed(&self.topic.name, what)(&e))?;
        // SAFETY: the words lie in a mapped file, whose bytes are always initialised: with zeros at first, with an
        // earlier message later. Every bit pattern is a valid u64.
        Ok(unsafe { sample.assume_init() })
    }

    /// The place for a message of `words` words, to be written and then [sent](Loan::send): nothing is copied. Words
    /// that are not written hold what an earlier message left there. One message can be written at a time.
    ///
    /// # Errors
    ///
    /// [`ChannelError::TooLong`], or [`ChannelError::Transport`].
    pub fn loan(&self, words: usize) -> Result<Loan<'_>, ChannelError> {
        Ok(Loan { sample: self.place(words, "begin a message")?, topic: &self.topic })
    }

    fn check(&self, words: usize) -> Result<(), ChannelError> {
        if words <= self.topic.words {
            return Ok(());
        }
        Err(ChannelError::TooLong { topic: self.topic.name.clone(), words, limit: self.topic.words })
    }

    /// Connects to the subscribers that exist by now, and gives their number. Until this is done, or a
    /// message is sent, a new subscriber gets nothing, and nobody is told.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn connect(&self) -> Result<usize, ChannelError> {
        self.port.update_connections().map_err(|e| failed(&self.topic.name, "connect to subscribers")(&e))?;
        Ok(self.factory.dynamic_config().number_of_subscribers())
    }

    /// What was agreed for this channel.
    pub fn topic(&self) -> &Topic {
        &self.topic
    }
}

impl Subscriber {
    /// Connects to the publishers that exist by now. Otherwise the first look for a message does that.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn connect(&self) -> Result<(), ChannelError> {
        self.port.update_connections().map_err(|e| failed(&self.topic.name, "connect to publishers")(&e))
    }

    /// Hands the next waiting message to `take`, if there is one; says whether there was. One that says of itself that it is
    /// longer than the channel allows is handed over without a word.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn receive(&self, take: impl FnOnce(&[u64])) -> Result<bool, ChannelError> {
        drop(self.last.0.take());
        match self.port.receive() {
            Ok(Some(sample)) => {
                take(words(&sample, self.topic.words));
                self.last.0.set(Some(sample));
                Ok(true)
            }
            Ok(None) => Ok(false),
            Err(e) => Err(failed(&self.topic.name, "receive")(&e)),
        }
    }

    /// As [`receive`](Self::receive), and gives what `arrived` said as soon as the message was there, before it is read. What
    /// `arrived` does, such as to look at the clock, takes its time while the message comes from the sender's core.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub(crate) fn receive_at<T>(
        &self,
        arrived: impl FnOnce() -> T,
        take: impl FnOnce(&[u64]),
    ) -> Result<Option<T>, ChannelError> {
        drop(self.last.0.take());
        let Some(sample) = self.port.receive().map_err(|e| failed(&self.topic.name, "receive")(&e))? else {
            return Ok(None);
        };
        fetch(&sample, self.topic.words);
        let arrived = arrived();
        take(words(&sample, self.topic.words));
        self.last.0.set(Some(sample));
        Ok(Some(arrived))
    }

    /// Takes the next waiting message, if there is one, where it lies. At most [`Topic::held`] views may be kept.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`], also when too many views are kept.
    pub fn take(&self) -> Result<Option<View>, ChannelError> {
        drop(self.last.0.take());
        let taken = self.port.receive().map_err(|e| failed(&self.topic.name, "receive")(&e))?;
        Ok(taken.map(|sample| {
            let words = NonNull::from(words(&sample, self.topic.words));
            View { sample: ManuallyDrop::new(sample), words, thread: self.thread }
        }))
    }

    /// What was agreed for this channel.
    pub fn topic(&self) -> &Topic {
        &self.topic
    }
}

impl Loan<'_> {
    /// Sends the message; gives the number of subscribers that it was put before.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn send(self) -> Result<usize, ChannelError> {
        self.sample.send().map_err(|e| failed(&self.topic.name, "send")(&e))
    }
}

impl Loan<'_> {
    /// Sends the message, and then hands it to `look`, to be read where it lies; gives the number of subscribers that it
    /// was put before.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`]; the message is not handed on then.
    ///
    /// # Safety
    ///
    /// `look` must neither begin nor send another message of the same publisher.
    pub(crate) unsafe fn send_then(self, look: impl FnOnce(&[u64])) -> Result<usize, ChannelError> {
        let words: *const [u64] = self.sample.payload();
        let delivered = self.send()?;
        // SAFETY: the words lie in the publisher's own segment, which stays mapped while the publisher lives, and it lives
        // for as long as the loan borrowed it. Receivers only read them. Their place is given to another message by this
        // publisher alone, when it begins or sends one, which the caller rules out.
        look(unsafe { &*words });
        Ok(delivered)
    }
}

impl Deref for Loan<'_> {
    type Target = [u64];

    fn deref(&self) -> &[u64] {
        self.sample.payload()
    }
}

impl DerefMut for Loan<'_> {
    fn deref_mut(&mut self) -> &mut [u64] {
        self.sample.payload_mut()
    }
}

impl Deref for View {
    type Target = [u64];

    fn deref(&self) -> &[u64] {
        // SAFETY: the words were the sample's when it was taken, and stay where they are, as they are, while it is there.
        unsafe { self.words.as_ref() }
    }
}
