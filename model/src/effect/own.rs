//! Names of effects that system files add.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

/// The name of an effect that a system's file adds. Equal names are one effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Own(&'static str);

/// Every name there has been: an effect is a plain value, so its name lives as long as the program.
static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());

impl Own {
    /// The effect of this name.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let mut names = NAMES.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = names.get(name) {
            return Own(known);
        }
        let kept: &'static str = Box::leak(name.into());
        names.insert(kept);
        Own(kept)
    }

    /// Its name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.0
    }
}
