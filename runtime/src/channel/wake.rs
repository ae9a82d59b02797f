//! Wake-ups: a node that sleeps until a message may have come, and whoever sends to it.
//!
//! A listener is two words in a page of shared memory: how often it was called, and whether it sleeps. To call somebody
//! who is awake is one addition and no system call, so that a sender pays for a wake-up only where there is one.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

use super::ChannelError;
use super::futex::{self, SharedPage};
use crate::clock::monotonic;
use crate::random::fnv1a;
use crate::time::Nanos;

/// How often the listener was called.
const CALLS: usize = 0;
/// Whether it sleeps. It lies a cache line away: looking at one word should not disturb who writes the other.
const ASLEEP: usize = 8;

/// Waits until a [`Waker`] of the same name calls.
#[derive(Debug)]
pub struct Listener {
    page: SharedPage,
    /// Calls that have been answered.
    answered: Cell<u32>,
}

/// Wakes the listener of the same name.
#[derive(Debug)]
pub struct Waker {
    page: SharedPage,
}

impl Listener {
    pub(super) fn create(run: &Path, name: &str) -> Result<Self, ChannelError> {
        let path = path(run, name);
        let page = SharedPage::create(&path).map_err(|source| ChannelError::Io {
            what: "cannot make the wake-up",
            path,
            source,
        })?;
        let answered = Cell::new(page.half(CALLS).load(SeqCst));
        Ok(Self { page, answered })
    }

    /// Waits until somebody has called since the last wait, or the time is over.
    pub fn wait(&self, time: Duration) {
        let calls = self.page.half(CALLS);
        if calls.load(SeqCst) == self.answered.get() {
            let time = Nanos::try_from(time.as_nanos()).unwrap_or(Nanos::MAX);
            let until = monotonic().saturating_add(time);
            // A caller adds its call first and looks for a sleeper then; here it is the other way round, and the kernel
            // compares once more. Whatever the order, one of the two sees the other.
            self.page.half(ASLEEP).store(1, SeqCst);
            futex::wait(calls, self.answered.get(), until);
            self.page.half(ASLEEP).store(0, SeqCst);
        }
        self.answered.set(calls.load(SeqCst));
    }
}

impl Waker {
    pub(super) fn open(run: &Path, name: &str) -> Result<Self, ChannelError> {
        let path = path(run, name);
        let page = SharedPage::open(&path).map_err(|source| ChannelError::Io {
            what: "cannot reach the wake-up",
            path,
            source,
        })?;
        Ok(Self { page })
    }

    /// Calls the listener; says whether it slept and a system call had to wake it.
    pub fn wake(&self) -> bool {
        self.page.half(CALLS).fetch_add(1, SeqCst);
        let asleep = self.page.half(ASLEEP).load(SeqCst) != 0;
        if asleep {
            futex::wake(self.page.half(CALLS));
        }
        asleep
    }
}

/// Names may hold slashes; a file's name may not.
fn path(run: &Path, name: &str) -> PathBuf {
    run.join(format!("{:016x}.wake", fnv1a(name.as_bytes())))
}
