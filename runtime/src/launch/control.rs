//! What the launcher and its nodes say to each other: one JSON object a line, over a socket pair.
//!
//! The same socket tells each side that the other is gone: it closes when a process dies, however it dies.

use std::io::{self, Read, Write};
use std::net::Shutdown;
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::net::UnixStream;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::desk::{By, Told, Wish};
use super::ledger::Ledger;
use super::link::{News, Word};
use super::report::Exit;
use crate::recording::{Clock, ClockReading, Fault};
use crate::time::Nanos;

/// Bytes that may wait for room on a line.
const MOST_WAITING: usize = 1 << 20;

/// Bytes of a line at most.
const LONGEST: usize = 1 << 20;

/// From the launcher to a node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Order {
    /// Every channel has its subscribers now: connect to them and count them.
    Connect,
    /// The run's clock has this epoch: begin when it shows 0, or take up the work of an earlier process of this node.
    Start { epoch: Nanos, resume: bool },
    /// The node of this name is gone, or hangs, before it sent message `next`; whether it may come back.
    SenderGone { node: String, next: u64, back: bool },
    /// Somebody wishes something of the node; the answer has this number.
    Tune { id: u64, by: By, wish: Wish },
    /// Finish the step and end.
    Stop,
    /// To the recorder: the run has this clock, begin to write; beside the files of the same name when the run has begun before.
    Record { clock: Clock, again: bool },
    /// To the recorder: write this down.
    Fault { fault: Fault },
    /// To the recorder: how the clocks of two machines stand to each other; write this down.
    Clocks { readings: Vec<ClockReading> },
    /// To the recorder: the run is over and lasted so long; write what is left.
    Finish { duration: Nanos },
    /// To the link.
    Link { word: Word },
}

/// From a node to the launcher.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Answer {
    /// The node exists and its channels are open; what the system refused it.
    Opened { refused: Vec<String> },
    /// Connected: the number of receivers of its output, and of its records.
    Connected { receivers: usize, recorders: usize },
    /// The recorder listens to all nodes.
    Listening,
    /// The link says something.
    Link { news: News },
    /// The recorder has closed its last file.
    Recorded { ledger: Box<Ledger> },
    /// The node, or the recorder, cannot go on.
    Failed { reason: String },
    /// The node takes up an earlier one's work with this step.
    Resumed { step: u64, shift: Nanos },
    /// What became of a wish.
    Tuned { id: u64, told: Result<Told, String> },
    /// The node has ended, after it did what it does at the end. What went wrong with that, and whether the run is to end
    /// with it whatever else holds.
    Done { exit: Exit, problem: Option<String>, ends_run: bool },
}

/// One end of a control socket.
#[derive(Debug)]
pub(super) struct Line {
    stream: UnixStream,
    /// Bytes of a line that is not complete yet.
    partial: Vec<u8>,
    /// What the other side has had no room for yet, where nobody here waits for it.
    waiting: Vec<u8>,
    /// Whether sending waits until there is room, or until the stream's own patience ends.
    waits: bool,
    closed: bool,
}

impl Line {
    /// A line on which sending waits until there is room.
    pub(super) fn new(stream: UnixStream) -> Self {
        Self { stream, partial: Vec::new(), waiting: Vec::new(), waits: true, closed: false }
    }

    /// A line on which sending waits for nobody: what there is no room for goes when there is, at the latest when it is asked what has
    /// come.
    pub(super) fn without_waiting(stream: UnixStream) -> io::Result<Self> {
        stream.set_nonblocking(true)?;
        Ok(Self { waits: false, ..Self::new(stream) })
    }

    pub(super) fn fd(&self) -> RawFd {
        self.stream.as_raw_fd()
    }

    /// Whether the other side is gone.
    pub(super) fn closed(&self) -> bool {
        self.closed
    }

    /// Ends the talk: the other side sees the line closed.
    pub(super) fn hang_up(&mut self) {
        // It can only fail when the other side is gone already.
        let _ = self.stream.shutdown(Shutdown::Both);
        self.partial.clear();
        self.closed = true;
    }

    /// Sends one message. A message to somebody who is gone is not an error here: the end of the line is
    /// noticed, and reported, where it is read.
    pub(super) fn send(&mut self, message: &impl Serialize) {
        if self.waiting.len() > MOST_WAITING {
            // Whoever has read nothing for so long hangs. It must not go on without what it was not told: it finds the line
            // closed, ends, and is told all that counts when it is started again.
            self.hang_up();
            return;
        }
        match serde_json::to_writer(&mut self.waiting, message) {
            Ok(()) => {
                self.waiting.push(b'\n');
                self.flush();
            }
            Err(_) => self.closed = true,
        }
    }

