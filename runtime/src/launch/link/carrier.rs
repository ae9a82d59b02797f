//! What crosses the link, counted: a carrier around iceoryx2's own that keeps books of every channel.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64};

use iceoryx2_bb_elementary::generation::Generation;
use iceoryx2_integrations_zenoh_link_carrier::{ChannelSendError, ZenohCarrier, ZenohChannel};
use iceoryx2_link_backend::service_description::ServiceDescriptor;
use iceoryx2_link_backend::{Reactive, WakeHandle};
use iceoryx2_link_carrier::{Announcement, Carrier, Channel, Frame, Offer};

use super::{Crossing, that_cross};
use crate::channel::Topic;
use crate::random::fnv1a;
use crate::time::Nanos;

/// Bytes of one channel's records that are kept until the machine that records has taken earlier ones; beyond, the oldest give way, and
/// the recorder counts them as missing.
const KEPT: usize = 64 << 20;
/// So many records of a channel may be under way at a time: the queues of the network, and the 64 places at the other side, hold them.
const WINDOW: u64 = 32;
/// After so long without progress records that are under way count as lost: a connection that was made anew has forgotten them.
const FORGOTTEN: Nanos = 1_000_000_000;
/// In place of the number that comes next: nothing is known of what came before.
const UNKNOWN: u64 = u64::MAX;
/// Bytes of what is said of one channel: the hash of its name, and the number that comes next.
const RECEIPT: usize = 16;

/// The place of the number in a message.
pub(super) const MESSAGES: usize = 0;
/// The place of the number in a record.
pub(super) const RECORDS: usize = 1;

/// What crosses on one channel.
#[derive(Debug, Clone)]
pub(super) struct Wares {
    pub(super) topic: Topic,
    /// Which word of a message is its number: [`MESSAGES`] or [`RECORDS`].
    pub(super) number: usize,
    /// Of so many messages one crosses.
    pub(super) every: u64,
}

/// The books of one channel.
#[derive(Debug)]
struct Page {
    topic: Topic,
    /// Which word of a message is its number.
    number: usize,
    every: u64,
    sent: AtomicU64,
    held_back: AtomicU64,
    received: AtomicU64,
    lost: AtomicU64,
    malformed: AtomicU64,
    bytes: AtomicU64,
    /// The number of the message that comes next.
    next: AtomicU64,
    /// Something came since this was last asked.
    arrived: AtomicBool,
    /// Records, which nobody waits for, and which nobody else has.
    records: bool,
    /// Messages that are kept.
    kept: AtomicU64,
    /// The number after that of the last record that was sent, and after the last that arrived over there, as far as is known.
    out: AtomicU64,
    arrived_there: AtomicU64,
    /// When that changed last, on the monotonic clock, and what it was then.
    progress: AtomicI64,
    progressed: AtomicU64,
}

/// The books of all channels that cross.
#[derive(Debug)]
pub(super) struct Books {
    pages: Vec<Page>,
}

impl Books {
    /// Books for these channels.
    pub(super) fn new(wares: impl IntoIterator<Item = Wares>) -> Arc<Self> {
        let page = |Wares { topic, number, every }| Page {
            topic,
            number,
            every,
            held_back: AtomicU64::new(0),
            sent: AtomicU64::new(0),
            received: AtomicU64::new(0),
            lost: AtomicU64::new(0),
            malformed: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            next: AtomicU64::new(0),
            arrived: AtomicBool::new(false),
            records: number == RECORDS,
            kept: AtomicU64::new(0),
            out: AtomicU64::new(0),
            arrived_there: AtomicU64::new(0),
            progress: AtomicI64::new(0),
            progressed: AtomicU64::new(0),
        };
        Arc::new(Self { pages: wares.into_iter().map(page).collect() })
    }

    /// Which records have arrived here.
    pub(super) fn receipt(&self) -> Vec<u8> {
        let records = self.pages.iter().filter(|page| {
            page.records && page.received.load(Relaxed) > 0 && page.next.load(Relaxed) != UNKNOWN
        });
        let entry = |page: &Page| [fnv1a(page.topic.name.as_bytes()), page.next.load(Relaxed)];
        records.flat_map(entry).flat_map(u64::to_le_bytes).collect()
    }

    /// Takes in which records have arrived at the machine that records.
    pub(super) fn acknowledge(&self, receipt: &[u8]) {
        for entry in receipt.as_chunks::<RECEIPT>().0 {
            let [name, next] = [0, 8].map(|at| {
                entry[at..at + 8].iter().rev().fold(0u64, |word, byte| word << 8 | u64::from(*byte))
            });
            let page =
                self.pages.iter().find(|page| page.records && fnv1a(page.topic.name.as_bytes()) == name);
            if let Some(page) = page {
                page.arrived_there.fetch_max(next.min(page.out.load(Relaxed)), Relaxed);
            }
        }
    }

