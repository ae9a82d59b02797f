//! The sending end of a channel, and messages that are written where they are read.

use std::cell::Cell;
use std::fmt::Debug;
use std::ops::{Deref, DerefMut};

use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::place::Place;
use super::{ChannelError, Ipc, Topic, failed};

/// The sending end of a channel.
#[derive(Debug)]
pub struct Publisher {
    /// The place of the next message, taken while there was time.
    ready: Ready,
    port: iceoryx2::port::publisher::Publisher<Ipc, [u64], ()>,
    factory: PortFactory<Ipc, [u64], ()>,
    topic: Topic,
}

/// A message that is not begun yet.
#[derive(Default)]
struct Ready(Cell<Option<Place>>);

impl Debug for Ready {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Ready")
    }
}

/// Words of a message that is small enough to be written to ahead of its time.
const SMALL: usize = 512;

/// A message being written, in the place in shared memory from which it is read.
#[derive(Debug)]
pub struct Loan<'a> {
    place: Place,
    topic: &'a Topic,
}

impl Publisher {
    pub(super) fn new(
        port: iceoryx2::port::publisher::Publisher<Ipc, [u64], ()>,
        factory: PortFactory<Ipc, [u64], ()>,
        topic: Topic,
    ) -> Self {
        Publisher { ready: Ready::default(), port, factory, topic }
    }

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
        let mut place = self.place(words, "send")?;
        fill(place.words_mut());
        place.send().map_err(|e| failed(&self.topic.name, "send")(&e))
    }

    /// Takes the place of the next message, of the greatest length, now that there is time: to take it back from a receiver
    /// on another core, and to get its memory into this core's cache, costs as much as to send it. What cannot be done now
    /// is done, or fails, when the message is sent.
    pub(crate) fn prepare(&self) {
        if let Some(ready) = self.ready.0.take() {
            return self.ready.0.set(Some(ready));
        }
        let Ok(mut place) = self.place(self.topic.words, "prepare") else { return };
        if self.topic.words <= SMALL {
            place.words_mut().fill(0);
        }
        self.ready.0.set(Some(place));
    }

    fn place(&self, words: usize, what: &'static str) -> Result<Place, ChannelError> {
        self.check(words)?;
        match self.ready.0.take() {
            Some(ready) if ready.words().len() == words => return Ok(ready),
            // One that does not fit is given back: only one may be taken at a time.
            other => drop(other),
        }
        let sample = self.port.loan_slice_uninit(words).map_err(|e| failed(&self.topic.name, what)(&e))?;
        // SAFETY: the words lie in a mapped file, whose bytes are always initialised: with zeros at first, with an
        // earlier message later. Every bit pattern is a valid u64.
        Ok(Place::new(unsafe { sample.assume_init() }, words))
    }

    /// The place for a message of `words` words, to be written and then [sent](Loan::send): nothing is copied. Words
    /// that are not written hold what an earlier message left there. One message can be written at a time.
    ///
    /// # Errors
    ///
    /// [`ChannelError::TooLong`], or [`ChannelError::Transport`].
    pub fn loan(&self, words: usize) -> Result<Loan<'_>, ChannelError> {
        Ok(Loan { place: self.place(words, "begin a message")?, topic: &self.topic })
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

impl Loan<'_> {
    /// Sends the message; gives the number of subscribers that it was put before.
    ///
    /// # Errors
    ///
    /// [`ChannelError::Transport`].
    pub fn send(self) -> Result<usize, ChannelError> {
        self.place.send().map_err(|e| failed(&self.topic.name, "send")(&e))
    }

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
        let words: *const [u64] = self.place.words();
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
        self.place.words()
    }
}

impl DerefMut for Loan<'_> {
    fn deref_mut(&mut self) -> &mut [u64] {
        self.place.words_mut()
    }
}
