//! What crosses the link, counted: a carrier around iceoryx2's own that keeps books of every channel.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};

use super::Crossing;
use crate::channel::Topic;
use iceoryx2_bb_elementary::generation::Generation;
use iceoryx2_integrations_zenoh_link_carrier::{ChannelSendError, ZenohCarrier, ZenohChannel};
use iceoryx2_link_backend::service_description::ServiceDescriptor;
use iceoryx2_link_backend::{Reactive, WakeHandle};
use iceoryx2_link_carrier::{Announcement, Carrier, Channel, Frame, Offer};

/// The books of one channel.
#[derive(Debug)]
struct Page {
    topic: Topic,
    /// Which word of a message is its number.
    number: usize,
    sent: AtomicU64,
    received: AtomicU64,
    lost: AtomicU64,
    malformed: AtomicU64,
    bytes: AtomicU64,
    /// The number of the message that comes next.
    next: AtomicU64,
    /// Something came since this was last asked.
    arrived: AtomicBool,
}

/// The books of all channels that cross.
#[derive(Debug)]
pub(super) struct Books(Vec<Page>);

impl Books {
    /// Books for these channels, each with the place of a message's number among its words.
    pub(super) fn new(topics: impl IntoIterator<Item = (Topic, usize)>) -> Arc<Self> {
        let page = |(topic, number)| Page {
            topic,
            number,
            sent: AtomicU64::new(0),
            received: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            malformed: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            next: AtomicU64::new(0),
            arrived: AtomicBool::new(false),
        };
        Arc::new(Self(topics.into_iter().map(page).collect()))
    }

    /// Whether something came on this channel since this was last asked.
    pub(super) fn arrived(&self, channel: usize) -> bool {
        self.0[channel].arrived.load(Relaxed) && self.0[channel].arrived.swap(false, Relaxed)
    }

    /// How many messages were moved, in either direction.
    pub(super) fn moved(&self) -> u64 {
        self.0.iter().map(|page| page.sent.load(Relaxed) + page.received.load(Relaxed)).sum()
    }

    pub(super) fn crossings(&self) -> Vec<Crossing> {
        let crossing = |page: &Page| Crossing {
            channel: page.topic.name.clone(),
            sent: page.sent.load(Relaxed),
            received: page.received.load(Relaxed),
            lost: page.lost.load(Relaxed),
            malformed: page.malformed.load(Relaxed),
            bytes: page.bytes.load(Relaxed),
        };
        self.0.iter().map(crossing).collect()
    }
}

impl Page {
    /// Takes in what came; says whether it has a length that it can have.
    fn took(&self, bytes: &[u8]) -> bool {
        self.received.fetch_add(1, Relaxed);
        self.bytes.fetch_add(bytes.len() as u64, Relaxed);
        self.arrived.store(true, Relaxed);
        let words = bytes.as_chunks::<8>().0;
        let fits = bytes.len().is_multiple_of(8) && words.len() <= self.topic.words;
        let Some(number) = words.get(self.number).filter(|_| fits).map(|word| u64::from_ne_bytes(*word))
        else {
            self.malformed.fetch_add(1, Relaxed);
            return false;
        };
        let next = self.next.load(Relaxed);
        // A smaller one comes from a node that was started again and repeats a number, or from nobody of ours.
        self.lost.fetch_add(number.saturating_sub(next).min(1 << 32), Relaxed);
        self.next.store(number.saturating_add(1).max(next), Relaxed);
        true
    }
}

/// iceoryx2's carrier over zenoh, with books.
pub(super) struct Counted {
    carrier: ZenohCarrier,
    books: Arc<Books>,
}

impl Counted {
    pub(super) fn new(carrier: ZenohCarrier, books: Arc<Books>) -> Self {
        Self { carrier, books }
    }
}

/// A channel with books.
pub(super) struct CountedChannel {
    channel: ZenohChannel,
    books: Arc<Books>,
    page: usize,
}

/// Why a channel could not be opened.
#[derive(Debug, thiserror::Error)]
pub(super) enum OpenError {
    #[error("the channel does not cross")]
    Unknown,
    #[error("the network refuses it: {0}")]
    Network(iceoryx2_integrations_zenoh_link_carrier::ChannelError),
}

impl Carrier for Counted {
    type AnnouncementError = <ZenohCarrier as Carrier>::AnnouncementError;
    type ListError = <ZenohCarrier as Carrier>::ListError;
    type ChannelError = OpenError;
    type Channel = CountedChannel;

    fn announce(&mut self, announcement: Announcement) -> Result<(), Self::AnnouncementError> {
        self.carrier.announce(announcement)
    }

    fn generation(&self) -> Generation {
        self.carrier.generation()
    }

    fn offers(&self, callback: &mut dyn FnMut(Offer)) -> Result<(), Self::ListError> {
        self.carrier.offers(callback)
    }

    fn open_channel(&mut self, descriptor: &ServiceDescriptor) -> Result<CountedChannel, OpenError> {
        let named = |page: &Page| page.topic.name == descriptor.name.as_str();
        let page = self.books.0.iter().position(named).ok_or(OpenError::Unknown)?;
        let channel = self.carrier.open_channel(descriptor).map_err(OpenError::Network)?;
        Ok(CountedChannel { channel, books: Arc::clone(&self.books), page })
    }
}

impl Reactive for Counted {
    fn attach(&mut self, wake: WakeHandle) {
        self.carrier.attach(wake);
    }
}

impl Channel for CountedChannel {
    type Error = ChannelSendError;

    fn send(&mut self, frame: Frame<'_>) -> Result<(), ChannelSendError> {
        let length = (frame.header.len() + frame.payload.len()) as u64;
        self.channel.send(frame)?;
        let page = &self.books.0[self.page];
        page.sent.fetch_add(1, Relaxed);
        page.bytes.fetch_add(length, Relaxed);
        Ok(())
    }

    fn receive<R>(&mut self, on_frame: impl FnOnce(&[u8]) -> R) -> Result<Option<R>, ChannelSendError> {
        let page = &self.books.0[self.page];
        self.channel.receive(|bytes| on_frame(if page.took(bytes) { bytes } else { &[] }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_and_lengths_that_cannot_be_are_counted() {
        let topic = Topic { name: "arm".into(), layout: 1, words: 4, buffer: 8, subscribers: 1, held: 0 };
        let books = Books::new([(topic, 0)]);
        let words = |seq: u64, count: usize| {
            std::iter::once(seq)
                .chain(std::iter::repeat(7))
                .take(count)
                .flat_map(u64::to_ne_bytes)
                .collect::<Vec<u8>>()
        };
        let page = &books.0[0];
        assert!(page.took(&words(0, 3)) && page.took(&words(1, 3)) && page.took(&words(5, 4)));
        // Too long, no whole words, nothing; and a number again.
        assert!(!page.took(&words(6, 5)) && !page.took(&[1; 12]) && !page.took(&[]));
        assert!(page.took(&words(5, 3)) && page.took(&words(6, 3)));
        let [crossing] = &books.crossings()[..] else { panic!("one channel") };
        assert_eq!((crossing.received, crossing.lost, crossing.malformed), (8, 3, 3));
        assert!(books.arrived(0) && !books.arrived(0));
    }
}