    /// Gives up what has been under way for too long, while the machine that records is heard.
    pub(super) fn forget(&self, now: Nanos, heard: bool) {
        for page in self.pages.iter().filter(|page| page.records) {
            let (arrived, out) = (page.arrived_there.load(Relaxed), page.out.load(Relaxed));
            if arrived == out || !heard || arrived != page.progressed.swap(arrived, Relaxed) {
                page.progress.store(now, Relaxed);
            } else if now.saturating_sub(page.progress.load(Relaxed)) > FORGOTTEN {
                page.arrived_there.store(out, Relaxed);
            }
        }
    }

    /// The number after that of the last message that came on a channel; 0 where none came.
    pub(super) fn next(&self, channel: &str) -> u64 {
        let page = self.pages.iter().find(|page| page.topic.name == channel);
        page.map(|page| page.next.load(Relaxed)).filter(|next| *next != UNKNOWN).unwrap_or(0)
    }

    /// This machine takes part again: what comes next has any number.
    pub(super) fn begin_anywhere(&self) {
        self.pages.iter().for_each(|page| page.next.store(UNKNOWN, Relaxed));
    }

    /// How many messages are kept.
    pub(super) fn kept(&self) -> u64 {
        self.pages.iter().map(|page| page.kept.load(Relaxed)).sum()
    }

    /// Whether something came on this channel since this was last asked.
    pub(super) fn arrived(&self, channel: usize) -> bool {
        self.pages[channel].arrived.load(Relaxed) && self.pages[channel].arrived.swap(false, Relaxed)
    }

    /// How many messages were moved, in either direction.
    pub(super) fn moved(&self) -> u64 {
        self.pages.iter().map(|page| page.sent.load(Relaxed) + page.received.load(Relaxed)).sum()
    }

    pub(super) fn crossings(&self) -> Vec<Crossing> {
        let crossing = |page: &Page| Crossing {
            channel: page.topic.name.clone(),
            sent: page.sent.load(Relaxed),
            held_back: page.held_back.load(Relaxed),
            received: page.received.load(Relaxed),
            lost: page.lost.load(Relaxed),
            malformed: page.malformed.load(Relaxed),
            bytes: page.bytes.load(Relaxed),
        };
        self.pages.iter().map(crossing).collect()
    }
}

impl Page {
    /// Whether one more record may be under way.
    fn has_room(&self) -> bool {
        self.out.load(Relaxed).saturating_sub(self.arrived_there.load(Relaxed)) < WINDOW
    }

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
        if next == UNKNOWN {
            self.next.store(number.saturating_add(1), Relaxed);
            return true;
        }
        // A smaller one comes from a node that was started again and repeats a number, or from nobody of ours.
        let missing = if next < number { that_cross(next, number, self.every) } else { 0 };
        self.lost.fetch_add(missing.min(1 << 32), Relaxed);
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
    /// Records that wait until the machine that records has taken earlier ones, and their bytes.
    kept: VecDeque<Vec<u8>>,
    bytes: usize,
}

impl CountedChannel {
    fn put(&mut self, frame: Frame<'_>) -> Result<(), ChannelSendError> {
        let length = (frame.header.len() + frame.payload.len()) as u64;
        self.channel.send(frame)?;
        let page = &self.books.pages[self.page];
        page.sent.fetch_add(1, Relaxed);
        page.bytes.fetch_add(length, Relaxed);
        if let Some(number) = frame.payload.as_chunks::<8>().0.get(page.number) {
            page.out.store(u64::from_ne_bytes(*number).saturating_add(1), Relaxed);
        }
        Ok(())
    }

