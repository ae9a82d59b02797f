//! Ending a diagnosis early: asked for from outside, heeded between fits, and what was left out is kept.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::report::Interrupted;

/// How a report calls sums of effects that were not tried.
pub(crate) const SEVERAL: &str = "several effects at once";

/// How a report calls what stands for causes without a name, where it was not tried.
pub(crate) const UNKNOWN: &str = "an unknown cause";

/// Whether a diagnosis shall end early, and what it left out for that.
#[derive(Clone, Debug, Default)]
pub struct Stop {
    /// Set by somebody else, at any time.
    asked: Option<Arc<AtomicBool>>,
    /// Shared by all copies.
    left_out: Arc<Mutex<BTreeSet<String>>>,
}

impl Stop {
    /// Heeds this flag.
    #[must_use]
    pub fn when(asked: Option<Arc<AtomicBool>>) -> Self {
        Stop { asked, left_out: Arc::default() }
    }

    /// Whether the diagnosis shall end.
    #[must_use]
    pub fn asked(&self) -> bool {
        self.asked.as_ref().is_some_and(|asked| asked.load(Ordering::Relaxed))
    }

    /// Whether to leave something out because the diagnosis shall end; if so, it is noted as left out.
    pub fn leaves_out(&self, what: impl FnOnce() -> String) -> bool {
        let asked = self.asked();
        if asked {
            self.left_out.lock().unwrap_or_else(PoisonError::into_inner).insert(what());
        }
        asked
    }

    /// What was left out, in alphabetical order, if anything was. An effect was not where one form of it was `weighed`.
    #[must_use]
    pub fn interrupted(&self, weighed: impl Fn(&String) -> bool) -> Option<Interrupted> {
        let left_out = self.left_out.lock().unwrap_or_else(PoisonError::into_inner);
        let not_tried: Vec<String> = left_out.iter().filter(|what| !weighed(what)).cloned().collect();
        (!not_tried.is_empty()).then_some(Interrupted { not_tried })
    }
}
