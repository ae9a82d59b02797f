//! What others tell a running node, without a lock.

use super::desk::Desk;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};

/// What others tell a running node.
#[derive(Debug)]
pub(super) struct Orders {
    pub(super) stop: AtomicBool,
    /// Nobody is left who could start, stop or watch anything.
    pub(super) launcher_gone: AtomicBool,
    /// News of each node of the graph, and whether there are any.
    news: Box<[News]>,
    any: AtomicBool,
    /// What is to be set, read or reset between two steps.
    pub(super) desk: Desk,
}

#[derive(Debug)]
struct News {
    state: AtomicU8,
    /// The message that the node did not send any more.
    next: AtomicU64,
}

/// A node is gone.
#[derive(Debug, Clone, Copy)]
pub(super) struct Absence {
    /// The message that it did not send any more: one from which that is known has been there since.
    pub(super) next: u64,
    pub(super) for_good: bool,
}

/// There is no news of the node.
const NONE: u8 = 0;
/// It is gone, and may come back.
const AWAY: u8 = 1;
/// It is gone for good.
const DEAD: u8 = 2;

impl Orders {
    pub(super) fn new(nodes: usize) -> Self {
        let news = |_| News { state: AtomicU8::new(NONE), next: AtomicU64::new(0) };
        Self {
            stop: AtomicBool::new(false),
            launcher_gone: AtomicBool::new(false),
            news: (0..nodes).map(news).collect(),
            any: AtomicBool::new(false),
            desk: Desk::new(),
        }
    }

    /// A node is gone before it sent message `next`.
    pub(super) fn gone(&self, node: usize, next: u64, back: bool) {
        let Some(news) = self.news.get(node) else { return };
        news.next.store(next, Ordering::Relaxed);
        news.state.store(if back { AWAY } else { DEAD }, Ordering::Release);
        self.any.store(true, Ordering::Release);
    }

    /// Whether there is news of any node since the last time that this was asked.
    pub(super) fn any(&self) -> bool {
        // A look costs nothing while there is none; a swap would take the line from whoever brings some.
        self.any.load(Ordering::Relaxed) && self.any.swap(false, Ordering::Acquire)
    }

    /// Takes the news that a node is gone. What comes meanwhile is there for the next time.
    pub(super) fn absence(&self, node: usize) -> Option<Absence> {
        let news = self.news.get(node)?;
        if news.state.load(Ordering::Relaxed) == NONE {
            return None;
        }
        match news.state.swap(NONE, Ordering::Acquire) {
            NONE => None,
            state => Some(Absence { next: news.next.load(Ordering::Relaxed), for_good: state == DEAD }),
        }
    }
}