    /// Sends what was kept, as far as there is room.
    fn catch_up(&mut self) -> Result<(), ChannelSendError> {
        while self.books.pages[self.page].has_room() {
            let Some(bytes) = self.kept.pop_front() else { break };
            self.bytes -= bytes.len();
            self.put(Frame { header: &[], payload: &bytes })?;
        }
        self.books.pages[self.page].kept.store(self.kept.len() as u64, Relaxed);
        Ok(())
    }
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
        let page = self.books.pages.iter().position(named).ok_or(OpenError::Unknown)?;
        let channel = self.carrier.open_channel(descriptor).map_err(OpenError::Network)?;
        Ok(CountedChannel { channel, books: Arc::clone(&self.books), page, kept: VecDeque::new(), bytes: 0 })
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
        let page = &self.books.pages[self.page];
        let number = frame.payload.as_chunks::<8>().0.get(page.number).map(|word| u64::from_ne_bytes(*word));
        if number.is_some_and(|number| !number.is_multiple_of(page.every)) {
            page.held_back.fetch_add(1, Relaxed);
            return Ok(());
        }
        if !page.records || (self.kept.is_empty() && page.has_room()) {
            return self.put(frame);
        }
        let bytes = frame.to_bytes();
        self.bytes += bytes.len();
        self.kept.push_back(bytes);
        while self.bytes > KEPT {
            self.bytes -= self.kept.pop_front().map_or(0, |bytes| bytes.len());
        }
        self.books.pages[self.page].kept.store(self.kept.len() as u64, Relaxed);
        Ok(())
    }

    fn receive<R>(&mut self, on_frame: impl FnOnce(&[u8]) -> R) -> Result<Option<R>, ChannelSendError> {
        if !self.kept.is_empty() {
            self.catch_up()?;
        }
        let page = &self.books.pages[self.page];
        self.channel.receive(|bytes| on_frame(if page.took(bytes) { bytes } else { &[] }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wares(topic: Topic, number: usize, every: u64) -> Wares {
        Wares { topic, number, every }
    }

    #[test]
    fn what_was_held_back_is_not_lost() {
        let topic = Topic { name: "arm".into(), layout: 1, words: 4, buffer: 8, subscribers: 1, held: 0 };
        let books = Books::new([wares(topic, MESSAGES, 3)]);
        let take = |number: u64| assert!(books.pages[0].took(&number.to_ne_bytes()));
        // 6 is missing; 1, 2, 4, 5, 7, 8, 10 and 11 never left.
        [0, 3, 9, 12].into_iter().for_each(take);
        assert_eq!(books.crossings()[0].lost, 1);
    }

    #[test]
    fn gaps_and_lengths_that_cannot_be_are_counted() {
        let topic = Topic { name: "arm".into(), layout: 1, words: 4, buffer: 8, subscribers: 1, held: 0 };
        let books = Books::new([wares(topic, MESSAGES, 1)]);
        let words = |seq: u64, count: usize| {
            std::iter::once(seq)
                .chain(std::iter::repeat(7))
                .take(count)
                .flat_map(u64::to_ne_bytes)
                .collect::<Vec<u8>>()
        };
        let page = &books.pages[0];
        assert!(page.took(&words(0, 3)) && page.took(&words(1, 3)) && page.took(&words(5, 4)));
        // Too long, no whole words, nothing; and a number again.
        assert!(!page.took(&words(6, 5)) && !page.took(&[1; 12]) && !page.took(&[]));
        assert!(page.took(&words(5, 3)) && page.took(&words(6, 3)));
        let [crossing] = &books.crossings()[..] else { panic!("one channel") };
        assert_eq!((crossing.received, crossing.lost, crossing.malformed), (8, 3, 3));
        assert!(books.arrived(0) && !books.arrived(0));
    }

    #[test]
    fn so_many_records_are_under_way_and_forgotten_ones_block_nothing() {
        let topic =
            |name: &str| Topic { name: name.into(), layout: 1, words: 4, buffer: 8, subscribers: 1, held: 0 };
        let (here, there) = (
            Books::new([wares(topic("arm/record"), RECORDS, 1)]),
            Books::new([wares(topic("arm/record"), RECORDS, 1)]),
        );
        let (page, far) = (&here.pages[0], &there.pages[0]);
        page.out.store(WINDOW, Relaxed);
        assert!(!page.has_room());
        let record =
            |number: u64| [3, number].iter().flat_map(|word| word.to_ne_bytes()).collect::<Vec<u8>>();
        assert!(far.took(&record(0)) && far.took(&record(4)));
        here.acknowledge(&there.receipt());
        assert!(page.has_room());
        assert_eq!(page.arrived_there.load(Relaxed), 5);
        // What somebody claims to have received that was never sent is not believed, nor is what is no receipt.
        here.acknowledge(&[u64::MAX.to_le_bytes(), u64::MAX.to_le_bytes()].concat());
        here.acknowledge(&[7; 15]);
        assert_eq!(page.arrived_there.load(Relaxed), 5);
        page.out.store(WINDOW + 5, Relaxed);
        here.forget(10, true);
        here.forget(FORGOTTEN, false);
        here.forget(FORGOTTEN + 9, true);
        assert!(!page.has_room());
        here.forget(2 * FORGOTTEN + 10, true);
        assert!(page.has_room());
    }
}
