//! The receiving end of a channel, and messages that are read where they lie.

use std::cell::Cell;
use std::fmt::Debug;
use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::ptr::NonNull;
use std::thread::ThreadId;

use iceoryx2::port::update_connections::UpdateConnections;

use super::place::received;
use super::{ChannelError, Ipc, Topic, failed};

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

/// A message that was looked at.
#[derive(Default)]
struct Last(Cell<Option<iceoryx2::sample::Sample<Ipc, [u64], ()>>>);

impl Debug for Last {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Last")
    }
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

impl Subscriber {
    /// In this thread, and for it.
    pub(super) fn new(port: iceoryx2::port::subscriber::Subscriber<Ipc, [u64], ()>, topic: Topic) -> Self {
        Subscriber { last: Last::default(), port, topic, thread: std::thread::current().id() }
    }

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
                take(received(&sample, self.topic.words));
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
        take(received(&sample, self.topic.words));
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
            let words = NonNull::from(received(&sample, self.topic.words));
            View { sample: ManuallyDrop::new(sample), words, thread: self.thread }
        }))
    }

    /// What was agreed for this channel.
    pub fn topic(&self) -> &Topic {
        &self.topic
    }
}

impl Deref for View {
    type Target = [u64];

    fn deref(&self) -> &[u64] {
        // SAFETY: the words were the sample's when it was taken, and stay where they are, as they are, while it is there.
        unsafe { self.words.as_ref() }
    }
}