    /// Sends what waits, as far as there is room.
    fn flush(&mut self) {
        while !self.waiting.is_empty() && !self.closed {
            match self.stream.write(&self.waiting) {
                Ok(0) => self.closed = true,
                Ok(count) => drop(self.waiting.drain(..count)),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) if e.kind() == io::ErrorKind::WouldBlock && !self.waits => return,
                Err(_) => self.closed = true,
            }
        }
    }

    /// Waits at most `milliseconds` for something to read, and gives the messages that are complete.
    ///
    /// # Errors
    ///
    /// When a line is not one of ours. What came before it was given by an earlier call; what comes behind it, the next one gives.
    pub(super) fn receive<T: DeserializeOwned>(
        &mut self,
        milliseconds: i32,
    ) -> Result<Vec<T>, serde_json::Error> {
        let mut messages = Vec::new();
        self.flush();
        let known = if self.partial.contains(&b'\n') { 0 } else { milliseconds };
        if !self.closed && readable(&[self.fd()], known) {
            let mut bytes = [0; 4096];
            match self.stream.read(&mut bytes) {
                Ok(0) => self.closed = true,
                Ok(count) => self.partial.extend_from_slice(&bytes[..count]),
                Err(e) if matches!(e.kind(), io::ErrorKind::Interrupted | io::ErrorKind::WouldBlock) => {}
                Err(_) => self.closed = true,
            }
        }
        if self.partial.len() > LONGEST && !self.partial.contains(&b'\n') {
            // Nobody of ours says so much at once.
            self.closed = true;
            self.partial.clear();
        }
        while let Some(end) = self.partial.iter().position(|byte| *byte == b'\n') {
            let message = serde_json::from_slice(&self.partial[..end]);
            if message.is_err() && !messages.is_empty() {
                break;
            }
            self.partial.drain(..=end);
            messages.push(message?);
        }
        Ok(messages)
    }
}

/// Waits at most `milliseconds` until one of the descriptors can be read or is closed; a signal ends the wait.
pub(super) fn readable(descriptors: &[RawFd], milliseconds: i32) -> bool {
    let mut polled: Vec<libc::pollfd> =
        descriptors.iter().map(|fd| libc::pollfd { fd: *fd, events: libc::POLLIN, revents: 0 }).collect();
    // SAFETY: the pointer and the length are those of one vector, which outlives the call.
    unsafe { libc::poll(polled.as_mut_ptr(), polled.len() as libc::nfds_t, milliseconds) > 0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_arrive_whole_and_in_order_and_the_end_is_noticed() {
        let (here, there) = UnixStream::pair().unwrap();
        let (mut here, mut there) = (Line::new(here), Line::new(there));
        here.send(&Order::Connect);
        here.send(&Order::Start { epoch: -3, resume: false });
        let got: Vec<Order> = there.receive(1000).unwrap();
        assert_eq!(got, [Order::Connect, Order::Start { epoch: -3, resume: false }]);
        assert_eq!(there.receive::<Order>(0).unwrap(), []);
        assert!(!there.closed());
        drop(here);
        assert_eq!(there.receive::<Order>(1000).unwrap(), []);
        assert!(there.closed());
    }

    #[test]
    fn nobody_waits_for_one_who_reads_nothing_and_what_was_said_is_there_when_he_does() {
        let (here, there) = UnixStream::pair().unwrap();
        let (mut here, mut there) = (Line::without_waiting(here).unwrap(), Line::new(there));
        let said = |next| Order::SenderGone { node: "camera".into(), next, back: true };
        // More than a socket holds.
        (0..5_000).for_each(|next| here.send(&said(next)));
        let mut got = Vec::new();
        while got.len() < 5_000 {
            got.extend(there.receive::<Order>(1000).unwrap());
            assert_eq!(here.receive::<Answer>(0).unwrap(), []);
        }
        assert!(got.iter().zip(0..).all(|(order, next)| *order == said(next)));
        // For ever is too long: who was not told all must not go on as if.
        (0..50_000).for_each(|next| here.send(&said(next)));
        assert!(here.waiting.len() < 2 * MOST_WAITING && here.closed());
        while !there.closed() {
            there.receive::<Order>(1000).unwrap();
        }
    }

    #[test]
    fn a_line_that_is_no_message_takes_none_of_the_others_along() {
        let (mut here, there) = UnixStream::pair().unwrap();
        let mut there = Line::new(there);
        let order = serde_json::to_string(&Order::Connect).unwrap();
        here.write_all(format!("{order}\n{order}\n{{}} nonsense\n{order}\n").as_bytes()).unwrap();
        drop(here);
        assert_eq!(there.receive::<Order>(1000).unwrap(), [Order::Connect, Order::Connect]);
        assert!(there.receive::<Order>(1000).is_err());
        assert_eq!(there.receive::<Order>(1000).unwrap(), [Order::Connect]);
        assert_eq!(there.receive::<Order>(1000).unwrap(), []);
        assert!(there.closed());
    }
}
